"""Error against run time of solvers, on a problem or in calls of a pipeline, in the manner of SciML's work-precision
sets: all start from the same noise, errors are of the latents against one reference, and failures are results too.
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
"""A result: solver, steps or tolerance, quartiles of the error, evaluations, seconds per sample, failures and why."""

STABLE_DIFFUSION = {"timestep_spacing": "leading", "steps_offset": 1, "set_alpha_to_one": False, "clip_sample": False}
BASELINES: dict[str, tuple[type, dict[str, Any]]] = {
    "diffusers:ddim": (DDIMScheduler, STABLE_DIFFUSION),
    "diffusers:dpm++2m": (DPMSolverMultistepScheduler, {"use_karras_sigmas": True}),
}
"""diffusers' own schedulers as its users exchange them, which ours are measured against."""

TURBO_STEPS = [1, 2, 4]
"""Their noise levels are among those that `training.distill` learns."""

NAMES = (*SOLVERS, "tolerance", "default", "turbo", *BASELINES)
"""Solvers that can be measured: "default" is a pipeline's own scheduler, "turbo" a distilled network."""


@dataclass(frozen=True, eq=False)
class Target:
    """What is run from N noises, and where the exact flow ends from them."""

    name: str
    run: Callable[[str, int | None, float | None], tuple[Tensor, RunReport]]
    """(one of `NAMES`, steps, tolerance) -> latents of the finite samples, report."""
    guidance_scale: float
    truth: Tensor  # (N, C, h, w) float64
    own_error: float = 0.0  # of the truth, median; 0 for a closed form
    default_steps: int | None = None  # of a pipeline
    noisy: tuple[str, ...] = ()  # solvers that add noise: they end at other samples, however many steps they take


def scheduler_of(solver: str, own: Any) -> Any:
    """The scheduler of a baseline, for a network that was trained with another one; of other solvers that one."""
    if solver not in BASELINES:
        return own
    kind, settings = BASELINES[solver]
    trained = [*TRAINED, *({"rescale_betas_zero_snr"} & own.config.keys())]  # not all schedulers have it
    return kind(**{name: own.config[name] for name in trained}, **settings)


def problem_target(problem: Problem, seeds: int = 8) -> Target:
    """A problem from some noises."""
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
        return latents[[code.finite for code in report.codes]], report

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
    """Calls of a pipeline under conditions, from some noises each.

    The reference is 400 steps of UniPC, its own error the distance of 200 steps to it. A trained network ripples with
    the waves of the timestep's embedding, by about one percent over some ten levels, and tolerances far below that
    follow every ripple.

    Args:
        inputs: Arguments of the pipeline's call that hold a row for each condition.
        seeds: Noises for each condition.
        turbo: The pipeline distilled, which needs no guidance, for "turbo".

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

    most = min(400, pipe.scheduler.config.num_train_timesteps)
    coarse, truth = (run("unipc", steps, throw=True)[0].double() for steps in (most // 2, most))
    own_error = relative_rms(coarse, truth).median().item()
    noisy = ("turbo", "default") if re.search("Ancestral|LCM|TCD|DDPM|SDE", str(type(pipe.scheduler))) else ("turbo",)
    return Target(name, run, scale, truth, own_error, pipe.config["default_num_inference_steps"], noisy)


def world_inputs(modalities: Sequence[str], conditions: int) -> dict[str, Tensor]:
    """Contacts with objects that nothing was trained on, over as many materials: "image" and "touch" (N, 3, S, S)."""
    from unitouch_gen.world import FIRST_OBJECT, MATERIAL_NAMES, World

    material = torch.arange(conditions) * len(MATERIAL_NAMES) // conditions
    objects = torch.full_like(material, FIRST_OBJECT["test"])
    scene = World().render(material, objects, torch.zeros_like(material), modalities=tuple(modalities))
    found: dict[str, Any] = {"image": scene.image, "touch": scene.touch.get("gelsight")}
    return {name: found[name] for name in modalities}


def measure(
    target: Target, solver: str, steps: int | None = None, tolerance: float | None = None, repeats: int = 3
) -> Row:
    """One result; what the run raises is its reason."""
    samples = len(target.truth)
    row: Row = {"solver": solver, "steps": steps, "tolerance": tolerance, "samples": samples, "reason": ""}
    row |= {"default": solver == "default" and steps == target.default_steps, "noisy": solver in target.noisy}
    try:
        runs = [target.run(solver, steps, tolerance) for _ in range(repeats)]
    except Exception as error:  # the other points are worth having, and this one says what it was
        return {**row, "failures": samples, "reason": f"{type(error).__name__}: {first_line(error)}"}
    latents, report = runs[-1]
    finite = [code.finite for code in report.codes]
    failed = [code for code in report.codes if code != "success"]
    errors = relative_rms(latents, target.truth[finite]).numpy()
    if len(errors):
        row |= zip(("error_low", "error", "error_high"), np.quantile(errors, (0.25, 0.5, 0.75)).tolist(), strict=True)
    seconds = min(report.seconds["denoising"] for _, report in runs) / samples
    row |= {"evaluations": report.evaluations, "seconds": seconds, "failures": len(failed)}
    return {**row, "reason": ", ".join(sorted({code.value for code in failed}))}


def good(rows: Sequence[Row]) -> list[Row]:
    """Those without failures."""
    return [row for row in rows if not row["failures"]]


def pareto_front(rows: Sequence[Row], cost: str) -> list[Row]:
    """Results without added noise that no other beats in both error and "seconds" or "evaluations", by cost."""
    front: list[Row] = []
    for row in sorted((row for row in good(rows) if not row["noisy"]), key=lambda row: (row[cost], row["error"])):
        if not front or row["error"] < front[-1]["error"]:
            front.append(row)
    return front


def amount(row: Row) -> str:
    """ "20 steps" or "tolerance 0.01"."""
    return f"tolerance {row['tolerance']:g}" if row["steps"] is None else f"{row['steps']} steps"


def draw_chart(target: Target, rows: Sequence[Row]) -> Figure:
    """Error against seconds and evaluations. Bars are quartiles, the wide band is the Pareto front with its steps or
    tolerances, a star what a call without options runs."""
    figure = Figure(figsize=(12.6, 5.4), layout="constrained")
    figure.suptitle(f"{target.name}, guidance {target.guidance_scale:g}: error against run time")
    left, right = figure.subplots(1, 2, sharey=True)
    _draw_panel(left, target, rows, "seconds", "seconds for one sample")
    _draw_panel(right, target, rows, "evaluations", "evaluations of the network")
    left.set_ylabel("relative RMS error of the latents")
    right.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
    return figure


def _draw_panel(axes: Axes, target: Target, rows: Sequence[Row], cost: str, words: str) -> None:
    scale = "log" if good(rows) else "linear"
    axes.set(xscale=scale, yscale=scale, xlabel=words)
    axes.grid(color="#d9d9d9")
    front = pareto_front(rows, cost)
    axes.plot(
        [row[cost] for row in front],
        [row["error"] for row in front],
        "y-",
        linewidth=11,
        alpha=0.4,
        label="Pareto front",
    )
    for row in front:
        axes.annotate(str(row["steps"] or row["tolerance"]), (row[cost], row["error"]))
    for solver in dict.fromkeys(row["solver"] for row in rows):
        known = sorted((row for row in good(rows) if row["solver"] == solver), key=lambda row: row[cost])
        x, low, error, high = ([row[key] for row in known] for key in (cost, "error_low", "error", "error_high"))
        bars = (np.subtract(error, low), np.subtract(high, error))
        colour = f"C{NAMES.index(solver)}"
        label = f"{solver} (adds noise)" if known and known[0]["noisy"] else solver
        axes.errorbar(x, error, yerr=bars, fmt="o-", color=colour, capsize=2, label=label)
        for row in known:
            if row["default"]:
                axes.plot(row[cost], row["error"], "*", markersize=19, color=colour)
    if target.own_error > 0.03 * min((row["error"] for row in good(rows)), default=math.inf):
        words = f"reference's own error {target.own_error:.0e}"
        axes.axhline(target.own_error, color="#444444", linestyle="--", label=words)
    if good(rows):
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter("")


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
