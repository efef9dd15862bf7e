"""What several benchmarks measure with: calls that take turns, and contacts of the world."""

import argparse
import json
import platform
import statistics
import time
import warnings
from collections.abc import Callable, Hashable, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

import numpy as np
import torch
from rich.console import Console
from sklearn.linear_model import RidgeCV
from sklearn.model_selection import LeaveOneGroupOut, cross_val_predict
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from torch import Tensor
from torchmetrics.functional.regression import pearson_corrcoef

from unitouch_gen.errors import UnfamiliarInputWarning
from unitouch_gen.files import write_file
from unitouch_gen.pipelines.tiny import tiny

Figures = dict[str, Any]
"""What was measured, by name: plain values, for JSON."""

Name = TypeVar("Name", bound=Hashable)
Seen = TypeVar("Seen")


def quiet(name: str, **settings: Any) -> Any:
    """A pipeline of the built-in family, or of another one, without its progress bar."""
    pipe = tiny(name, **settings)
    pipe.set_progress_bar_config(disable=True)
    return pipe


def in_turns(calls: Mapping[Name, Callable[[], Seen]], repeats: int) -> dict[Name, list[Seen]]:
    """What calls return that take turns, so that a busy spell of the machine hits all; a first turn is not kept."""
    turns = [{name: call() for name, call in calls.items()} for _ in range(repeats + 1)]
    return {name: [turn[name] for turn in turns[1:]] for name in calls}


def seconds_of(call: Callable[..., Any], *args: Any, **kwargs: Any) -> float:
    """Seconds of one call."""
    started = time.perf_counter()
    call(*args, **kwargs)
    return time.perf_counter() - started


def ratio_of(slow: Sequence[float], fast: Sequence[float]) -> dict[str, float]:
    """How many times as long `slow` took as `fast`: ratio of the medians, and the least and largest of the turns."""
    turns = [high / low for high, low in zip(slow, fast, strict=True)]
    return {"ratio": statistics.median(slow) / statistics.median(fast), "low": min(turns), "high": max(turns)}


def cross_predicted(features: Tensor, targets: Tensor, groups: Tensor) -> Tensor:
    """Targets (N, K) by ridge regression on features (N, D), each of the groups (N,) predicted from the others."""
    probe = make_pipeline(StandardScaler(), RidgeCV(np.logspace(-2, 4, 13)))
    x, y = (values.double().numpy() for values in (features, targets))
    return torch.from_numpy(cross_val_predict(probe, x, y, groups=groups.numpy(), cv=LeaveOneGroupOut())).to(targets)


def attribute_agreement(read: Tensor, truth: Tensor, names: Sequence[str]) -> dict[str, float]:
    """How well values read of contacts agree with the truth, (N, K) each, by the K names of `ATTRIBUTES`.

    Returns:
        Of numbers Pearson's correlation, 0 where one does not vary. Of the direction of the grain, whose angle the two
        numbers have doubled, the share within 20 degrees, 22 % by chance, and the median angle, over contacts that have
        one. Of the place of a contact the median distance in half views.
    """
    columns = {name: (read[:, place].double(), truth[:, place].double()) for place, name in enumerate(names)}
    pairs = {kind: [columns.pop(f"{kind} {axis}", None) for axis in "xy"] for kind in ("grain", "place")}
    found = {name: pearson_corrcoef(*pair).nan_to_num(0.0).item() for name, pair in columns.items()}
    if pairs["grain"][0] is not None:
        (read_x, true_x), (read_y, true_y) = pairs["grain"]
        clear = true_x.hypot(true_y) > 0.3  # 1 is all one way
        turned = torch.rad2deg(torch.atan2(read_y, read_x) - torch.atan2(true_y, true_x))[clear] / 2
        apart = ((turned + 90.0) % 180.0 - 90.0).abs()
        found |= {"grain within 20": (apart <= 20.0).double().mean().item(), "grain degrees": apart.median().item()}
    if pairs["place"][0] is not None:
        (read_x, true_x), (read_y, true_y) = pairs["place"]
        found["place apart"] = (read_x - true_x).hypot(read_y - true_y).median().item()
    return found


def over_seeds(rows: Sequence[Mapping[str, Mapping[str, float]]]) -> dict[str, dict[str, float | None]]:
    """Means over seeds of each figure and its controls, and the spread of the figure: its largest less its least."""
    figures = {}
    for name in rows[0]:
        each = [row[name] for row in rows]
        means: dict[str, float | None] = dict.fromkeys(("value", "class_mean", "shuffled", "ceiling"))
        means |= {key: statistics.mean(one[key] for one in each) for key in each[0]}
        values = [one["value"] for one in each]
        figures[name] = {**means, "spread": max(values) - min(values)}
    return figures


def machine() -> str:
    """What timings depend on, in words."""
    known = Path("/proc/cpuinfo")
    lines = known.read_text(encoding="utf-8").splitlines() if known.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    count = torch.get_num_threads()
    threads = "1 thread" if count == 1 else f"{count} threads"
    return f"{(names or [platform.machine()])[0]}, {threads}, torch {torch.__version__}"


def print_figures(given: argparse.Namespace, measure: Callable[[argparse.Namespace, Path], Figures]) -> None:
    """What a benchmark's command does: prints what `measure(given, cache)` returns, and writes it to `given.output`.

    `given.cache` is where contacts are rendered to; a folder that is removed if it is `None`.
    """
    warnings.simplefilter("ignore", UnfamiliarInputWarning)  # of sensors drawn anew and of scanned surfaces
    with TemporaryDirectory() as scratch:
        figures = measure(given, given.cache or Path(scratch))
    if given.output is not None:
        write_file("output", given.output, json.dumps(figures, indent=2) + "\n")
    Console(width=160, soft_wrap=True).print_json(data=figures)
