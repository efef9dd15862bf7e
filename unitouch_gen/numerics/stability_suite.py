"""The table of stiff and extreme cases: solvers on exact problems, calls of pipelines, and the world's physics.

Pictures are small and steps few, as what makes a case hard is neither.
"""

import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import count, product
from operator import attrgetter
from typing import Any

import diffusers.utils.logging
import torch
import transformers.utils.logging
from torch import Tensor

from unitouch_gen.errors import NonFiniteError, NotConvergedError, UnfamiliarInputWarning
from unitouch_gen.numerics.problems import (
    STABLE_DIFFUSION,
    GaussianMixture,
    Problem,
    all_problems,
    make_problem,
    spectrum,
)
from unitouch_gen.numerics.reference import relative_rms, solve_reference
from unitouch_gen.numerics.stability import Case, Ended
from unitouch_gen.numerics.stability_world import world_cases
from unitouch_gen.sampling import ReturnCode, prepare_steps
from unitouch_gen.schedulers.schedule import PREDICTION_TYPES
from unitouch_gen.schedulers.solvers import SOLVERS, make_scheduler, schedule_settings
from unitouch_gen.world import World

SUCCESS, NON_FINITE, DIVERGED = ReturnCode.SUCCESS, ReturnCode.NON_FINITE, ReturnCode.DIVERGED
MAX_EVALUATIONS = ReturnCode.MAX_EVALUATIONS
NAN, INF, CPU = math.nan, math.inf, torch.device("cpu")

KINDS = ("touch-to-image", "stylization", "x-to-touch")
"""Pipelines, as the built-in family names them."""

TOLERANCE = 1e-2
"""Tolerance of a run, where a case says nothing."""

ROUNDING = 4 * 2.0**-23
"""What a step of some four operations loses in float32."""

SAME = 1e-4
"""Relative difference of calls that do the same in another order: some thousand roundings of float32."""


def suite(load: Callable[..., Any]) -> dict[str, list[Case]]:
    """All cases, by group.

    `load(kind, dtype=...)` is called when a case first needs that pipeline, as `unitouch_gen.tiny` is; the libraries'
    messages and bars are off from then on.
    """
    return {
        "stiff": [*stiff_cases()],
        "guidance": [*guidance_cases()],
        "few steps": [*few_step_cases()],
        "steps": [*step_cases()],
        "batches": [*batch_cases()],
        "schedules": [*schedule_cases()],
        "predictions": [*prediction_cases()],
        **pipeline_cases(load, KINDS),
        **world_cases(),
    }


# Bounds of solvers ----------------------------------------------------------------------------------------------------


@cache
def truth(problem: Problem, batch_size: int = 4) -> Tensor:
    """Where the exact flow ends from `problem.noise(batch_size)`, (B, C, h, w)."""
    noise = problem.noise(batch_size)
    if problem.has_solution:
        return problem.solution(noise)
    return solve_reference(problem.flow, noise, rtol=1e-7, end="zero").latents


def a_priori(problem: Problem, solver: str, steps: int, batch_size: int = 4) -> float:
    """Relative error that a solver may leave on Gaussian data, of the worst sample.

    In lambda = -log sigma the flow is dx/dlambda = D - x, and a step of h leaves out C h^(p+1) |D^(p)|, with C = 1/2 at
    order p = 1, and for p >= 2 at most that of two steps of Adams and Bashforth (5/12 where they are equal). The exact
    flow, along which D is known, carries these errors to the end (Hairer, Nørsett & Wanner, Solving Ordinary
    Differential Equations I, Section II.3). The step to sigma = 0 and roundings are added.
    """
    timesteps = prepare_steps(make_scheduler(problem.scheduler(), solver), steps, CPU)
    sigmas = problem.schedule.sigma(timesteps.double()).unique().flip(0).tolist()
    values, levels = along(problem, sigmas, batch_size), [-math.log(sigma) for sigma in sigmas]
    higher = SOLVERS[solver].order > 1
    total = last_step(problem, sigmas, higher, batch_size)
    for place in range(1, len(sigmas)):
        step = levels[place] - levels[place - 1]
        slope = (values[place] - values[place - 1]) / step
        local = step**2 / 2 * slope.abs()
        if higher and place > 1:
            before = levels[place - 1] - levels[place - 2]
            curvature = 2 * (slope - (values[place - 1] - values[place - 2]) / before) / (step + before)
            local = (step**3 / 6 + step**2 * before / 4) * curvature.abs()
        total = total + carried(problem, sigmas[place]) * local
    return worst(total, problem, batch_size) + len(sigmas) * ROUNDING


def along(problem: Problem, sigmas: Sequence[float], batch_size: int) -> list[Tensor]:
    """D on the exact path at each noise level, along the axes of the data, (B, d)."""
    noise = problem.noise(batch_size)
    return [problem.data.to_axes(problem.denoise(problem.solution(noise, sigma), sigma)) for sigma in sigmas]


def carried(problem: Problem, sigma: float) -> Tensor:
    """What the exact flow makes of a difference at a noise level by sigma = 0, along each axis, (d,)."""
    scale = problem.guidance_scale if problem.guidance.active else 1.0
    both = [(problem.unconditional or problem.data).variances[0], problem.data.variances[0]]
    other, conditional = (variances / (variances + sigma**2) for variances in both)
    return other ** ((1 - scale) / 2) * conditional ** (scale / 2)


def last_step(problem: Problem, sigmas: Sequence[float], higher: bool, batch_size: int) -> Tensor:
    """What the step to sigma = 0 leaves out, (B, d): order 1 ends with D at the smallest level, higher ones with the
    line in sigma^2 through it and the last level that is 1.5 times as large."""
    wider = [sigma for sigma in sigmas if sigma >= 1.5 * sigmas[-1]][-1:] if higher else []
    end, *earlier = along(problem, [sigmas[-1], *wider], batch_size)
    for sigma, value in zip(wider, earlier):
        end = end + (end - value) * sigmas[-1] ** 2 / (sigma**2 - sigmas[-1] ** 2)
    return (end - problem.data.to_axes(truth(problem, batch_size))).abs()


def worst(errors: Tensor, problem: Problem, batch_size: int) -> float:
    """Errors (B, d) relative to where the flow ends, of the worst sample."""
    return (errors.norm(dim=1) / truth(problem, batch_size).flatten(1).norm(dim=1)).max().item()


def within(problem: Problem, tolerance: float, batch_size: int = 4) -> float:
    """A tolerance, and what a line through two levels up to a factor of 2 apart misses of the step to sigma = 0."""
    if not problem.has_solution:
        return tolerance
    last = problem.schedule.sigma_min
    return tolerance + worst(last_step(problem, [2 * last, last], True, batch_size), problem, batch_size)


# Solvers on exact problems --------------------------------------------------------------------------------------------


def solve(problem: Problem, solver: str | None = None, steps: int = 50, *, batch_size: int = 4, **way: Any) -> Ended:
    """One run from `problem.noise(batch_size)`, see `Problem.run`.

    Args:
        problem, solver, steps, batch_size: What is run.
        way: "expected" is what should come out, (B, C, h, w), in place of the exact solution; the rest is the run's.
    """
    expected = way.pop("expected", None)
    latents, report = problem.run(problem.noise(batch_size), solver, steps, **{"throw": False, **way})
    rows = [row for row, code in enumerate(report.codes) if code.finite]
    exact = truth(problem, batch_size) if expected is None else expected
    error = relative_rms(latents[rows], exact[rows]).max().item() if rows else NAN
    return Ended(latents[rows], error, report.codes)


def by_solver(name: str, problem: Problem, solver: str, steps: int = 50, batch_size: int = 4) -> Case:
    """A solver that has to keep to its a-priori error."""
    ask = partial(solve, problem, solver, steps, batch_size=batch_size)
    bound = partial(a_priori, problem, solver, steps, batch_size)
    return Case(f"{name}, {solver}", ask, bound, order_of(solver))


def to_tolerance(name: str, problem: Problem, tolerance: float = TOLERANCE, batch_size: int = 4) -> Case:
    """Steps that have to keep to a tolerance."""
    ask = partial(solve, problem, tolerance=tolerance, batch_size=batch_size)
    return Case(name, ask, partial(within, problem, tolerance, batch_size), "tolerance")


def ends(name: str, ask: Callable[..., Ended], code: ReturnCode) -> list[Case]:
    """What has to end with a code, and to raise the error of that code where it may."""
    error = NonFiniteError if code is NON_FINITE else NotConvergedError
    raising = Case(f"{name}, raising", partial(ask, throw=True), raises=error)
    return [Case(name, ask, codes=code), raising]


def order_of(solver: str) -> str:
    """Where the a-priori error of a solver comes from, in words."""
    return f"order {min(SOLVERS[solver].order, 2)}"


def able(problem: Problem) -> list[str]:
    """Solvers that cope with a problem's schedule."""
    rescaled = problem.schedule_config.get("rescale_betas_zero_snr")
    return [name for name, solver in SOLVERS.items() if solver.zero_snr or not rescaled]


def stiff_cases() -> Iterator[Case]:
    """Every solver, and steps to a tolerance, on every stiff problem."""
    for problem in all_problems(stiff=True):
        for solver in able(problem):
            name, ask = f"{problem.name}, {solver}", partial(solve, problem, solver)
            if problem.has_solution:
                yield by_solver(problem.name, problem, solver)
            elif problem.guidance.active:
                yield Case(name, ask, partial(halved, problem, solver), "half an order less than nominal")
            else:
                deviation = 3 * problem.data.smallest_deviation / problem.data.root_mean_square
                yield Case(name, ask, deviation + 50 * ROUNDING, "both ends within 1.5 deviations of a mode")
        yield to_tolerance(f"{problem.name}, tolerance", problem)


def halved(problem: Problem, solver: str) -> float:
    """The error of 25 steps, and what 50 make of it at half an order less than the solver's."""
    return solve(problem, solver, 25).error * 0.5 ** (SOLVERS[solver].order - 0.5)


RESOLVED = {0.0: 50, 1.0: 50, 1.0001: 50, 2.0: 50, 7.5: 50, 30.0: 50, 100.0: 200}
"""Steps that follow a guidance scale g: D turns at a rate of up to g / 3 in log sigma, so that is about one a step."""


def guidance_cases() -> Iterator[Case]:
    """Scales from none to a thousand between two Gaussians, where the flow has a closed form and stays small."""
    guided = make_problem("gaussian-guided")
    for scale, steps in RESOLVED.items():
        problem = replace(guided, guidance_scale=scale)
        yield from (by_solver(f"guidance {scale:g}", problem, solver, steps) for solver in ("ddim", "dpm++2m"))
        yield to_tolerance(f"guidance {scale:g}, tolerance", problem)
    few = partial(solve, replace(guided, guidance_scale=100.0), "dpm++2m")
    yield Case("guidance 100 in 50 steps", few, codes=DIVERGED)
    problem = replace(guided, guidance_scale=1000.0)
    for solver in ("ddim", "dpm++2m"):  # the states grow until float32 ends
        yield Case(f"guidance 1000, {solver}", partial(solve, problem, solver), codes=NON_FINITE)
    for tolerance in (TOLERANCE, 0.1):
        ask = partial(solve, problem, tolerance=tolerance)
        yield Case(f"guidance 1000, tolerance {tolerance:g}", ask, codes=MAX_EVALUATIONS)
    # The states grow a billion times on the way, where no network but an exact one would lead them back.
    thousand = partial(solve, problem, "euler", 1000)
    yield Case("guidance 1000, 1000 steps", thousand, codes=DIVERGED)
    yield Case("guidance 1000, raising", partial(thousand, throw=True), raises=NotConvergedError)


def few_step_cases() -> Iterator[Case]:
    """Strong guidance in too few steps, which blows multistep solvers up: results are finite, whatever their code."""

    def ask(problem: Problem, solver: str, steps: int) -> Ended:
        ended = solve(problem, solver, steps)
        return Ended(ended.output, ended.error)

    names = ("mixture-7.5", "mixture-30", "gaussian-guided", "gaussian-guided-30")
    runs = [*product(map(make_problem, names), SOLVERS, (3, 5)), (make_problem("gaussian-guided-30"), "dpm++2m", 20)]
    strong = replace(make_problem("gaussian-guided"), name="gaussian-guided-60", guidance_scale=60.0)
    for problem, solver, steps in [*runs, (strong, "dpm++2m", 50)]:
        yield Case(f"{problem.name}, {solver}, {steps} steps", partial(ask, problem, solver, steps), codes=())


def step_cases() -> Iterator[Case]:
    """One step, as many as there are levels, and tolerances from the loosest to the tightest."""
    plain, mixture = make_problem("conditioning-1e2"), make_problem("mixture-7.5")
    for solver in SOLVERS:
        if solver not in ("euler", "heun"):  # which would begin at the last level, and are refused
            yield by_solver("1 step", plain, solver, 1)
        yield by_solver("1000 steps", plain, solver, 1000)
    for tolerance in (1.0, 1e-1, 1e-2, 1e-3, 1e-4):
        yield to_tolerance(f"tolerance {tolerance:g}", mixture, tolerance)
    for most in (2, 5):
        ask = partial(solve, mixture, tolerance=1e-4, max_evaluations=most)
        yield from ends(f"tolerance within {most} evaluations", ask, MAX_EVALUATIONS)


def batch_cases() -> Iterator[Case]:
    """One sample and many, of one value and of odd sides."""
    plain = make_problem("conditioning-1e2")
    for size in (1, 64, 256):
        yield by_solver(f"batch of {size}", plain, "dpm++2m", batch_size=size)
        yield to_tolerance(f"batch of {size}, tolerance", plain, batch_size=size)
    for shape in ((1, 1, 1), (3, 7, 5), (4, 1, 64)):
        data = spectrum(100.0, math.prod(shape), mean=0.1)
        yield by_solver(f"latents {shape}", Problem("odd", "Gaussian of odd sides", shape, data), "unipc")


SCHEDULES: dict[str, dict[str, Any]] = {
    "largest level 0.1": {"beta_start": 1e-6, "beta_end": 2e-5, "beta_schedule": "linear"},
    "cosine": {"beta_schedule": "squaredcos_cap_v2"},
    "zero terminal SNR": {**STABLE_DIFFUSION, "rescale_betas_zero_snr": True},
    "2 levels": {"num_train_timesteps": 2, "trained_betas": [0.01, 0.999]},
    "10000 levels": {"num_train_timesteps": 10_000, "beta_start": 1e-5, "beta_end": 2e-3, "beta_schedule": "linear"},
}


def schedule_cases() -> Iterator[Case]:
    """Schedules with ends far away, with few levels and with many, and all kinds of predictions."""
    for (name, config), kind in product(SCHEDULES.items(), PREDICTION_TYPES):
        problem = replace(make_problem("conditioning-1e2"), schedule_config=config, prediction_type=kind)
        yield to_tolerance(f"{name}, {kind}, tolerance", problem)
        for solver in [solver for solver in ("ddim", "euler", "dpm++2m") if solver in able(problem)]:
            hopeless = (name, kind, solver) == ("zero terminal SNR", "epsilon", "ddim")
            if not hopeless and name != "2 levels":  # which is refused, and whose a-priori error is above 1
                yield by_solver(f"{name}, {kind}", problem, solver, 20)


def prediction_cases() -> Iterator[Case]:
    """Networks that break, that say nothing, and that round."""
    plain = make_problem("conditioning-1e2")
    largest, noise = plain.schedule.sigma_max, plain.noise(4)

    def changed(change: Callable[[Tensor], Tensor], call: int | None = None, **way: Any) -> Ended:
        """A run with predictions (B, C, h, w) changed at one call, or at all."""
        network, calls = plain.network(), count()

        def predict(state: Tensor, timestep: Tensor) -> Tensor:
            prediction = network(state, timestep)
            return change(prediction) if call in (None, next(calls)) else prediction

        return solve(plain, network=predict, **way)

    def filled(value: float) -> Callable[[Tensor], Tensor]:
        return partial(torch.full_like, fill_value=value)

    def bound(name: str, steps: int, more: float = 0.0) -> float:
        return more + (a_priori(plain, name, steps) if name in SOLVERS else within(plain, TOLERANCE))

    def restless() -> Ended:
        generator = torch.Generator().manual_seed(0)
        noisy = lambda prediction: prediction + 0.3 * torch.randn(prediction.shape, generator=generator)  # noqa: E731
        return changed(noisy, tolerance=1e-4)

    ways: dict[str, dict[str, Any]] = {solver: {"solver": solver, "steps": 10} for solver in SOLVERS}
    for name, way in {**ways, "tolerance": {"tolerance": TOLERANCE}}.items():
        for what, change, call in (
            ("NaN at the first evaluation", filled(NAN), 0),
            ("NaN at a later evaluation", filled(NAN), 5),
            ("Inf at the first evaluation", filled(INF), 0),
            ("Inf at a later evaluation", filled(INF), 5),
            ("1e38 throughout", filled(1e38), None),
            ("beyond float16", lambda prediction: (1e5 * prediction).half(), None),
        ):
            yield Case(f"{what}, {name}", partial(changed, change, call, **way), codes=NON_FINITE)
        broken = partial(changed, lambda prediction: prediction.index_fill(0, torch.tensor(1), NAN), 3, **way)
        codes = [SUCCESS, NON_FINITE, SUCCESS, SUCCESS]
        yield Case(f"NaN in one of four, {name}", broken, partial(bound, name, 10), "that of the others alone", codes)
        raising = partial(changed, filled(NAN), 3, throw=True, **way)
        yield Case(f"NaN, raising, {name}", raising, raises=NonFiniteError)
        for value in (0.0, 1.0, 1e4):
            left = noise * math.hypot(1.0, largest) - value * largest  # dx/dsigma is constant
            ask = partial(changed, filled(value), expected=left, **way)
            yield Case(f"{value:g} throughout, {name}", ask, 50 * ROUNDING, "a straight path", DIVERGED)
        for dtype in (torch.float16, torch.bfloat16):
            ask = partial(changed, partial(Tensor.to, dtype=dtype), **{**way, "steps": 50})
            # A rounding u moves x by u d(sigma) in a step, of which the flow keeps 1 / sigma of the result.
            roundings = torch.finfo(dtype).eps / 2 * (1 + math.log(2 * largest / plain.schedule.sigma_min))
            label = f"predictions in {str(dtype).removeprefix('torch.')}, {name}"
            yield Case(label, ask, partial(bound, name, 50, roundings), "and roundings along the path")
    yield Case("other noise at every evaluation, tolerance", restless, codes=ReturnCode.STEP_TOO_SMALL)


# Calls of pipelines ---------------------------------------------------------------------------------------------------

SIDE = 8
"""Latents along each side of small pictures."""


@cache
def inputs(kind: str) -> dict[str, Tensor]:
    """What each pipeline is given where a case says nothing: one contact of the world, seen or touched."""
    scene = World().render([5], [200], [0], modalities=("image", "touch"))
    given: dict[str, Any] = {"image": scene.image, "touch": scene.touch["gelsight"]}
    left_out = {"touch-to-image": "image", "x-to-touch": "touch"}.get(kind)
    return {name: value for name, value in given.items() if name != left_out}


EMBEDS = {"touch-to-image": ["touch_embeds"], "stylization": [], "x-to-touch": ["condition_embeds"]}
"""Arguments that come in the place of those inputs, as `touch` does."""

SHAPES: dict[str, Callable[[Any], Any]] = {
    "touch_embeds": lambda pipe: (1, pipe.embedding_dim),
    "condition_embeds": lambda pipe: (1, 1, pipe.embedding_dim),
    "latents": lambda pipe: (1, pipe.unet.config.out_channels, SIDE, SIDE),
}
"""Shapes of arguments, which only a pipeline knows: cases say what becomes of noise of that shape."""


@dataclass(frozen=True)
class Calls:
    """Small calls of one pipeline, by its name in the built-in family, from one noise."""

    load: Callable[[str, torch.dtype], Any]
    kind: str

    def output(self, dtype: torch.dtype = torch.float32, **arguments: Any) -> Any:
        """What one call returns; arguments that are given take the place of the usual ones."""
        pipe = self.load(self.kind, dtype)
        given: dict[str, Any] = {"guidance_scale": 2.0, "output_type": "latent", "throw": False}
        given["height"] = given["width"] = SIDE * pipe.vae_scale_factor
        given["generator"] = torch.Generator().manual_seed(0)
        if "tolerance" not in arguments:
            given["num_inference_steps"] = 2
        if not {"touch", *EMBEDS[self.kind]} & set(arguments) or self.kind == "stylization":
            given.update(inputs(self.kind))
        if self.kind == "stylization":
            given["init_strength"] = 1.0  # from noise
        given.update(arguments)
        for name in SHAPES.keys() & arguments.keys():
            given[name] = given[name](torch.randn(SHAPES[name](pipe), generator=torch.Generator().manual_seed(1)))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UnfamiliarInputWarning)  # they are to be unfamiliar
            return pipe(**given)

    def run(self, expected: Callable[[], Tensor] | None = None, **arguments: Any) -> Ended:
        """How one call ended, and how far its finite samples are from what is expected (b, ...)."""
        output = self.output(**arguments)
        images, codes = torch.as_tensor(output.images), output.report.codes
        return Ended(images, relative_rms(images, expected()).max().item() if expected else NAN, codes)

    def coded(self, name: str, code: ReturnCode, **arguments: Any) -> Case:
        """A call that has to end with a code."""
        return Case(name, partial(self.run, **arguments), codes=code)

    def same(self, name: str, because: str, one: dict[str, Any], other: dict[str, Any], bound: Any = SAME) -> Case:
        """Two calls that have to come to the same."""
        return Case(name, partial(self.run, lambda: self.output(**other).images, **one), bound, because)


def exact_cases(calls: Calls) -> Iterator[Case]:
    """Whole calls with an exact network in the place of the pipeline's own."""

    @cache
    def exact() -> Problem:
        """Gaussian data of the shape of the pipeline's small latents on its own schedule, at guidance 3."""
        pipe = calls.load(calls.kind, torch.float32)
        shape, settings = SHAPES["latents"](pipe)[1:], schedule_settings(pipe.scheduler)
        kind = settings.pop("prediction_type")
        variances = torch.logspace(0, -1, math.prod(shape), dtype=torch.float64)[None]
        narrow, wide = GaussianMixture(0.3 + 0 * variances, variances), GaussianMixture(0 * variances, 2 * variances)
        return Problem("pipeline", "Latents of a pipeline", shape, narrow, wide, 3.0, settings, kind)

    def called(**arguments: Any) -> Ended:
        pipe, problem = calls.load(calls.kind, torch.float32), exact()
        unet, network = pipe.unet, problem.network()
        network.config, pipe.unet = unet.config, network
        try:
            noise = problem.noise(1)
            return calls.run(lambda: truth(problem, 1), guidance_scale=3.0, latents=lambda _: noise, **arguments)
        finally:
            pipe.unet = unet

    for solver in SOLVERS:
        ask = partial(called, solver=solver, num_inference_steps=20)
        bound = lambda solver=solver: a_priori(exact(), solver, 20, 1)  # noqa: E731
        yield Case(f"exact network, {solver}", ask, bound, order_of(solver))
    for tolerance in (0.1, TOLERANCE):
        bound = lambda tolerance=tolerance: within(exact(), tolerance, 1)  # noqa: E731
        yield Case(f"exact network, tolerance {tolerance:g}", partial(called, tolerance=tolerance), bound, "tolerance")


def number_cases(calls: Calls) -> Iterator[Case]:
    """Numbers of a call at their ends, and callbacks."""
    for scale in (0.0, 0.5):
        yield calls.same(f"guidance_scale={scale:g}", "no guidance", {"guidance_scale": scale}, {"guidance_scale": 1.0})
    yield calls.same("guidance_interval=(0, 1)", "everywhere", {"guidance_interval": (0, 1)}, {})
    yield from ends("guidance_scale=1e6", partial(calls.run, guidance_scale=1e6), DIVERGED)
    few = partial(calls.run, tolerance=1e-4, max_evaluations=3)
    yield from ends("a call within 3 evaluations", few, MAX_EVALUATIONS)

    def interrupt(pipe: Any, *_: Any) -> dict:
        pipe._interrupt = True  # as diffusers documents it
        return {}

    for name, throw in (("an interrupt", False), ("an interrupt, which raises nothing", True)):
        yield calls.coded(name, ReturnCode.INTERRUPTED, callback_on_step_end=interrupt, throw=throw)
    for value in (NAN, INF):
        spoil = partial(lambda value, pipe, step, timestep, given: {"latents": value * given["latents"]}, value)
        yield calls.coded(f"latents {value} from a callback", NON_FINITE, callback_on_step_end=spoil)


def input_cases(calls: Calls) -> Iterator[Case]:
    """Noise and embeddings that are next to nothing, far too large, or of another dtype, and touches of any size."""
    alike: list[tuple[str, Callable, Callable]] = [
        ("of size 1e-40", lambda noise: 1e-40 * noise, lambda noise: 0 * noise),
        ("in float16", Tensor.half, lambda noise: noise.half().float()),
        ("in float64", Tensor.double, lambda noise: noise),
    ]
    for name in ("latents", *EMBEDS[calls.kind]):
        # Touch embeddings get noise of their own dtype, which is other noise.
        for what, one, other in alike[: 1 if name == "touch_embeds" else 3]:
            yield calls.same(f"{name} {what}, {calls.kind}", "the same numbers", {name: one}, {name: other})
        for size in (1e30, 3e38):
            large = partial(lambda size, noise: size * noise.sign(), size)
            yield calls.coded(f"{name} of size {size:g}, {calls.kind}", NON_FINITE, **{name: large})
    yield calls.coded(f"latents of size 1e3, {calls.kind}", DIVERGED, latents=lambda noise: 1e3 * noise)
    for sides in ((8, 8), (37, 101), (8, 800), (800, 8), (800, 800)):
        grey, resized = ({"touch": torch.full((3, *size), 51 / 255)} for size in ((64, 64), sides))
        yield calls.same(f"a grey touch of {sides}, {calls.kind}", "constant at any size", resized, grey)


def many_cases(calls: Calls, size: int = 64) -> Iterator[Case]:
    """The last of many, and alone."""

    def last(repeats: int) -> Ended:
        generators = [torch.Generator().manual_seed(row) for row in range(size)]
        rows: dict[str, Any] = {
            name: value.expand(size // repeats, -1, -1, -1) for name, value in inputs(calls.kind).items()
        }
        many = calls.output(**rows, num_images_per_prompt=repeats, generator=generators)
        alone = calls.output(generator=torch.Generator().manual_seed(size - 1))
        return Ended(many.images, relative_rms(many.images[-1:], alone.images).item(), many.report.codes)

    for repeats, name in ((1, f"{size} inputs"), (size, f"{size} of one input")):
        yield Case(f"{name}, {calls.kind}", partial(last, repeats), SAME, "each as alone")


def precision_cases(calls: Calls) -> Iterator[Case]:
    """Networks in half precision, against the same in float32 from the same noise."""

    def roundings(dtype: torch.dtype) -> float:
        modules = calls.load(calls.kind, torch.float32).unet.modules()
        layers = sum(any(True for _ in module.parameters(recurse=False)) for module in modules)
        return torch.finfo(dtype).eps / 2 * math.sqrt(8 * layers)

    for dtype in (torch.float16, torch.bfloat16):
        name = str(dtype).removeprefix("torch.")
        yield calls.coded(f"{name} at guidance 1000, {calls.kind}", DIVERGED, dtype=dtype, guidance_scale=1000)
        for scale in (0.0, 2.0):
            label, because = f"{name} at guidance {scale:g}, {calls.kind}", "independent roundings of its layers"
            usual: Any = {"latents": lambda noise: noise, "num_inference_steps": 8, "guidance_scale": scale}
            yield calls.same(label, because, {**usual, "dtype": dtype}, usual, partial(roundings, dtype))
    for name in EMBEDS[calls.kind]:
        large: Any = {name: lambda noise: 1e6 * noise}
        yield calls.coded(f"{name} beyond float16, {calls.kind}", NON_FINITE, dtype=torch.float16, **large)


def broken_cases(calls: Calls) -> Iterator[Case]:
    """Each network of a pipeline broken in turn, for all samples and for one of three."""
    three: dict[str, Any] = {"num_images_per_prompt": 3, "guidance_scale": 1.0, "output_type": "pt"}
    parts = {"UNet": "unet", "VAE": "vae.decoder"}
    if calls.kind != "x-to-touch":
        parts |= {"touch encoder": "unitouch.touch_model", "text encoder": "text_encoder.final_layer_norm"}

    def run(part: str, value: float, row: int | None = None, **arguments: Any) -> Ended:
        def answer(_module: Any, _arguments: Any, output: Any) -> None:
            first = output[0] if isinstance(output, tuple) else output
            first[slice(None) if row is None else row] = value

        others = None if row is None else calls.output(**three).images[[0, 2]]
        module = attrgetter(parts[part])(calls.load(calls.kind, torch.float32))
        handle = module.register_forward_hook(answer)
        try:
            return calls.run(None if others is None else lambda: others, **{**three, **arguments})
        finally:
            handle.remove()

    for part in parts:
        for value in (NAN, INF):
            yield Case(f"{part} says {value}", partial(run, part, value), codes=NON_FINITE)
        yield Case(f"{part} says NaN, raising", partial(run, part, NAN, throw=True), raises=NonFiniteError)
    for part in ("UNet", "VAE"):
        codes = [SUCCESS, NON_FINITE, SUCCESS]
        yield Case(f"{part} says NaN of one of three", partial(run, part, NAN, 1), SAME, "the others as ever", codes)
    yield Case("UNet says 1e4", partial(run, "UNet", 1e4), codes=DIVERGED)


def pipeline_cases(load: Callable[..., Any], kinds: Sequence[str] = KINDS) -> dict[str, list[Case]]:
    """Cases on pipelines, by group; see `suite`."""

    @cache
    def kept(kind: str, dtype: torch.dtype) -> Any:
        for library in (diffusers, transformers):
            library.utils.logging.disable_progress_bar()
            library.utils.logging.set_verbosity_error()
        pipe = load(kind, dtype=dtype)
        pipe.set_progress_bar_config(disable=True)
        return pipe

    each = [Calls(kept, kind) for kind in kinds]
    return {
        "calls": [*exact_cases(each[0]), *number_cases(each[0])],
        "inputs": [case for calls in each for case in input_cases(calls)],
        "many": [case for calls in each for case in many_cases(calls)],
        "precision": [case for calls in each for case in precision_cases(calls)],
        "broken": [*broken_cases(each[0])],
    }
