"""Weights in files: checkpoints as their authors published them, read without running a line of what they hold, and
safetensors, written tensor by tensor.

A pickle is read by torch's own unpickler that knows tensors and plain containers, and by nothing else; its tensors stay
in the file until they are used.
"""

import errno
import json
import os
import pickle
import re
import shutil
import struct
import zipfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from unitouch_gen.errors import InvalidInputError, describe, first_of

DTYPES = {torch.float32: "F32", torch.float16: "F16", torch.bfloat16: "BF16", torch.bool: "BOOL"}
"""That weights may have, by their names in safetensors."""

WRAPPERS = ("state_dict",)
"""Keys under which trainers put the weights: Lightning's."""

ALIGNMENT = 8
"""Of the data in a safetensors file, bytes."""


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """The tensors of a file, by name.

    Attributes:
        path: Of the file.
        tensors: Read from the file when they are used.
    """

    path: Path
    tensors: Mapping[str, Tensor]


def open_checkpoint(name: str, path: str | os.PathLike) -> Checkpoint:
    """The weights in a checkpoint: a pickle as `torch.save` writes it, with or without Lightning's wrapping, or
    safetensors.

    Args:
        name: Of the argument that the path came in, for the messages.
        path: Of the file.

    Raises:
        InvalidInputError: If there is no such file, it is cut off, holds anything but tensors and plain containers, or
            claims more values than it has bytes for.
    """
    path = Path(path)
    if not path.is_file():
        what = "is a folder" if path.is_dir() else "does not exist"
        raise InvalidInputError(f"`{name}` names {str(path)!r}, which {what}; pass the file of a checkpoint.")
    if path.stat().st_size == 0:
        raise InvalidInputError(f"`{name}` names {str(path)!r}, which is empty; download it again.")
    if path.suffix == ".safetensors":
        from safetensors import SafetensorError, safe_open

        try:
            with safe_open(path, framework="pt") as file:
                found: Any = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 - not a dict
        except (SafetensorError, OSError) as error:
            raise _unreadable(name, path, error) from error
    else:
        found = _unpickled(name, path)
    for wrapper in WRAPPERS:
        if isinstance(found, Mapping) and isinstance(found.get(wrapper), Mapping):
            found = found[wrapper]
    if not isinstance(found, Mapping):
        raise InvalidInputError(f"`{name}` names {str(path)!r}, which holds {describe(found)}; pass a state dict.")
    tensors = {key: value for key, value in found.items() if isinstance(key, str) and isinstance(value, Tensor)}
    if not tensors:
        raise InvalidInputError(f"`{name}` names {str(path)!r}, which holds no tensors; pass a state dict.")
    for key, tensor in tensors.items():
        _check_claim(name, path, key, tensor)
    return Checkpoint(path, tensors)


def _unpickled(name: str, path: Path) -> Any:
    """What torch's restricted unpickler makes of a file, its tensors mapped where the format allows."""
    zipped = zipfile.is_zipfile(path)
    try:
        if zipped:
            with zipfile.ZipFile(path) as archive:
                claimed = sum(member.file_size for member in archive.infolist())
            if claimed > path.stat().st_size:
                raise InvalidInputError(
                    f"`{name}` names {str(path)!r}, whose parts unpack to {claimed} bytes, more than the file has; a "
                    "checkpoint is not compressed, so this is none to trust."
                )
        return torch.load(path, map_location="cpu", weights_only=True, mmap=zipped)
    except InvalidInputError:
        raise
    except Exception as error:  # a broken file makes its readers raise errors of many kinds
        raise _unreadable(name, path, error) from error


def _unreadable(name: str, path: Path, error: Exception) -> InvalidInputError:
    named = re.search(r"GLOBAL:? (\S+)", str(error), re.IGNORECASE)
    if isinstance(error, pickle.UnpicklingError) and named:
        return InvalidInputError(
            f"`{name}` names {str(path)!r}, which holds more than weights: {named[1]}, of which nothing was run. Pass "
            "a file of weights alone."
        )
    return InvalidInputError(
        f"`{name}` names {str(path)!r}, which cannot be read as a checkpoint: it is cut off, or something else. "
        "Download it again."
    )


def _check_claim(name: str, path: Path, key: str, tensor: Tensor) -> None:
    """Refuses tensors that are more than the file has bytes for, as of strides of 0, and those that are no numbers."""
    held = tensor.untyped_storage().nbytes()
    if tensor.layout is not torch.strided or tensor.numel() * tensor.element_size() > held:
        raise InvalidInputError(
            f"`{name}` names {str(path)!r}, whose {key!r} claims {tensor.numel()} values and holds {held} bytes; this "
            "is no checkpoint to trust."
        )


def counted(keys: Iterable[str], part_of: Callable[[str], str] = lambda key: ".".join(key.split(".")[:2])) -> str:
    """Keys by what they belong to, with how many there are: "modality_trunks.depth (144), ...".

    Args:
        keys: Of a checkpoint.
        part_of: What a key belongs to; the first two parts of its name when left out.
    """
    counts = Counter(map(part_of, keys))
    return first_of([f"{part} ({count})" for part, count in sorted(counts.items())], between=", ")


# Writing --------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Promise:
    """A tensor that is made when it is written.

    Attributes:
        shape, dtype: Of it.
        make: Makes it.
    """

    shape: tuple[int, ...]
    dtype: torch.dtype
    make: Callable[[], Tensor]

    @property
    def size(self) -> int:
        """Bytes."""
        values = 1
        for side in self.shape:
            values *= side
        return values * self.dtype.itemsize


def promised(tensor: Tensor) -> Promise:
    """A tensor that is there."""
    return Promise(tuple(tensor.shape), tensor.dtype, lambda: tensor)


def write_tensors(
    path: Path, promises: Mapping[str, Promise], written: Callable[[int], None] = lambda size: None
) -> None:
    """Writes a safetensors file, one tensor in memory at a time, by name: the same tensors make the same bytes.

    safetensors' own writer takes all tensors of a file at once.

    Args:
        path: Of the file.
        promises: By name.
        written: Told the bytes of each tensor when it is written.

    Raises:
        ValueError: If a tensor is not what was promised.
        OSError: If it cannot be written; what is there so far stays.
    """
    header: dict[str, Any] = {"__metadata__": {"format": "pt"}}
    place = 0
    names = sorted(promises, key=lambda name: (-promises[name].dtype.itemsize, name))  # so that all are aligned
    for name in names:
        promise = promises[name]
        header[name] = {
            "dtype": DTYPES[promise.dtype],
            "shape": list(promise.shape),
            "data_offsets": [place, place + promise.size],
        }
        place += promise.size
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % ALIGNMENT)
    with path.open("wb") as file:
        file.write(struct.pack("<Q", len(text)) + text)
        for name in names:
            promise = promises[name]
            tensor = promise.make().contiguous()
            if tuple(tensor.shape) != promise.shape or tensor.dtype != promise.dtype:
                raise ValueError(
                    f"{name!r} is {describe(tensor)}, and was promised as {promise.shape}, {promise.dtype}"
                )
            if tensor.numel():
                file.write(tensor.view(-1).view(torch.uint8).numpy().data)
            written(promise.size)


def bytes_of(promises: Iterable[Promise]) -> int:
    """Of their data, without headers."""
    return sum(promise.size for promise in promises)


@contextmanager
def staged(name: str, folder: Path, size: int = 0) -> Iterator[Path]:
    """An empty folder to write files to, which go into another one when the block ends, and nowhere where it fails.

    Files of the same names are replaced, others stay.

    Args:
        name: Of the argument that the folder came in, for the messages.
        folder: Where the files are to go; made if it is not there.
        size: Bytes that are going to be written, as far as it is known.

    Raises:
        InvalidInputError: If the folder cannot be made or written to, or its disk is too small.
    """
    folder = folder.absolute()
    staging = folder.with_name(f".{folder.name}.{os.getpid()}.partial")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        if folder.exists() and not folder.is_dir():
            raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR))
        free = shutil.disk_usage(folder.parent).free
        if free < size:
            raise OSError(errno.ENOSPC, f"{size / 1e9:.1f} GB are needed and {free / 1e9:.1f} GB free")
        staging.mkdir()
        yield staging
        files = [file for file in staging.rglob("*") if file.is_file()]
        for file in sorted(files, key=lambda file: (file.suffix == ".json", file)):  # those that name others last
            target = folder / file.relative_to(staging)
            target.parent.mkdir(parents=True, exist_ok=True)
            file.replace(target)
    except OSError as error:
        raise InvalidInputError(
            f"`{name}` is {str(folder)!r}, which cannot be written to: {error.strerror or error}. Nothing was changed; "
            "name another folder or make room."
        ) from error
    finally:
        shutil.rmtree(staging, ignore_errors=True)
