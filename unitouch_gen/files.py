"""Files that are written whole, and files, folders and tables that are read with errors that name the argument."""

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

from unitouch_gen.errors import InvalidInputError, check_file, check_kind, describe, first_line, is_lfs_pointer

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
"""Options that diffusers and transformers pass to every `from_pretrained`, and those of downloads."""

_LOADING = threading.RLock()  # libraries patch torch in all threads while they read networks


# Writing --------------------------------------------------------------------------------------------------------------

UNFINISHED = ".unfinished-save"
"""Lies in a folder while files of a save take their places, and says which; stays there if the save is cut off."""


@contextmanager
def writing_to(name: str, target: Path) -> Iterator[None]:
    """Turns errors of writing into one that names the argument."""
    try:
        yield
    except Exception as error:
        is_os_error = isinstance(error, OSError) or "(os error" in str(error)  # the second of libraries in Rust
        is_name = isinstance(error, UnicodeEncodeError)  # of which these want UTF-8
        if isinstance(error, InvalidInputError) or not (is_os_error or is_name):
            raise
        why = getattr(error, "strerror", None) or first_line(error)
        raise InvalidInputError(
            f"`{name}` cannot be written to {str(target)!r}: {why}. Nothing was changed."
        ) from error


@contextmanager
def replacing(name: str, file: Path) -> Iterator[Path]:
    """A path of the same name to write to, which takes the place of a file when the block ends without an error.

    Raises `InvalidInputError` if it cannot be written, or is a folder or a device; what was there stays.
    """
    target = Path(os.path.realpath(file))
    with writing_to(name, target):
        target.parent.mkdir(parents=True, exist_ok=True)
        check_replaceable(target)
        with tempfile.TemporaryDirectory(prefix=".", suffix=".partial", dir=target.parent) as hidden:
            partial = Path(hidden) / file.name
            yield partial
            share_as_usual(partial, target)
            os.replace(partial, target)


def write_file(name: str, file: Path, content: str | bytes) -> Path:
    """Writes text, in UTF-8, or bytes, whole or not at all; returns the file."""
    with replacing(name, file) as partial:
        partial.write_bytes(content.encode() if isinstance(content, str) else content)
    return file


def check_writable(name: str, file: Path) -> None:
    """Raises `InvalidInputError`, before any work, if a file cannot be written; leaves nothing behind."""
    target = Path(os.path.realpath(file))
    with writing_to(name, target):
        check_replaceable(target)
        # os.path.exists is False for a name that is too long, where Path.exists raises.
        above = next(parent for parent in target.parents if os.path.exists(parent))
        tempfile.TemporaryDirectory(prefix=".", suffix=".partial", dir=above).cleanup()


def share_as_usual(file: Path, destination: Path) -> None:
    """Gives a file the permissions of the one that it replaces, or of a new one; safetensors' own are 0600."""
    if os.path.exists(destination):
        mode = destination.stat().st_mode & 0o777
    else:
        probe = file.with_name(f".{file.name}.mode")
        probe.touch()
        mode = probe.stat().st_mode & 0o777
        probe.unlink()
    with suppress(OSError):  # of file systems without permissions
        file.chmod(mode)


def check_replaceable(file: Path) -> None:
    """Raises `FileExistsError` where there is something other than a file."""
    if os.path.exists(file) and not os.path.isfile(file):
        raise FileExistsError(errno.EEXIST, f"{file.name} is a folder or a device")


@contextmanager
def locked(folder: Path, *, shared: bool = False) -> Iterator[None]:
    """Holds a lock on a folder, so that saves do not mix with each other or, `shared`, with a reader.

    Without one where the system has none.
    """
    if fcntl is None or not os.path.isdir(folder):
        yield
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):  # of file systems without locks
            fcntl.flock(descriptor, fcntl.LOCK_SH if shared else fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def is_unfinished(folder: Path) -> bool:
    """Whether a save into a folder was cut off while its files took their places."""
    return os.path.exists(folder / UNFINISHED)


def finish_save(folder: Path) -> None:
    """Finishes a save that was decided: its files take their places, and older weights of the same components go.

    The folder is `locked`. A plan that leads out of the folder is refused.
    """
    if not is_unfinished(folder):
        return
    try:
        plan = json.loads((folder / UNFINISHED).read_text())
        parts = [*(part for move in plan["moves"] for part in move), *plan["removed"]]
        moves = [(folder / beside, folder / destination) for beside, destination in plan["moves"]]
        removed = [folder / part for part in plan["removed"]]
    except (ValueError, TypeError, LookupError) as error:
        raise InvalidInputError(f"`{folder / UNFINISHED}` is no plan of a save; save again.") from error
    if any(Path(part).is_absolute() or ".." in Path(part).parts for part in parts):
        raise InvalidInputError(f"`{folder / UNFINISHED}` leads out of its folder.")
    for beside, destination in moves:
        if os.path.lexists(beside):  # and is not in its place yet
            os.replace(beside, destination)
    inside = os.path.realpath(folder)
    for file in removed:
        # A plan that came with a downloaded folder could name files behind a link.
        if os.path.commonpath([inside, os.path.realpath(file.parent)]) == inside:
            file.unlink(missing_ok=True)
    (folder / UNFINISHED).unlink()


# Reading --------------------------------------------------------------------------------------------------------------


def as_path(name: str, place: Any) -> Path:
    """The path passed as the argument `name`, with `~` as the home folder."""
    if not str(check_kind(name, place, str, os.PathLike)) or "\0" in str(place):
        raise InvalidInputError(f"`{name}` is {describe(str(place))}; it has to be the path of a file or folder.")
    return Path(place).expanduser()


def local_folder(name: str, place: str | os.PathLike, **options: Any) -> Path:
    """A folder as it is, or the local copy of a repository, without files that are `NEVER_READ`.

    Of the options, which are those of `from_pretrained`, the ones of a fetch are used.
    """
    folder = as_path(name, place)
    if os.path.isdir(folder):  # unlike Path.is_dir, False for a name that is too long
        return folder
    if os.path.exists(folder):
        raise InvalidInputError(f"`{name}` is {str(place)!r}, which is no folder; pass one, or a repository id.")
    from huggingface_hub import snapshot_download

    known = ("cache_dir", "revision", "token", "local_files_only", "allow_patterns", "ignore_patterns")
    given = {key: options[key] for key in known if options.get(key) is not None}
    try:
        return Path(snapshot_download(str(place), **{"ignore_patterns": NEVER_READ, **given}))
    except (OSError, ValueError, ImportError) as error:  # the last two: of what is no id, of a proxy by SOCKS
        why = f"no folder here, and no repository that can be fetched: {first_line(error)}"
        raise InvalidInputError(f"`{name}` is {str(place)!r}, {why}") from error


def natural(path: str | Path) -> list[Any]:
    """A key to sort names by, with numbers in them as numbers: 2.png before 10.png."""
    return [int(part) if place % 2 else part for place, part in enumerate(re.split(r"(\d+)", str(path)))]


def files_below(folder: Path) -> list[Path]:
    """The files in a folder and those below, in natural order; also behind links, where each folder is entered once.

    A folder that may not be read counts as empty. One that is there by its own name and behind a link goes by its own.
    """
    files: list[Path] = []
    waiting = [folder]
    links: list[Path] = []
    entered = set[str]()
    while waiting or links:
        place = waiting.pop() if waiting else links.pop(0)
        real = os.path.realpath(place)
        if real in entered:
            continue
        entered.add(real)
        with suppress(OSError), os.scandir(place) as entries:
            for entry in entries:
                path = place / entry.name
                if os.path.isfile(path):
                    files.append(path)
                elif os.path.isdir(path):
                    (links if entry.is_symlink() else waiting).append(path)
    return sorted(files, key=natural)


def find_file(folder: Path, name: str) -> Path:
    """The file of a name in a folder, also where the disk composes its letters in another way than a table does.

    Tables hold composed letters (NFC); macOS and some archives leave decomposed ones (NFD) on disks.
    """
    found = folder
    for part in Path(name).parts:
        exact = found / part
        if not os.path.lexists(exact) and os.path.isdir(found):
            wanted = unicodedata.normalize("NFC", part)
            same = (other for other in os.listdir(found) if unicodedata.normalize("NFC", other) == wanted)
            exact = found / next(same, part)
        found = exact
    return found


def is_hidden(path: Path) -> bool:
    """Whether a path in a folder of the user's is what systems and programs leave there for themselves."""
    return any(part.startswith((".", "~$")) or part in ("@eaDir", "__MACOSX", "$RECYCLE.BIN") for part in path.parts)


def read_text(file: Path) -> str:
    """A text in UTF-8, or in UTF-16 as spreadsheets write it; nothing where there is no file."""
    content = file.read_bytes() if file.is_file() else b""
    if file.is_file() and is_lfs_pointer(file):
        raise InvalidInputError(f"{str(file)!r} is a Git LFS pointer; run `git lfs pull` in its repository.")
    try:
        return content.decode("utf-16" if content.startswith((b"\xff\xfe", b"\xfe\xff")) else "utf-8-sig")
    except UnicodeDecodeError as error:
        raise InvalidInputError(f"{str(file)!r} is not in UTF-8; save it as UTF-8.") from error


def read_table(file: Path, header: Sequence[str] | None = None) -> list[dict[str, str]]:
    """The rows of a table, parted by commas, semicolons or tabs, by the names in its first line; without blank ones."""
    text = read_text(file)
    if said := re.match(r'"?sep=(.)"?\r?\n', text):  # to Excel
        text = text[said.end() :]
    delimiter = said[1] if said else max(",;\t", key=text.lstrip().partition("\n")[0].count)
    lines = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter, strict=True)
    try:
        cells = [[cell.strip() for cell in row] for row in lines if any(map(str.strip, row))]
    except csv.Error as error:
        raise InvalidInputError(f"{str(file)!r} is no table: {error}, in line {lines.line_num}.") from error
    names = header or [name.lower() for name in (cells.pop(0) if cells else ())]
    if not header and len(names) > 1 and not names[0]:  # the row numbers of pandas
        names = names[1:]
        cells = [row[1:] for row in cells]
    width = max((place for row in (names, *cells) for place, cell in enumerate(row, start=1) if cell), default=0)
    names = names[:width]
    cells = [row[:width] for row in cells]
    odd = [str(number) for number, row in enumerate(cells, start=1) if len(row) != len(names)]
    if not cells or odd or len(set(names)) < len(names):
        wrong = f"other columns in row {', '.join(odd[:5])}; quote texts that hold commas" if odd else "two of one name"
        raise InvalidInputError(f"{str(file)!r} has the columns {[*names]}, and {wrong if cells else 'no rows'}.")
    return [dict(zip(names, row, strict=True)) for row in cells]


def read_settings(name: str, file: Path, parse: Callable[[str], Any] = json.loads) -> dict[str, Any]:
    """The settings in a file in UTF-8: JSON, or what another parser reads."""
    check_file(name, file, "a settings file")
    try:
        found = parse(file.read_text(encoding="utf-8"))
        if not isinstance(found, dict):
            raise ValueError(f"it holds {describe(found)} and no settings")
    except Exception as error:  # of the format, of dates, of integers of thousands of digits
        why = first_line(error)
        raise InvalidInputError(f"`{name}` names {str(file)!r}, which cannot be read: {why}.") from error
    return found


SAVED_FILES = {
    "network": (["config.json"], ["*.safetensors"]),
    "scheduler": (["scheduler_config.json"],),
    "processor": (["preprocessor_config.json"],),
    "tokenizer": (["tokenizer_config.json"], ["tokenizer.json", "vocab.*", "*.model"]),
}
"""Files of each kind of component, as patterns; of those in one list, any will do."""


def check_saved(folder: Path, kind: str) -> None:
    """Raises if a folder lacks one of the `SAVED_FILES` of a kind, as after a download that stopped.

    Without them, transformers builds an empty tokenizer, or a network of its default size.
    """
    for patterns in SAVED_FILES[kind]:
        if not any(os.path.isfile(file) for pattern in patterns for file in folder.glob(pattern)):
            wanted = " or ".join(patterns)
            raise InvalidInputError(f"`{folder}` holds no {wanted}; it is not whole, so fetch or save it again.")


def check_filled(folder: Path, network: Any) -> None:
    """Raises if a folder's files lack numbers of a network, which its library would draw at random."""
    from safetensors import safe_open

    sizes: dict[str, int] = {}
    for path in folder.glob("*.safetensors"):
        with safe_open(path, framework="pt") as file:
            for name in file.keys():  # noqa: SIM118 - not a dict
                if ".base_layer." not in name and ".lora_" not in name:  # of no network by itself
                    sizes[name] = math.prod(file.get_slice(name).get_shape())
    tensors = [*network.state_dict().values()]
    lacking = [one for one in tensors if one.is_meta]
    # Tied weights are stored once.
    held = sum(sizes.values())
    wanted = sum({(one.data_ptr(), one.shape): one.numel() for one in tensors}.values())
    if lacking or held < wanted:
        raise InvalidInputError(
            f"`{folder}` holds {held} of the {wanted} numbers of {type(network).__name__}; it is cut off or of another "
            "network."
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
    """The pipeline's class that a model_index.json names: a text, or [module, class] on the Hub."""
    name = settings.get("_class_name")
    return name[-1] if isinstance(name, list) and name else name


def model_files(place: Path) -> list[Path]:
    """A file itself, or the weights, settings and vocabularies in a folder and its components."""
    files = [place] if place.is_file() else [*place.glob("*"), *place.glob("*/*")]
    return [file for file in files if file.suffix in (".safetensors", ".json", ".txt") and file.is_file()]


@contextmanager
def reading(name: str, place: Any) -> Iterator[None]:
    """For libraries to read networks, one at a time: whatever they raise becomes one error that names the argument."""
    import torch

    folder = as_path(name, place)
    if is_unfinished(folder):
        with writing_to(name, folder), locked(folder):
            finish_save(folder)
    # Inference tensors can never be trained.
    with _LOADING, torch.inference_mode(False), locked(folder, shared=True):
        try:
            for file in sorted(folder.glob("*config.json") if os.path.isdir(folder) else ()):
                read_settings(name, file)  # libraries name no file, and would wait for a pipe
            yield
        except Exception as error:  # of as many kinds as there are readers
            if isinstance(error, InvalidInputError) and str(error).startswith(f"`{name}` "):
                raise
            if pointer := next(filter(is_lfs_pointer, model_files(folder)), None):
                why = f"{str(pointer)!r} is a Git LFS pointer; run `git lfs pull` in its repository."
                raise InvalidInputError(f"`{name}` is {str(place)!r}, which cannot be loaded: {why}") from error
            why = re.sub(r"^`pretrained_model_name_or_path` is .*?, which cannot be loaded: ", "", first_line(error))
            hint = "" if os.path.isdir(folder) else " Pass a folder, or a repository id."
            raise InvalidInputError(f"`{name}` is {str(place)!r}, which cannot be loaded: {why}{hint}") from error
