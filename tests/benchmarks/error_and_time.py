"""Error against run time: `python -m tests.benchmarks --only error_and_time`, some minutes.

Orders of convergence, what the cache of cross-attentions saves, speed-ups at the paper's guidance over the usual way
of running the networks, how well runs estimate their own error and what an error costs, and the world's own physics.
Errors are of latents from the same noise under the same conditions, relative to a close path; seconds are of one
sample, of calls that take turns.
"""

import copy
import shutil
import statistics
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import groupby, pairwise, product
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from diffusers import DDIMScheduler, StableUnCLIPImg2ImgPipeline
from rich.console import Console
from torch import Tensor, nn

from tests.benchmarks.measuring import Figures, in_turns, quiet, ratio_of, seconds_of
from tests.benchmarks.world import physics_figures
from unitouch_gen.conditioning import QUALITY_PROMPT
from unitouch_gen.errors import InvalidInputError, NotConvergedError
from unitouch_gen.models.cross_attention_cache import cache_arguments, cross_attention_cache
from unitouch_gen.numerics.fit import (
    NOISE_LEVELS,
    Observation,
    close_reference,
    fit_calibration,
    fitted_runs,
    observe,
)
from unitouch_gen.numerics.problems import Problem, all_problems, make_problem
from unitouch_gen.numerics.reference import Reference
from unitouch_gen.numerics.targets import (
    DEFAULT,
    Configuration,
    PipelineTarget,
    ProblemTarget,
    errors_of,
    replaced_scheduler,
    world_inputs,
)
from unitouch_gen.numerics.work_precision import Result, configurations, fitted_orders, measure
from unitouch_gen.sampling import ReturnCode
from unitouch_gen.schedulers.adaptive import ADAPTIVE
from unitouch_gen.schedulers.exponential import Calibration
from unitouch_gen.schedulers.solvers import SOLVERS

CONDITIONS = 8
"""Held-out contacts that errors are medians over."""

REPEATS = 7
"""Turns of timed calls."""

CLOSE = 300
"""Evaluations of a path that errors are measured from; its own, against one of 1,000, is 7e-5 in the median and 4e-4 at
most on touches from photos."""

SEED = 1_000
"""Seed of the noises to start from, which nothing was fitted to."""


def error_and_time_figures() -> Figures:
    """All of it; each part is printed when it is done."""
    targets: dict[str, Callable[..., PipelineTarget]] = {
        "touch-to-image": partial(picture_target, quiet("touch-to-image")),
        "x-to-touch": partial(touch_target, quiet("x-to-touch")),
    }
    parts: dict[str, Callable[[], Figures]] = {
        "orders": order_figures,
        "cross_attention_cache": lambda: {name: cache_figures(make(max(ROWS) // 2)) for name, make in targets.items()},
        "speedup": lambda: {
            name: speedup_figures(make(CONDITIONS), *BASELINES[name], compiling=True) for name, make in targets.items()
        },
        "effectivity": lambda: {
            "exact": exact_effectivity(all_problems()),
            **{name: effectivity_and_cost(make, CALLS[name]) for name, make in targets.items()},
        },
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


# The cache of cross-attentions ----------------------------------------------------------------------------------------

TIMESTEPS = (999.0, 500.0, 20.0)
ROWS = (2, 16)
"""Rows of a batch, both branches of guidance: one sample, and eight."""


@torch.no_grad()
def cache_figures(target: PipelineTarget, rows: Sequence[int] = ROWS, repeats: int = 15) -> Figures:
    """Ratio of a UNet's seconds without and with them, and the largest difference of predictions, by rows."""
    network = target.network("float32")
    figures: Figures = {}
    for number in rows:
        part = list(range(number // 2))
        inputs, state = target.network_inputs(target.guidance_scale, part), torch.cat([target.noise[part]] * 2)
        if inputs.beside is not None:
            state = torch.cat([state, inputs.beside], dim=1)
        conditions = {**inputs.conditions, "return_dict": False}
        figures[f"{number} rows"] = _compared(network, state, conditions, repeats)
    return figures


def _compared(network: Any, state: Tensor, conditions: dict[str, Any], repeats: int) -> Figures:
    """The figures of one batch (B, C, h, w)."""
    cached = cache_arguments(cross_attention_cache(network, conditions["encoder_hidden_states"]), len(state))

    def predictions(**more: Any) -> Tensor:
        return torch.stack([network(state, timestep, **conditions, **more)[0] for timestep in TIMESTEPS])

    calls = {"plain": partial(seconds_of, predictions), "cached": partial(seconds_of, predictions, **cached)}
    seen = in_turns(calls, repeats)
    difference = (predictions(**cached) - predictions()).abs().max().item()
    return {**ratio_of(seen["plain"], seen["cached"]), "difference": difference}


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
"""Steps that are tried beside those that were fitted."""

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
    known = [found for found in candidates(target.pipe, guidance_scale, tried) if found.expected_evaluations <= steps]
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


def candidates(pipe: Any, guidance_scale: float, steps: Sequence[int] = STEPS) -> list[Configuration]:
    """What was fitted to the checkpoint at a guidance, and every named solver; the fewest evaluations first."""
    named = configurations(tuple(SOLVERS), steps, guidance_scales=[guidance_scale])
    found = [*fitted_runs(pipe.scheduler, guidance_scale), *named]
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
        "evaluations; fit steps to the checkpoint (`unitouch-gen fit`)."
    )


def compiled_call(pipe: Any, run: Callable[[], Any]) -> Callable[[], Any]:
    """A call with a compiled copy of a pipeline's network, which takes its weights for constants."""
    fast = copy.deepcopy(pipe.unet)
    fast.compile(options={"freezing": True})

    def call() -> Any:
        with patch.object(pipe, "unet", fast):
            return run()

    return call


# Estimates of the error -----------------------------------------------------------------------------------------------

SAMPLES = (16, 8)
"""Noises to fit calibrations on, and others to judge them on."""

NOTHING = 1e-6
"""Errors below it are rounding, and nothing that anybody could estimate."""

TRUTH = 1e-3
"""Errors of pipelines below it are not judged, as a close path errs by some ten-thousandths itself."""

JUDGED_GUIDANCES, JUDGED_STEPS = (1.0, 3.0, 4.0, 7.5, 9.0, 12.0), (6, 9, 15, 20, 30)
"""Of calls of pipelines whose estimates are judged, without any other setting but those of `CALLS`."""

CALLS: dict[str, list[dict[str, Any]]] = {
    "touch-to-image": [{"noise_level": level} for level in NOISE_LEVELS],
    "x-to-touch": [{}],
}

NAMED = (*SOLVERS, ADAPTIVE)

FITTED_STEPS, FITTED_TOLERANCES = (6, 8, 10, 14, 20, 28, 40, 56, 80), (1e-1, 3e-2, 1e-2, 3e-3, 1e-3)
"""Runs of exact problems that calibrations are fitted to and judged on."""

BOUNDS = ((0.5, 2.0), (0.3, 3.0))
BINS = (0.0, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.4, 2.0, 3.0, 5.0, 10.0, np.inf)
"""Bins of the histogram of estimate over true error."""


def shares_of(ratios: Sequence[float]) -> Figures:
    """Shares of estimate over true error within `BOUNDS`, and the histogram; none of nothing."""
    if not len(ratios):
        return {"estimates": 0}
    values = np.asarray(ratios)
    shares = {f"within {low:g} to {high:g}": float(np.mean((values >= low) & (values <= high))) for low, high in BOUNDS}
    bins = [*(f"{low:g} to {high:g}" for low, high in pairwise(BINS[:-1])), f"above {BINS[-2]:g}"]
    counts = np.histogram(values, BINS)[0].tolist()
    return {"estimates": len(values), **shares, "histogram": dict(zip(bins, counts, strict=True))}


def fit_calibrations(observations: Iterable[Observation]) -> dict[str, Calibration]:
    """Calibrations of each solver that was observed often enough."""
    groups: dict[str, list[Observation]] = {}
    for item in observations:
        groups.setdefault(item.solver, []).append(item)
    fitted = {solver: fit_calibration(group) for solver, group in groups.items()}
    return {solver: calibration for solver, calibration in fitted.items() if calibration is not None}


def exact_effectivity(problems: Iterable[Problem], samples: tuple[int, int] = SAMPLES) -> Figures:
    """Estimates of every solver and "adaptive" on exact problems, with calibrations fitted to other noises.

    `left_out` counts samples with errors of rounding size alone, and `refused` configurations that solvers refuse a
    problem's schedule for.
    """
    everything: list[float] = []
    by_problem, left_out, refused = {}, 0, 0
    for problem in problems:
        fitted, _ = _observations(problem, samples[0], seed=0)
        judged, without = _observations(problem, samples[1], seed=1)
        calibrations = fit_calibrations(item for item in fitted if item.error > NOTHING)
        telling = [item for item in judged if item.error > NOTHING]
        ratios = [
            calibrations[item.solver].error(item.indicator) / item.error
            for item in telling
            if item.solver in calibrations
        ]
        everything += ratios
        left_out += len(judged) - len(telling)
        refused += without
        by_problem[problem.name] = {key: share for key, share in shares_of(ratios).items() if key != "histogram"}
    return {**shares_of(everything), "problems": by_problem, "left_out": left_out, "refused": refused}


def _observations(problem: Problem, count: int, seed: int) -> tuple[list[Observation], int]:
    """Indicators and errors of every configuration that can be run on a problem, and how many cannot."""
    target = ProblemTarget(problem, count)
    target.noise = problem.noise(count, seed)
    reference, scale = target.reference(problem.guidance_scale), problem.guidance_scale
    seen: list[Observation] = []
    refused = 0
    for configuration in configurations(NAMED, FITTED_STEPS, FITTED_TOLERANCES, guidance_scales=[scale]):
        try:
            seen += observe(target, configuration, reference)
        except InvalidInputError:  # solvers refuse schedules that they break on, and more steps than there are levels
            refused += 1
    return seen, refused


def pipeline_effectivity(target: PipelineTarget, guidance_scale: float, steps: Sequence[int]) -> Figures:
    """Errors and estimates of a pipeline's calls without a solver, of all samples that ended well and err by `TRUTH`.

    "solvers" holds those that ran, "uncalibrated" how many calls told nothing, "ratios" estimates over errors, and
    "of_runs" the medians of estimates over those of errors.
    """
    reference = close_reference(target, guidance_scale, CLOSE)
    found: Figures = {"solvers": [], "uncalibrated": 0, "ratios": [], "of_runs": []}
    for number in steps:
        latents, report = target.run(Configuration(DEFAULT, number, guidance_scale=guidance_scale))
        errors = errors_of(latents, reference).numpy()
        use = np.array([code is ReturnCode.SUCCESS for code in report.codes]) & (errors > TRUTH)
        found["solvers"].append(report.solver)
        if not report.error_estimate:
            found["uncalibrated"] += 1
        elif use.any():
            estimates = np.asarray(report.error_estimate)[use]
            found["ratios"] += (estimates / errors[use]).tolist()
            found["of_runs"].append(float(np.median(estimates) / np.median(errors[use])))
    return found


def effectivity_and_cost(make: Callable[..., PipelineTarget], calls: Sequence[Mapping[str, Any]]) -> Figures:
    """Estimates against true errors over guidance, steps and what else calls say, and what errors cost by default."""
    ratios: list[float] = []
    of_runs: list[float] = []
    solvers: dict[str, int] = {}
    uncalibrated = 0
    for options in calls:
        target = make(CONDITIONS, **options)
        for scale in JUDGED_GUIDANCES:
            found = pipeline_effectivity(target, scale, JUDGED_STEPS)
            ratios += found["ratios"]
            of_runs += found["of_runs"]
            uncalibrated += found["uncalibrated"]
            for solver in found["solvers"]:
                solvers[solver] = solvers.get(solver, 0) + 1
    return {
        **shares_of(ratios),
        "by_run": shares_of(of_runs),
        "solvers": solvers,
        "uncalibrated": uncalibrated,
        **cost_figures(make(COSTED, seeds=NOISES)),
    }


# What an error costs --------------------------------------------------------------------------------------------------

WANTED = (0.2, 0.1, 0.05, 0.02)
"""Errors whose cost is told."""

CLASSICAL = ("unipc", "dpm++2m", "deis")
"""Multistep solvers that fitted steps are compared with."""

COSTED, NOISES = 16, 4
"""Held-out contacts that costs are medians over, and noises of each."""

COSTED_STEPS = (8, 10, 12, 14, 16, 20, 26, 32)
"""Steps of the solvers of `CLASSICAL`."""


def cost_figures(
    target: PipelineTarget,
    repeats: int = REPEATS,
    wanted: Sequence[float] = WANTED,
    steps: Sequence[int] = COSTED_STEPS,
    evaluations: int = CLOSE,
) -> Figures:
    """What errors cost at the pipeline's own guidance, in medians over samples.

    Of "cost_at_error" for each error the run with the fewest evaluations that has it and seconds of the denoising of
    one sample; in "classical" the best solver of `CLASSICAL` for the same. Where none has it, it is left out.
    """
    scale = target.guidance_scale
    truth = close_reference(target, scale, evaluations)
    named = configurations(CLASSICAL, steps, guidance_scales=[scale])
    results = [measure(target, each, truth, 1) for each in [*named, *fitted_runs(target.pipe.scheduler, scale)]]
    classical = [result for result in results if result.solver in CLASSICAL]
    chosen, best = ({f"{error:g}": cheapest(some, error) for error in wanted} for some in (results, classical))
    call = partial(called, target, [0], "latent", guidance_scale=scale)
    calls = {
        (run.solver, run.steps): partial(call, solver=run.solver, num_inference_steps=run.steps)
        for run in chosen.values()
        if run is not None
    }
    seen = in_turns(calls, repeats)
    costs: Figures = {}
    for error, run in chosen.items():
        if run is not None:
            seconds = [taken["denoising"] for _, taken in seen[run.solver, run.steps]]
            taken = {"seconds": statistics.median(seconds), "low": min(seconds), "high": max(seconds)}
            costs[error] = {**{key: getattr(run, key) for key in OF_RESULTS}, **taken}
    return {
        "guidance_scale": scale,
        "conditions": target.samples,
        "cost_at_error": costs,
        "classical": {
            error: {key: getattr(run, key) for key in OF_RESULTS} for error, run in best.items() if run is not None
        },
    }


def cheapest(results: Sequence[Result], error: float) -> Result | None:
    """The result with the fewest evaluations whose median error is at most so large."""
    able = [result for result in results if result.error is not None and result.error <= error]
    return min(able, key=lambda result: (result.evaluations, result.error), default=None)
