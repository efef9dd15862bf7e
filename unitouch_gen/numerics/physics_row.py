"""A point of error against run time of the world's physics, and how its error, order and seconds are measured."""

import math
import time
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from torch import Tensor

Name = TypeVar("Name", bound=Hashable)


@dataclass(frozen=True)
class PhysicsRow:
    """One point of error against run time.

    Attributes:
        problem: What was rendered.
        option: Which setting is varied; `value` says to what.
        spacing: Grid spacing relative to the default's, for options that refine a grid; `None` for others.
        samples: Contacts behind the quartiles.
        error_low, error, error_high: Quartiles of the relative RMS error. Of touch images it is relative to what the
            contact changes in the image of the untouched gel; of sounds to the sound, at the loudness that fits best
            (a sound is brought to one peak, so its own loudness is arbitrary).
        psnr_low, psnr, psnr_high: Quartiles of the PSNR of touch images, dB; NaN elsewhere.
        seconds, seconds_median: Least and median time for one sample.
        order: Slope of log error over log spacing, fitted to all of the option's rows; `None` where nothing is refined.
        failed, reason: Whether the setting could not be rendered or was not finite, and why.
    """

    problem: str
    option: str
    value: str
    spacing: float | None = None
    samples: int = 0
    error_low: float = math.nan
    error: float = math.nan
    error_high: float = math.nan
    psnr_low: float = math.nan
    psnr: float = math.nan
    psnr_high: float = math.nan
    seconds: float = math.nan
    seconds_median: float = math.nan
    order: float | None = None
    failed: bool = False
    reason: str = ""


def time_calls(calls: Mapping[Name, Callable[[], Any]], repeats: int = 3) -> dict[Name, tuple[float, float]]:
    """Least and median seconds of each call, after one warm-up; the calls take turns, so a busy spell hits them all."""
    for call in calls.values():
        call()
    seconds: dict[Name, list[float]] = {name: [] for name in calls}
    for _ in range(repeats):
        for name, call in calls.items():
            started = time.perf_counter()
            call()
            seconds[name].append(time.perf_counter() - started)
    return {name: (min(times), float(np.median(times))) for name, times in seconds.items()}


def with_quartiles(row: PhysicsRow, errors: Tensor | np.ndarray, psnr: Tensor | None = None) -> PhysicsRow:
    """The row with how far off (N,) samples were; it has failed if one of them is not finite."""
    errors = np.asarray(errors, dtype=np.float64)
    if not np.isfinite(errors).all():
        return replace(row, samples=len(errors), failed=True, reason="what it renders is not finite")
    low, middle, high = np.quantile(errors, (0.25, 0.5, 0.75)).tolist()
    row = replace(row, samples=len(errors), error_low=low, error=middle, error_high=high)
    if psnr is None:
        return row
    # "nearest", as the PSNR of equal images is infinite.
    low, middle, high = np.quantile(psnr.numpy(), (0.25, 0.5, 0.75), method="nearest").tolist()
    return replace(row, psnr_low=low, psnr=middle, psnr_high=high)


def observed_order(spacings: Sequence[float], errors: Sequence[float]) -> float:
    """Slope of log error over log spacing, by least squares."""
    return float(np.polyfit(np.log(spacings), np.log(errors), 1)[0])


def with_orders(rows: Iterable[PhysicsRow]) -> list[PhysicsRow]:
    """The rows, with the order that is seen over each problem's option filled in where a grid is refined."""
    rows = list(rows)
    families: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for row in rows:
        if row.spacing is not None and not row.failed and row.error > 0.0:
            families.setdefault((row.problem, row.option), []).append((row.spacing, row.error))
    orders = {
        key: observed_order(*zip(*points, strict=True)) for key, points in families.items() if len(set(points)) > 1
    }
    return [replace(row, order=orders.get((row.problem, row.option))) for row in rows]


def pareto_front(rows: Iterable[PhysicsRow]) -> list[PhysicsRow]:
    """The rows of one problem that no other beats in both median error and least seconds, fastest first."""
    front: list[PhysicsRow] = []
    for row in sorted((row for row in rows if not row.failed), key=lambda row: (row.seconds, row.error)):
        if not front or row.error < front[-1].error:
            front.append(row)
    return front
