"""Error against run time: `python -m tests.benchmarks --only error_and_time`, half an hour.

Speed-ups at the paper's guidance over the usual way of running the networks, what an error costs, and the world's own
physics; `unitouch-gen work-precision` fits orders of convergence. Errors are of latents from the same noise under the
same conditions, relative to a close path; seconds are of one sample, of calls that take turns.
"""

import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import groupby
from typing import Any
from unittest.mock import patch

import torch
from diffusers import StableUnCLIPImg2ImgPipeline
from torch import Tensor, nn

from tests.benchmarks.measuring import Figures, in_turns, quiet, ratio_of
from tests.benchmarks.world import physics_figures
from unitouch_gen.conditioning import QUALITY_PROMPT
from unitouch_gen.errors import NotConvergedError
from unitouch_gen.numerics.reference import Reference
from unitouch_gen.numerics.targets import (
    Configuration,
    PipelineTarget,
    Target,
    errors_of,
    replaced_scheduler,
    world_inputs,
)
from unitouch_gen.numerics.work_precision import Result, configurations, measure

ADAPTIVE = "adaptive"
SOLVERS = tuple(name for name in Target.solvers if name != ADAPTIVE)

MULTISTEP = ("unipc", "dpm++2m", "deis")
"""Solvers whose cost is told."""

OF_RESULTS = ("solver", "steps", "evaluations", "error_low", "error", "error_high")


def error_and_time_figures() -> Figures:
    """All of it."""
    targets: dict[str, Callable[..., PipelineTarget]] = {
        "touch-to-image": partial(picture_target, quiet("touch-to-image")),
        "x-to-touch": partial(touch_target, quiet("x-to-touch")),
    }
    return {
        "speedup": {name: speedup_figures(make(8), *BASELINES[name]) for name, make in targets.items()},
        "cost": {name: cost_figures(make(16, seeds=4)) for name, make in targets.items()},
        "physics": physics_figures(),
    }


def picture_target(pipe: Any, conditions: int, seeds: int = 1) -> PipelineTarget:
    """Pictures from touches of objects that nothing was trained on, by their embeddings."""
    embeds = pipe.encode_touch(world_inputs(("touch",), conditions)["touch"])  # diffusers' pipeline knows no bridge
    return PipelineTarget(pipe, {"touch_embeds": embeds}, seeds=seeds, noise_seed=1_000, options={"bridge": False})


def touch_target(pipe: Any, conditions: int, seeds: int = 1) -> PipelineTarget:
    """Touches from photos of objects that nothing was trained on."""
    return PipelineTarget(pipe, world_inputs(("image",), conditions), seeds=seeds, noise_seed=1_000)


def close_reference(target: PipelineTarget, guidance_scale: float) -> Reference:
    """Where the exact flow ends, by the adaptive solver to a tolerance far below the errors that are measured."""
    path = Configuration(ADAPTIVE, tolerance=1e-4, guidance_scale=guidance_scale)
    return Reference.exact(target.run(path)[0].double())


# The usual way --------------------------------------------------------------------------------------------------------

DDIM = "diffusers:ddim"

Run = tuple[Tensor, dict[str, float]]
"""Latents or pictures, and the seconds of the "denoising" and of the "whole" call."""


class TimedUnclip(StableUnCLIPImg2ImgPipeline):
    """diffusers' pipeline; `denoising` holds the seconds of its last loop."""

    denoising = 0.0

    def progress_bar(self, iterable: Any = None, total: int | None = None) -> Iterator[Any]:
        started = time.perf_counter()
        yield from iterable
        self.denoising = time.perf_counter() - started


def diffusers_unclip(pipe: Any) -> TimedUnclip:
    """diffusers' own pipeline of the same parts, with its own DDIM."""
    pipe.unitouch.load("image")
    parts = ("image_normalizer", "image_noising_scheduler", "tokenizer", "text_encoder", "unet")
    theirs = TimedUnclip(
        feature_extractor=None,
        image_encoder=pipe.unitouch.vision_model,  # neither runs, as embeddings are given
        scheduler=replaced_scheduler(pipe.scheduler, DDIM),
        vae=None,  # whose size it would read under a name that autoencoders of other kinds do not have
        **{name: getattr(pipe, name) for name in parts},
    )
    theirs.register_modules(vae=pipe.vae)
    theirs.vae_scale_factor = pipe.vae_scale_factor
    return theirs


def diffusers_pictures(target: PipelineTarget, rows: Sequence[int], output_type: str, **settings: Any) -> Run:
    """diffusers' pipeline of the same parts on the same embeddings, prompts and noise."""
    theirs = diffusers_unclip(target.pipe)
    started = time.perf_counter()
    images = theirs(
        prompt=[QUALITY_PROMPT] * len(rows),
        image_embeds=target.inputs["touch_embeds"][list(rows)],
        noise_level=target.pipe.config["default_noise_level"],
        output_type=output_type,
        **_noises(target, rows),
        **settings,
    ).images
    return images, {"denoising": theirs.denoising, "whole": time.perf_counter() - started}


class Plain(nn.Module):
    """A network of which pipelines know nothing, so that they leave nothing out of it."""

    def __init__(self, network: Any) -> None:
        super().__init__()
        self.network, self.config, self.dtype, self.device = network, network.config, network.dtype, network.device

    def forward(self, *args: Any, **kwargs: Any) -> Any:
        return self.network(*args, **kwargs)


def plain_touches(target: PipelineTarget, rows: Sequence[int], output_type: str, **settings: Any) -> Run:
    """Our pipeline with diffusers' scheduler, and nothing left out of the network."""
    pipe = target.pipe
    with patch.multiple(pipe, unet=Plain(pipe.unet), scheduler=replaced_scheduler(pipe.scheduler, DDIM)):
        return called(target, rows, output_type, **settings)


def called(target: PipelineTarget, rows: Sequence[int], output_type: str, **settings: Any) -> Run:
    """Rows of a target that has one noise for each condition, by one call of its pipeline."""
    inputs = {name: value[list(rows)] for name, value in target.inputs.items()} | _noises(target, rows)
    started = time.perf_counter()
    output = target.pipe(**inputs, output_type=output_type, **{**target.options, **settings})
    return output.images, {"denoising": output.report.seconds["denoising"], "whole": time.perf_counter() - started}


def _noises(target: PipelineTarget, rows: Sequence[int]) -> dict[str, Any]:
    """Noises of some rows: the latents, and generators of that on embeddings, as targets of one seed have it."""
    return {"latents": target.noise[list(rows)], "generator": [torch.Generator().manual_seed(0) for _ in rows]}


BASELINES: dict[str, tuple[Callable[..., Run], str, int, float]] = {
    "touch-to-image": (diffusers_pictures, "diffusers' StableUnCLIPImg2ImgPipeline", 50, 9.0),
    "x-to-touch": (plain_touches, "a plain network in a loop", 200, 7.5),  # diffusers has no pipeline of touches
}
"""What makes some rows of a target in the usual way, its name, and the steps and guidance that the paper takes."""


# Speed-ups and costs --------------------------------------------------------------------------------------------------

STEPS = (6, 8, 10, 12, 14, 16, 18, 20, 23, 26, 32, 40, 50)


def speedup_figures(
    target: PipelineTarget,
    baseline: Callable[..., Run],
    name: str,
    steps: int,
    guidance_scale: float,
    *,
    repeats: int = 7,
    tried: Sequence[int] = STEPS,
) -> Figures:
    """Error and seconds of the usual way and of the cheapest configuration that comes as close, and their ratios.

    Of "baseline" and "ours" the configuration, quartiles of the error and median seconds; the ratios are those of the
    seconds of "denoising" and of the "whole" call.
    """
    run = partial(baseline, target, num_inference_steps=steps, guidance_scale=guidance_scale)
    truth = close_reference(target, guidance_scale)
    errors = errors_of(run(range(target.samples), "latent")[0], truth)
    low, middle, high = errors.quantile(torch.tensor([0.25, 0.5, 0.75]).double()).tolist()
    known = [one for one in candidates(guidance_scale, tried) if one.expected_evaluations <= steps]
    chosen = cheapest_within(target, known, truth, middle)
    settings = {"solver": chosen.solver, "num_inference_steps": chosen.steps, "guidance_scale": guidance_scale}
    calls = {"baseline": lambda: run([0], "pt")[1], "ours": lambda: called(target, [0], "pt", **settings)[1]}
    turns = in_turns(calls, repeats)
    seconds = {who: {kind: [one[kind] for one in turns[who]] for kind in ("denoising", "whole")} for who in turns}
    medians = {who: {kind: statistics.median(taken) for kind, taken in each.items()} for who, each in seconds.items()}
    return {
        "guidance_scale": guidance_scale,
        "conditions": target.samples,
        "repeats": repeats,
        "baseline": {"name": name, "solver": DDIM, "steps": steps, "evaluations": steps, "error_low": low,
                     "error": middle, "error_high": high, **medians["baseline"]},
        "ours": {**{key: getattr(chosen, key) for key in OF_RESULTS}, **medians["ours"]},
        "evaluations": steps / chosen.evaluations,
        **{kind: ratio_of(seconds["baseline"][kind], seconds["ours"][kind]) for kind in ("denoising", "whole")},
    }  # fmt: skip


def candidates(guidance_scale: float, steps: Sequence[int] = STEPS) -> list[Configuration]:
    """Every named solver at a guidance; the fewest evaluations first."""
    found = configurations(SOLVERS, steps, guidance_scales=[guidance_scale])
    return sorted(found, key=lambda configuration: configuration.expected_evaluations)


def cheapest_within(target: PipelineTarget, known: Sequence[Configuration], truth: Reference, wanted: float) -> Result:
    """The best of those with the fewest evaluations that come within a bound; `known` are in the order of these."""
    for _, alike in groupby(known, key=lambda configuration: configuration.expected_evaluations):
        results = [measure(target, configuration, truth, 1) for configuration in alike]
        within = [result for result in results if result.error is not None and result.error <= wanted]
        if within:
            return min(within, key=lambda result: result.error)
    raise NotConvergedError(f"No solver comes within {wanted:.2g} of the exact latents.")


def cost_figures(
    target: PipelineTarget, wanted: Sequence[float] = (0.2, 0.1, 0.05, 0.02), steps: Sequence[int] = STEPS
) -> Figures:
    """The run with the fewest evaluations that has each median error, at the pipeline's own guidance."""
    scale = target.guidance_scale
    truth = close_reference(target, scale)
    results = [measure(target, each, truth, 1) for each in configurations(MULTISTEP, steps, guidance_scales=[scale])]
    costs = {}
    for error in wanted:
        able = [result for result in results if result.error is not None and result.error <= error]
        if able:
            best = min(able, key=lambda result: (result.evaluations, result.error))
            costs[f"{error:g}"] = {key: getattr(best, key) for key in OF_RESULTS}
    return {"guidance_scale": scale, "conditions": target.samples, "cost_at_error": costs}
