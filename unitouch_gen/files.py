"""Atomic writing of files, and reading of files, folders and tables with errors that name the argument."""

import csv
import errno
import io
import json
import math
import os
import re
import tempfile
import threading
import unicodedata
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from unitouch_gen.errors import (
    InvalidInputError,
    check_file,
    check_kind,
    describe,
    explain_errors,
    first_line,
    is_lfs_pointer,
)

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

NEVER_READ = ["*.bin", "*.ckpt", "*.pt", "*.pth", "*.h5", "*.msgpack", "*.onnx", "*.onnx_data"]
"""Files of repositories that are not fetched: pickles, and weights for other frameworks."""

LOADING_OPTIONS = (
    "adapter_kwargs",
    "allow_patterns",
    "cache_dir",
    "code_revision",
    "device_map",
    "disable_mmap",
    "dtype",
    "force_download",
    "ignore_patterns",
    "local_files_only",
    "low_cpu_mem_usage",
    "max_memory",
    "offload_folder",
    "offload_state_dict",
    "proxies",
    "quantization_config",
    "revision",
    "subfolder",
    "token",
    "torch_dtype",
    "trust_remote_code",
    "use_flashpack",
    "use_safetensors",
    "variant",
)
"""Options that every `from_pretrained` of diffusers or transformers accepts, and options of downloads."""

_LOADING = threading.RLock()  # libraries patch torch in all threads while they read networks


# Writing --------------------------------------------------------------------------------------------------------------

UNFINISHED = ".unfinished-save"
"""The plan of a save, in its folder while files take their places; it remains if the save is cut off."""


@contextmanager
def writing_to(name: str, target: Path) -> Iterator[None]:
    """Turns errors of writing into an `InvalidInputError` that names the argument."""
    try:
        yield
    except Exception as error:
        is_os_error = isinstance(error, OSError) or "(os error" in str(error)  # the latter from libraries in Rust
        is_name = isinstance(error, UnicodeEncodeError)  # those libraries take names in UTF-8
        if isinstance(error, InvalidInputError) or not (is_os_error or is_name):
            raise
        why = getattr(error, "strerror", None) or first_line(error)
        message = f"`{name}` cannot be written to {str(target)!r}: {why}. Nothing was changed."
        raise InvalidInputError(message) from error


@contextmanager
def replacing(name: str, file: Path) -> Iterator[Path]:
    """A path of the same name to write to, which replaces `file` when the block ends without an error.

    Raises `InvalidInputError` if it cannot be written, or is a folder or a device. The file is then unchanged.
    """
    target = Path(os.path.realpath(file))
    with writing_to(name, target):
        target.parent.mkdir(parents=True, exist_ok=True)
        check_replaceable(target)
        with tempfile.TemporaryDirectory(prefix=".", suffix=".partial", dir=target.parent) as hidden:
            partial = Path(hidden) / file.name
            yield partial
            set_permissions(partial, target)
            os.replace(partial, target)


def write_file(name: str, file: Path, content: str | bytes) -> Path:
    """Writes text, in UTF-8, or bytes, completely or not at all; returns the file."""
    with replacing(name, file) as partial:
        partial.write_bytes(content.encode() if isinstance(content, str) else content)
    return file


def check_writable(name: str, file: Path) -> None:
    """Raises `InvalidInputError`, before any work, if a file cannot be written. Nothing is left behind."""
    target = Path(os.path.realpath(file))
    with writing_to(name, target):
        check_replaceable(target)
        # os.path.exists is False for a name that is too long, where Path.exists raises.
        existing = next(parent for parent in target.parents if os.path.exists(parent))
        tempfile.TemporaryDirectory(prefix=".", suffix=".partial", dir=existing).cleanup()


def set_permissions(file: Path, destination: Path) -> None:
    """Gives a file the permissions of the file that it replaces, or of a new file; safetensors writes with 0600."""
    if os.path.exists(destination):
        mode = destination.stat().st_mode & 0o777
    else:
        probe = file.with_name(f".{file.name}.mode")
        probe.touch()
        mode = probe.stat().st_mode & 0o777
        probe.unlink()
    with suppress(OSError):  # raised by file systems without permissions
        file.chmod(mode)


def check_replaceable(file: Path) -> None:
    """Raises `FileExistsError` if there is something other than a file."""
    if os.path.exists(file) and not os.path.isfile(file):
        raise FileExistsError(errno.EEXIST, f"{file.name} is a folder or a device")


@contextmanager
def locked(folder: Path, *, shared: bool = False) -> Iterator[None]:
    """Holds a lock on a folder, so that saves do not mix with each other. Readers hold a `shared` lock.

    On a system without locks, it does nothing.
    """
    if fcntl is None or not os.path.isdir(folder):
        yield
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):  # raised by file systems without locks
            fcntl.flock(descriptor, fcntl.LOCK_SH if shared else fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def is_unfinished(folder: Path) -> bool:
    """Whether a save into a folder was cut off while its files took their places."""
    return os.path.exists(folder / UNFINISHED)


def finish_save(folder: Path) -> None:
    """Finishes a save whose plan is written: its files take their places, older weights of its components are removed.

    The folder has to be `locked`. Raises if the plan names paths outside of the folder.
    """
    if not is_unfinished(folder):
        return
    file = folder / UNFINISHED
    # What a plan holds may be of any type.
    with explain_errors(f"`{file}` is no plan of a save", "save again", ValueError, TypeError, LookupError):
        plan = json.loads(file.read_text())
        moves = [
            (path_inside(str(file), folder, hidden), path_inside(str(file), folder, destination))
            for hidden, destination in plan["moves"]
        ]
        removed = [path_inside(str(file), folder, place) for place in plan["removed"]]
    for hidden, destination in moves:
        if os.path.lexists(hidden):  # it has not been moved yet
            os.replace(hidden, destination)
    real_folder = os.path.realpath(folder)
    for older in removed:
        # A plan in a downloaded folder could name files behind a link.
        if os.path.commonpath([real_folder, os.path.realpath(older.parent)]) == real_folder:
            older.unlink(missing_ok=True)
    file.unlink()


def path_inside(name: str, folder: Path, place: str) -> Path:
    """The path of a `place` in a folder; raises if it leads out of the folder. `name` is the argument that holds it."""
    if Path(place).is_absolute() or ".." in Path(place).parts:
        raise InvalidInputError(f"`{name}` is {place!r}, which leads out of {str(folder)!r}; name a place in it.")
    return folder / place


# Reading --------------------------------------------------------------------------------------------------------------


def as_path(name: str, place: Any) -> Path:
    """The path passed as the argument `name`, with `~` as the home folder."""
    if not str(check_kind(name, place, str, os.PathLike)) or "\0" in str(place):
        raise InvalidInputError(f"`{name}` is {describe(str(place))}; it has to be the path of a file or folder.")
    return Path(place).expanduser()


def local_folder(name: str, place: str | os.PathLike, **options: Any) -> Path:
    """A folder as it is, or the local copy of a repository, without files that are `NEVER_READ`.

    `options` are those of `from_pretrained`, of which the options of downloads are used.
    """
    folder = as_path(name, place)
    if os.path.isdir(folder):  # unlike Path.is_dir, False for a name that is too long
        return folder
    if os.path.exists(folder) or str(place).count("/") != 1:
        wanted = "pass one, or a repository id such as owner/name"
        raise InvalidInputError(f"`{name}` is {str(place)!r}, which is no folder; {wanted}.")
    from huggingface_hub import snapshot_download

    names = ("cache_dir", "revision", "token", "local_files_only", "allow_patterns", "ignore_patterns")
    download_options: dict[str, Any] = {"ignore_patterns": NEVER_READ}
    for option in names:
        if options.get(option) is not None:
            download_options[option] = options[option]
    problem = f"`{name}` is {str(place)!r}, no folder here, and no repository that can be fetched"
    kinds = (OSError, ValueError, ImportError)  # ValueError: no id; ImportError: a SOCKS proxy
    with explain_errors(problem, "pass the path of a folder, or the id of a repository", *kinds):
        return Path(snapshot_download(str(place), **download_options))


def natural(path: str | Path) -> list[Any]:
    """A key to sort names by, with numbers in them as numbers: 2.png before 10.png."""
    parts = re.split(r"(\d+)", str(path))  # texts and numbers in turn
    return [int(part) if place % 2 else part for place, part in enumerate(parts)]


def files_below(folder: Path) -> list[Path]:
    """The files in a folder and below, in natural order, also behind links. Each folder is entered once.

    A folder that cannot be read counts as empty. A folder that is reached by its own name and by a link has its own
    name.
    """
    files = list[Path]()
    folders = [folder]
    links = list[Path]()
    entered = set[str]()
    while folders or links:
        current = folders.pop() if folders else links.pop(0)
        real_path = os.path.realpath(current)
        if real_path in entered:
            continue
        entered.add(real_path)
        for path in _entries_in(current):
            if os.path.isfile(path):
                files.append(path)
            elif os.path.islink(path) and os.path.isdir(path):
                links.append(path)
            elif os.path.isdir(path):
                folders.append(path)
    return sorted(files, key=natural)


def _entries_in(folder: Path) -> list[Path]:
    """The entries of a folder; none if it cannot be read."""
    try:
        return [folder / name for name in os.listdir(folder)]
    except OSError:
        return []


def find_file(folder: Path, name: str) -> Path:
    """The file of a name in a folder, also if the disk has another Unicode form of the name.

    Tables have composed letters (NFC). macOS and some archives leave decomposed ones (NFD) on disks.
    """
    path = folder
    for part in Path(name).parts:
        exact = path / part
        if not os.path.lexists(exact) and os.path.isdir(path):
            composed = unicodedata.normalize("NFC", part)
            same = (entry for entry in os.listdir(path) if unicodedata.normalize("NFC", entry) == composed)
            exact = path / next(same, part)
        path = exact
    return path


def is_hidden(path: Path) -> bool:
    """Whether a path is hidden, or left by a system or program for itself."""
    return any(part.startswith((".", "~$")) or part in ("@eaDir", "__MACOSX", "$RECYCLE.BIN") for part in path.parts)


def read_text(file: Path) -> str:
    """A text in UTF-8, or in UTF-16 as spreadsheets write it; empty if there is no file."""
    if not file.is_file():
        return ""
    check_file(file.name, file, "a text")
    content = file.read_bytes()
    with explain_errors(f"{str(file)!r} is not in UTF-8", "save it as UTF-8", UnicodeDecodeError):
        return content.decode("utf-16" if content.startswith((b"\xff\xfe", b"\xfe\xff")) else "utf-8-sig")


def read_table(file: Path, header: Sequence[str] | None = None) -> list[dict[str, str]]:
    """The rows of a table, by the names of its columns, without blank rows.

    Columns are separated by commas, semicolons or tabs. Their names are in the first line, or in `header`.
    """
    text = read_text(file)
    first, _, _ = text.lstrip().partition("\n")
    delimiter = max(",;\t", key=first.count)
    declaration = re.match(r'"?sep=(.)"?\r?\n', text)  # read by Excel
    if declaration:
        delimiter = declaration[1]
        text = text[declaration.end() :]
    lines = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter, strict=True)
    try:
        cells = [[cell.strip() for cell in row] for row in lines if any(map(str.strip, row))]
    except csv.Error as error:
        raise InvalidInputError(f"{str(file)!r} is no table: {error}, in line {lines.line_num}.") from error
    if header:
        names = list(header)
    else:
        names = [name.lower() for name in cells.pop(0)] if cells else []
        if len(names) > 1 and not names[0]:  # row numbers of pandas
            names = names[1:]
            cells = [row[1:] for row in cells]
    width = max(_filled_width(row) for row in (names, *cells))
    names = names[:width]
    cells = [row[:width] for row in cells]
    _check_cells(file, names, cells)
    return [dict(zip(names, row, strict=True)) for row in cells]


def _filled_width(row: Sequence[str]) -> int:
    """The number of cells of a row up to its last one that is not blank."""
    return max((place for place, cell in enumerate(row, start=1) if cell), default=0)


def _check_cells(file: Path, names: Sequence[str], cells: Sequence[Sequence[str]]) -> None:
    """Raises if a table has no rows, rows of other widths, or two columns of one name."""
    odd = [str(number) for number, row in enumerate(cells, start=1) if len(row) != len(names)]
    wrong = ""
    if not cells:
        wrong = "no rows"
    elif odd:
        wrong = f"another number of columns in row {', '.join(odd[:5])}; quote texts that hold commas"
    elif len(set(names)) < len(names):
        wrong = "two columns of one name"
    if wrong:
        raise InvalidInputError(f"{str(file)!r} has the columns {[*names]}, and {wrong}.")


def read_settings(name: str, file: Path, parse: Callable[[str], Any] = json.loads) -> dict[str, Any]:
    """The settings in a file in UTF-8: JSON, or another format with its parser."""
    check_file(name, file, "a settings file")
    problem = f"`{name}` names {str(file)!r}, which cannot be read"
    with explain_errors(problem, "pass a whole file of settings", Exception):  # parsers raise many kinds of errors
        return check_kind("content", parse(file.read_text(encoding="utf-8")), dict)


SAVED_FILES = {
    "network": (["config.json"], ["*.safetensors"]),
    "scheduler": (["scheduler_config.json"],),
    "processor": (["preprocessor_config.json"],),
    "tokenizer": (["tokenizer_config.json"], ["tokenizer.json", "vocab.*", "*.model"]),
}
"""Files of each kind of component, as lists of patterns; one file of each list is needed."""


def check_saved(folder: Path, kind: str) -> None:
    """Raises if a folder lacks one of the `SAVED_FILES` of a kind, as after an interrupted download.

    Without this check, transformers would build an empty tokenizer, or a network of its default size.
    """
    for patterns in SAVED_FILES[kind]:
        if not any(os.path.isfile(file) for pattern in patterns for file in folder.glob(pattern)):
            wanted = " or ".join(patterns)
            raise InvalidInputError(f"`{folder}` holds no {wanted}; it is not whole, so fetch or save it again.")


def check_filled(folder: Path, network: Any) -> None:
    """Raises if a folder's files lack weights of a network, which its library would initialise at random."""
    from safetensors import safe_open

    sizes: dict[str, int] = {}
    for path in folder.glob("*.safetensors"):
        with safe_open(path, framework="pt") as file:
            for name in file.keys():  # noqa: SIM118 - not a dict
                if ".base_layer." not in name and ".lora_" not in name:  # adapters, which are no part of the network
                    sizes[name] = math.prod(file.get_slice(name).get_shape())
    tensors = list(network.state_dict().values())
    # Tied weights are stored once.
    unique = {(tensor.data_ptr(), tensor.shape): tensor.numel() for tensor in tensors}
    stored = sum(sizes.values())
    expected = sum(unique.values())
    if stored < expected or any(tensor.is_meta for tensor in tensors):
        raise InvalidInputError(
            f"`{folder}` holds {stored} of the {expected} numbers of {type(network).__name__}; it is cut off or of "
            "another network."
        )


def read_network(kind: Any, folder: Path, **options: Any) -> Any:
    """A network of diffusers or transformers from its folder of safetensors.

    `options` are those of its `from_pretrained`. Raises if the folder does not hold the whole network.
    """
    check_saved(folder, "network")
    network = kind.from_pretrained(folder, use_safetensors=True, **options)
    check_filled(folder, network)
    return network


def class_name(settings: dict[str, Any]) -> Any:
    """The pipeline's class in a model_index.json, where it is a name, or on the Hub [module, name]."""
    name = settings.get("_class_name")
    return name[-1] if isinstance(name, list) and name else name


def model_files(place: Path) -> list[Path]:
    """A file itself, or the weights, settings and vocabularies in a folder and its components."""
    files = [place] if place.is_file() else [*place.glob("*"), *place.glob("*/*")]
    return [file for file in files if file.suffix in (".safetensors", ".json", ".txt") and file.is_file()]


@contextmanager
def reading(name: str, place: Any) -> Iterator[None]:
    """Runs a block in which libraries read networks, one at a time.

    Whatever they raise becomes an `InvalidInputError` that names the argument.
    """
    import torch

    folder = as_path(name, place)
    if is_unfinished(folder):
        with writing_to(name, folder), locked(folder):
            finish_save(folder)
    # Inference tensors can never be trained.
    with _LOADING, torch.inference_mode(False), locked(folder, shared=True):
        try:
            if os.path.isdir(folder):
                for file in sorted(folder.glob("*config.json")):
                    read_settings(name, file)  # the errors of libraries name no file, and a pipe would block them
            yield
        except Exception as error:  # readers raise many kinds of errors
            if isinstance(error, InvalidInputError) and str(error).startswith(f"`{name}` "):
                raise
            why = _why_unreadable(folder, error)
            raise InvalidInputError(f"`{name}` is {str(place)!r}, which cannot be loaded: {why}") from error


def _why_unreadable(folder: Path, error: Exception) -> str:
    """Why a folder's networks cannot be read."""
    for file in model_files(folder):
        if is_lfs_pointer(file):
            return f"{str(file)!r} is a Git LFS pointer; run `git lfs pull` in its repository."
    why = re.sub(r"^`pretrained_model_name_or_path` is .*?, which cannot be loaded: ", "", first_line(error))
    return why if os.path.isdir(folder) else f"{why} Pass a folder, or a repository id."
