"""What every benchmark is timed and measured with."""

import statistics
import time
from collections.abc import Callable, Hashable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar

from unitouch_gen.pipelines.tiny import tiny

Figures = dict[str, Any]
"""What was measured, by name: plain values, for JSON."""

Name = TypeVar("Name", bound=Hashable)
Seen = TypeVar("Seen")


def in_turns(calls: Mapping[Name, Callable[[], Seen]], repeats: int) -> dict[Name, list[Seen]]:
    """What calls return that take turns, so that a busy spell of the machine hits all; a first turn is not kept."""
    seen: dict[Name, list[Seen]] = {name: [] for name in calls}
    for turn in range(repeats + 1):
        for name, call in calls.items():
            found = call()
            if turn > 0:
                seen[name].append(found)
    return seen


def seconds_of(call: Callable[..., Any], *args: Any, **kwargs: Any) -> float:
    """Seconds of one call."""
    started = time.perf_counter()
    call(*args, **kwargs)
    return time.perf_counter() - started


def ratio_of(slow: Sequence[float], fast: Sequence[float]) -> dict[str, float]:
    """How many times as long `slow` took as `fast`: ratio of the medians, and the least and largest of the turns."""
    turns = [high / low for high, low in zip(slow, fast, strict=True)]
    return {"ratio": statistics.median(slow) / statistics.median(fast), "low": min(turns), "high": max(turns)}


def spread_of(values: Sequence[float]) -> dict[str, float]:
    """Median, and largest less least."""
    return {"median": statistics.median(values), "spread": max(values) - min(values)}


def in_own_process(function: Callable[..., Seen], *arguments: Any) -> Seen:
    """What a function of a module returns in a process of its own, whose peak of memory is of nothing else."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


class PeakMemory:
    """Largest resident size of this process, in bytes above that at the start; `None` but under Linux.

    The record of the peak is the process's: a second `PeakMemory` starts it anew (proc_pid_clear_refs(5)).
    """

    def __init__(self) -> None:
        try:
            Path("/proc/self/clear_refs").write_text("5")
        except OSError:
            self.start = None
        else:
            self.start = resident("VmRSS")

    @property
    def extra(self) -> int | None:
        return None if self.start is None else max(resident("VmHWM") - self.start, 0)


def resident(field: str) -> int:
    """Bytes of this process by /proc/self/status: "VmRSS" now, "VmHWM" at most since the last reset."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(1024 * int(line.split()[1]) for line in lines if line.startswith(f"{field}:"))


def quiet(name: str, **settings: Any) -> Any:
    """A pipeline of the built-in family, or of another one, without its progress bar."""
    pipe = tiny(name, **settings)
    pipe.set_progress_bar_config(disable=True)
    return pipe
