"""Files and folders: put in place whole by a rename, and read with errors that name the argument."""

import ctypes
import functools
import inspect
import json
import logging
import os
import re
import shutil
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from unitouch_gen.errors import InvalidInputError, InvalidTypeError, describe, first_line

FETCH_OPTIONS = ("cache_dir", "revision", "token", "local_files_only", "allow_patterns", "ignore_patterns")
NEVER_READ = ["*.bin", "*.ckpt", "*.pt", "*.pth", "*.h5", "*.msgpack", "*.onnx", "*.onnx_data"]
"""Files of repositories that are not fetched: pickles, and weights for other frameworks."""

LOADING = threading.RLock()
"""Held while libraries read networks, for which they patch torch in all threads."""


# Writing --------------------------------------------------------------------------------------------------------------


@contextmanager
def _hidden_beside(name: str, target: Path, folder: Path | None = None) -> Iterator[Path]:
    """A hidden folder beside a target, or in `folder`; errors of writing name the argument that the target came in."""
    folder = folder or target.parent
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".", suffix=".partial", dir=folder) as hidden:
            yield Path(hidden)
    except InvalidInputError:
        raise
    except Exception as error:  # torch's writer and libraries in Rust have no class of their own
        if not isinstance(error, OSError) and not re.search(r"inline_container|\(os error \d+\)", str(error)):
            raise
        why = getattr(error, "strerror", None) or first_line(error)
        raise InvalidInputError(
            f"`{name}` cannot be written to {str(target)!r}: {why}. Nothing was changed."
        ) from error


def _is_device(file: Path) -> bool:
    return os.path.exists(file) and not os.path.isfile(file) and not os.path.isdir(file)


@contextmanager
def replacing(name: str, file: Path) -> Iterator[Path]:
    """A path of the same name to write to, which takes the place of a file when the block ends without an error.

    A device is written to directly. Raises `InvalidInputError` if it cannot be written; what was there stays.
    """
    target = Path(os.path.realpath(file))
    if _is_device(target):
        yield target
        return
    with _hidden_beside(name, target) as hidden:
        yield hidden / file.name
        os.replace(hidden / file.name, target)


def write_file(name: str, file: Path, content: str | bytes) -> Path:
    """Writes text, in UTF-8, or bytes, whole or not at all; returns the file."""
    with replacing(name, file) as partial:
        partial.write_bytes(content.encode() if isinstance(content, str) else content)
    return file


def check_writable(name: str, file: Path) -> None:
    """Raises `InvalidInputError`, before any work, if a file cannot be written; leaves nothing behind."""
    target = Path(os.path.realpath(file))
    above = next(parent for parent in target.parents if os.path.exists(parent))  # unlike Path.exists, of any length
    if not _is_device(target):
        with _hidden_beside(name, target, above) as hidden:
            if os.path.isdir(target):
                raise IsADirectoryError(21, "it is a folder")
            place = hidden / target.relative_to(above)
            place.parent.mkdir(parents=True, exist_ok=True)
            place.touch()


@contextmanager
def writing_folder(name: str, folder: Path, *, replace: bool = False) -> Iterator[Path]:
    """An empty folder of the same name to write to, which takes another one's place when the block ends.

    Files of the old folder that the new one lacks are kept, but for weights that a reader could take for the new ones,
    and with `replace` those in folders that the new one has. A process that is killed leaves the old folder or the new
    one. Raises `InvalidInputError` if it cannot be written; what was there stays.
    """
    target = Path(os.path.realpath(folder))
    with _hidden_beside(name, target) as hidden:
        if target.exists() and not target.is_dir():
            raise NotADirectoryError(20, "it is a file")
        new = hidden / target.name
        new.mkdir()
        yield new
        if not target.exists():
            os.rename(new, target)
            return
        written = {entry.name for entry in new.iterdir()} if replace else set()
        for file in sorted(target.rglob("*")):
            place = new / file.relative_to(target)
            replaced = place.exists() or file.relative_to(target).parts[0] in written or _superseded(place)
            if file.is_file() and not replaced:
                place.parent.mkdir(parents=True, exist_ok=True)
                try:
                    os.link(file, place)
                except OSError:  # of file systems without links
                    shutil.copy2(file, place)
        _exchange(new, target)  # the old folder goes with the hidden one


def _superseded(file: Path) -> bool:
    """Whether it names weights of which its folder holds others: shards and a single file, of the same variant."""

    def kind(name: str) -> str:
        return re.sub(r"-\d+-of-\d+|\.index|\.json|\.safetensors", "", name)

    others = file.parent.glob("*.safetensors*")
    return ".safetensors" in file.name and any(kind(other.name) == kind(file.name) for other in others)


def _exchange(one: Path, other: Path) -> None:
    """Exchanges two folders in one step where the system can (Linux: renameat2), and in two renames elsewhere."""
    library, here, exchange = ctypes.CDLL(None), -100, 2  # AT_FDCWD, RENAME_EXCHANGE
    places = os.fsencode(one), os.fsencode(other)
    if not hasattr(library, "renameat2") or library.renameat2(here, places[0], here, places[1], exchange):
        os.rename(other, one.with_name(f"{one.name}.old"))
        os.rename(one, other)


def saved_whole(save: Callable[..., Any]) -> Callable[..., None]:
    """A `save_pretrained` that writes all of it or nothing, see `writing_folder`; uploads come after that."""

    @functools.wraps(save)  # with the signature, by which diffusers knows what it may pass
    def save_pretrained(self: Any, save_directory: Any, *args: Any, push_to_hub: bool = False, **kwargs: Any) -> None:
        folder = as_path("save_directory", save_directory)
        with writing_folder("save_directory", folder) as place:
            save(self, place, *args, **kwargs)
        if push_to_hub:
            known = inspect.signature(self.push_to_hub).parameters
            options = {"repo_id": folder.resolve().name, **kwargs}
            self.push_to_hub(**{key: value for key, value in options.items() if key in known})

    return save_pretrained


# Reading --------------------------------------------------------------------------------------------------------------


def as_path(name: str, place: Any) -> Path:
    """A path that came in the argument `name`, with `~` as the home folder."""
    if not isinstance(place, str | os.PathLike):
        raise InvalidTypeError(f"`{name}` is {describe(place)}; it has to be a path.")
    if not str(place) or "\0" in str(place):
        raise InvalidInputError(f"`{name}` is {describe(str(place))}; it has to be the path of a file or folder.")
    return Path(place).expanduser()


def check_file(name: str, path: str | os.PathLike, what: str) -> None:
    """Raises `InvalidInputError` if there is no file of that path; `what` should be there, such as "an image file"."""
    if os.path.isfile(path):  # unlike Path.is_file, False for a name that is too long
        return
    if re.match(r"\w+://", str(path)):
        raise InvalidInputError(
            f"`{name}` is {describe(str(path))}, an address; download it, and pass the file's path."
        )
    why = "is a folder" if os.path.isdir(path) else "is no regular file" if os.path.exists(path) else "does not exist"
    raise InvalidInputError(f"`{name}` names {str(path)[:400]!r}, which {why}; pass the path of {what}.")


def local_folder(name: str, place: str | os.PathLike, **options: Any) -> Path:
    """A folder as it is, or the local copy of a repository.

    Of the options those of a fetch are used, `FETCH_OPTIONS`; files that are `NEVER_READ` are not fetched. Raises
    `InvalidInputError` if it is neither a folder nor a repository that can be fetched.
    """
    folder = as_path(name, place)
    if os.path.isdir(folder):  # unlike Path.is_dir, False for a name that is too long
        return folder
    if str(place).startswith((".", "/", "~")) or os.path.isfile(folder):
        raise InvalidInputError(f"`{name}` is {str(place)!r}, which is no folder; pass one, or a repository id.")
    from huggingface_hub import snapshot_download

    known = {key: value for key, value in options.items() if key in FETCH_OPTIONS and value is not None}
    try:
        return Path(snapshot_download(str(place), **{"ignore_patterns": NEVER_READ, **known}))
    except (OSError, ValueError) as error:  # the second of what is no id
        raise InvalidInputError(
            f"`{name}` is {str(place)!r}, which is no folder here, and no repository of that id could be fetched: "
            f"{first_line(error)}"
        ) from error


def natural(path: str | Path) -> list[Any]:
    """A key to sort names by, with numbers in them as numbers: 2.png before 10.png."""
    return [int(part) if place % 2 else part for place, part in enumerate(re.split(r"(\d+)", str(path)))]


def read_text(name: str, file: Path, what: str) -> str:
    """The text, in UTF-8, of a regular file of at most 1 GiB; `what` names the format in messages."""
    check_file(name, file, f"a {what} file")
    try:
        if file.stat().st_size > 2**30:
            raise ValueError("it has more than 1 GiB")
        return file.read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        raise InvalidInputError(f"`{name}` names {str(file)!r}, which cannot be read as {what}: {error}.") from error


def read_json(name: str, file: Path) -> dict[str, Any]:
    """The settings in a JSON file."""
    return _read_settings(name, file, "JSON", json.loads)


def read_yaml(name: str, file: Path) -> dict[str, Any]:
    """The settings in a YAML file."""
    import yaml

    return _read_settings(name, file, "YAML", yaml.safe_load)


def _read_settings(name: str, file: Path, what: str, load: Callable[[str], Any]) -> dict[str, Any]:
    try:
        found = load(read_text(name, file, what))
        if not isinstance(found, dict):
            raise ValueError(f"it holds {describe(found)} and no settings")
    except InvalidInputError:
        raise
    except Exception as error:  # of the format, of dates, of integers of thousands of digits
        why = first_line(error)
        raise InvalidInputError(f"`{name}` names {str(file)!r}, which cannot be read as {what}: {why}.") from error
    return found


@contextmanager
def reading(name: str, place: Any) -> Iterator[None]:
    """For libraries to read networks, one at a time: whatever they raise becomes one error that names the argument."""
    folder, libraries = as_path(name, place), logging.getLogger("diffusers")
    with LOADING:
        level = libraries.level
        libraries.setLevel(logging.CRITICAL)  # what diffusers logs as an error it raises as well
        try:
            for file in sorted(folder.glob("*config.json") if os.path.isdir(folder) else ()):
                read_json(name, file)  # libraries name no file
            yield
        except MemoryError:
            raise
        except Exception as error:  # of as many kinds as there are readers
            if isinstance(error, InvalidInputError) and str(error).startswith(f"`{name}` "):
                raise
            reason = re.sub(r"^`pretrained_model_name_or_path` is .*?, which cannot be loaded: ", "", first_line(error))
            hint = "" if os.path.isdir(folder) else " Pass a folder, or a repository id."
            raise InvalidInputError(f"`{name}` is {str(place)!r}, which cannot be loaded: {reason}{hint}") from error
        finally:
            libraries.setLevel(level)
