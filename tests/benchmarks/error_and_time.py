"""Error against run time: `python -m tests.benchmarks --only error_and_time`, half an hour.

What an error costs, speed-ups of four evaluations over the usual way of running the networks, and the world's own
physics; `unitouch-gen work-precision` fits orders of convergence. Errors are of latents from the same noise under the
same conditions, relative to the exact flow; seconds are of one sample, of calls that take turns.
"""

import statistics
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any
from unittest.mock import patch

from diffusers import DDIMScheduler, StableUnCLIPImg2ImgPipeline

from tests.benchmarks.measuring import Figures, in_turns, quiet, ratio_of, seconds_of
from tests.benchmarks.world import physics_figures
from unitouch_gen.conditioning import QUALITY_PROMPT
from unitouch_gen.numerics.work_precision import BASELINES, measure, pareto_front, pipeline_target, world_inputs
from unitouch_gen.pipelines import TouchToImagePipeline
from unitouch_gen.pipelines.tiny import TURBO

USUAL = {"num_inference_steps": 50, "guidance_scale": 9.0}
"""Steps of DDIM and guidance that the paper takes for pictures."""

OF_ROWS = ("solver", "steps", "evaluations", "error_low", "error", "error_high")


def error_and_time_figures() -> Figures:
    """All of it; errors are medians over held-out contacts."""
    inputs = {"touch-to-image": ("touch",), "x-to-touch": ("image",)}
    cost = {name: cost_figures(quiet(name), world_inputs(inputs[name], 16)) for name in TURBO.values()}
    return {"cost": cost, "turbo": turbo_figures(), "physics": physics_figures()}


def usual_way(pipe: Any) -> Callable[..., Any]:
    """diffusers' DDIM: calls of diffusers' own pipeline of the same parts, which has none of touches, or of ours."""
    _, ddim = BASELINES["diffusers:ddim"]
    scheduler = DDIMScheduler.from_config(pipe.scheduler.config, **ddim)
    if not isinstance(pipe, TouchToImagePipeline):

        def ours(**call: Any) -> Any:
            with patch.object(pipe, "scheduler", scheduler):
                return pipe(**call)

        return ours
    pipe.unitouch.load("image")
    parts = ("image_normalizer", "image_noising_scheduler", "tokenizer", "text_encoder", "unet")
    theirs = StableUnCLIPImg2ImgPipeline(
        feature_extractor=None,
        image_encoder=pipe.unitouch.vision_model,  # neither runs, as embeddings are given
        scheduler=scheduler,
        vae=None,  # whose size it would read under a name that autoencoders of other kinds do not have
        **{name: getattr(pipe, name) for name in parts},
    )
    theirs.set_progress_bar_config(disable=True)
    theirs.register_modules(vae=pipe.vae)
    theirs.vae_scale_factor, level = pipe.vae_scale_factor, pipe.config["default_noise_level"]

    def call(touch: Any = None, touch_embeds: Any = None, **settings: Any) -> Any:
        embeds = pipe.encode_touch(touch) if touch_embeds is None else touch_embeds
        return theirs(prompt=[QUALITY_PROMPT] * len(embeds), image_embeds=embeds, noise_level=level, **settings)

    return call


def turbo_figures(batches: Sequence[int] = (1, 32), repeats: int = 3) -> Figures:
    """Seconds a sample of whole calls, encoding and decoding included, and speed-ups, by pipeline and batch size: over
    diffusers' DDIM in 50 steps at guidance 9, and over the default call."""
    figures: Figures = {}
    for name, of in TURBO.items():
        usual = quiet(of)
        turbo = quiet(name)
        ddim = usual_way(usual)
        for size in batches:
            inputs = world_inputs(("touch",) if of == "touch-to-image" else ("image",), size)
            calls = {
                "ddim": partial(seconds_of, ddim, **inputs, **USUAL, output_type="pt"),
                "default": partial(seconds_of, usual, **inputs, output_type="pt"),
                "turbo": partial(seconds_of, turbo, **inputs, output_type="pt"),
            }
            seen = in_turns(calls, repeats)
            seconds = {who: statistics.median(taken) / size for who, taken in seen.items()}
            ratios = {f"over {who}": ratio_of(seen[who], seen["turbo"]) for who in ("ddim", "default")}
            figures[f"{of}, {size} at once"] = {"seconds": seconds, **ratios}
    return figures


def cost_figures(
    pipe: Any,
    inputs: dict[str, Any],
    wanted: Sequence[float] = (0.2, 0.1, 0.05, 0.02),
    steps: Sequence[int] = (8, 10, 12, 14, 16, 20, 26, 32),
    seeds: int = 4,
) -> Figures:
    """The run with the fewest evaluations that has each error, at the pipeline's own guidance, in medians over samples.

    Where none has it, it is left out.
    """
    target = pipeline_target(pipe, inputs, seeds=seeds)
    solvers = ("unipc", "dpm++2m")
    front = pareto_front([measure(target, name, n, repeats=1) for name in solvers for n in steps], "evaluations")
    found = {f"{error:g}": [row for row in front if row["error"] <= error] for error in wanted}
    costs = {error: {key: rows[0][key] for key in OF_ROWS} for error, rows in found.items() if rows}
    return {"guidance_scale": target.guidance_scale, "conditions": len(target.truth), "cost_at_error": costs}
