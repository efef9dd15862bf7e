"""Timings, which are of the machine they were taken on."""

import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context

import torch

from tests.benchmarks import Figures
from unitouch_gen.numerics.physics import request_rows
from unitouch_gen.numerics.physics_row import time_calls
from unitouch_gen.pipelines.tiny import tiny
from unitouch_gen.world import SENSORS, World
from unitouch_gen.world.collections import SPLITS


@contextmanager
def one_thread() -> Iterator[None]:
    """torch on one core for a while.

    The world renders in many small operations. On cores that others use, its threads wait for each other at the end of
    every one of them, which makes it ten times slower than on one thread, and figures of it a chance.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _render_many(first: int) -> int:
    rows = torch.arange(first, first + 32)
    with one_thread():
        World().render(rows % 16, rows // 16, rows * 0, sensors=tuple(SENSORS))
    return 32


def world_figures(samples: int = 1024) -> Figures:
    """Full samples (picture, touch of five sensors, sound, caption) a second on two cores; cost of parts on one."""
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        list(pool.map(_render_many, [0, 32]))  # start-up is not counted
        started = time.perf_counter()
        count = sum(pool.map(_render_many, range(0, samples, 32)))
        rate = count / (time.perf_counter() - started)
    with one_thread():
        shares = {row.request: row.share for row in request_rows()}
    return {"samples_per_second": rate, "share_of_full": shares}


def speed_figures() -> Figures:
    """Seconds for one 64 x 64 picture with default settings, after loading."""
    pipe = tiny("touch-to-image")
    pipe.set_progress_bar_config(disable=True)
    touch = World().render([5], [SPLITS["test"][0]], [0], modalities=("touch",)).touch["gelsight"]
    calls = {"picture": lambda: pipe(touch, generator=torch.Generator().manual_seed(0))}
    return {"seconds_per_picture": time_calls(calls)["picture"][0]}
