"""Arrays whose rows are computed from files when they are asked for."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import numpy as np
from tqdm.auto import tqdm

from unitouch_gen.files import natural

Found = TypeVar("Found")

BLOCK = 64
"""Rows that one thread computes in a row: neighbours share a video, which is read forwards."""

THREADS = min(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1, 16)
"""Processors that this process may use, as far as decoding gains by them."""


class Computed:
    """An array of bytes or numbers whose rows are computed when they are asked for, in several threads.

    Pillow, PyAV and torch let others run meanwhile, so threads do what processes would, without copies.

    Args:
        count: Rows.
        shape: Of a row.
        dtype: Of the array.
        row: Computes one, by its number.
    """

    def __init__(self, count: int, shape: tuple[int, ...], dtype: type, row: Callable[[int], np.ndarray]):
        self.shape, self.dtype, self.row = (count, *shape), np.dtype(dtype), row

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, index: int | slice | np.ndarray) -> np.ndarray:
        rows = np.arange(len(self))[index]
        if rows.ndim == 0:
            return self.row(int(rows))
        with ThreadPoolExecutor(THREADS) as pool:
            parts = pool.map(lambda part: list(map(self.row, part.tolist())), np.array_split(rows, THREADS))
            return np.stack([value for part in parts for value in part])

    def fill(self, array: np.ndarray, files: Sequence[Any], description: str) -> None:
        """Computes all rows into another array; see `for_each`."""

        def compute(row: int) -> None:
            array[row] = self.row(row)

        for_each(compute, files, description)


def for_each(call: Callable[[int], Found], files: Sequence[Any], description: str, quiet: bool = False) -> list[Found]:
    """What a call returns for each row, called in the order of the rows' files, in several threads.

    Args:
        call: With a row's number.
        files: A frame or a path for each row.
        description: Of the progress bar, which shows the time left.
        quiet: Whether to show none.
    """
    order = sorted(range(len(files)), key=lambda row: natural(str(files[row])))
    blocks = [order[start : start + BLOCK] for start in range(0, len(order), BLOCK)]
    found: dict[int, Found] = {}
    pool = ThreadPoolExecutor(THREADS)
    try:
        with tqdm(total=len(order), desc=description, unit="record", mininterval=1.0, disable=quiet) as bar:
            for block, part in zip(blocks, pool.map(lambda rows: list(map(call, rows)), blocks), strict=True):
                found.update(zip(block, part, strict=True))
                bar.update(len(block))
    finally:
        pool.shutdown(cancel_futures=True)  # where one failed, the others need not begin
    return [found[row] for row in range(len(files))]
