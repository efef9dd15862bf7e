"""Weights in files: checkpoints as their authors published them, read without running a line of what they hold, and
safetensors, written tensor by tensor.

A pickle is read by torch's own unpickler that knows tensors and plain containers, and by nothing else; its tensors stay
in the file until they are used.
"""

import ctypes
import json
import mmap
import os
import pickle
import re
import struct
import sys
import zipfile
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from unitouch_gen.errors import InvalidInputError, describe, first_line, first_of

DTYPES = {torch.float32: "F32", torch.float16: "F16", torch.bfloat16: "BF16", torch.bool: "BOOL"}
"""That weights may have, by their names in safetensors."""

WRAPPER = "state_dict"
"""Key under which Lightning puts the weights."""


class Inert:
    """Stands for what trainers leave beside the weights, of which nothing is made."""

    def __new__(cls, *args: Any) -> "Inert":
        return super().__new__(cls)

    def __setstate__(self, state: Any) -> None:
        pass


LEFT_BY_TRAINERS: list[Any] = [
    (Inert, name)
    for name in (
        "pytorch_lightning.callbacks.early_stopping.EarlyStopping",
        "pytorch_lightning.callbacks.model_checkpoint.ModelCheckpoint",
        "numpy.core.multiarray.scalar",
        "numpy._core.multiarray.scalar",
        "numpy.dtype",
    )
]
"""Names in pickles of Lightning 1: its callbacks' states go by their classes, and their scores are numpy's."""

ZIP = b"PK\x03\x04"
"""First bytes of an archive."""

MADV_PAGEOUT = 21
"""madvise(2); systems before Linux 5.4 refuse it, and nothing happens."""

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
    if isinstance(found, Mapping) and isinstance(found.get(WRAPPER), Mapping):
        found = found[WRAPPER]
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
    try:
        with path.open("rb") as file:
            zipped = file.read(len(ZIP)) == ZIP  # as torch tells
        if zipped:
            _check_archive(name, path)
        with torch.serialization.safe_globals(LEFT_BY_TRAINERS):
            return torch.load(path, map_location="cpu", weights_only=True, mmap=zipped)
    except InvalidInputError:
        raise
    except Exception as error:  # a broken file makes its readers raise errors of many kinds
        raise _unreadable(name, path, error) from error


def _check_archive(name: str, path: Path) -> None:
    """Refuses what unpacks to more than it is, and what is damaged: torch compares no checksums of mapped files."""
    with zipfile.ZipFile(path) as archive:
        claimed = sum(member.file_size for member in archive.infolist())
        if claimed > path.stat().st_size:
            raise InvalidInputError(
                f"`{name}` names {str(path)!r}, whose parts unpack to {claimed} bytes, more than the file has; a "
                "checkpoint is not compressed, so this is none to trust."
            )
        damaged = archive.testzip()
    if damaged is not None:
        raise InvalidInputError(
            f"`{name}` names {str(path)!r}, whose part {damaged!r} is damaged: its checksum differs. Download it again."
        )


def _unreadable(name: str, path: Path, error: Exception) -> InvalidInputError:
    named = re.search(r"GLOBAL:? (\S+)", str(error), re.IGNORECASE)
    if isinstance(error, pickle.UnpicklingError) and named:
        return InvalidInputError(
            f"`{name}` names {str(path)!r}, which holds more than weights: {named[1]}, of which nothing was run. Pass "
            "a file of weights alone."
        )
    if isinstance(error, OSError | MemoryError):
        return InvalidInputError(f"`{name}` names {str(path)!r}, which cannot be read: {first_line(error)}.")
    archive = isinstance(error, zipfile.BadZipFile | RuntimeError)  # others speak of pickles, and how to trust them
    reason = f" ({first_line(error)})" if archive else ""
    return InvalidInputError(
        f"`{name}` names {str(path)!r}, which cannot be read as a checkpoint: it is cut off, or something else"
        f"{reason}. Compare its size with its source's."
    )


def _check_claim(name: str, path: Path, key: str, tensor: Tensor) -> None:
    """Refuses tensors that are more than the file has bytes for, as of strides of 0, or none, as of no device."""
    if tensor.layout is not torch.strided or tensor.device.type != "cpu":
        kind = f"{str(tensor.layout).removeprefix('torch.')} on the device {tensor.device.type!r}"
        raise InvalidInputError(f"`{name}` names {str(path)!r}, whose {key!r} is {kind}; pass plain tensors.")
    held = tensor.untyped_storage().nbytes()
    if tensor.numel() * tensor.element_size() > held:
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
                page_out(tensor)
            written(promise.size)


def page_out(tensor: Tensor) -> None:
    """Takes a tensor that is mapped from a file out of memory until it is used again; Linux alone knows how.

    Nothing is lost of any tensor: where there is nowhere to read it from again, it stays.
    """
    if sys.platform != "linux" or not tensor.is_contiguous():
        return
    first = -(-tensor.data_ptr() // mmap.PAGESIZE) * mmap.PAGESIZE  # whole pages: others may lie on those at its ends
    last = (tensor.data_ptr() + tensor.numel() * tensor.element_size()) // mmap.PAGESIZE * mmap.PAGESIZE
    if last > first:
        ctypes.CDLL(None).madvise(ctypes.c_void_p(first), ctypes.c_size_t(last - first), MADV_PAGEOUT)


def counting(whole: int, written: Callable[[int, int], object]) -> Callable[[int], None]:
    """Takes the bytes of one tensor after the other, and tells how many of how many are written by then."""
    done = 0

    def count(size: int) -> None:
        nonlocal done
        done += size
        written(done, whole)

    return count


def bytes_of(promises: Iterable[Promise]) -> int:
    """Of their data, without headers."""
    return sum(promise.size for promise in promises)
