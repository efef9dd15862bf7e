"""Error against run time: `python -m tests.benchmarks --only error_and_time`, half an hour.

Speed-ups at the paper's guidance over the usual way of running the networks, what an error costs, and the world's own
physics; `unitouch-gen work-precision` fits orders of convergence. Errors are of latents from the same noise under the
same conditions, relative to the exact flow; seconds are of one sample, of calls that take turns.
"""

import statistics
import time
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any
from unittest.mock import patch

import torch
from diffusers import DDIMScheduler, StableUnCLIPImg2ImgPipeline

from tests.benchmarks.measuring import Figures, in_turns, quiet, ratio_of, seconds_of
from tests.benchmarks.world import physics_figures
from unitouch_gen.conditioning import QUALITY_PROMPT
from unitouch_gen.errors import NotConvergedError
from unitouch_gen.numerics.work_precision import (
    BASELINES,
    Row,
    Target,
    measure,
    pareto_front,
    pipeline_target,
    world_inputs,
)
from unitouch_gen.pipelines.tiny import TURBO
from unitouch_gen.solvers import SOLVERS

CONDITIONS = 8
"""Held-out contacts that errors are medians over."""

USUAL = {"touch-to-image": (50, 9.0), "x-to-touch": (200, 7.5)}
"""Steps of DDIM and guidance that the paper takes."""


def error_and_time_figures() -> Figures:
    """All of it."""
    pipes = {name: quiet(name) for name in USUAL}
    speedup = {name: speedup_figures(pipe, held_out(name, pipe, CONDITIONS), *USUAL[name])
               for name, pipe in pipes.items()}  # fmt: skip
    cost = {name: cost_figures(pipe, held_out(name, pipe, 2 * CONDITIONS)) for name, pipe in pipes.items()}
    return {"speedup": speedup, "cost": cost, "turbo": turbo_figures(), "physics": physics_figures()}


def held_out(name: str, pipe: Any, conditions: int) -> dict[str, Any]:
    """Arguments of a call on objects that nothing was trained on: embeddings of touches, or photos."""
    if name == "x-to-touch":
        return world_inputs(("image",), conditions)
    embeds = pipe.encode_touch(world_inputs(("touch",), conditions)["touch"])
    return {"touch_embeds": embeds}


# The usual way --------------------------------------------------------------------------------------------------------


class TimedUnclip(StableUnCLIPImg2ImgPipeline):
    """diffusers' pipeline; `denoising` holds the seconds of its last loop."""

    denoising = 0.0

    def progress_bar(self, iterable: Any = None, total: int | None = None) -> Iterator[Any]:
        started = time.perf_counter()
        yield from iterable
        self.denoising = time.perf_counter() - started


def usual_call(pipe: Any, inputs: dict[str, Any], **settings: Any) -> tuple[torch.Tensor, dict[str, float]]:
    """Pictures and seconds by diffusers' DDIM: in diffusers' own pipeline of the same parts, which has none of touches,
    or in ours."""
    _, ddim = BASELINES["diffusers:ddim"]
    scheduler = DDIMScheduler.from_config(pipe.scheduler.config, **ddim)
    if "touch_embeds" not in inputs:
        with patch.object(pipe, "scheduler", scheduler):
            return our_call(pipe, inputs, **settings)
    pipe.unitouch.load("image")
    parts = ("image_normalizer", "image_noising_scheduler", "tokenizer", "text_encoder", "unet")
    theirs = TimedUnclip(
        feature_extractor=None,
        image_encoder=pipe.unitouch.vision_model,  # neither runs, as embeddings are given
        scheduler=scheduler,
        vae=None,  # whose size it would read under a name that autoencoders of other kinds do not have
        **{name: getattr(pipe, name) for name in parts},
    )
    theirs.register_modules(vae=pipe.vae)
    theirs.vae_scale_factor = pipe.vae_scale_factor
    started, embeds = time.perf_counter(), inputs["touch_embeds"]
    prompt, level = [QUALITY_PROMPT] * len(embeds), pipe.config["default_noise_level"]
    images = theirs(prompt=prompt, image_embeds=embeds, noise_level=level, **settings).images
    return images, {"denoising": theirs.denoising, "whole": time.perf_counter() - started}


def our_call(pipe: Any, inputs: dict[str, Any], **settings: Any) -> tuple[torch.Tensor, dict[str, float]]:
    """Pictures and seconds by our pipeline."""
    started = time.perf_counter()
    output = pipe(**inputs, **settings)
    return output.images, {"denoising": output.report.seconds["denoising"], "whole": time.perf_counter() - started}


# Speed-ups ------------------------------------------------------------------------------------------------------------

STEPS = (6, 8, 10, 12, 14, 16, 18, 20, 23, 26, 32, 40, 50)
"""Steps that are tried."""

OF_ROWS = ("solver", "steps", "evaluations", "error_low", "error", "error_high")


def speedup_figures(
    pipe: Any,
    inputs: dict[str, Any],
    steps: int,
    guidance_scale: float,
    *,
    repeats: int = 7,
    tried: Sequence[int] = STEPS,
    rtol: float = 1e-3,
) -> Figures:
    """Error and seconds of the usual way and of the cheapest solver that comes as close, and their ratios.

    The ratios are those of the seconds of "denoising" and of the "whole" call of one sample.
    """
    target = pipeline_target(pipe, inputs, seeds=1, guidance_scale=guidance_scale, rtol=rtol)
    usual = measure(target, "diffusers:ddim", steps, repeats=1)
    chosen = cheapest_within(target, usual["error"], tried)
    first = {name: value[:1] for name, value in inputs.items()}
    call = {"guidance_scale": guidance_scale, "output_type": "pt"}
    ours = {**call, "solver": chosen["solver"], "num_inference_steps": chosen["steps"]}
    calls = {
        "baseline": lambda: usual_call(pipe, first, num_inference_steps=steps, **call)[1],
        "ours": lambda: our_call(pipe, first, **ours)[1],
    }
    seen = in_turns(calls, repeats)
    seconds = {who: {kind: [turn[kind] for turn in turns] for kind in turns[0]} for who, turns in seen.items()}
    medians = {who: {kind: statistics.median(taken) for kind, taken in each.items()} for who, each in seconds.items()}
    name = "diffusers' StableUnCLIPImg2ImgPipeline" if "touch_embeds" in inputs else "diffusers' DDIM in our pipeline"
    return {
        "guidance_scale": guidance_scale,
        "conditions": len(target.noise),
        "repeats": repeats,
        "baseline": {"name": name, **{key: usual[key] for key in OF_ROWS}, **medians["baseline"]},
        "ours": {**{key: chosen[key] for key in OF_ROWS}, **medians["ours"]},
        "evaluations": steps / chosen["evaluations"],
        **{kind: ratio_of(taken, seconds["ours"][kind]) for kind, taken in seconds["baseline"].items()},
    }


def cheapest_within(target: Target, error: float, steps: Sequence[int] = STEPS) -> Row:
    """The best of the solvers with the fewest evaluations that comes within an error."""
    for count in steps:
        within = [row for row in (measure(target, name, count, repeats=1) for name in SOLVERS if name != "heun")
                  if not row["failures"] and row["error"] <= error]  # fmt: skip
        if within:
            return min(within, key=lambda row: row["error"])
    raise NotConvergedError(f"No solver comes within {error:.2g} of the exact latents in up to {steps[-1]} steps.")


# Four evaluations -----------------------------------------------------------------------------------------------------


def turbo_figures(batches: Sequence[int] = (1, 32), repeats: int = 3) -> Figures:
    """Seconds a sample of whole calls, encoding and decoding included, and speed-ups, by pipeline and batch size: over
    diffusers' DDIM in 50 steps at guidance 9, and over the default call."""
    figures: Figures = {}
    for name, of in TURBO.items():
        usual, turbo = quiet(of), quiet(name)
        for size in batches:
            inputs = world_inputs(("touch",) if of == "touch-to-image" else ("image",), size)
            calls = {
                "ddim": partial(ddim_seconds, usual, inputs),
                "default": partial(seconds_of, usual, **inputs, output_type="pt"),
                "turbo": partial(seconds_of, turbo, **inputs, output_type="pt"),
            }
            seen = in_turns(calls, repeats)
            seconds = {who: statistics.median(taken) / size for who, taken in seen.items()}
            ratios = {f"over {who}": ratio_of(seen[who], seen["turbo"]) for who in ("ddim", "default")}
            figures[f"{of}, {size} at once"] = {"seconds": seconds, **ratios}
    return figures


def ddim_seconds(pipe: Any, inputs: dict[str, Any]) -> float:
    """Seconds of DDIM as the paper draws pictures; of pictures, with those of encoding the touches."""
    started = time.perf_counter()
    given = {"touch_embeds": pipe.encode_touch(**inputs)} if "touch" in inputs else inputs
    encoding = time.perf_counter() - started
    steps, scale = USUAL["touch-to-image"]
    settings = {"num_inference_steps": steps, "guidance_scale": scale, "output_type": "pt"}
    return encoding + usual_call(pipe, given, **settings)[1]["whole"]


# What an error costs --------------------------------------------------------------------------------------------------


def cost_figures(
    pipe: Any,
    inputs: dict[str, Any],
    wanted: Sequence[float] = (0.2, 0.1, 0.05, 0.02),
    steps: Sequence[int] = (8, 10, 12, 14, 16, 20, 26, 32),
    seeds: int = 4,
    rtol: float = 1e-3,
) -> Figures:
    """The run with the fewest evaluations that has each error, at the pipeline's own guidance, in medians over samples.

    Where none has it, it is left out.
    """
    target = pipeline_target(pipe, inputs, seeds=seeds, rtol=rtol)
    solvers = ("unipc", "dpm++2m", "deis")
    front = pareto_front([measure(target, name, n, repeats=1) for name in solvers for n in steps], "evaluations")
    found = {f"{error:g}": [row for row in front if row["error"] <= error] for error in wanted}
    costs = {error: {key: rows[0][key] for key in OF_ROWS} for error, rows in found.items() if rows}
    return {"guidance_scale": target.guidance.scale, "conditions": len(target.noise), "cost_at_error": costs}
