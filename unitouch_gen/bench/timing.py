"""Timings, which are of the machine they were taken on."""

import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any

import torch

from unitouch_gen.pipelines.tiny import tiny
from unitouch_gen.world import SENSORS, World
from unitouch_gen.world.collections import SPLITS

Figures = dict[str, Any]


def fastest(call: Callable[[], Any], repeats: int = 3) -> float:
    """Shortest wall-clock time of a call, after one warm-up, s."""
    call()
    times = []
    for _ in range(repeats):
        started = time.perf_counter()
        call()
        times.append(time.perf_counter() - started)
    return min(times)


def _render_many(first: int) -> int:
    torch.set_num_threads(1)
    rows = torch.arange(first, first + 32)
    World().render(rows % 16, rows // 16, rows * 0, sensors=tuple(SENSORS))
    return 32


def world_figures(samples: int = 1024) -> Figures:
    """Full samples (picture, touch of five sensors, sound, caption) a second on two cores, and the cost of parts."""
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        list(pool.map(_render_many, [0, 32]))  # start-up is not counted
        started = time.perf_counter()
        count = sum(pool.map(_render_many, range(0, samples, 32)))
        rate = count / (time.perf_counter() - started)
    rows = torch.arange(64)
    world = World()

    def seconds(**request: Any) -> float:
        return fastest(lambda: world.render(rows % 16, rows // 16, rows * 0, **request))

    full = seconds(sensors=tuple(SENSORS))
    parts = {
        "picture": seconds(senses=("image",)),
        "touch of one sensor": seconds(senses=("touch",)),
        "sound": seconds(senses=("audio",)),
        "caption": seconds(senses=("text",)),
        "grasp": seconds(senses=("grasp",)),
    }
    return {"samples_per_second": rate, "share_of_full": {key: value / full for key, value in parts.items()}}


def speed_figures() -> Figures:
    """Seconds for one 64 x 64 picture with default settings, after loading."""
    pipe = tiny("touch-to-image")
    pipe.set_progress_bar_config(disable=True)
    touch = World().render([5], [SPLITS["test"][0]], [0], senses=("touch",)).touch["gelsight"]
    return {"seconds_per_picture": fastest(lambda: pipe(touch, generator=torch.Generator().manual_seed(0)))}
