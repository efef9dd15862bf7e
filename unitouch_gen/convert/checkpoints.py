"""Weights in files: checkpoints as their authors published them, read without running a line of what they hold, and
safetensors, written tensor by tensor.

A pickle is read by torch's own unpickler that knows tensors and plain containers, and by nothing else; its tensors stay
in the file until they are used.
"""

import ctypes
import json
import math
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
from safetensors.torch import load_file
from torch import Tensor

from unitouch_gen.errors import InvalidInputError, describe, first_line, first_of
from unitouch_gen.files import as_path, check_file

DTYPES = {torch.float32: "F32", torch.float16: "F16", torch.bfloat16: "BF16", torch.bool: "BOOL"}
"""What weights may be, by the names in safetensors."""

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
"""Bytes at a multiple of which the data of a safetensors file begins."""


# Reading --------------------------------------------------------------------------------------------------------------


def open_checkpoint(name: str, path: str | os.PathLike) -> dict[str, Tensor]:
    """The weights in a checkpoint: a pickle as `torch.save` writes it, with or without Lightning's wrapping, or
    safetensors.

    Args:
        name: Argument that the path came in, for the messages.
        path: The file.

    Returns:
        Tensors by name; those of an archive are read from the file when they are used.

    Raises:
        InvalidInputError: If there is no such file, it is cut off, holds anything but tensors and plain containers, or
            claims more values than it has bytes for.
    """
    path = as_path(name, path)
    named = f"`{name}` names {str(path)!r},"
    check_file(name, path, "a checkpoint")
    if path.stat().st_size == 0:
        raise InvalidInputError(f"{named} which is empty; download it again.")
    try:
        found = load_file(path) if path.suffix == ".safetensors" else _unpickle(named, path)
    except InvalidInputError:
        raise
    except Exception as error:  # a broken file makes its readers raise errors of many kinds
        raise InvalidInputError(f"{named} {_what_is_wrong(error)}") from error
    if isinstance(found, Mapping) and isinstance(found.get(WRAPPER), Mapping):
        found = found[WRAPPER]
    if not isinstance(found, Mapping):
        raise InvalidInputError(f"{named} which holds {describe(found)}; pass a state dict.")
    tensors = {key: value for key, value in found.items() if isinstance(key, str) and isinstance(value, Tensor)}
    if not tensors:
        raise InvalidInputError(f"{named} which holds no tensors; pass a state dict.")
    for key, tensor in tensors.items():
        if tensor.layout is not torch.strided or tensor.device.type != "cpu":
            kind = f"{str(tensor.layout).removeprefix('torch.')} on the device {tensor.device.type!r}"
            raise InvalidInputError(f"{named} whose {key!r} is {kind}; pass plain tensors.")
        held = tensor.untyped_storage().nbytes()
        if tensor.numel() * tensor.element_size() > held:  # as with strides of 0
            raise InvalidInputError(
                f"{named} whose {key!r} claims {tensor.numel()} values and holds {held} bytes; this is no checkpoint "
                "to trust."
            )
    return tensors


def _unpickle(named: str, path: Path) -> Any:
    """What torch's restricted unpickler makes of a file, its tensors mapped where the format allows."""
    with path.open("rb") as file:
        zipped = file.read(len(ZIP)) == ZIP  # as torch tells
    if zipped:
        with zipfile.ZipFile(path) as archive:
            claimed = sum(member.file_size for member in archive.infolist())
            if claimed > path.stat().st_size:
                raise InvalidInputError(
                    f"{named} whose parts unpack to {claimed} bytes, more than the file has; a checkpoint is not "
                    "compressed, so this is none to trust."
                )
            damaged = archive.testzip()  # torch compares no checksums of mapped files
        if damaged is not None:
            raise InvalidInputError(
                f"{named} whose part {damaged!r} is damaged: its checksum differs. Download it again."
            )
    with torch.serialization.safe_globals(LEFT_BY_TRAINERS):
        return torch.load(path, map_location="cpu", weights_only=True, mmap=zipped)


def _what_is_wrong(error: Exception) -> str:
    """What a reader's error says of its file."""
    unsafe = re.search(r"GLOBAL:? (\S+)", str(error), re.IGNORECASE)
    if isinstance(error, pickle.UnpicklingError) and unsafe:
        return f"which holds more than weights: {unsafe[1]}, of which nothing was run. Pass a file of weights alone."
    if isinstance(error, OSError | MemoryError):
        return f"which cannot be read: {first_line(error)}."
    archive = isinstance(error, zipfile.BadZipFile | RuntimeError)  # others speak of pickles, and how to trust them
    reason = f" ({first_line(error)})" if archive else ""
    return (
        f"which cannot be read as a checkpoint: it is cut off, or something else{reason}. Compare its size with its "
        "source's."
    )


def counted(keys: Iterable[str], part_of: Callable[[str], str] = lambda key: ".".join(key.split(".")[:2])) -> str:
    """Keys of a checkpoint by what they belong to, with how many there are: "modality_trunks.depth (144), ...".

    Args:
        keys: To count.
        part_of: What a key belongs to; the first two parts of its name when left out.
    """
    counts = Counter(map(part_of, keys))
    return first_of([f"{part} ({count})" for part, count in sorted(counts.items())], between=", ")


# Writing --------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class LazyTensor:
    """A tensor that is made when it is written.

    Attributes:
        shape, dtype: What it is going to be.
        make: Makes it.
    """

    shape: tuple[int, ...]
    dtype: torch.dtype
    make: Callable[[], Tensor]

    @classmethod
    def of(cls, tensor: Tensor) -> "LazyTensor":
        """A tensor that is there."""
        return cls(tuple(tensor.shape), tensor.dtype, lambda: tensor)

    @property
    def size(self) -> int:
        """Bytes."""
        return math.prod(self.shape) * self.dtype.itemsize


def size_of(files: Mapping[str, Mapping[str, LazyTensor]]) -> int:
    """Bytes of the tensors of some files, without headers."""
    return sum(tensor.size for tensors in files.values() for tensor in tensors.values())


def write_tensors(
    folder: Path,
    files: dict[str, dict[str, LazyTensor]],
    written: Callable[[int, int], object] = lambda done, size: None,
) -> None:
    """Writes safetensors files, one tensor in memory at a time: the same tensors make the same bytes.

    safetensors' own writer takes all tensors of a file at once.

    Args:
        folder: For the files.
        files: Tensors by name, by the path of their file in the folder. A file is taken out when it is written, and
            with it what its tensors are made of is let go.
        written: Told how many bytes of how many are written, after each tensor.

    Raises:
        ValueError: If a tensor is not what it was going to be.
        OSError: If it cannot be written; what is there so far stays.
    """
    done, size = 0, size_of(files)
    while files:
        place = next(iter(files))
        (folder / place).parent.mkdir(parents=True, exist_ok=True)
        tensors = files.pop(place)
        names = sorted(tensors, key=lambda name: (-tensors[name].dtype.itemsize, name))  # so that all are aligned
        with (folder / place).open("wb") as file:
            file.write(_header({name: tensors[name] for name in names}))
            for name in names:
                lazy = tensors[name]
                tensor = lazy.make().contiguous()
                if tuple(tensor.shape) != lazy.shape or tensor.dtype != lazy.dtype:
                    raise ValueError(f"{name!r} is {describe(tensor)}, and was promised as {lazy.shape}, {lazy.dtype}")
                if tensor.numel():
                    file.write(tensor.view(-1).view(torch.uint8).numpy().data)
                    page_out(tensor)
                done += lazy.size
                written(done, size)


def _header(tensors: Mapping[str, LazyTensor]) -> bytes:
    """The bytes of a safetensors file before its data, which lie in the order of the tensors."""
    entries: dict[str, Any] = {"__metadata__": {"format": "pt"}}
    start = 0
    for name, tensor in tensors.items():
        end = start + tensor.size
        entries[name] = {"dtype": DTYPES[tensor.dtype], "shape": list(tensor.shape), "data_offsets": [start, end]}
        start = end
    text = json.dumps(entries, separators=(",", ":")).encode()
    text += b" " * (-len(text) % ALIGNMENT)
    return struct.pack("<Q", len(text)) + text


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
