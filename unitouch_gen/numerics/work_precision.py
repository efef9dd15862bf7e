"""Error against run time of solvers, on a problem or on a pipeline's network, in the manner of SciML's work-precision
sets: all start from the same noise, errors are of the latents against one reference, and what fails is a result too.
"""

import io
import json
import math
import platform
import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import diffusers
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator
from torch import Tensor

from unitouch_gen.errors import UnfamiliarInputWarning, first_line
from unitouch_gen.files import write_file
from unitouch_gen.numerics.problems import Problem
from unitouch_gen.numerics.reference import relative_rms, solve_reference
from unitouch_gen.sampling import SOLVERS, Guidance, Network, RunReport, prepare_steps, sample
from unitouch_gen.schedule import NoiseSchedule, alpha, to_denoised

Row = dict[str, Any]
"""A result: solver, steps or tolerance, quartiles of the error, evaluations, seconds a sample, failures and why."""

LEADING = {"timestep_spacing": "leading", "steps_offset": 1}
BASELINES: dict[str, tuple[str, dict[str, Any]]] = {
    "diffusers:ddim": ("DDIMScheduler", {**LEADING, "set_alpha_to_one": False, "clip_sample": False}),
    "diffusers:pndm": ("PNDMScheduler", {**LEADING, "set_alpha_to_one": False, "skip_prk_steps": True}),
    "diffusers:euler": ("EulerDiscreteScheduler", LEADING),
    "diffusers:dpm++2m": ("DPMSolverMultistepScheduler", {"use_karras_sigmas": True}),
    "diffusers:unipc": ("UniPCMultistepScheduler", {"use_karras_sigmas": True}),
}
"""diffusers' own schedulers as users of Stable Diffusion exchange them: what ours are measured against."""

OURS = (*SOLVERS, "adaptive")


# What is measured -----------------------------------------------------------------------------------------------------


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


def problem_target(problem: Problem, seeds: int = 8) -> Target:
    """A problem from some noises."""
    noise = problem.noise(seeds)
    network, truth = problem.network(seeds), problem.solution(noise)
    return Target(problem.name, network, problem.scheduler(), problem.guidance, noise, truth)


@torch.no_grad()
def pipeline_target(
    pipe: Any,
    inputs: Mapping[str, Any],
    *,
    name: str = "",
    seeds: int = 2,
    guidance_scale: float | None = None,
    rtol: float = 1e-4,
    **options: Any,
) -> Target:
    """The network of a pipeline under conditions, from some noises each.

    Args:
        pipe: A pipeline of this package.
        inputs: Arguments of its call that hold a value for each condition.
        name: To show.
        seeds: Noises for each condition.
        guidance_scale: The pipeline's default if left out.
        rtol: Tolerance of the reference. A trained network ripples with the waves of the timestep's embedding, by about
            one percent over some ten levels; far below this tolerance solvers follow every ripple.
        options: More arguments of the call.
    """
    scale = pipe.config["default_guidance_scale"] if guidance_scale is None else guidance_scale
    seen: list[tuple[Tensor, dict[str, Any]]] = []
    hook = pipe.unet.register_forward_pre_hook(lambda _, args, kwargs: seen.append((args[0], kwargs)), with_kwargs=True)
    rows = [row for row in range(len(next(iter(inputs.values())))) for _ in range(seeds)]
    repeated = {key: value[rows] if isinstance(value, Tensor) else [value[row] for row in rows]
                for key, value in inputs.items()}  # fmt: skip
    generators = [torch.Generator().manual_seed(row % seeds) for row in range(len(rows))]  # of noise on conditions
    call = {"solver": "ddim", "num_inference_steps": 1, "guidance_scale": scale, "output_type": "latent"}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UnfamiliarInputWarning)
            pipe(**repeated, **call, generator=generators, throw=False, **options)
    finally:
        hook.remove()
    (states, conditions), unet = seen[0], pipe.unet
    channels, scheduler, guidance = unet.config.out_channels, pipe.scheduler, Guidance(scale)

    def network(z: Tensor, timestep: Tensor) -> Tensor:
        """Of a batch without unconditional half, the conditions of the other one."""
        of_rows = {key: value[-len(z) :] if isinstance(value, Tensor) else value for key, value in conditions.items()}
        beside = states[-len(z) :, channels:]  # what the network is shown as further channels
        return unet(torch.cat([z.to(states), beside], dim=1), timestep.to(states.device), **of_rows)[0]

    schedule = NoiseSchedule.of(scheduler)

    @torch.no_grad()
    def denoise(x: Tensor, sigma: float) -> Tensor:
        z, timestep = x * alpha(sigma), schedule.timestep(sigma).float()
        prediction = network(torch.cat([z] * 2) if guidance.active else z, timestep).cpu().double()
        prediction = guidance.combine(prediction) if guidance.active else prediction
        return to_denoised(prediction, z, sigma, scheduler.config.prediction_type)

    noises = torch.randn(seeds, channels, *states.shape[2:], generator=torch.Generator().manual_seed(0))
    noise = noises.repeat(len(rows) // seeds, 1, 1, 1)
    truth, disagreement = solve_reference(denoise, noise, schedule, rtol)
    steps = pipe.config["default_num_inference_steps"]
    noise = noise.to(states.device)
    return Target(name, network, scheduler, guidance, noise, truth, disagreement.median().item(), steps)


def world_inputs(modalities: Sequence[str], conditions: int) -> dict[str, Tensor]:
    """Contacts with objects that nothing was trained on, over as many materials: "image" and "touch" (N, 3, S, S)."""
    from unitouch_gen.world import FIRST_OBJECT, MATERIAL_NAMES, World

    material = torch.arange(conditions) * len(MATERIAL_NAMES) // conditions
    objects = torch.full_like(material, FIRST_OBJECT["test"])
    scene: Any = World().render(material, objects, torch.zeros_like(material), modalities=tuple(modalities))
    return {name: scene.image if name == "image" else scene.touch["gelsight"] for name in modalities}


# Measuring ------------------------------------------------------------------------------------------------------------


def measure(
    target: Target, solver: str, steps: int | None = None, tolerance: float | None = None, repeats: int = 3
) -> Row:
    """One result; what the run raises is its reason."""
    row: Row = {"solver": solver, "steps": steps, "tolerance": tolerance, "samples": len(target.noise), "reason": ""}
    row["default"] = solver == "default" and steps == target.default_steps
    scheduler: Any = target.scheduler
    if solver in BASELINES:
        kind, settings = BASELINES[solver]
        known = ("num_train_timesteps", "beta_start", "beta_end", "beta_schedule", "trained_betas", "prediction_type")
        trained = {name: scheduler.config[name] for name in known}
        scheduler = getattr(diffusers, kind)(**trained, **settings)
    seconds, report = [], RunReport()
    try:
        prepared = prepare_steps(
            scheduler, solver=solver if solver in SOLVERS else None, num_inference_steps=steps, tolerance=tolerance
        )
        for _ in range(repeats):
            report, started = RunReport(), time.perf_counter()
            latents = sample(target.network, target.noise, prepared, report, guidance=target.guidance, throw=False)
            seconds.append((time.perf_counter() - started) / len(latents))
    except Exception as error:  # the other points are worth having, and this one says what it was
        return {**row, "failures": len(target.noise), "reason": f"{type(error).__name__}: {first_line(error)}"}
    failed = sorted({code.value for code in report.codes if code != "success"})
    errors = relative_rms(latents.cpu(), target.truth)[[code.finite for code in report.codes]].numpy()
    if len(errors):
        row |= zip(("error_low", "error", "error_high"), np.quantile(errors, (0.25, 0.5, 0.75)).tolist(), strict=True)
    failures = sum(code != "success" for code in report.codes)
    row |= {"evaluations": report.evaluations, "seconds": min(seconds), "failures": failures}
    return {**row, "reason": ", ".join(failed)}


def good(rows: Sequence[Row]) -> list[Row]:
    """Those without failures."""
    return [row for row in rows if not row["failures"]]


def fitted_order(rows: Sequence[Row], floor: float) -> float | None:
    """The slope of log error over log(1 / steps) of one solver, where errors are below 0.1, and ten times above the
    reference's own error and float32; `None` for less than three points."""
    points = [(row["steps"], row["error"]) for row in good(rows) if row["steps"]]
    usable = np.log([point for point in points if max(10 * floor, 1e-6) <= point[1] <= 0.1]).reshape(-1, 2)
    return -float(np.polyfit(usable[:, 0], usable[:, 1], 1)[0]) if len(usable) >= 3 else None


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


def machine(device: str = "cpu") -> str:
    """What timings depend on, in words."""
    name = platform.processor() or platform.machine()
    if device.startswith("cuda"):
        name = torch.cuda.get_device_name()
    elif (known := Path("/proc/cpuinfo")).exists():
        lines = known.read_text(encoding="utf-8").splitlines()
        name = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), name)
    threads = torch.get_num_threads()
    return f"{name}, {threads} thread{'s' * (threads > 1)}, torch {torch.__version__}"


# Chart ----------------------------------------------------------------------------------------------------------------

HUES = ("#b8860b", "#56b4e9", "#009e73", "#0050a0", "#d55e00", "#cc79a7", "#111111", "#7a3fbf", "#8c564b", "#a0a03c",
        "#4f8f9f", "#7f8fd0", "#e8955c")  # fmt: skip
COLOURS = dict(zip((*OURS, "default", *BASELINES), HUES, strict=True))
"""Colours of solvers, the same on every chart (after Okabe & Ito, for all kinds of colour vision)."""


def draw_chart(target: Target, rows: Sequence[Row], note: str = "") -> Figure:
    """Error against seconds and evaluations. Bars are quartiles, the wide band is the Pareto front with its steps or
    tolerances, a star what a call without options runs, a cross at the top what failed."""
    figure = Figure(figsize=(12.6, 5.4), layout="constrained")
    figure.suptitle(f"{target.name}: error against run time", x=0.01, ha="left", fontsize=14, weight="bold")
    failed = [f"{row['solver']}, {amount(row)}: {row['reason']}" for row in rows if row["failures"]]
    lines = [note, *(f"\N{MULTIPLICATION X} {line[:140]}" for line in failed[:4])]
    figure.supxlabel("\n".join(lines), x=0.01, ha="left", fontsize=8, color="#555555")
    left, right = figure.subplots(1, 2, sharey=True)
    _draw_panel(left, target, rows, "seconds", "seconds for one sample")
    _draw_panel(right, target, rows, "evaluations", "evaluations of the network")
    guidance = f"guidance {target.guidance.scale:g}" if target.guidance.active else "no guidance"
    left.set_title(f"{len(target.noise)} samples, {guidance}", loc="left", fontsize=9.5, color="#333333")
    left.set_ylabel("relative RMS error of the latents")
    right.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False, fontsize=8.5)
    return figure


def _draw_panel(axes: Axes, target: Target, rows: Sequence[Row], cost: str, words: str) -> None:
    axes.set(xscale="log", yscale="log", xlabel=words)
    front = pareto_front(rows, cost)
    axes.plot([row[cost] for row in front], [row["error"] for row in front], color="#f2c94c", linewidth=11, alpha=0.55,
              solid_capstyle="round", zorder=1, label="Pareto front")  # fmt: skip
    for row in front:
        text = f"{row['tolerance']:g}" if row["steps"] is None else str(row["steps"])
        axes.annotate(text, (row[cost], row["error"]), (-7, -7), textcoords="offset points", ha="right", va="top",
                      fontsize=7.5, color=COLOURS[row["solver"]], zorder=7)  # fmt: skip
    per_step = [row[cost] / row["steps"] for row in good(rows) if row["steps"]]
    for height, solver in enumerate(dict.fromkeys(row["solver"] for row in rows)):
        of_solver, colour = [row for row in rows if row["solver"] == solver], COLOURS[solver]
        known = sorted(good(of_solver), key=lambda row: row["evaluations"])
        x, low, error, high = ([row[key] for row in known] for key in (cost, "error_low", "error", "error_high"))
        order, nominal = fitted_order(of_solver, target.own_error), SOLVERS.get(solver)
        label = (
            solver if order is None else f"{solver}  order {order:.1f}" + (f" of {nominal.order}" if nominal else "")
        )
        axes.errorbar(x, error, yerr=(np.subtract(error, low), np.subtract(high, error)), fmt="o-", markersize=5,
                      color=colour, ecolor=(colour, 0.45), capsize=2, zorder=3, label=label)  # fmt: skip
        starred = [row for row in known if row["default"]]
        axes.plot([row[cost] for row in starred], [row["error"] for row in starred], "*", markersize=19, color=colour,
                  markeredgecolor="white", zorder=5)  # fmt: skip
        # What failed is at the top edge; where its cost is unknown, at what its steps cost others.
        failed = [row.get(cost) or (row["steps"] or 1) * float(np.median(per_step or [1.0]))
                  for row in of_solver if row["failures"]]  # fmt: skip
        axes.plot(failed, [0.97 - 0.03 * height] * len(failed), "x", markersize=8, markeredgewidth=2.2, color=colour,
                  transform=axes.get_xaxis_transform(), zorder=6)  # fmt: skip
    if target.own_error > 0.03 * min((row["error"] for row in good(rows)), default=math.inf):
        axes.axhline(target.own_error, color="#444444", linestyle="--", linewidth=1.1,
                     label=f"reference's own error {target.own_error:.0e}")  # fmt: skip
    axes.grid(color="#d9d9d9")
    axes.spines[["top", "right"]].set_visible(False)
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter("")


def save(folder: Path, target: Target, rows: Sequence[Row], note: str = "") -> list[Path]:
    """Writes `results.json`, `chart.png` and `chart.svg`."""
    values = {"target": target.name, "guidance_scale": target.guidance.scale, "own_error": target.own_error,
              "machine": machine(str(target.noise.device)), "rows": list(rows)}  # fmt: skip
    files, figure = (
        [write_file("output", folder / "results.json", json.dumps(values, indent=1))],
        draw_chart(target, rows, note),
    )
    for kind in ("png", "svg"):
        data = io.BytesIO()
        figure.savefig(data, format=kind, dpi=160, facecolor="white")
        files.append(write_file("output", folder / f"chart.{kind}", data.getvalue()))
    return files
