"""Error against run time: `python -m tests.benchmarks --only error_and_time`, some minutes.

Orders of convergence, speed-ups at the paper's guidance over the usual way of running the networks, what an error
costs, and the world's own physics. Errors are of latents from the same noise under the same conditions, relative to a
close path; seconds are of one sample, of calls that take turns.
"""

import copy
import math
import shutil
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import groupby, product
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from diffusers import DDIMScheduler, StableUnCLIPImg2ImgPipeline
from rich.console import Console
from torch import Tensor, nn

from tests.benchmarks.measuring import Figures, in_turns, quiet, ratio_of
from tests.benchmarks.world import physics_figures
from unitouch_gen.conditioning import QUALITY_PROMPT
from unitouch_gen.errors import NotConvergedError
from unitouch_gen.numerics.problems import make_problem
from unitouch_gen.numerics.reference import Flow, Reference
from unitouch_gen.numerics.targets import (
    Configuration,
    PipelineTarget,
    ProblemTarget,
    errors_of,
    replaced_scheduler,
    world_inputs,
)
from unitouch_gen.numerics.work_precision import Result, configurations, fitted_orders, measure
from unitouch_gen.schedulers.exponential import FinalExtrapolation, advance, exponential_integral
from unitouch_gen.schedulers.solvers import SOLVERS

CONDITIONS = 8
"""Held-out contacts that errors are medians over."""

REPEATS = 7
"""Turns of timed calls."""

CLOSE = 300
"""Evaluations of a path that errors are measured from; its own, against one of 1,000, is 7e-5 in the median and 4e-4 at
most on touches from photos."""

SEED = 1_000
"""Seed of the noises to start from."""


def error_and_time_figures() -> Figures:
    """All of it; each part is printed when it is done."""
    targets: dict[str, Callable[..., PipelineTarget]] = {
        "touch-to-image": partial(picture_target, quiet("touch-to-image")),
        "x-to-touch": partial(touch_target, quiet("x-to-touch")),
    }
    parts: dict[str, Callable[[], Figures]] = {
        "orders": order_figures,
        "speedup": lambda: {
            name: speedup_figures(make(CONDITIONS), *BASELINES[name], compiling=True) for name, make in targets.items()
        },
        "cost": lambda: {name: cost_figures(make(COSTED, seeds=NOISES)) for name, make in targets.items()},
        "physics": physics_figures,
    }
    figures: Figures = {}
    for name, part in parts.items():
        figures[name] = part()
        Console(width=110, stderr=True).print(f"{name}:", figures[name])
    return figures


def picture_target(pipe: Any, conditions: int, seeds: int = 1, **options: Any) -> PipelineTarget:
    """Pictures from touches of objects that nothing was trained on, by their embeddings; `options` are of the call."""
    embeds = pipe.encode_touch(world_inputs(("touch",), conditions)["touch"])
    if pipe.embedding_bank is not None:  # diffusers' pipeline, which is given them, too, knows no bridge
        embeds = pipe.embedding_bank.bridge(embeds)
    options = {"bridge": False, **options}
    return PipelineTarget(pipe, {"touch_embeds": embeds}, seeds=seeds, noise_seed=SEED, options=options)


def touch_target(pipe: Any, conditions: int, seeds: int = 1, **options: Any) -> PipelineTarget:
    """Touches from photos of objects that nothing was trained on; `options` are of the call."""
    return PipelineTarget(pipe, world_inputs(("image",), conditions), seeds=seeds, noise_seed=SEED, options=options)


# Solvers, on problems whose answer is known ---------------------------------------------------------------------------

ORDER_PROBLEMS = ("gaussian", "mixture", "mixture-3")
ORDER_STEPS = (16, 24, 32, 48, 64, 96)
LATE_STEPS = {"ddim": (100, 150, 200, 300)}
"""For solvers that come to their order later, as timesteps that are even in time are far apart near the end."""


def order_figures(
    problems: Sequence[str] = ORDER_PROBLEMS,
    solvers: Sequence[str] = tuple(SOLVERS),
    steps: Sequence[int] | None = None,
    seeds: int = 8,
) -> Figures:
    """Nominal and fitted orders by solver, and by exact problem, over `steps` or those of the solver.

    The reference ends as the solver does, since the step from the smallest noise level to none is the same for any
    number of steps and would cover what is asked for.
    """
    figures: Figures = {}
    for problem, solver in product(map(make_problem, problems), solvers):
        target, scale = ProblemTarget(problem, seeds), problem.guidance_scale
        target.end = end_of(solver)
        truth = target.reference(scale)
        numbers = LATE_STEPS.get(solver, ORDER_STEPS) if steps is None else steps
        wanted = configurations([solver], numbers, guidance_scales=[scale])
        results = [measure(target, configuration, truth, 1) for configuration in wanted]
        (order,) = fitted_orders(results, {scale: truth.disagreement.median().item()}, target.nominal_order)
        of_solver = figures.setdefault(solver, {"nominal": order.nominal, "fitted": {}})
        of_solver["fitted"][problem.name] = order.fitted
    return figures


def end_of(solver: str) -> str:
    """The `end` of the reference that a named solver comes to with ever more steps."""
    scheduler = SOLVERS[solver].scheduler
    if getattr(scheduler, "second_order_end", False):
        return "extrapolate"
    return "zero" if issubclass(scheduler, DDIMScheduler) else "denoise"


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


BASELINES: dict[str, tuple[Callable[..., Run], str, int, float]] = {
    "touch-to-image": (diffusers_pictures, "diffusers' StableUnCLIPImg2ImgPipeline", 50, 9.0),
    "x-to-touch": (plain_touches, "a plain network in a loop", 200, 7.5),  # diffusers has no pipeline of touches
}
"""What makes some rows of a target in the usual way, its name, and the steps and guidance that the paper takes."""


def called(target: PipelineTarget, rows: Sequence[int], output_type: str, **settings: Any) -> Run:
    """Rows of a target that has one noise for each condition, by one call of its pipeline."""
    started = time.perf_counter()
    output = drawn(target, target.pipe, rows, output_type=output_type, **settings)
    whole = time.perf_counter() - started
    return output.images, {"denoising": output.report.seconds["denoising"], "whole": whole}


def drawn(target: PipelineTarget, pipe: Any, rows: Sequence[int], **settings: Any) -> Any:
    """What a pipeline makes of rows of a target that has one noise for each condition."""
    inputs = {name: value[list(rows)] for name, value in target.inputs.items()}
    return pipe(**inputs, **_noises(target, rows), **{**target.options, **settings})


def _noises(target: PipelineTarget, rows: Sequence[int]) -> dict[str, Any]:
    """Noises of some rows: the latents, and generators of that on embeddings, as targets of one seed have it."""
    return {"latents": target.noise[list(rows)], "generator": [torch.Generator().manual_seed(0) for _ in rows]}


# Speed-ups ------------------------------------------------------------------------------------------------------------

STEPS = (6, 8, 10, 12, 14, 16, 18, 20, 23, 26, 32, 40, 50)
"""Steps that are tried."""

OF_RESULTS = ("solver", "steps", "evaluations", "error_low", "error", "error_high")


def speedup_figures(
    target: PipelineTarget,
    baseline: Callable[..., Run],
    name: str,
    steps: int,
    guidance_scale: float,
    *,
    repeats: int = REPEATS,
    tried: Sequence[int] = STEPS,
    evaluations: int = CLOSE,
    compiling: bool = False,
) -> Figures:
    """Error and seconds of the usual way and of the cheapest configuration that comes as close, and their ratios.

    Of "baseline" and "ours" the configuration, quartiles of the error and median seconds; the ratios are those of the
    seconds of "denoising" and of the "whole" call, and in "compiled" those of the baseline as it is over ours compiled,
    where there is a compiler.
    """
    run = partial(baseline, target, num_inference_steps=steps, guidance_scale=guidance_scale)
    truth = close_reference(target, guidance_scale, evaluations)
    errors = errors_of(run(range(target.samples), "latent")[0], truth).numpy()
    low, middle, high = np.quantile(errors, (0.25, 0.5, 0.75)).tolist()
    known = [found for found in candidates(guidance_scale, tried) if found.expected_evaluations <= steps]
    chosen = cheapest_within(target, known, truth, middle)
    settings = {"solver": chosen.solver, "num_inference_steps": chosen.steps, "guidance_scale": guidance_scale}
    calls = {
        "baseline": lambda: run([0], "pt")[1],
        "ours": lambda: called(target, [0], "pt", **settings)[1],
    }
    if compiling and shutil.which("g++"):
        calls["compiled"] = compiled_call(target.pipe, calls["ours"])
    seconds = {
        who: {kind: [call[kind] for call in seen] for kind in ("denoising", "whole")}
        for who, seen in in_turns(calls, repeats).items()
    }
    medians = {who: {kind: statistics.median(taken) for kind, taken in each.items()} for who, each in seconds.items()}
    ratios = {
        who: {kind: ratio_of(seconds["baseline"][kind], taken) for kind, taken in each.items()}
        for who, each in seconds.items()
    }
    plain = {"name": name, "solver": DDIM, "steps": steps, "evaluations": steps}
    return {
        "guidance_scale": guidance_scale,
        "conditions": target.samples,
        "repeats": repeats,
        "baseline": {**plain, "error_low": low, "error": middle, "error_high": high, **medians["baseline"]},
        "ours": {**{key: getattr(chosen, key) for key in OF_RESULTS}, **medians["ours"]},
        "evaluations": steps / chosen.evaluations,
        **ratios["ours"],
        **({"compiled": ratios["compiled"]} if "compiled" in ratios else {}),
    }


def candidates(guidance_scale: float, steps: Sequence[int] = STEPS) -> list[Configuration]:
    """Every named solver at a guidance; the fewest evaluations first."""
    found = configurations(tuple(SOLVERS), steps, guidance_scales=[guidance_scale])
    return sorted(found, key=lambda configuration: configuration.expected_evaluations)


def cheapest_within(target: PipelineTarget, known: Sequence[Configuration], truth: Reference, wanted: float) -> Result:
    """The best of those with the fewest evaluations that come within a bound; `known` are in the order of these."""
    for _, alike in groupby(known, key=lambda configuration: configuration.expected_evaluations):
        results = [measure(target, configuration, truth, 1) for configuration in alike]
        within = [result for result in results if result.error is not None and result.error <= wanted]
        if within:
            return min(within, key=lambda result: result.error)
    raise NotConvergedError(
        f"No solver comes within {wanted:.2g} of the exact latents in up to {known[-1].expected_evaluations} "
        "evaluations."
    )


def compiled_call(pipe: Any, run: Callable[[], Any]) -> Callable[[], Any]:
    """A call with a compiled copy of a pipeline's network, which takes its weights for constants."""
    fast = copy.deepcopy(pipe.unet)
    fast.compile(options={"freezing": True})

    def call() -> Any:
        with patch.object(pipe, "unet", fast):
            return run()

    return call


# What an error costs --------------------------------------------------------------------------------------------------

WANTED = (0.2, 0.1, 0.05, 0.02)
"""Errors whose cost is told."""

COSTED, NOISES = 16, 4
"""Held-out contacts that costs are medians over, and noises of each."""

COSTED_STEPS = (8, 10, 12, 14, 16, 20, 26, 32)
"""Steps of the solvers of `MULTISTEP`."""

MULTISTEP = ("unipc", "dpm++2m", "deis")


def cost_figures(
    target: PipelineTarget,
    wanted: Sequence[float] = WANTED,
    steps: Sequence[int] = COSTED_STEPS,
    evaluations: int = CLOSE,
) -> Figures:
    """The run with the fewest evaluations that has each error, at the pipeline's own guidance, in medians over samples.

    Where none has it, it is left out.
    """
    scale = target.guidance_scale
    truth = close_reference(target, scale, evaluations)
    results = [measure(target, each, truth, 1) for each in configurations(MULTISTEP, steps, guidance_scales=[scale])]
    chosen = {f"{error:g}": cheapest(results, error) for error in wanted}
    return {
        "guidance_scale": scale,
        "conditions": target.samples,
        "cost_at_error": {
            error: {key: getattr(run, key) for key in OF_RESULTS} for error, run in chosen.items() if run is not None
        },
    }


def cheapest(results: Sequence[Result], error: float) -> Result | None:
    """The result with the fewest evaluations whose median error is at most so large."""
    able = [result for result in results if result.error is not None and result.error <= error]
    return min(able, key=lambda result: (result.evaluations, result.error), default=None)


# What errors are relative to ------------------------------------------------------------------------------------------


def close_reference(target: PipelineTarget, guidance_scale: float, evaluations: int) -> Reference:
    """Where the exact flow ends, from a close path, whose own error is not known."""
    flows = [(target.flow(guidance_scale, part), target.noise[part]) for part in target.parts]
    return Reference.exact(torch.cat([end_of_path(flow, noise, evaluations) for flow, noise in flows]))


def end_of_path(flow: Flow, noise: Tensor, evaluations: int) -> Tensor:
    """x at sigma = 0, float64, from unit-variance noise (B, C, h, w) at levels of Karras spacing.

    The formulas are those of `schedulers.adaptive`: order three after a prediction of order two.
    """
    sigmas = [flow.schedule.karras(number / (evaluations - 1)) for number in range(evaluations)]
    levels = [-math.log(sigma) for sigma in sigmas]
    state, final = flow.start(noise), FinalExtrapolation()
    values = [flow.denoise(state, sigmas[0])]
    for number in range(1, evaluations):
        step = levels[number] - levels[number - 1]
        nodes = [levels[number - 1 - back] - levels[number - 1] for back in range(len(values))]
        predicted = advance(state, step, exponential_integral(step, nodes, values))
        value = flow.denoise(predicted, sigmas[number])
        state = advance(state, step, exponential_integral(step, [step, *nodes], [value, *values]))
        values = [value, *values[:1]]
        final.add(sigmas[number], value)
    return final.result()
