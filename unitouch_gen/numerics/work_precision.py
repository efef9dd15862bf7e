"""Work-precision diagrams: error against run time of solvers, on a problem or in calls of a pipeline.

As in SciML's work-precision sets, all solvers start from the same noise, errors are of the latents against one
reference, and failures are results, too.
"""

import copy
import io
import json
import math
import platform
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from diffusers import DDIMScheduler, DPMSolverMultistepScheduler
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator
from torch import Tensor

from unitouch_gen.errors import UnfamiliarInputWarning, first_line
from unitouch_gen.files import write_file
from unitouch_gen.numerics.problems import Problem, relative_rms
from unitouch_gen.sampling import SOLVERS, RunReport
from unitouch_gen.schedule import TRAINED

Row = dict[str, Any]
"""A result: solver, steps or tolerance, quartiles of the error, evaluations, seconds per sample, failures, reason."""

STABLE_DIFFUSION = {"timestep_spacing": "leading", "steps_offset": 1, "set_alpha_to_one": False, "clip_sample": False}
BASELINES: dict[str, tuple[type, dict[str, Any]]] = {
    "diffusers:ddim": (DDIMScheduler, STABLE_DIFFUSION),
    "diffusers:dpm++2m": (DPMSolverMultistepScheduler, {"use_karras_sigmas": True}),
}
"""diffusers' own schedulers with the settings its users choose, as baselines."""

TURBO_STEPS = [1, 2, 4]
"""Numbers of steps whose noise levels are among those that `training.distill` learns."""

NAMES = (*SOLVERS, "tolerance", "default", "turbo", *BASELINES)
"""Solvers that can be measured: "default" is a pipeline's own scheduler, "turbo" a distilled network."""


@dataclass(frozen=True, eq=False)
class Target:
    """A problem or a pipeline that is run from N noises, and the ends of the exact flow."""

    name: str
    run: Callable[[str, int | None, float | None], tuple[Tensor, RunReport]]
    """(one of `NAMES`, steps, tolerance) -> latents of the finite samples, report."""
    guidance_scale: float
    truth: Tensor  # (N, C, h, w) float64
    own_error: float = 0.0  # median error of the truth; 0 for a closed form
    default_steps: int | None = None  # of a pipeline
    noisy: tuple[str, ...] = ()  # solvers that add noise, which end at other samples, however many steps they take


def scheduler_of(solver: str, own: Any) -> Any:
    """The scheduler of a baseline with the trained settings of the scheduler `own`; of other solvers `own`."""
    if solver not in BASELINES:
        return own
    kind, settings = BASELINES[solver]
    names = list(TRAINED)
    if "rescale_betas_zero_snr" in own.config:  # not all schedulers have it
        names.append("rescale_betas_zero_snr")
    return kind(**{name: own.config[name] for name in names}, **settings)


def problem_target(problem: Problem, seeds: int = 8) -> Target:
    """A problem from `seeds` noises."""
    noise = problem.noise(seeds)

    def run(solver: str, steps: int | None, tolerance: float | None) -> tuple[Tensor, RunReport]:
        latents, report = problem.run(
            noise,
            solver if solver in SOLVERS else None,
            scheduler=scheduler_of(solver, problem.scheduler()),
            num_inference_steps=steps,
            tolerance=tolerance,
            throw=False,
        )
        is_finite = [code.finite for code in report.codes]
        return latents[is_finite], report

    return Target(problem.name, run, problem.guidance_scale, problem.solution(noise))


def pipeline_target(
    pipe: Any,
    inputs: Mapping[str, Tensor],
    *,
    name: str = "",
    seeds: int = 2,
    guidance_scale: float | None = None,
    turbo: Any = None,
) -> Target:
    """Calls of a pipeline under some conditions, from `seeds` noises each.

    The reference is 400 steps of UniPC. Its own error is the distance of 200 steps from it. The output of a trained
    network ripples with the waves of the timestep's embedding, by about one percent over some ten levels, and
    tolerances far below that follow every ripple.

    Args:
        inputs: Arguments of the pipeline's call, with a row for each condition.
        seeds: Noises for each condition.
        turbo: The distilled pipeline, which needs no guidance, for "turbo".

    Raises:
        NonFiniteError: If the reference is not finite.
    """
    scale = pipe.config["default_guidance_scale"] if guidance_scale is None else guidance_scale

    def run(
        solver: str, steps: int | None, tolerance: float | None = None, throw: bool = False
    ) -> tuple[Tensor, RunReport]:
        called = copy.copy(turbo if solver == "turbo" else pipe)
        called.scheduler = scheduler_of(solver, called.scheduler)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UnfamiliarInputWarning)
            output = called(
                **inputs,
                num_images_per_prompt=seeds,
                solver=solver if solver in SOLVERS else None,
                num_inference_steps=steps,
                tolerance=tolerance,
                guidance_scale=1.0 if solver == "turbo" else scale,
                generator=torch.Generator().manual_seed(0),
                output_type="latent",
                throw=throw,
            )
        return output.images.cpu(), output.report

    most_steps = min(400, pipe.scheduler.config.num_train_timesteps)
    coarse, _ = run("unipc", most_steps // 2, throw=True)
    truth, _ = run("unipc", most_steps, throw=True)
    coarse = coarse.double()
    truth = truth.double()
    adds_noise = re.search("Ancestral|LCM|TCD|DDPM|SDE", str(type(pipe.scheduler)))
    return Target(
        name,
        run,
        scale,
        truth,
        own_error=relative_rms(coarse, truth).median().item(),
        default_steps=pipe.config["default_num_inference_steps"],
        noisy=("turbo", "default") if adds_noise else ("turbo",),
    )


def world_inputs(modalities: Sequence[str], conditions: int) -> dict[str, Tensor]:
    """Contacts with held-out objects of as many materials as possible: "image" and "touch" (N, 3, S, S)."""
    from unitouch_gen.world import FIRST_OBJECT, MATERIAL_NAMES, World

    material = torch.arange(conditions) * len(MATERIAL_NAMES) // conditions
    objects = torch.full_like(material, FIRST_OBJECT["test"])
    scene = World().render(material, objects, torch.zeros_like(material), modalities=tuple(modalities))
    images: dict[str, Any] = {"image": scene.image, "touch": scene.touch.get("gelsight")}
    return {name: images[name] for name in modalities}


def measure(
    target: Target, solver: str, steps: int | None = None, tolerance: float | None = None, repeats: int = 3
) -> Row:
    """One result; if the run raises an error, that is the reason of its failure."""
    samples = len(target.truth)
    row: Row = {
        "solver": solver,
        "steps": steps,
        "tolerance": tolerance,
        "samples": samples,
        "reason": "",
        "default": solver == "default" and steps == target.default_steps,
        "noisy": solver in target.noisy,
    }
    try:
        runs = [target.run(solver, steps, tolerance) for _ in range(repeats)]
    except Exception as error:  # an error of one point must not lose the others
        return {**row, "failures": samples, "reason": f"{type(error).__name__}: {first_line(error)}"}
    latents, report = runs[-1]
    is_finite = [code.finite for code in report.codes]
    errors = relative_rms(latents, target.truth[is_finite]).numpy()
    if len(errors):
        row["error_low"], row["error"], row["error_high"] = np.quantile(errors, (0.25, 0.5, 0.75)).tolist()
    row["evaluations"] = report.evaluations
    row["seconds"] = min(report.seconds["denoising"] for _, report in runs) / samples
    failed = [code for code in report.codes if code != "success"]
    row["failures"] = len(failed)
    row["reason"] = ", ".join(sorted({code.value for code in failed}))
    return row


def successful(rows: Sequence[Row]) -> list[Row]:
    """Results without failures."""
    return [row for row in rows if not row["failures"]]


def pareto_front(rows: Sequence[Row], cost: str) -> list[Row]:
    """Results without added noise that no other beats in both error and `cost`, "seconds" or "evaluations", by cost."""
    candidates = [row for row in successful(rows) if not row["noisy"]]
    front: list[Row] = []
    for row in sorted(candidates, key=lambda row: (row[cost], row["error"])):
        if not front or row["error"] < front[-1]["error"]:
            front.append(row)
    return front


def amount(row: Row) -> str:
    """The steps or tolerance in words: "20 steps", "tolerance 0.01"."""
    return f"tolerance {row['tolerance']:g}" if row["steps"] is None else f"{row['steps']} steps"


def draw_chart(target: Target, rows: Sequence[Row]) -> Figure:
    """Error against seconds and evaluations.

    Bars are quartiles. The wide band is the Pareto front, with its steps or tolerances. A star is a call without
    options.
    """
    figure = Figure(figsize=(12.6, 5.4), layout="constrained")
    figure.suptitle(f"{target.name}, guidance {target.guidance_scale:g}: error against run time")
    left, right = figure.subplots(1, 2, sharey=True)
    _draw_panel(left, target, rows, cost="seconds", label="seconds for one sample")
    _draw_panel(right, target, rows, cost="evaluations", label="evaluations of the network")
    left.set_ylabel("relative RMS error of the latents")
    right.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
    return figure


def _draw_panel(axes: Axes, target: Target, rows: Sequence[Row], cost: str, label: str) -> None:
    """Error against one cost."""
    results = successful(rows)
    scale = "log" if results else "linear"
    axes.set(xscale=scale, yscale=scale, xlabel=label)
    axes.grid(color="#d9d9d9")
    front = pareto_front(rows, cost)
    front_costs = [row[cost] for row in front]
    front_errors = [row["error"] for row in front]
    axes.plot(front_costs, front_errors, "y-", linewidth=11, alpha=0.4, label="Pareto front")
    for row in front:
        axes.annotate(str(row["steps"] or row["tolerance"]), (row[cost], row["error"]))
    for solver in dict.fromkeys(row["solver"] for row in rows):
        _draw_solver(axes, solver, [row for row in results if row["solver"] == solver], cost)
    if target.own_error > 0.03 * min((row["error"] for row in results), default=math.inf):
        words = f"reference's own error {target.own_error:.0e}"
        axes.axhline(target.own_error, color="#444444", linestyle="--", label=words)
    if results:
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter("")


def _draw_solver(axes: Axes, solver: str, results: Sequence[Row], cost: str) -> None:
    """Errors of one solver with their quartiles, and a star at the default."""
    points = sorted(results, key=lambda row: row[cost])
    costs = [row[cost] for row in points]
    errors = [row["error"] for row in points]
    below = np.subtract(errors, [row["error_low"] for row in points])
    above = np.subtract([row["error_high"] for row in points], errors)
    colour = f"C{NAMES.index(solver)}"
    label = f"{solver} (adds noise)" if points and points[0]["noisy"] else solver
    axes.errorbar(costs, errors, yerr=(below, above), fmt="o-", color=colour, capsize=2, label=label)
    for row in points:
        if row["default"]:
            axes.plot(row[cost], row["error"], "*", markersize=19, color=colour)


def save(folder: Path, target: Target, rows: Sequence[Row]) -> list[Path]:
    """Writes `results.json` and `chart.png`."""
    values = {
        "target": target.name,
        "guidance_scale": target.guidance_scale,
        "own_error": target.own_error,
        "machine": f"{platform.machine()}, {torch.get_num_threads()} threads",
        "rows": list(rows),
    }
    picture = io.BytesIO()
    draw_chart(target, rows).savefig(picture, format="png", dpi=160, facecolor="white")
    contents: dict[str, str | bytes] = {"results.json": json.dumps(values, indent=1), "chart.png": picture.getvalue()}
    return [write_file("output", folder / name, content) for name, content in contents.items()]
