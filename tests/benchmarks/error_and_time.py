"""Every figure of error against run time, from one run: `python -m tests.benchmarks --only error_and_time`.

Speed-ups at the paper's guidance over the usual way, what exact eliminations save, orders of convergence, how well runs
estimate their own error, the stiff and extreme cases, and the world's own physics. Ten minutes or so; each part is
printed when it is done.
"""

import statistics
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from tests.benchmarks import Figures
from tests.benchmarks.effectivities import exact_effectivity, pipeline_configurations, pipeline_effectivity
from tests.benchmarks.eliminations import ROWS, elimination_figures
from tests.benchmarks.speedup import (
    CLOSE,
    called,
    picture_subject,
    speedup_figures,
    touch_subject,
    usual_pictures,
    usual_touches,
)
from tests.benchmarks.turns import in_turns
from unitouch_gen import weights
from unitouch_gen.numerics.checkpoint import close_reference
from unitouch_gen.numerics.physics import physics_rows
from unitouch_gen.numerics.physics_row import PhysicsRow
from unitouch_gen.numerics.pipeline_subject import PipelineSubject
from unitouch_gen.numerics.stability import Suite, run_cases
from unitouch_gen.numerics.stability_suite import suite
from unitouch_gen.numerics.work_precision import Order, order_table
from unitouch_gen.pipelines.tiny import tiny

WANTED = (0.2, 0.1, 0.05, 0.02)
"""Errors whose price is told."""

PHYSICS = {"touch of gelsight": "both grids, spectral slopes", "sound, whole band": "sample rate"}
"""Of the world's physics, what is varied of each problem."""


def error_and_time_figures(
    family: Path = weights.FAMILY, conditions: int = 16, judged: int = 16, repeats: int = 7, evaluations: int = CLOSE
) -> Figures:
    """All of it.

    Args:
        family: Folder of weights.
        conditions: Held-out contacts that errors of speed-ups are medians over.
        judged: ... that estimates of pipelines are judged on.
        repeats: Pairs of timed calls.
        evaluations: Of the close paths that errors are measured from.
    """
    picture, touch = (_pipeline(name, family) for name in ("touch-to-image", "x-to-touch"))
    subjects: dict[str, Callable[[int], PipelineSubject]] = {
        "touch-to-image": lambda count: picture_subject(picture, count),
        "x-to-touch": lambda count: touch_subject(touch, count),
    }
    usual = {"touch-to-image": usual_pictures, "x-to-touch": usual_touches}
    parts: dict[str, Callable[[], Any]] = {
        "orders": lambda: order_figures(order_table()),
        "eliminations": lambda: {name: elimination_figures(make(max(ROWS) // 2)) for name, make in subjects.items()},
        "speedup": lambda: {
            name: speedup_figures(subject, usual[name](subject), repeats, evaluations=evaluations, compiling=True)
            for name, subject in ((name, make(conditions)) for name, make in subjects.items())
        },
        "effectivity": lambda: {
            "exact": exact_effectivity(),
            **{name: default_figures(make(judged), repeats, evaluations) for name, make in subjects.items()},
        },
        "stability": lambda: stability_figures(suite(partial(tiny, family=family))),
        "physics": lambda: physics_figures(physics_rows(16, ("gelsight",))),
    }
    return run_parts(parts)


def run_parts(parts: Mapping[str, Callable[[], Any]]) -> Figures:
    """Figures by part, each printed when it is done."""
    figures = {}
    for name, measure in parts.items():
        figures[name] = measure()
        Console(width=110, stderr=True).print(f"{name}:", figures[name])
    return figures


def _pipeline(name: str, family: Path) -> Any:
    pipe = tiny(name, family=family)
    pipe.set_progress_bar_config(disable=True)
    return pipe


def order_figures(orders: Sequence[Order]) -> Figures:
    """Nominal and fitted orders by solver, and by problem."""
    figures: Figures = {}
    for order in orders:
        figures.setdefault(order.solver, {"nominal": order.nominal, "fitted": {}})["fitted"][order.series] = (
            order.fitted
        )
    return figures


def default_figures(subject: PipelineSubject, repeats: int, evaluations: int) -> Figures:
    """Estimates against true errors at the pipeline's own guidance, and what errors cost there."""
    reference = close_reference(subject, subject.guidance_scale, evaluations)
    wanted = pipeline_configurations(subject.pipe, subject.guidance_scale)
    figures = pipeline_effectivity(subject, reference, wanted)
    return {**figures, "prices": price_figures(subject, figures["runs"], repeats)}


def price_figures(
    subject: PipelineSubject, runs: Sequence[Mapping[str, Any]], repeats: int, wanted: Sequence[float] = WANTED
) -> Figures:
    """For each error the run with the fewest evaluations that has it, and seconds of the denoising of one sample.

    Args:
        subject: They are of.
        runs: See `pipeline_effectivity`.
        repeats: Timed calls of each; they take turns.
        wanted: Errors.
    """
    chosen: dict[str, Mapping[str, Any]] = {}
    for error in wanted:
        able = [run for run in runs if run["error"] <= error and run["steps"]]
        if able:
            chosen[f"{error:g}"] = min(able, key=lambda run: (run["evaluations"], run["error"]))
    calls = {}
    for run in chosen.values():
        settings = {
            "solver": run["solver"],
            "num_inference_steps": run["steps"],
            "guidance_scale": subject.guidance_scale,
        }
        calls[run["solver"], run["steps"]] = lambda settings=settings: called(subject, [0], "latent", **settings)[1]
    seen = in_turns(calls, repeats)
    prices: Figures = {}
    for named, run in chosen.items():
        seconds = [each["denoising"] for each in seen[run["solver"], run["steps"]]]
        prices[named] = {**run, "seconds": statistics.median(seconds), "low": min(seconds), "high": max(seconds)}
    return prices


def stability_figures(cases: Suite) -> Figures:
    """How many cases there are, ended as expected, and were silently not finite; and which did not end so."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of libraries, on input that is meant to be odd
        outcomes = list(run_cases(cases))
    wrong = [outcome.name for outcome in outcomes if not outcome.ok]
    return {
        "cases": len(outcomes),
        "as_expected": len(outcomes) - len(wrong),
        "silent": sum(outcome.silent for outcome in outcomes),
        "seconds": sum(outcome.seconds for outcome in outcomes),
        "wrong": wrong,
    }


def physics_figures(rows: Sequence[PhysicsRow]) -> Figures:
    """Error, seconds and order of what `PHYSICS` names, by setting."""
    return {
        problem: {
            row.value: {"error": row.error, "seconds": row.seconds, "order": row.order}
            for row in rows
            if (row.problem, row.option) == (problem, option) and not row.failed
        }
        for problem, option in PHYSICS.items()
    }
