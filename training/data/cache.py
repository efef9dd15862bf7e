"""Work that is done once: columns that are decoded or rendered to files, and what is computed of them."""

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
    """Calls with the number of each record, in threads, and returns why some cannot be read."""
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
    """Arrays of `count` rows in the .npy files of a folder; `write` fills them where they are not there yet.

    `columns` gives dtype and shape of a row by name. What `write` puts beside the arrays is kept with them.
    """
    there = all((folder / f"{name}.npy").is_file() for name in columns)
    if not there or is_unfinished(folder):
        with filling("cache", folder) as place:
            arrays: Arrays = {}
            for name, (dtype, *shape) in columns.items():
                file = place / f"{name}.npy"
                arrays[name] = np.lib.format.open_memmap(file, mode="w+", dtype=dtype, shape=(count, *shape))
                if hasattr(os, "posix_fallocate"):  # a disk that is found to be full later would end the process
                    with file.open("r+b") as stream:
                        os.posix_fallocate(stream.fileno(), 0, arrays[name].offset + arrays[name].nbytes)
            write(arrays, place)
            for array in arrays.values():
                array.flush()
    return {name: np.load(folder / f"{name}.npy", mmap_mode="r") for name in columns}


def computed_once(file: Path, compute: Callable[[], Tensor]) -> Tensor:
    """What `compute` gives; read from the file if it is there, else written to it."""
    if file.is_file():
        return load_file(file)["values"]
    values = compute()
    with replacing("cache", file) as partial:
        save_file({"values": values.contiguous()}, partial)
    return values
