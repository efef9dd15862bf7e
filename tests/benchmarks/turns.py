"""Timing calls against each other, in turns."""

import statistics
import time
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any, TypeVar

Name = TypeVar("Name", bound=Hashable)
Seen = TypeVar("Seen")


def in_turns(calls: Mapping[Name, Callable[[], Seen]], repeats: int) -> dict[Name, list[Seen]]:
    """What calls return that take turns, so that a busy spell of the machine hits them all.

    Args:
        calls: By name.
        repeats: Turns, after a first one that is not counted.
    """
    seen: dict[Name, list[Seen]] = {name: [] for name in calls}
    for turn in range(repeats + 1):
        for name, call in calls.items():
            found = call()
            if turn > 0:
                seen[name].append(found)
    return seen


def spread_of(values: Sequence[float]) -> dict[str, float]:
    """Median, and largest less least."""
    return {"median": statistics.median(values), "spread": max(values) - min(values)}


def ratio_of(slow: Sequence[float], fast: Sequence[float]) -> dict[str, float]:
    """How many times as long `slow` took as `fast`: ratio of the medians, and the least and largest of the turns."""
    turns = [high / low for high, low in zip(slow, fast, strict=True)]
    return {"ratio": statistics.median(slow) / statistics.median(fast), "low": min(turns), "high": max(turns)}


def seconds_of(call: Callable[[], Any]) -> float:
    """Of one call."""
    started = time.perf_counter()
    call()
    return time.perf_counter() - started
