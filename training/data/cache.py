"""The cache of a stage: columns decoded or rendered to memory-mapped files, and tensors computed from them."""

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.torch import load_file, save_file
from torch import Tensor
from tqdm.contrib.concurrent import thread_map

from unitouch_gen.errors import first_line
from unitouch_gen.files import is_unfinished, replacing
from unitouch_gen.saving import filling
from unitouch_gen.training.data.sets import RecordSet


def for_each(call: Callable[[int], object], data: RecordSet, quiet: bool = False) -> dict[int, str]:
    """Calls with the number of each record, in threads. Returns reasons by the number of a record that failed."""
    broken: dict[int, str] = {}

    def call_one(row: int) -> None:
        try:
            call(row)
        except (OSError, ValueError) as error:
            broken[row] = first_line(error)

    thread_map(call_one, range(len(data)), desc=str(data), unit="records", disable=quiet)
    return dict(sorted(broken.items()))


Arrays = dict[str, np.memmap]


def mapped(
    folder: Path, count: int, columns: Mapping[str, tuple[Any, ...]], write: Callable[[Arrays, Path], None]
) -> Arrays:
    """Arrays of `count` rows in the .npy files of a folder. If they are missing, `write` fills them.

    `columns` has dtype and shape of a row by name. `write(arrays, folder)` may write other files beside the arrays.
    """
    complete = all((folder / f"{name}.npy").is_file() for name in columns)
    if not complete or is_unfinished(folder):
        with filling("cache", folder) as partial:
            arrays: Arrays = {}
            for name, (dtype, *shape) in columns.items():
                arrays[name] = _allocate(partial / f"{name}.npy", dtype, shape=(count, *shape))
            write(arrays, partial)
            for array in arrays.values():
                array.flush()
    return {name: np.load(folder / f"{name}.npy", mmap_mode="r") for name in columns}


def _allocate(file: Path, dtype: Any, shape: tuple[int, ...]) -> np.memmap:
    """A memory-mapped array whose space on the disk is reserved; writing to a full disk would kill the process."""
    array = np.lib.format.open_memmap(file, mode="w+", dtype=dtype, shape=shape)
    if hasattr(os, "posix_fallocate"):
        with file.open("r+b") as stream:
            os.posix_fallocate(stream.fileno(), 0, array.offset + array.nbytes)
    return array


def computed_once(file: Path, compute: Callable[[], Tensor]) -> Tensor:
    """The tensor in a file; if there is none, the result of `compute`, which is written to it."""
    if file.is_file():
        return load_file(file)["values"]
    values = compute()
    with replacing("cache", file) as partial:
        save_file({"values": values.contiguous()}, partial)
    return values
