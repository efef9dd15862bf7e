"""Files and folders: written so that whoever looks finds the old ones or the new ones, also after a kill, and read of
folders of models.

What is being written lies in a hidden folder beside its place, locked by its writer: one that is not is what a killed
writer left, and the next one removes it. A file takes its place by one rename. Where there are several, the hidden
folder gets a name that says that all is there, settings of before are removed, for no library to load what is half
replaced, and all is moved. What a killed process does not come to, our next reader or writer of the folder does.
"""

import errno
import functools
import inspect
import json
import logging
import os
import re
import shutil
import stat
import tempfile
import threading
import time
import uuid
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from safetensors import SafetensorError, safe_open

from unitouch_gen.errors import InvalidInputError, check_kind, describe, first_line

OPTIONS = ("cache_dir", "revision", "token", "local_files_only", "allow_patterns", "ignore_patterns")
"""What a fetch may be told, as huggingface_hub calls it."""

NEVER_READ = ["*.bin", "*.ckpt", "*.pt", "*.pth", "*.h5", "*.msgpack", "*.onnx", "*.onnx_data"]
"""Files of repositories that are not fetched: pickles, and weights for other frameworks."""

MOST_TRIES = 1000
"""To make a folder in one that others take away."""

READ_OPTIONS = (
    *OPTIONS, "dtype", "torch_dtype", "variant", "use_safetensors", "device_map", "max_memory", "low_cpu_mem_usage",
    "offload_folder", "offload_state_dict", "disable_mmap", "quantization_config", "use_flashpack", "force_download",
    "proxies", "trust_remote_code", "custom_pipeline", "custom_revision", "load_connected_pipeline", "use_onnx",
    "provider", "sess_options", "provider_options",
)  # fmt: skip
"""What readers of diffusers take beside the parts of a pipeline."""

OF_AUTO_CLASSES = ("adapter_kwargs", "code_revision", "_from_auto", "_commit_hash")
"""What transformers' `AutoModel` and its like pass beside that."""

SETTINGS = re.compile(r"(?:(?:\w+_)?config|model_index|.*\.index(?:\..*)?|\w*token\w*|vocab|defaults)\.json")
"""Names of the files that libraries read as settings, which are a dictionary each."""

SOUNDS = frozenset({".wav", ".flac", ".ogg", ".mp3"})
"""Suffixes of files that are taken for sounds in a folder."""

LARGEST_SETTINGS = 2**26
"""Bytes of such a file. Vocabularies are the largest, of up to a third of that."""

LARGEST_YAML = 2**20
"""Bytes; people write some thousand, and what has more is likely a checkpoint."""

LARGEST_SIZE, MOST_LAYERS = 10**7, 1000
"""What settings of networks may say of sizes, and of numbers of layers."""

AT_LEAST_ONE = ("layers_per_block", "norm_num_groups", "num_train_timesteps")
"""Settings that diffusers takes nothing for, until the network runs."""

DECLARED: dict[Any, Any] = {int: int, float: (int, float), str: str}
"""What settings hold where a class declares one kind."""

A_DAY = 24 * 60 * 60
"""Seconds."""

NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)

LOADING = threading.RLock()
"""Held while libraries read networks, for which they patch torch in all threads, and where a model loses parts."""

PARTIAL = re.compile(r"\.unitouch-(\w+)-\w+\.partial")
"""Names of hidden folders that are being written: on which system, and something random."""

COMPLETE = {False: ".unitouch-adds", True: ".unitouch-replaces"}
"""Names of those whose content is to be moved, by whether folders in it replace others or are added to them."""


# Writing --------------------------------------------------------------------------------------------------------------


@contextmanager
def writing(name: str, place: Path) -> Iterator[None]:
    """Makes errors of writing a place, which came in the argument `name`, an `InvalidInputError`."""
    try:
        yield
    except InvalidInputError:
        raise
    except Exception as error:  # torch's writer and libraries in Rust have no class of their own for it
        unnamed = isinstance(error, UnicodeEncodeError)  # in UTF-8, which the libraries in Rust ask for
        if not (isinstance(error, OSError) or unnamed) and not re.search(
            r"inline_container|\(os error \d+\)", str(error)
        ):
            raise
        why = getattr(error, "strerror", None) or first_line(error)
        room = "make room, or " if getattr(error, "errno", errno.ENOSPC) in NO_ROOM else ""
        todo = f"Nothing was changed; {room}name another place."
        raise InvalidInputError(f"`{name}` cannot be written to {str(place)!r}: {why}. {todo}") from error


def check_writable(name: str, file: Path, size: int = 2**20) -> None:
    """Checks, before any work, that a file, or several beside it, can be written; leaves nothing behind.

    Raises:
        InvalidInputError: If not, or its disk has less than `size` bytes; `name` is the argument that it came in.
    """
    with writing(name, file):
        if file.is_dir() or (_stream(file) and not os.access(file, os.W_OK)):
            raise OSError(errno.EACCES, "it is a folder" if file.is_dir() else os.strerror(errno.EACCES))
        if not _stream(file):
            with _hidden_folder(Path(os.path.realpath(file)).parent) as place:
                _check_room(place, size)
                allocate(place / file.name, min(size, 2**20))


def allocate(file: Path, size: int) -> None:
    """Gives a file its room on the disk, or raises an `OSError`: a mapped one that finds none ends the process."""
    _check_room(file.parent, size)
    with file.open("ab") as stream:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(stream.fileno(), 0, size)


@contextmanager
def replacing(name: str, file: Path, hidden: Path | None = None) -> Iterator[Path]:
    """A path to write to, which takes the place of a file when the block ends, and goes where it fails.

    It has the name of the file, in a hidden folder beside it. A link stays one, and the file that it leads to is
    replaced; what is no regular file, such as a device, is written to when the block ends, as is standard output.

    Args:
        name: Argument that the file came in, for the messages.
        file: The file.
        hidden: A `hidden_folder` on its disk, where many files are written one by one.

    Raises:
        InvalidInputError: If it cannot be written; what was there stays.
    """
    stream, target = _stream(file), Path(os.path.realpath(file))
    beside = target.parent if stream is None else Path(tempfile.gettempdir())
    with writing(name, file), _hidden_folder(beside) if hidden is None else nullcontext(hidden) as place:
        partial = place / file.name
        yield partial
        if stream is None:
            partial.replace(target)
        else:
            print(end="", flush=True)  # what came before on standard output
            with partial.open("rb") as source, open(stream, "wb", closefd=stream is file) as sink:
                shutil.copyfileobj(source, sink)


def write_file(name: str, file: Path, content: str | bytes) -> Path:
    """Writes text, in UTF-8, or bytes, and returns the file; see `replacing`."""
    with replacing(name, file) as partial:
        partial.write_bytes(content.encode() if isinstance(content, str) else content)
    return file


@contextmanager
def hidden_folder(name: str, folder: Path) -> Iterator[Path]:
    """An empty folder in another one, for what is to be moved from there; it goes with the block.

    Raises:
        InvalidInputError: If it cannot be made; `name` is the argument that the other one came in.
    """
    with ExitStack() as held:
        with writing(name, folder):
            place = held.enter_context(_hidden_folder(folder))
        yield place


@contextmanager
def appending(name: str, file: Path) -> Iterator[Callable[[str], None]]:
    """What appends lines to a file, all or, in a kill, the first of them; nobody else appends to it meanwhile.

    A last line that a kill, or a full disk, has cut short goes before.

    Raises:
        InvalidInputError: If it cannot be written, or another appends to it; `name` is the argument that it came in.
    """
    with ExitStack() as held:
        with writing(name, file):
            file.parent.mkdir(parents=True, exist_ok=True)
            stream = held.enter_context(file.open("ab", buffering=0))
            try:
                held.enter_context(_locked(file, wait=False))
            except BlockingIOError as error:
                raise InvalidInputError(
                    f"`{name}` is {str(file.parent)!r}, which another process writes to; wait for it, or end it."
                ) from error
            except (OSError, ImportError):  # there are no locks here
                pass
            written = file.read_bytes()
            stream.truncate(written.rfind(b"\n") + 1)

        def append(lines: str) -> None:
            with writing(name, file):
                left = lines.encode()
                while left:
                    left = left[stream.write(left) :]

        yield append


@contextmanager
def holding(name: str, folder: Path) -> Iterator[None]:
    """A block in a folder, made if it is not there, in which one process of all is at a time.

    Raises:
        InvalidInputError: If it cannot be made; `name` is the argument that it came in.
    """
    with ExitStack() as held:
        with writing(name, folder):
            folder.mkdir(parents=True, exist_ok=True)
            held.enter_context(_locked(folder))
        yield


@contextmanager
def writing_folder(name: str, folder: Path, size: int = 0, *, replace: bool = False) -> Iterator[Path]:
    """An empty folder to write to, whose files go into another one when the block ends, and nowhere where it fails.

    It lies in the other one. Files of the same names are replaced, as are weights that readers would take for a part of
    the new ones; others stay. For when a process is killed, see the top of this module and `complete_folder`.

    Args:
        name: Argument that the folder came in, for the messages.
        folder: Where the files are to go; made if it is not there. In a folder that is being written, it is written
            with that one.
        size: Bytes that are going to be written, as far as it is known.
        replace: Whether folders that it holds replace those of the same names, in place of being added to them.

    Raises:
        InvalidInputError: If the folder cannot be made or written to, or its disk is too small.
    """
    folder = folder.resolve()
    if any(PARTIAL.fullmatch(part) for part in folder.parts):
        folder.mkdir(parents=True, exist_ok=True)
        yield folder
        return
    with writing(name, folder), _hidden_folder(folder) as place:
        _check_room(folder, size)
        yield place
        for entry in _entries(place, replace):
            target = folder / entry
            if target.exists() and target.is_dir() != (place / entry).is_dir():
                raise OSError(errno.EEXIST, f"{entry} is a {'folder' if target.is_dir() else 'file'} there")
            target.parent.mkdir(parents=True, exist_ok=True)
            if target.parent.stat().st_dev != place.stat().st_dev:
                raise OSError(errno.EXDEV, f"{entry.parent} is on another disk")
        with _locked(folder):
            _complete(folder)
            place.rename(folder / COMPLETE[replace])
            _complete(folder)


def written_for(place: Path) -> Path:
    """The folder that the files in a hidden one of `writing_folder` go to; others are their own."""
    return place.parent if PARTIAL.fullmatch(place.name) else place


def complete_folder(folder: Path) -> None:
    """Does the rest where a `writing_folder` of this folder, or of the one around it, was killed as it moved its files.

    Raises:
        InvalidInputError: If it has to be done and cannot.
    """
    for place in (folder, folder.parent):
        if any((place / name).is_dir() for name in COMPLETE.values()):
            with _locked(place):
                _complete(place)


def _complete(folder: Path) -> None:
    """Moves what is all there into its place, in a folder that is locked; done again after a kill, it does the rest."""
    try:
        for replace, hidden in COMPLETE.items():
            entries = _entries(folder / hidden, replace)
            settings = [name for name in entries if name.suffix == ".json"]
            first = [name for name in settings if ".index." not in name.name]  # an index tells what is to go with it
            for name in [*first, *superseded(folder, folder / hidden, entries), *settings] if len(entries) > 1 else []:
                (folder / name).unlink(missing_ok=True)
            for name in entries:
                if (folder / name).is_dir():
                    (folder / name).unlink() if (folder / name).is_symlink() else shutil.rmtree(folder / name)
                (folder / hidden / name).replace(folder / name)
            shutil.rmtree(folder / hidden, ignore_errors=True)
    except OSError as error:
        raise InvalidInputError(
            f"`{folder}` is half replaced, and the rest cannot be moved into its place: {error.strerror or error}. It "
            "is whole again when it is loaded or written to where that works."
        ) from error


def _entries(folder: Path, whole: bool) -> list[Path]:
    """What a folder holds, itself or in all files below; settings last, as they name others, and outer ones."""
    found = folder.iterdir() if whole else (file for file in folder.rglob("*") if not file.is_dir())
    names = (file.relative_to(folder) for file in found) if folder.is_dir() else ()
    return sorted(names, key=lambda name: (name.suffix == ".json", -len(name.parts), name))


def saved_whole(save: Callable[..., Any]) -> Callable[..., Any]:
    """A `save_pretrained` that writes all of it or nothing, see `writing_folder`; uploads come after that."""

    @functools.wraps(save)  # with the signature, by which diffusers knows what it may pass
    def save_pretrained(
        self: Any, save_directory: str | os.PathLike, *args: Any, push_to_hub: bool = False, **kwargs: Any
    ) -> Any:
        folder = as_path("save_directory", save_directory)
        check_variant(kwargs.get("variant"))
        with writing_folder("save_directory", folder) as place:
            written = save(self, place, *args, **kwargs)
        if push_to_hub:
            known = inspect.signature(self.push_to_hub).parameters
            hub = {"repo_id": folder.resolve().name, **kwargs}
            self.push_to_hub(**{key: value for key, value in hub.items() if key in known})
        return written and [str(folder / Path(file).relative_to(place)) for file in written]

    return save_pretrained


@contextmanager
def _hidden_folder(folder: Path) -> Iterator[Path]:
    """An empty folder in another one, locked while its writer lives; it goes with the block, as do parents made for it.

    Those that writers before have left go, too: ones of this system that are not locked, and of others after a day.
    """
    for above in (folder, *folder.parents):
        if above.exists() and not above.is_dir():
            raise NotADirectoryError(errno.ENOTDIR, f"{above} is a file")
    made = [above for above in (folder, *folder.parents) if not above.exists()]
    system, place, tries = running_system(), None, 0
    with ExitStack() as lock:
        try:
            while place is None or not place.exists():  # others may take it away before it is locked, and its parents
                folder.mkdir(parents=True, exist_ok=True)
                _remove_left(folder, system)
                tries += 1  # /proc, too, says that nothing is there where nothing can be made
                with suppress(FileNotFoundError) if tries < MOST_TRIES else nullcontext():
                    place = Path(tempfile.mkdtemp(".partial", f".unitouch-{system}-", folder))
                    lock.enter_context(_locked(place))
            yield place
        finally:
            if place is not None:
                shutil.rmtree(place, ignore_errors=True)
            for parent in made:
                with suppress(OSError):  # there is something in it
                    parent.rmdir()


def _remove_left(folder: Path, system: str) -> None:
    for left in folder.glob(".unitouch-*.partial"):
        name = PARTIAL.fullmatch(left.name)
        with suppress(OSError, ImportError):  # its writer lives, or another is just removing it
            if name and (name[1] == system or time.time() - left.stat().st_mtime > A_DAY):
                with _locked(left, wait=False):
                    shutil.rmtree(left)


def running_system() -> str:
    """Names the kernel: locks are seen by all that runs on it, also in other containers, and by nothing else."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii")[:8]
    except OSError:
        return f"{uuid.getnode():x}"


@contextmanager
def _locked(folder: Path, *, wait: bool = True) -> Iterator[None]:
    """Holds the lock of a folder, which goes with the process at the latest; does without where there are none.

    Where nothing is to be waited for, it raises an error if another holds it, or there are none.
    """
    with ExitStack() as held:
        try:
            import fcntl  # which Windows has not

            descriptor = os.open(folder, os.O_RDONLY)
            held.callback(os.close, descriptor)
            fcntl.flock(descriptor, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
            held.callback(fcntl.flock, descriptor, fcntl.LOCK_UN)  # a process forked meanwhile has it open, too
        except (OSError, ImportError):
            if not wait:
                raise
        yield


def _stream(file: Path) -> Path | int | None:
    """What to write to in place of replacing a file: a device or pipe itself, or where this process prints to."""
    try:
        found = file.stat()
    except OSError:
        return None
    for descriptor in (1, 2):
        with suppress(OSError):
            if os.path.samestat(found, os.fstat(descriptor)):
                return descriptor
    return None if stat.S_ISREG(found.st_mode) or stat.S_ISDIR(found.st_mode) else file


def _check_room(folder: Path, size: int) -> None:
    free = shutil.disk_usage(folder).free
    if free < size:
        raise OSError(errno.ENOSPC, f"{size / 1e6:.1f} MB are needed and {free / 1e6:.1f} MB free")


# Reading --------------------------------------------------------------------------------------------------------------


def as_path(name: str, place: Any) -> Path:
    """A path, whether something is there or not.

    Raises:
        InvalidTypeError: If it is no string or path.
        InvalidInputError: If no file system has such names.
    """
    path = Path(check_kind(name, place, str, os.PathLike))
    try:
        path.lstat()
    except (OSError, ValueError) as error:
        if isinstance(error, ValueError) or error.errno == errno.ENAMETOOLONG:  # in no encoding, or with a zero
            why = getattr(error, "strerror", None) or first_line(error)  # without the name once more
            raise InvalidInputError(f"`{name}` is {describe(str(place))}, no path at all: {why}.") from error
    return path


ADDRESS = re.compile(r"[A-Za-z][\w+.-]+:/")
"""How addresses begin, also where a path has taken one of their two slashes; a drive has a single letter."""


def check_no_address(name: str, place: str | os.PathLike) -> None:
    """Refuses what is on the web.

    Raises:
        InvalidInputError: If it is an address, and no file of that name.
    """
    if ADDRESS.match(str(place)) and not os.path.lexists(place):
        raise InvalidInputError(
            f"`{name}` is {describe(str(place))}, an address, and nothing is fetched from there; download it, and pass "
            "the path of the file."
        )


def check_variant(variant: Any) -> None:
    """Refuses what cannot stand in the names of weights: they have it between two dots.

    Raises:
        InvalidInputError, InvalidTypeError: Unless it is a word, or `None`.
    """
    if variant is not None and not re.fullmatch(r"[\w-]{1,100}", check_kind("variant", variant, str)):
        raise InvalidInputError(f'`variant` is {describe(variant)}; it has to be a word, such as "fp16".')


def local_folder(name: str, place: str | os.PathLike, **options: Any) -> Path:
    """A folder as it is, or the copy of a repository.

    Args:
        name: Argument that the place came in, for the messages.
        place: Path or repository id.
        options: What a fetch may be told; others than `OPTIONS`, and those that are `None`, are left out. Where no
            `ignore_patterns` come, files that are `NEVER_READ` stay where they are.

    Raises:
        InvalidInputError: If it is neither a folder nor the id of a repository that can be fetched.
    """
    folder = as_path(name, place)
    complete_folder(folder)
    if folder.is_dir():
        return folder
    if folder.is_file():
        raise InvalidInputError(
            f"`{name}` is {str(place)!r}, which is a file; pass a folder, such as `unitouch-gen convert` makes of a "
            "checkpoint."
        )
    from huggingface_hub import snapshot_download
    from huggingface_hub.utils import validate_repo_id

    try:
        if str(place).startswith((".", "/", "~")):
            raise ValueError(place)
        validate_repo_id(str(place))
    except ValueError as error:
        raise InvalidInputError(
            f"`{name}` is {str(place)!r}, which is no folder and no repository id; pass one of them."
        ) from error
    known = {key: value for key, value in options.items() if key in OPTIONS and value is not None}
    known.setdefault("ignore_patterns", NEVER_READ)
    try:
        return Path(snapshot_download(str(place), **known))
    except OSError as error:
        raise InvalidInputError(
            f"`{name}` is {str(place)!r}, which is no folder here, and no repository of that id could be fetched: "
            f"{first_line(error)}"
        ) from error


def check_file(name: str, path: str | os.PathLike, what: str) -> None:
    """Refuses a path where there is no file, and an address.

    Args:
        name: Argument that it came in, for the message.
        path: Of the file.
        what: It should be, for the message: "an image file".

    Raises:
        InvalidInputError: If there is none, or it is an address.
    """
    check_no_address(name, path)
    if not os.path.isfile(path):  # unlike Path.is_file, False for a name that is too long
        why = "is a folder" if os.path.isdir(path) else "does not exist"
        raise InvalidInputError(f"`{name}` names {describe(str(path))}, which {why}; pass the path of {what}.")


def natural(path: str | Path) -> list[Any]:
    """A key to sort names by, with numbers in them as numbers: 2.png before 10.png."""
    return [int(part) if place % 2 else part for place, part in enumerate(re.split(r"(\d+)", str(path)))]


def read_text(name: str, file: Path, what: str, most: int) -> str:
    """The text, in UTF-8, of a file that has an end: no device, no pipe, and nothing larger than settings are.

    Args:
        name: Argument that the file or its folder came in, for the message.
        file: To read.
        what: The format, for the message.
        most: Bytes.

    Raises:
        InvalidInputError: If it cannot be read.
    """
    named = f"`{name}` names {str(as_path(name, file))!r}, which"
    if not os.path.isfile(file):
        kind = "is a folder" if os.path.isdir(file) else "is no regular file" if file.exists() else "does not exist"
        raise InvalidInputError(f"{named} {kind}.")
    try:
        with file.open("rb") as stream:
            found = stream.read(most + 1)  # some say that they hold nothing, and never end
        text = found.decode()
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidInputError(f"{named} cannot be read as {what}: {first_line(error)}.") from error
    if len(found) > most:
        raise InvalidInputError(f"{named} has {file.stat().st_size} bytes; settings have at most {most}.")
    return text


def read_json(name: str, file: Path) -> dict[str, Any]:
    """The settings in a JSON file of such a folder; see `read_text`.

    Raises:
        InvalidInputError: If it cannot be read, or holds something else.
    """
    return _read_settings(name, file, "JSON", json.loads, LARGEST_SETTINGS)


def drop_setting(file: Path, setting: str) -> None:
    """Takes a setting out of the JSON file that a library wrote of a part's; the others are sorted, as by diffusers."""
    settings = read_json("config", file)
    settings.pop(setting, None)
    file.write_text(json.dumps(settings, indent=2, sort_keys=True) + "\n", encoding="utf-8")


def read_yaml(name: str, file: Path) -> dict[str, Any]:
    """The settings in a YAML file; see `read_text`.

    Raises:
        InvalidInputError: If it cannot be read, or holds something else.
    """
    import yaml

    return _read_settings(name, file, "YAML", yaml.safe_load, LARGEST_YAML)


def _read_settings(name: str, file: Path, what: str, load: Callable[[str], Any], most: int) -> dict[str, Any]:
    text, named = read_text(name, file, what, most), f"`{name}` names {str(file)!r}, which"
    try:
        found = load(text)
        json.dumps(found, default=str, skipkeys=True)  # YAML may hold itself
    except Exception as error:  # of the format, of dates, of integers of thousands of digits
        raise InvalidInputError(f"{named} cannot be read as {what}: {first_line(error)}.") from error
    if not isinstance(found, dict):
        raise InvalidInputError(f"{named} holds {describe(found)} and no settings.")
    return found


@contextmanager
def reading(name: str, place: Any) -> Iterator[None]:
    """For libraries to read a folder of models, or a repository, one at a time: all that goes wrong becomes one error.

    The folder's settings are read before, and what has no end, or makes networks of more than could be there, refused.

    Args:
        name: Argument that the place came in, for the message.
        place: Path or repository id.

    Raises:
        InvalidInputError: If the block raises anything, with the first line of that.
    """
    folder, logger = as_path(name, place), logging.getLogger("diffusers.models.modeling_utils")
    with LOADING, ExitStack() as filtered:
        quiet = _Quiet()  # one of this block's own, as a pipeline's block holds those of its parts
        logger.addFilter(quiet)
        filtered.callback(logger.removeFilter, quiet)
        try:
            complete_folder(folder)
            for file in sorted([*folder.glob("*.json"), *folder.glob("[!.]*/*.json")]):
                if SETTINGS.fullmatch(file.name):
                    settings = read_json(name, file)
                    if file.name in ("config.json", "scheduler_config.json"):
                        check_sizes(str(file), settings)
                        check_kinds(str(file), settings)
            yield
        except MemoryError:
            raise
        except Exception as error:  # of as many kinds as there are readers
            if isinstance(error, InvalidInputError) and str(error).startswith(f"`{name}` "):
                raise
            hint = "" if folder.is_dir() else " Pass a folder that `save_pretrained` wrote, or a repository id."
            said = f"is {str(place)!r}, which cannot be loaded: "
            reason = first_line(error).removeprefix(f"`pretrained_model_name_or_path` {said}")  # one inside the other
            raise InvalidInputError(f"`{name}` {said}{reason}{hint}") from error


class _Quiet(logging.Filter):
    """Leaves out errors, as what is logged of them is raised as well."""

    def filter(self, record: logging.LogRecord) -> bool:
        return record.levelno < logging.ERROR


def check_sizes(name: str, value: Any, key: str = "") -> None:
    """Refuses settings of networks that would take their time or memory before anybody sees that they do not fit.

    Raises:
        InvalidInputError: If one asks for more than `MOST_LAYERS` or `LARGEST_SIZE`, or for none of `AT_LEAST_ONE`.
    """
    for inner, held in value.items() if isinstance(value, dict) else ((key, value),):
        if isinstance(held, dict):
            check_sizes(name, held)
        elif isinstance(held, list):
            for item in held:
                check_sizes(name, item, str(inner))
        elif isinstance(held, int) and abs(held) > (most := MOST_LAYERS if "layers" in str(inner) else LARGEST_SIZE):
            raise InvalidInputError(f"`{name}` says that `{inner}` is {describe(held)}; it may be at most {most}.")
        elif inner in AT_LEAST_ONE and isinstance(held, int) and held < 1:
            raise InvalidInputError(f"`{name}` says that `{inner}` is {held}; it has to be at least 1.")


def check_kinds(name: str, settings: dict[str, Any]) -> None:
    """Refuses settings of another kind than their class in diffusers declares, which would fail when it runs.

    What may be of several kinds, or `None`, is left to the class, but for flags in the place of numbers.

    Raises:
        InvalidInputError: If one is no number or string where it has to be, or none of the words that there are.
    """
    import diffusers

    kind = getattr(diffusers, str(settings.get("_class_name")), None)
    for key, argument in inspect.signature(kind).parameters.items() if isinstance(kind, type) else ():
        value, wanted = settings.get(key, argument.default), argument.annotation
        if value is argument.default:
            continue
        kinds = kinds_in(wanted) | {type(argument.default)}
        if holds_flag(value) and kinds & {int, float} and bool not in kinds:  # Python counts `True` among integers
            raise InvalidInputError(f"`{name}` says that `{key}` is {describe(value)}; it has to be of numbers.")
        if argument.default is None:
            continue
        words = get_args(wanted) if get_origin(wanted) is Literal else None
        if (wanted in DECLARED and not isinstance(value, DECLARED[wanted])) or (words and value not in words):
            declared = f"one of {', '.join(map(repr, words))}" if words else f"a {wanted.__name__}"
            raise InvalidInputError(f"`{name}` says that `{key}` is {describe(value)}; it has to be {declared}.")


def kinds_in(annotation: Any) -> set[Any]:
    """All that an annotation is made of: {int, None, ...} of `tuple[int] | None`."""
    return {annotation}.union(*map(kinds_in, get_args(annotation)))


def holds_flag(value: Any) -> bool:
    """Whether it is `True` or `False`, or a list with one in it."""
    return isinstance(value, bool) or (isinstance(value, list | tuple) and any(map(holds_flag, value)))


def names_of_weights(stem: str = "model", variant: str | None = None) -> tuple[str, str]:
    """What transformers and diffusers call a single file of weights, and the index of several."""
    part = "" if variant is None else f".{variant}"
    return f"{stem}{part}.safetensors", f"{stem}.safetensors.index{part}.json"


def weight_map_of(index: Path) -> dict[str, str]:
    """The file of each tensor, by an index of transformers' kind; none where there is no index.

    Raises:
        InvalidInputError: If the index cannot be read, or names a file elsewhere.
    """
    if not index.is_file():
        return {}
    weight_map = read_json("source", index).get("weight_map")
    if not isinstance(weight_map, dict):
        raise InvalidInputError(f"`{index}` holds no `weight_map`; it is no index of weights.")
    for file in weight_map.values():
        if not isinstance(file, str) or Path(file).name != file or file == "..":
            raise InvalidInputError(f"`{index}` names {file!r}, which is not in its folder; do not trust it.")
    return weight_map


WEIGHTS = re.compile(r"([^.]+)(?:\.safetensors\.index(?:\.([^.]+))?\.json|(?:\.([^.]+))?\.safetensors)")
"""Such names: what they begin with, and the variant in that of an index, or of a file."""


def superseded(folder: Path, source: Path, new: Iterable[Path]) -> list[Path]:
    """Weights in a folder that readers could take for new ones of `source`: a file for shards, and shards of before."""
    kept, found = set(new), list[Path]()
    for file in new:
        if name := WEIGHTS.fullmatch(file.name):
            single, index = (file.with_name(other) for other in names_of_weights(name[1], name[2] or name[3]))
            with suppress(InvalidInputError):  # it is damaged, and goes
                found += {file.with_name(shard) for shard in weight_map_of(folder / index).values()}
            found += [single, index]
            kept |= {file.with_name(shard) for shard in weight_map_of(source / index).values()}
    return [file for file in found if file not in kept]


def shards(source: Path, prefix: str = "", variant: str | None = None) -> dict[Path, list[str]]:
    """The safetensors files of a folder with the keys in each that start with `prefix`, if it has any.

    Raises:
        InvalidInputError: If the folder holds no weights, or its index names a file elsewhere.
    """
    single, index = (source / name for name in names_of_weights(variant=variant))
    if index.is_file():
        files: dict[Path, list[str]] = {}
        for key, file in weight_map_of(index).items():
            if key.startswith(prefix):
                files.setdefault(source / file, []).append(key)
        return files
    if not single.is_file():
        raise InvalidInputError(f"`{source}` holds no {single.name}; pass the folder that `save_pretrained` wrote.")
    with open_weights(single) as weights:
        keys = [key for key in weights.keys() if key.startswith(prefix)]  # noqa: SIM118 - not a dict
    return {single: keys} if keys else {}


@contextmanager
def open_weights(file: Path) -> Iterator[Any]:
    """A file of safetensors, open.

    Raises:
        InvalidInputError: If it is not there, or does not hold what it says.
    """
    if not file.is_file():
        raise InvalidInputError(f"`{file}` is missing, or no file; copy the whole folder again.")
    try:
        with safe_open(file, framework="pt") as weights:
            yield weights
    except (SafetensorError, OSError) as error:
        raise InvalidInputError(
            f"`{file}` does not hold what it says: {error}. It is cut off or damaged; write it again."
        ) from error
