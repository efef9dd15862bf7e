"""Stability: stiff and extreme cases of solvers, pipelines and the world's physics, each with an a-priori bound.

A bound follows from the problem: a closed form, the order of a method, a number of roundings. A case measures one
number, which may be at most its bound. An error counts as infinite where a sample ends with an unexpected return code,
or where a value that is not finite leaves as a result.
"""

import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import count, product
from operator import attrgetter
from typing import Any

import torch
from torch import Tensor

from unitouch_gen.errors import UnfamiliarInputWarning
from unitouch_gen.numerics.problems import STABLE_DIFFUSION, Problem, all_problems, make_problem
from unitouch_gen.numerics.reference import relative_rms, solve_reference
from unitouch_gen.sampling import ReturnCode, prepare_steps
from unitouch_gen.schedulers.solvers import SOLVERS, make_scheduler
from unitouch_gen.world import World
from unitouch_gen.world.gel import gel_displacement
from unitouch_gen.world.sounds import impulse_response

SUCCESS, NON_FINITE, DIVERGED = ReturnCode.SUCCESS, ReturnCode.NON_FINITE, ReturnCode.DIVERGED
MAX_EVALUATIONS, INTERRUPTED = ReturnCode.MAX_EVALUATIONS, ReturnCode.INTERRUPTED
NAN, INF, CPU = math.nan, math.inf, torch.device("cpu")

KINDS = ("touch-to-image", "stylization", "x-to-touch")
"""Built-in pipelines."""

ROUNDING = 4 * 2.0**-23
"""Relative error of a step of some four operations in float32."""

SAME = 1e-4
"""Relative difference of equal calls: some thousand roundings of float32 in another order."""

TRANSFORMS = 1e-5
"""Rounding of Fourier transforms of 128 x 128 values in float32."""


@dataclass(frozen=True)
class Case:
    """One stiff or extreme case.

    Attributes:
        name: Unique name.
        problem: Function that runs it and returns what it measured.
        demand: What has to hold, in words.
        bound: Largest value allowed, or a function that computes it.
        reason: Where the bound comes from.
    """

    name: str
    problem: Callable[[], float]
    demand: str
    bound: float | Callable[[], float] = 0.0
    reason: str = "none may"

    @torch.no_grad()
    def measure(self) -> tuple[float, float]:
        """(value measured, bound)."""
        return self.problem(), self.bound() if callable(self.bound) else self.bound


def cases(load: Callable[..., Any], kinds: Sequence[str] = KINDS) -> list[Case]:
    """All cases; `load(kind, dtype=...)` returns a pipeline when a case first needs it, as `unitouch_gen.tiny` does."""
    kept = cache(lambda kind, dtype: load(kind, dtype=dtype))
    pipelines = [case for kind in kinds for case in pipeline_cases(partial(kept, kind), kind)]
    return [*solver_cases(), *network_cases(), *pipelines, *gel_cases(), *mode_cases()]


# Measures -------------------------------------------------------------------------------------------------------------


def as_expected(result: Tensor, codes: Sequence[ReturnCode], expected: ReturnCode | Sequence[ReturnCode]) -> bool:
    """Whether codes are as expected (one for all, or one a sample) and every value of the result is finite."""
    wanted = [expected] * len(codes) if isinstance(expected, ReturnCode) else list(expected)
    return list(codes) == wanted and bool(torch.isfinite(result).all())


def error(result: Tensor, exact: Tensor, codes: Sequence[ReturnCode], expected: Any = SUCCESS) -> float:
    """Relative RMS error of the worst sample; infinite if codes or values are not as they have to be."""
    return relative_rms(result, exact).max().item() if as_expected(result, codes, expected) else INF


def apart(result: Tensor, exact: Tensor | float) -> float:
    """Largest absolute difference."""
    return float((result - exact).abs().max())


def beyond(result: Tensor, low: float = 0.0, high: float = 1.0) -> float:
    """How far values leave a range."""
    return max(low - float(result.min()), float(result.max()) - high, 0.0) if bool(result.isfinite().all()) else INF


# Bounds of solvers ----------------------------------------------------------------------------------------------------


@cache
def truth(problem: Problem, batch_size: int = 4) -> Tensor:
    """Where the exact flow ends from `problem.noise(batch_size)`, (B, C, h, w)."""
    noise = problem.noise(batch_size)
    if problem.has_solution:
        return problem.solution(noise)
    return solve_reference(problem.flow, noise, rtol=1e-7, end="zero").latents


def a_priori(problem: Problem, solver: str, steps: int) -> float:
    """Relative error that a solver may leave on Gaussian data, of the worst of four samples.

    In lambda = -log sigma the flow is dx/dlambda = D - x, and a step of h leaves out C h^(p+1) |D^(p)|, with C = 1/2 at
    order p = 1, and for p >= 2 at most that of two steps of Adams and Bashforth (5/12 where they are equal). The exact
    flow, along which D is known, carries these errors to the end (Hairer, Nørsett & Wanner, Solving Ordinary
    Differential Equations I, Section II.3). The step to sigma = 0 and roundings are added.
    """
    timesteps = prepare_steps(make_scheduler(problem.scheduler(), solver), steps, CPU)
    sigmas = problem.schedule.sigma(timesteps.double()).unique().flip(0).tolist()
    values, levels = along(problem, sigmas), [-math.log(sigma) for sigma in sigmas]
    higher = SOLVERS[solver].order > 1
    total = last_step(problem, sigmas, higher)
    for place in range(1, len(sigmas)):
        step = levels[place] - levels[place - 1]
        slope = (values[place] - values[place - 1]) / step
        local = step**2 / 2 * slope.abs()
        if higher and place > 1:
            before = levels[place - 1] - levels[place - 2]
            curvature = 2 * (slope - (values[place - 1] - values[place - 2]) / before) / (step + before)
            local = (step**3 / 6 + step**2 * before / 4) * curvature.abs()
        total = total + carried(problem, sigmas[place]) * local
    return worst(total, problem) + len(sigmas) * ROUNDING


def along(problem: Problem, sigmas: Sequence[float]) -> list[Tensor]:
    """D on the exact path at each noise level, along the axes of the data, (4, d)."""
    noise = problem.noise(4)
    return [problem.data.to_axes(problem.denoise(problem.solution(noise, sigma), sigma)) for sigma in sigmas]


def carried(problem: Problem, sigma: float) -> Tensor:
    """Factor of the exact flow on a difference at a noise level by sigma = 0, along each axis, (d,)."""
    scale = problem.guidance_scale if problem.guidance.active else 1.0
    both = [(problem.unconditional or problem.data).variances[0], problem.data.variances[0]]
    other, conditional = (variances / (variances + sigma**2) for variances in both)
    return other ** ((1 - scale) / 2) * conditional ** (scale / 2)


def last_step(problem: Problem, sigmas: Sequence[float], higher: bool) -> Tensor:
    """Error of the step to sigma = 0, (4, d): order 1 ends with D at the smallest level, higher ones with the line in
    sigma^2 through it and the last level that is 1.5 times as large."""
    wider = [sigma for sigma in sigmas if sigma >= 1.5 * sigmas[-1]][-1:] if higher else []
    end, *earlier = along(problem, [sigmas[-1], *wider])
    for sigma, value in zip(wider, earlier):
        end = end + (end - value) * sigmas[-1] ** 2 / (sigma**2 - sigmas[-1] ** 2)
    return (end - problem.data.to_axes(truth(problem))).abs()


def worst(errors: Tensor, problem: Problem) -> float:
    """Errors (4, d) relative to where the flow ends, of the worst sample."""
    return (errors.norm(dim=1) / truth(problem).flatten(1).norm(dim=1)).max().item()


def within(problem: Problem, tolerance: float) -> float:
    """A tolerance, and the error of the step to sigma = 0 from a line through two levels a factor of 2 apart."""
    last = problem.schedule.sigma_min
    end = worst(last_step(problem, [2 * last, last], True), problem) if problem.has_solution else 0.0
    return tolerance + end


# Solvers on exact problems --------------------------------------------------------------------------------------------


def run(problem: Problem, solver: str | None = None, steps: int = 50, **options: Any) -> tuple[Tensor, list[int], Any]:
    """One run from four noises, see `Problem.run`: finite latents (b, C, h, w), their rows, and the report."""
    latents, report = problem.run(problem.noise(4), solver, steps, **{"throw": False, **options})
    rows = [row for row, code in enumerate(report.codes) if code.finite]
    return latents[rows], rows, report


def solve(problem: Problem, *way: Any, codes: Any = SUCCESS, exact: Tensor | None = None, **options: Any) -> float:
    """Error of one run."""
    latents, rows, report = run(problem, *way, **options)
    return error(latents, (truth(problem) if exact is None else exact)[rows], report.codes, codes)


def ends(name: str, call: Callable[..., tuple[Tensor, Sequence[ReturnCode]]], code: ReturnCode) -> Case:
    """A call that has to end with a code for every sample, and with finite results."""
    return Case(name, lambda: float(not as_expected(*call(), code)), f"ends as {code.value}, no NaN or Inf comes out")


def by_solver(name: str, problem: Problem, solver: str, steps: int = 50) -> Case:
    """A solver that has to keep its a-priori error."""
    reason = f"order {min(SOLVERS[solver].order, 2)} along the exact flow"
    bound = partial(a_priori, problem, solver, steps)
    return Case(f"{name}, {solver}", partial(solve, problem, solver, steps), "relative error", bound, reason)


def to_tolerance(name: str, problem: Problem, tolerance: float = 1e-2) -> Case:
    """Steps that have to keep a tolerance."""
    ask, bound = partial(solve, problem, tolerance=tolerance), partial(within, problem, tolerance)
    return Case(f"{name}, tolerance {tolerance:g}", ask, "relative error", bound, "tolerance, and the step to sigma 0")


RESOLVED = {0.0: 50, 1.0001: 50, 7.5: 50, 100.0: 200}
"""Steps that follow a guidance scale g: D turns at a rate of up to g / 3 in log sigma, so that is about one a step."""

SCHEDULES: dict[str, dict[str, Any]] = {
    "largest sigma 0.1": {"beta_start": 1e-6, "beta_end": 2e-5, "beta_schedule": "linear"},
    "cosine": {"beta_schedule": "squaredcos_cap_v2"},
    "zero terminal SNR": {**STABLE_DIFFUSION, "rescale_betas_zero_snr": True},
    "10000 levels": {"num_train_timesteps": 10_000, "beta_start": 1e-5, "beta_end": 2e-3, "beta_schedule": "linear"},
}


def able(problem: Problem) -> list[str]:
    """Solvers that cope with a problem's schedule."""
    rescaled = problem.schedule_config.get("rescale_betas_zero_snr")
    return [name for name, solver in SOLVERS.items() if solver.zero_snr or not rescaled]


def solver_cases() -> Iterator[Case]:
    """Stiff problems, extreme guidance, extreme sigmas, very few and very many steps."""
    for problem in all_problems(stiff=True):
        deviation = 3 * problem.data.smallest_deviation / problem.data.root_mean_square + 50 * ROUNDING
        for solver in able(problem):
            name, ask = f"{problem.name}, {solver}", partial(solve, problem, solver)
            if problem.has_solution:
                yield by_solver(problem.name, problem, solver)
            elif not problem.guidance.active:
                yield Case(name, ask, "relative error", deviation, "both ends within 1.5 deviations of a mode")
        yield to_tolerance(problem.name, problem)

    guided = make_problem("gaussian-guided")
    for scale, steps in RESOLVED.items():
        problem = replace(guided, guidance_scale=scale)
        yield from (by_solver(f"guidance {scale:g}", problem, solver, steps) for solver in ("ddim", "dpm++2m"))
        yield to_tolerance(f"guidance {scale:g}", problem)

    def ended(scale: float, *way: Any, **options: Any) -> tuple[Tensor, Sequence[ReturnCode]]:
        latents, _, report = run(replace(guided, guidance_scale=scale), *way, **options)
        return latents, report.codes

    yield ends("guidance 100 in 50 steps", partial(ended, 100.0, "dpm++2m"), DIVERGED)
    for solver in ("ddim", "dpm++2m"):  # the states grow until float32 ends
        yield ends(f"guidance 1000, {solver}", partial(ended, 1000.0, solver), NON_FINITE)
    yield ends("guidance 1000, tolerance 0.1", partial(ended, 1000.0, tolerance=0.1), MAX_EVALUATIONS)
    few = partial(ended, 7.5, tolerance=1e-4, max_evaluations=2)
    yield ends("tolerance within 2 evaluations", few, MAX_EVALUATIONS)

    def finite(problem: Problem, steps: int) -> float:
        """0 if the latents of every solver are finite, infinite if not: strong guidance blows multistep solvers up."""
        return max(beyond(run(problem, solver, steps)[0], -INF, INF) for solver in SOLVERS)

    for name, steps in product(("mixture-7.5", "mixture-30", "gaussian-guided", "gaussian-guided-30"), (3, 5)):
        yield Case(
            f"{name} in {steps} steps",
            partial(finite, make_problem(name), steps),
            "samples that are returned are finite",
        )

    plain = make_problem("conditioning-1e2")
    yield from (by_solver("1 step", plain, solver, 1) for solver in ("ddim", "dpm++2m"))
    yield from (by_solver("1000 steps", plain, solver, 1000) for solver in ("ddim", "dpm++2m"))
    yield from (to_tolerance("mixture-7.5", make_problem("mixture-7.5"), tolerance) for tolerance in (1.0, 0.1, 1e-3))
    for name, config in SCHEDULES.items():
        problem = replace(plain, schedule_config=config, prediction_type="v_prediction")
        yield to_tolerance(name, problem)
        yield from (by_solver(name, problem, solver, 20) for solver in ("ddim", "dpm++2m") if solver in able(problem))


def network_cases() -> Iterator[Case]:
    """Networks that break, that are constant, and that round, under every solver and to a tolerance."""
    plain = make_problem("conditioning-1e2")
    largest, noise = plain.schedule.sigma_max, plain.noise(4)
    ways: dict[str, dict[str, Any]] = {solver: {"solver": solver, "steps": 10} for solver in SOLVERS}
    ways["tolerance 0.01"] = {"tolerance": 1e-2}

    def changed(change: Callable[[Tensor], Tensor], call: int | None = None) -> Callable[[Tensor, Tensor], Tensor]:
        """The exact network with predictions (B, C, h, w) changed at one call, or at all."""
        network, calls = plain.network(), count()

        def predict(state: Tensor, timestep: Tensor) -> Tensor:
            prediction = network(state, timestep)
            return change(prediction) if call in (None, next(calls)) else prediction

        return predict

    def filled(value: float) -> Callable[[Tensor], Tensor]:
        return partial(torch.full_like, fill_value=value)

    def ended(change: Callable, call: int | None, **way: Any) -> tuple[Tensor, Sequence[ReturnCode]]:
        latents, _, report = run(plain, network=changed(change, call), **way)
        return latents, report.codes

    def kept(change: Callable, call: int | None = None, **way: Any) -> float:
        return solve(plain, network=changed(change, call), **way)

    def bound(name: str, steps: int, more: float = 0.0) -> float:
        return more + (a_priori(plain, name, steps) if name in SOLVERS else within(plain, 1e-2))

    def broken(prediction: Tensor) -> Tensor:
        return prediction.index_fill(0, torch.tensor(1), NAN)

    for name, way in ways.items():
        for what, change, call in (
            ("NaN at the first evaluation", filled(NAN), 0),
            ("Inf at a later evaluation", filled(INF), 5),
            ("1e38 throughout", filled(1e38), None),
            ("beyond float16", lambda prediction: (1e5 * prediction).half(), None),
        ):
            yield ends(f"network gives {what}, {name}", partial(ended, change, call, **way), NON_FINITE)
        ask = partial(kept, broken, 3, codes=[SUCCESS, NON_FINITE, SUCCESS, SUCCESS], **way)
        yield Case(f"network gives NaN for one of four, {name}", ask, "relative error of the others",
                   partial(bound, name, 10), "that of the others alone")  # fmt: skip
        straight = noise * math.hypot(1.0, largest) - 1e4 * largest  # dx/dsigma is constant
        ask = partial(kept, filled(1e4), codes=DIVERGED, exact=straight, **way)
        yield Case(f"network gives 1e4, {name}", ask, "diverged; relative error", 50 * ROUNDING, "a straight path")
        for dtype in (torch.float16, torch.bfloat16):
            ask = partial(kept, partial(Tensor.to, dtype=dtype), **{**way, "steps": 50})
            # A rounding u moves x by u d(sigma) in a step, of which the flow keeps 1 / sigma of the result.
            roundings = torch.finfo(dtype).eps / 2 * (1 + math.log(2 * largest / plain.schedule.sigma_min))
            yield Case(f"network in {str(dtype).removeprefix('torch.')}, {name}", ask, "relative error",
                       partial(bound, name, 50, roundings), "order, and roundings along the path")  # fmt: skip


# Pipelines ------------------------------------------------------------------------------------------------------------

SIDE = 8
"""Latents along each side of small pictures."""


def pipeline_cases(load: Callable[[torch.dtype], Any], kind: str) -> Iterator[Case]:
    """Extreme numbers, latents and embeddings, half precision and broken networks in calls of a pipeline."""
    embeds = {"touch-to-image": "touch_embeds", "x-to-touch": "condition_embeds"}.get(kind, "")

    def shape(pipe: Any, name: str) -> tuple[int, ...]:
        if name == "latents":
            return (1, pipe.unet.config.out_channels, SIDE, SIDE)
        return (1, pipe.embedding_dim) if name == "touch_embeds" else (1, 1, pipe.embedding_dim)

    def call(dtype: torch.dtype = torch.float32, **arguments: Any) -> tuple[Tensor, Sequence[ReturnCode]]:
        """Images and codes of one call; latents and embeddings are given as functions of noise of their shape."""
        pipe = load(dtype)
        pipe.set_progress_bar_config(disable=True)
        given: dict[str, Any] = {"guidance_scale": 2.0, "output_type": "latent", "throw": False}
        given["height"] = given["width"] = SIDE * pipe.vae_scale_factor
        given["generator"] = torch.Generator().manual_seed(0)
        if "tolerance" not in arguments:
            given["num_inference_steps"] = 2
        if embeds not in arguments:
            scene = World().render([5], [200], [0], modalities=("image", "touch"))
            given |= {} if kind == "x-to-touch" else {"touch": scene.touch["gelsight"]}
            given |= {} if kind == "touch-to-image" else {"image": scene.image}
        if kind == "x-to-touch" and "touch" in arguments:
            del given["image"]
        if kind == "stylization":
            given["init_strength"] = 1.0  # from noise
        given |= arguments
        for name in {"latents", embeds} & arguments.keys():
            given[name] = given[name](torch.randn(shape(pipe, name), generator=torch.Generator().manual_seed(1)))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UnfamiliarInputWarning)  # inputs are meant to be unfamiliar
            output = pipe(**given)
        return torch.as_tensor(output.images), output.report.codes

    def same(name: str, reason: str, one: dict[str, Any], other: dict[str, Any], bound: Any = SAME) -> Case:
        def ask() -> float:
            images, codes = call(**one)
            return error(images, call(**other)[0], codes)

        return Case(f"{kind}: {name}", ask, "relative difference", bound, reason)

    def coded(name: str, code: ReturnCode, **arguments: Any) -> Case:
        return ends(f"{kind}: {name}", partial(call, **arguments), code)

    def interrupt(pipe: Any, *_: Any) -> dict:
        pipe._interrupt = True  # as diffusers documents it
        return {}

    yield same("guidance_scale 0", "no guidance", {"guidance_scale": 0.0}, {"guidance_scale": 1.0})
    yield coded("guidance_scale 1e6", DIVERGED, guidance_scale=1e6)
    yield coded("tolerance within 3 evaluations", MAX_EVALUATIONS, tolerance=1e-4, max_evaluations=3)
    yield coded("an interrupt", INTERRUPTED, callback_on_step_end=interrupt)
    spoil = lambda pipe, step, timestep, given: {"latents": NAN * given["latents"]}  # noqa: E731
    yield coded("NaN latents from a callback", NON_FINITE, callback_on_step_end=spoil)
    for name in ("latents", *([embeds] if embeds else [])):
        tiny, none = {name: lambda noise: 1e-40 * noise}, {name: lambda noise: 0 * noise}
        yield same(f"{name} of size 1e-40", "those of size 0", tiny, none)
        for size in (1e30, 3e38):
            large: Any = partial(lambda size, noise: size * noise.sign(), size)
            yield coded(f"{name} of size {size:g}", NON_FINITE, **{name: large})
    yield coded("latents of size 1e3", DIVERGED, latents=lambda noise: 1e3 * noise)
    grey = [{"touch": torch.full((3, *sides), 51 / 255)} for sides in ((64, 64), (8, 800))]
    yield same("a grey touch of 8 x 800", "constant at any size", *grey)
    if kind != "x-to-touch":
        yield same("strength 0", "0 times any embedding", {"strength": 0.0}, {**grey[0], "strength": 0.0})
    if embeds:

        def opposite() -> float:
            """Difference of an embedding in a batch with its opposite to the same alone."""
            generators = [torch.Generator().manual_seed(0) for _ in range(2)]
            pair: Any = {embeds: lambda noise: torch.cat([noise, -noise])}
            second: Any = {embeds: lambda noise: -noise}
            images, codes = call(**pair, generator=generators)
            return error(images[1:], call(**second)[0], codes)

        yield Case(f"{kind}: {embeds} beside their opposite", opposite, "relative difference", SAME, "each as alone")
        beyond_half = {embeds: lambda noise: 1e6 * noise}
        yield coded(f"{embeds} beyond float16", NON_FINITE, dtype=torch.float16, **beyond_half)

    def roundings(dtype: torch.dtype) -> float:
        modules = load(torch.float32).unet.modules()
        layers = sum(any(True for _ in module.parameters(recurse=False)) for module in modules)
        return torch.finfo(dtype).eps / 2 * math.sqrt(8 * layers)

    usual: Any = {"latents": lambda noise: noise, "num_inference_steps": 8}
    for dtype in (torch.float16, torch.bfloat16):
        name, bound = str(dtype).removeprefix("torch."), partial(roundings, dtype)
        yield same(name, "independent roundings of its layers", {**usual, "dtype": dtype}, usual, bound)
        yield coded(f"{name} at guidance 1000", DIVERGED, dtype=dtype, guidance_scale=1000)

    three: dict[str, Any] = {"num_images_per_prompt": 3, "guidance_scale": 1.0, "output_type": "pt"}

    def spoiled(part: str, value: float, row: int | None = None) -> tuple[Tensor, Sequence[ReturnCode]]:
        """A call with a network's output spoiled, for all samples or for one."""

        def answer(_module: Any, _arguments: Any, output: Any) -> None:
            first = output[0] if isinstance(output, tuple) else output
            first[slice(None) if row is None else row] = value

        handle = attrgetter(part)(load(torch.float32)).register_forward_hook(answer)
        try:
            return call(**three)
        finally:
            handle.remove()

    def others(part: str) -> float:
        images, codes = spoiled(part, NAN, 1)
        return error(images, call(**three)[0][[0, 2]], codes, [SUCCESS, NON_FINITE, SUCCESS])

    for part in ("unet", "vae.decoder"):
        for value in (NAN, INF):
            yield ends(f"{kind}: {part} gives {value}", partial(spoiled, part, value), NON_FINITE)
        yield Case(f"{kind}: {part} gives nan for one of three", partial(others, part),
                   "relative difference of the others", SAME, "those of a call without it")  # fmt: skip


# The world ------------------------------------------------------------------------------------------------------------

EXTENT, THICKNESS, CORRELATION, RELAXATION, SIZE = 24.0, 2.0, 0.22, 0.05, 128
STIFFNESSES = (1e-3, 1e-2, 1e-1, 1.0, 1e1, 1e2, 1e3)
SETTLED = 1e9
"""Seconds after which nothing moves."""

RINGING = math.log1p(1 / (CORRELATION * math.pi * SIZE / EXTENT) ** 2) / (2 * math.pi)
"""What waves beyond the grid's limit K would add to a cliff of 1: 1 / (pi k (1 + (c k)^2)) from k = K on."""


def gel_cases() -> Iterator[Case]:
    """Stiffness, time, relaxation, thickness and the length over which a gel spreads, to the ends of float32."""
    level = lambda value: torch.full((1, SIZE, SIZE), value)  # noqa: E731
    cliff, spike = level(0.0), level(0.0)
    cliff[..., SIZE // 2 :], spike[0, SIZE // 2, SIZE // 2] = 10.0, 10.0
    steep = torch.cat([cliff, spike, level(10.0), level(0.0)])
    load = THICKNESS * -torch.expm1(-steep / THICKNESS)
    mean, flat = load[0].mean(), THICKNESS * -math.expm1(-1 / THICKNESS)

    def sink(indentation: Tensor, dwell: float = SETTLED, **gel: Any) -> Tensor:
        settings = {"extent": EXTENT, "thickness": THICKNESS, "correlation": CORRELATION, "relaxation": RELAXATION}
        return gel_displacement(indentation, torch.full((len(indentation),), dwell), **(settings | gel))

    def share(stiffness: float) -> float:
        """How far the sinking at any time leaves 0 to load / stiffness, in shares of it."""
        sunk = [sink(steep, dwell, stiffness=stiffness) for dwell in (1e-6, 0.1, SETTLED)]
        return beyond(torch.stack(sunk).abs() * stiffness / THICKNESS)

    rounding, ringing = (TRANSFORMS, "rounding of the transforms"), (RINGING, "waves beyond the grid")
    for stiffness in STIFFNESSES:
        yield Case(f"gel, stiffness {stiffness:g}", partial(share, stiffness), "at most load / stiffness", *rounding)
    table: list[tuple[str, Callable[[], float], str, tuple[float, str]]] = [
        ("flat contact at all stiffnesses",
         lambda: apart(torch.cat([k * sink(level(1.0), stiffness=k) for k in STIFFNESSES]), flat),
         "sinks by load / stiffness", rounding),
        ("stiffness 1e30", lambda: apart(sink(steep, stiffness=1e30), 0.0), "at most load / stiffness",
         (1e-29, "load / stiffness")),
        ("stiffness 1e-30", lambda: apart(sink(level(1.0), 0.5, stiffness=1e-30) / 10.0, flat),
         "sinks by load x time / relaxation", rounding),
        ("dwell 0 s, stiffness 1e30", lambda: apart(sink(steep, 0.0, stiffness=1e30), 0.0), "has not moved",
         (0.0, "initial value")),
        ("dwell without end", lambda: apart(sink(steep, INF), sink(steep)), "has settled", rounding),
        ("relaxation 0 s", lambda: apart(sink(steep, 0.5, relaxation=0.0), sink(steep)), "has settled", rounding),
        ("relaxation 1e-320 s", lambda: apart(sink(steep, 0.5, relaxation=1e-320), sink(steep)), "has settled",
         rounding),
        ("relaxation 1e30 s", lambda: apart(sink(steep, 0.5, relaxation=1e30), 0.0),
         "at most load x time / relaxation", (1e-29, "load x time / relaxation")),
        ("correlation 0 mm", lambda: apart(sink(steep, correlation=0.0), load), "sinks by the load, pixel by pixel",
         rounding),
        ("correlation 1e18 mm", lambda: apart(sink(cliff, correlation=1e18), mean), "sinks by the mean load",
         rounding),
        ("blur 1e18 mm", lambda: apart(sink(cliff, blur=1e18), mean), "sinks by the mean load", rounding),
        ("thickness 1e-30 mm", lambda: beyond(sink(steep, thickness=1e-30) / 1e-30), "stays within the gel", ringing),
        ("cliff of 10 mm", lambda: beyond(sink(cliff, 0.5) / THICKNESS), "stays within the gel", ringing),
        ("depth beyond the gel", lambda: apart(sink(level(1e3)), THICKNESS), "sinks by its thickness", rounding),
    ]  # fmt: skip
    yield from (Case(f"gel, {name}", ask, demand, *bound) for name, ask, demand, bound in table)


def energy(ratio: float) -> Tensor:
    """q'^2 + w^2 q^2 of a mode struck at t = 0, over its first energy, at 400 times up to 0.3 s, float64."""
    w = torch.tensor([2000.0], dtype=torch.float64)
    times = torch.linspace(1e-6, 0.3, 400, dtype=torch.float64)
    with torch.enable_grad():
        times.requires_grad_()
        response = impulse_response(w, ratio * w, times)  # w q
        (speed,) = torch.autograd.grad(response.sum(), times)  # w q', and q'(0) = 1
    return (response.detach() ** 2 + (speed / w) ** 2).detach()


def gained(ratio: float) -> float:
    """Largest gain of energy between two times, the strike included."""
    return max(float(torch.cat([torch.ones(1), energy(ratio)]).diff().max()), 0.0)


def mode_cases() -> Iterator[Case]:
    """Damping from none to far beyond the critical, and frequencies at both ends of float32."""
    digits = (1e-12, "some thousand roundings of float64")
    for ratio in (1e-6, 1e-3, 0.1, 0.999999, 1.0, 1.000001, 10.0, 1e3, 1e6):
        yield Case(f"mode at {ratio:.7g} of critical damping", partial(gained, ratio), "gains no energy", *digits)
    yield Case("mode without damping", lambda: apart(energy(0.0), 1.0), "keeps its energy", *digits)
    extreme, w = torch.tensor([[1e-6], [1.0], [1e5], [1e12], [1e18]]), torch.tensor([[1e3]])
    times, bound = torch.tensor([0.0, 1e-9, 1e-3, 1.0, 1e6]), (TRANSFORMS, "some rounding of float32")
    for name, mode in (("frequencies from 1e-6 to 1e18 rad/s", (extreme, 0 * extreme)),
                       ("dampings from 1e-6 to 1e18 1/s", (w, extreme))):  # fmt: skip
        ask = partial(lambda mode: beyond(impulse_response(mode[0], mode[1], times), -1.0), mode)
        yield Case(f"mode, {name}", ask, "swings by at most the strike", *bound)
