"""Files and folders: written so that whoever looks finds the old ones or the new ones, also after a kill, and read of
folders of models.
"""

import errno
import json
import os
import shutil
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from safetensors import safe_open
from transformers.utils import SAFE_WEIGHTS_INDEX_NAME, SAFE_WEIGHTS_NAME

from unitouch_gen.errors import InvalidInputError, describe, first_line

OPTIONS = ("cache_dir", "revision", "token", "local_files_only", "allow_patterns", "ignore_patterns")
"""What a fetch may be told, as huggingface_hub calls it."""

NEVER_READ = ["*.bin", "*.ckpt", "*.pt", "*.pth", "*.h5", "*.msgpack", "*.onnx", "*.onnx_data"]
"""Files of repositories that are not fetched: pickles, and weights for other frameworks."""

A_DAY = 24 * 60 * 60
"""Seconds."""

LOADING = threading.RLock()
"""Held while libraries read networks, for which they patch torch in all threads, and where a model loses parts."""


# Writing --------------------------------------------------------------------------------------------------------------


@contextmanager
def replacing(file: Path) -> Iterator[Path]:
    """A path to write to, which takes the place of a file when the block ends, and goes where it fails.

    It is hidden, lies beside the file, has its suffix, and is this process's own: others may write the same file.

    Args:
        file: Its folder is made if it is not there.

    Raises:
        OSError: If the folder cannot be made, or the file not be replaced.
    """
    partial = file.with_name(f".{os.getpid()}.partial{file.suffix}")
    file.parent.mkdir(parents=True, exist_ok=True)
    try:
        yield partial
        partial.replace(file)
    finally:
        partial.unlink(missing_ok=True)


def write_file(file: Path, content: str | bytes) -> None:
    """Writes text, in UTF-8, or bytes.

    Raises:
        OSError: If it cannot be written; what was there stays.
    """
    with replacing(file) as partial:
        partial.write_bytes(content.encode() if isinstance(content, str) else content)


@contextmanager
def replacing_folder(folder: Path) -> Iterator[Path]:
    """An empty folder to write to, which takes the place of another one when the block ends, and goes where it fails.

    It lies beside the other one. At no time is there neither the old nor the new one: between two renames the old one
    is called `folder` + ".old", and `restore_folder` puts it back if that was the last moment of the process.

    Raises:
        OSError: If it cannot be made, or the other one not be replaced.
    """
    restore_folder(folder)
    old = folder.with_name(folder.name + ".old")
    with _empty_folder(folder.with_name(folder.name + ".partial")) as partial:
        yield partial
        if folder.exists():
            shutil.rmtree(old, ignore_errors=True)
            folder.rename(old)
        partial.rename(folder)
        shutil.rmtree(old, ignore_errors=True)


def restore_folder(folder: Path) -> None:
    """Undoes a `replacing_folder` that was killed between its two renames."""
    old = folder.with_name(folder.name + ".old")
    if old.exists() and not folder.exists():
        old.rename(folder)


@contextmanager
def adding_to_folder(name: str, folder: Path, size: int = 0) -> Iterator[Path]:
    """An empty folder to write to, whose files go into another one when the block ends, and nowhere where it fails.

    It lies in the other one, and is this process's own. Files of the same names are replaced, one after the other, and
    others stay.

    Args:
        name: Argument that the folder came in, for the messages.
        folder: Where the files are to go; made if it is not there.
        size: Bytes that are going to be written, as far as it is known.

    Raises:
        InvalidInputError: If the folder cannot be made or written to, or its disk is too small.
    """
    folder = folder.resolve()
    changed = "Nothing was changed"
    try:
        for above in (folder, *folder.parents):
            if above.exists() and not above.is_dir():
                raise NotADirectoryError(errno.ENOTDIR, f"{above} is a file")
        for left in folder.glob(".*.partial"):  # by a process that was killed, as none writes for so long
            if time.time() - left.stat().st_mtime > A_DAY:
                shutil.rmtree(left, ignore_errors=True)
        with _empty_folder(folder / f".{os.getpid()}.partial") as partial:
            free = shutil.disk_usage(folder).free
            if free < size:
                raise OSError(errno.ENOSPC, f"{size / 1e9:.1f} GB are needed and {free / 1e9:.1f} GB free")
            yield partial
            files = [file for file in partial.rglob("*") if file.is_file()]
            targets = {file: folder / file.relative_to(partial) for file in files}
            for target in targets.values():
                if target.is_dir():
                    raise IsADirectoryError(errno.EISDIR, f"{target.name} is a folder")
            changed = "Some of its files may have been replaced"
            for file in sorted(files, key=lambda file: (file.suffix == ".json", file)):  # those that name others last
                targets[file].parent.mkdir(parents=True, exist_ok=True)
                file.replace(targets[file])
    except OSError as error:
        raise InvalidInputError(
            f"`{name}` is {str(folder)!r}, which cannot be written to: {error.strerror or error}. {changed}; name "
            "another folder or make room."
        ) from error


@contextmanager
def _empty_folder(folder: Path) -> Iterator[Path]:
    """A new folder, which goes when the block ends; where it fails, parents that were made for it go, too."""
    made = [parent for parent in folder.parents if not parent.exists()]
    shutil.rmtree(folder, ignore_errors=True)  # what a process that was killed has left
    try:
        folder.mkdir(parents=True)
        yield folder
        made = []
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        for parent in made:
            with suppress(OSError):  # others may have put something there
                parent.rmdir()


# Reading --------------------------------------------------------------------------------------------------------------


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
    folder = Path(place)
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


def read_json(name: str, file: Path) -> dict[str, Any]:
    """The settings in a JSON file of such a folder.

    Args:
        name: Argument that the file or its folder came in, for the message.
        file: To read.

    Raises:
        InvalidInputError: If it cannot be read, or holds something else.
    """
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InvalidInputError(
            f"`{name}` names {str(file)!r}, which cannot be read as JSON: {first_line(error)}."
        ) from error
    if not isinstance(found, dict):
        raise InvalidInputError(f"`{name}` names {str(file)!r}, which holds {describe(found)} and no settings.")
    return found


def weight_map_of(source: Path) -> dict[str, str]:
    """The file of each tensor, by an index of transformers' kind; none where there is no index.

    Raises:
        InvalidInputError: If the index cannot be read, or names a file elsewhere.
    """
    index = source / SAFE_WEIGHTS_INDEX_NAME
    if not index.is_file():
        return {}
    weight_map = read_json("source", index).get("weight_map")
    if not isinstance(weight_map, dict):
        raise InvalidInputError(f"`{index}` holds no `weight_map`; it is no index of weights.")
    for file in weight_map.values():
        if not isinstance(file, str) or Path(file).name != file or file == "..":
            raise InvalidInputError(f"`{index}` names {file!r}, which is not in its folder; do not trust it.")
    return weight_map


def shards(source: Path, prefix: str = "") -> dict[Path, list[str]]:
    """The safetensors files of a folder with the keys in each that start with `prefix`, if it has any.

    Raises:
        InvalidInputError: If the folder holds no weights, or its index names a file elsewhere.
    """
    if (source / SAFE_WEIGHTS_INDEX_NAME).is_file():
        files: dict[Path, list[str]] = {}
        for key, file in weight_map_of(source).items():
            if key.startswith(prefix):
                files.setdefault(source / file, []).append(key)
        return files
    path = source / SAFE_WEIGHTS_NAME
    if not path.is_file():
        raise InvalidInputError(
            f"`{source}` holds no {SAFE_WEIGHTS_NAME}; pass the folder that `save_pretrained` wrote."
        )
    with safe_open(path, framework="pt") as file:
        keys = [key for key in file.keys() if key.startswith(prefix)]  # noqa: SIM118 - not a dict
    return {path: keys} if keys else {}
