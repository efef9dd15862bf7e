"""Error against run time of solvers, on a problem or on a pipeline's network, in the manner of SciML's work-precision
sets: all start from the same noise, errors are of the latents against one reference, and failures are results too.
"""

import io
import json
import math
import platform
import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from diffusers import DDIMScheduler, DPMSolverMultistepScheduler, LCMScheduler
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator
from torch import Tensor

from unitouch_gen.errors import UnfamiliarInputWarning, first_line
from unitouch_gen.files import write_file
from unitouch_gen.numerics.problems import Problem
from unitouch_gen.numerics.reference import relative_rms, solve_reference
from unitouch_gen.sampling import SOLVERS, Guidance, Network, RunReport, prepare_steps, sample
from unitouch_gen.schedule import TRAINED, NoiseSchedule, alpha, to_denoised

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

NAMES = (*SOLVERS, "adaptive", "default", "turbo", *BASELINES)
"""Solvers that can be measured: "default" is a pipeline's own scheduler, "turbo" a distilled network."""


@dataclass(frozen=True, eq=False)
class Target:
    """A network with its conditions bound, N noises to start from, and where the exact flow ends from them."""

    name: str
    network: Network
    scheduler: Any  # the pipeline's own
    guidance: Guidance
    noise: Tensor  # (N, C, h, w)
    truth: Tensor  # (N, C, h, w) float64
    own_error: float = 0.0  # of the truth, median; 0 for a closed form
    default_steps: int | None = None  # of a pipeline
    turbo: Network | None = None  # which needs no guidance
    turbo_timesteps: Sequence[int] | None = None  # that it was distilled for, if not those of `LCMScheduler`


def problem_target(problem: Problem, seeds: int = 8) -> Target:
    """A problem from some noises."""
    noise = problem.noise(seeds)
    network, truth = problem.network(seeds), problem.solution(noise)
    return Target(problem.name, network, problem.scheduler(), problem.guidance, noise, truth)


@torch.no_grad()
def pipeline_target(
    pipe: Any, inputs: Mapping[str, Tensor], *, name: str = "", seeds: int = 2, guidance_scale: float | None = None,
    rtol: float = 1e-4, student: Any = None, timesteps: Sequence[int] | None = None, **options: Any,
) -> Target:  # fmt: skip
    """The network of a pipeline under conditions, from some noises each.

    Args:
        inputs: Arguments of the pipeline's call that hold a row for each condition; `options` are more of them.
        seeds: Noises for each condition.
        rtol: Tolerance of the reference. A trained network ripples with the waves of the timestep's embedding, by about
            one percent over some ten levels; far below this tolerance solvers follow every ripple.
        student, timesteps: A UNet that was distilled from the pipeline's, for "turbo", and what it was distilled for.
    """
    guidance = Guidance(pipe.config["default_guidance_scale"] if guidance_scale is None else guidance_scale)
    seen: list[tuple[Tensor, dict[str, Any]]] = []
    hook = pipe.unet.register_forward_pre_hook(lambda _, args, kwargs: seen.append((args[0], kwargs)), with_kwargs=True)
    repeated = {key: value.repeat_interleave(seeds, dim=0) for key, value in inputs.items()}
    call = {"solver": "ddim", "num_inference_steps": 1, "guidance_scale": guidance.scale, "output_type": "latent"}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UnfamiliarInputWarning)
            pipe(**repeated, **call, generator=torch.Generator().manual_seed(0), throw=False, **options)
    finally:
        hook.remove()
    (states, conditions), unet, scheduler = seen[0], pipe.unet, pipe.scheduler
    channels, schedule = unet.config.out_channels, NoiseSchedule.of(scheduler)

    def network(z: Tensor, timestep: Tensor, unet: Any = unet) -> Tensor:
        """Of a batch without unconditional half, the conditions of the other one."""
        of_rows = {key: value[-len(z) :] if isinstance(value, Tensor) else value for key, value in conditions.items()}
        beside = states[-len(z) :, channels:]  # what the network is shown as further channels
        return unet(torch.cat([z.to(states), beside], dim=1), timestep.to(states.device), **of_rows)[0]

    @torch.no_grad()
    def denoise(x: Tensor, sigma: float) -> Tensor:
        z, timestep = x * alpha(sigma), schedule.timestep(sigma).float()
        prediction = network(torch.cat([z] * 2) if guidance.active else z, timestep).cpu().double()
        prediction = guidance.combine(prediction) if guidance.active else prediction
        return to_denoised(prediction, z, sigma, scheduler.config.prediction_type)

    samples = len(states) // (2 if guidance.active else 1)
    noise = torch.randn(samples, channels, *states.shape[2:], generator=torch.Generator().manual_seed(0))
    truth, disagreement = solve_reference(denoise, noise, schedule, rtol)
    own_error, steps = disagreement.median().item(), pipe.config["default_num_inference_steps"]
    turbo = None if student is None else partial(network, unet=student)
    noise = noise.to(states.device)
    return Target(name, network, scheduler, guidance, noise, truth, own_error, steps, turbo, timesteps)


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
    row: Row = {"solver": solver, "steps": steps, "tolerance": tolerance, "samples": len(target.noise), "reason": ""}
    row["default"] = solver == "default" and steps == target.default_steps
    scheduler: Any = target.scheduler
    network: Any = target.network
    guidance = target.guidance
    if solver == "turbo":
        scheduler, guidance = LCMScheduler.from_config(scheduler.config), Guidance(1.0)
        network = target.turbo
    elif solver in BASELINES:
        kind, settings = BASELINES[solver]
        scheduler = kind(**{name: scheduler.config[name] for name in TRAINED}, **settings)
    named, seconds, report = solver if solver in SOLVERS else None, [], RunReport()
    given: dict[str, Any] = {"num_inference_steps": steps}
    if solver == "turbo" and target.turbo_timesteps and len(target.turbo_timesteps) == steps:
        given = {"timesteps": target.turbo_timesteps}
    try:
        prepared = prepare_steps(scheduler, solver=named, tolerance=tolerance, **given)
        for _ in range(repeats):
            report, started = RunReport(), time.perf_counter()
            added = torch.Generator().manual_seed(1)  # noise of some schedulers, other than what they start from
            latents = sample(network, target.noise, prepared, report, guidance=guidance, generator=added, throw=False)
            seconds.append((time.perf_counter() - started) / len(latents))
    except Exception as error:  # the other points are worth having, and this one says what it was
        return {**row, "failures": len(target.noise), "reason": f"{type(error).__name__}: {first_line(error)}"}
    finite, failed = ([code.finite for code in report.codes], [code for code in report.codes if code != "success"])
    errors = relative_rms(latents.cpu(), target.truth)[finite].numpy()
    if len(errors):
        row |= zip(("error_low", "error", "error_high"), np.quantile(errors, (0.25, 0.5, 0.75)).tolist(), strict=True)
    row |= {"evaluations": report.evaluations, "seconds": min(seconds), "failures": len(failed)}
    return {**row, "reason": ", ".join(sorted({code.value for code in failed}))}


def good(rows: Sequence[Row]) -> list[Row]:
    """Those without failures."""
    return [row for row in rows if not row["failures"]]


def pareto_front(rows: Sequence[Row], cost: str) -> list[Row]:
    """The results that no other beats in both error and "seconds" or "evaluations", cheapest first."""
    front: list[Row] = []
    for row in sorted(good(rows), key=lambda row: (row[cost], row["error"])):
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
    figure.suptitle(f"{target.name}, guidance {target.guidance.scale:g}: error against run time")
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
    axes.plot([row[cost] for row in front], [row["error"] for row in front], "y-", linewidth=11, alpha=0.4,
              label="Pareto front")  # fmt: skip
    for row in front:
        axes.annotate(str(row["steps"] or row["tolerance"]), (row[cost], row["error"]))
    for solver in dict.fromkeys(row["solver"] for row in rows):
        known = sorted((row for row in good(rows) if row["solver"] == solver), key=lambda row: row[cost])
        x, low, error, high = ([row[key] for row in known] for key in (cost, "error_low", "error", "error_high"))
        bars, colour = (np.subtract(error, low), np.subtract(high, error)), f"C{NAMES.index(solver)}"
        axes.errorbar(x, error, yerr=bars, fmt="o-", color=colour, capsize=2, label=solver)
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
    values = {"target": target.name, "guidance_scale": target.guidance.scale, "own_error": target.own_error,
              "machine": f"{platform.machine()}, {torch.get_num_threads()} threads", "rows": list(rows)}  # fmt: skip
    picture = io.BytesIO()
    draw_chart(target, rows).savefig(picture, format="png", dpi=160, facecolor="white")
    contents: dict[str, str | bytes] = {"results.json": json.dumps(values, indent=1), "chart.png": picture.getvalue()}
    return [write_file("output", folder / name, content) for name, content in contents.items()]
