"""Stability: stiff and extreme cases of solvers and pipelines, each with an a-priori bound.

A case measures one number, which may be at most its bound. The bound follows from the problem: a closed form, the order
of a method, a number of roundings. An error is infinite where a sample ends with an unexpected return code, or where a
value that is not finite leaves as a result.
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
from unitouch_gen.examples import example
from unitouch_gen.numerics.problems import PROBLEMS, STABLE_DIFFUSION, Problem
from unitouch_gen.numerics.reference import relative_rms
from unitouch_gen.sampling import SOLVERS, ReturnCode, prepare_steps
from unitouch_gen.solvers import APART

SUCCESS, NON_FINITE, DIVERGED = ReturnCode.SUCCESS, ReturnCode.NON_FINITE, ReturnCode.DIVERGED
MAX_EVALUATIONS, INTERRUPTED = ReturnCode.MAX_EVALUATIONS, ReturnCode.INTERRUPTED
NAN, INF = math.nan, math.inf

ROUNDING = 4 * 2.0**-23
"""Relative error of a step of some four operations in float32."""

SAME = 1e-4
"""Relative difference of equal calls: some thousand roundings of float32 in another order."""


@dataclass(frozen=True)
class Case:
    """One stiff or extreme case."""

    name: str
    measure: Callable[[], float]
    bound: float | Callable[[], float] = 0.0
    reason: str = "ends with its code, no NaN or Inf comes out"

    @torch.no_grad()
    def run(self) -> tuple[float, float]:
        """(value measured, bound)."""
        return self.measure(), self.bound() if callable(self.bound) else self.bound


def cases(load: Callable[..., Any], kinds: Sequence[str]) -> list[Case]:
    """All cases, with those of some pipelines; `load(kind, dtype=...)` returns one when a case first needs it."""
    kept = cache(lambda kind, dtype: load(kind, dtype=dtype))
    pipelines = [case for kind in kinds for case in pipeline_cases(partial(kept, kind), kind)]
    return [*solver_cases(), *network_cases(), *pipelines]


def error(found: Tensor, codes: Sequence[ReturnCode], expected: Any = SUCCESS, exact: Tensor | None = None) -> float:
    """Relative RMS error of the worst sample, 0 without an exact result; `expected` is one code or one a sample."""
    wanted = [expected] * len(codes) if isinstance(expected, ReturnCode) else expected
    if list(codes) != wanted or not bool(found.isfinite().all()):
        return INF
    return 0.0 if exact is None else relative_rms(found, exact).max().item()


# Bounds of solvers ----------------------------------------------------------------------------------------------------


@cache
def truth(problem: Problem) -> Tensor:
    """Where the exact flow ends from four noises."""
    return problem.solution(problem.noise(4))


def a_priori(problem: Problem, solver: str, steps: int) -> float:
    """Relative error that a solver may leave on Gaussian data, of the worst of four samples.

    In lambda = -log sigma the flow is dx/dlambda = D - x, and a step of h leaves out C h^(p+1) |D^(p)|, with C = 1/2 at
    order p = 1, and for p >= 2 at most that of two steps of Adams and Bashforth (5/12 where they are equal). The exact
    flow, along which D is known, carries these errors to the end (Hairer, Nørsett & Wanner, Solving Ordinary
    Differential Equations I, Section II.3). The step to sigma = 0 and roundings are added.
    """
    sigmas = list(prepare_steps(problem.scheduler(), solver=solver, num_inference_steps=steps).sigmas[:-1])
    values, levels, higher = along(problem, sigmas), [-math.log(sigma) for sigma in sigmas], SOLVERS[solver].order > 1
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


def along(problem: Problem, sigmas: list[float]) -> list[Tensor]:
    """D on the exact path at each noise level, (4, d)."""
    path = problem.path(problem.noise(4), sigmas)
    return [problem.denoise(x, sigma).flatten(1) for x, sigma in zip(path, sigmas, strict=True)]


def carried(problem: Problem, sigma: float) -> Tensor:
    """Factor of the exact flow on a difference at a noise level by sigma = 0, along each axis, (d,)."""
    scale = problem.guidance_scale if problem.guidance.active else 1.0
    both = [(problem.unconditional or problem.data).variances[0], problem.data.variances[0]]
    other, conditional = (variances / (variances + sigma**2) for variances in both)
    return other ** ((1 - scale) / 2) * conditional ** (scale / 2)


def last_step(problem: Problem, sigmas: list[float], higher: bool) -> Tensor:
    """Error of the step to sigma = 0, (4, d): order 1 ends with D at the smallest level, higher ones with the line in
    sigma^2 through it and the last level that is 1.5 times as large."""
    wider = [sigma for sigma in sigmas if sigma >= APART * sigmas[-1]][-1:] if higher else []
    *earlier, end = along(problem, [*wider, sigmas[-1]])
    for sigma, value in zip(wider, earlier, strict=True):
        end = end + (end - value) * sigmas[-1] ** 2 / (sigma**2 - sigmas[-1] ** 2)
    return (end - truth(problem).flatten(1)).abs()


def worst(errors: Tensor, problem: Problem) -> float:
    """Errors (4, d) relative to where the flow ends, of the worst sample."""
    return (errors.norm(dim=1) / truth(problem).flatten(1).norm(dim=1)).max().item()


def within(problem: Problem, tolerance: float) -> float:
    """A tolerance, and the error of the step to sigma = 0 from a line through two levels a factor of 2 apart."""
    last = problem.schedule.sigma_min
    return tolerance + (worst(last_step(problem, [2 * last, last], True), problem) if problem.is_gaussian else 0.0)


# Solvers on exact problems --------------------------------------------------------------------------------------------

STEPS_TO = "tolerance 0.01"
WAYS: dict[str, dict[str, Any]] = {name: {"solver": name} for name in SOLVERS} | {STEPS_TO: {"tolerance": 1e-2}}


def solve(
    problem: Problem,
    expected: Any = SUCCESS,
    exact: Callable[[Problem], Tensor] | None = truth,
    change: Callable[[Tensor], Tensor] | None = None,
    at: int | None = None,
    **way: Any,
) -> float:
    """Error of one run from four noises, of the samples that did not break.

    Args:
        expected: Return codes; `None` for any.
        exact: What the result is compared with, if anything.
        change: What becomes of the predictions of the exact network, all or `at` one evaluation.
        way: Solver and steps, or a tolerance.
    """
    network, calls = problem.network(4), count()

    def predict(z: Tensor, timestep: Tensor) -> Tensor:
        prediction = network(z, timestep)
        return prediction if change is None or at not in (None, next(calls)) else change(prediction)

    found, report = problem.run(problem.noise(4), throw=False, network=predict, **way)
    rows = [row for row, code in enumerate(report.codes) if code.finite]
    wanted = report.codes if expected is None else expected
    return error(found[rows], report.codes, wanted, None if exact is None else exact(problem)[rows])


def by_solver(name: str, problem: Problem, solver: str, steps: int = 50) -> Case:
    measure = partial(solve, problem, solver=solver, num_inference_steps=steps)
    return Case(f"{name}, {solver}", measure, partial(a_priori, problem, solver, steps), "order along the exact flow")


def to_tolerance(name: str, problem: Problem, tolerance: float = 1e-2) -> Case:
    measure, bound = partial(solve, problem, tolerance=tolerance), partial(within, problem, tolerance)
    return Case(f"{name}, tolerance {tolerance:g}", measure, bound, "tolerance, and the step to sigma 0")


SCHEDULES: dict[str, dict[str, Any]] = {
    "largest sigma 0.1": {"beta_start": 1e-6, "beta_end": 2e-5, "beta_schedule": "linear"},
    "cosine": {"beta_schedule": "squaredcos_cap_v2"},
    "zero terminal SNR": {**STABLE_DIFFUSION, "rescale_betas_zero_snr": True},
    "10000 levels": {"num_train_timesteps": 10_000, "beta_start": 1e-5, "beta_end": 2e-3, "beta_schedule": "linear"},
}


def solver_cases() -> Iterator[Case]:
    """Stiff problems, extreme guidance and noise levels, very few and very many steps."""
    for problem in (each for each in PROBLEMS.values() if each.stiff):
        apart = 3 * problem.smallest_deviation / problem.size + 50 * ROUNDING
        for solver in SOLVERS:
            if problem.is_gaussian:
                yield by_solver(problem.name, problem, solver)
            elif not problem.guidance.active:
                measure = partial(solve, problem, solver=solver)
                yield Case(f"{problem.name}, {solver}", measure, apart, "both within 1.5 deviations of a mode")
        yield to_tolerance(problem.name, problem)
    guided, plain, mixture = PROBLEMS["gaussian-guided"], PROBLEMS["conditioning-1e2"], PROBLEMS["mixture-7.5"]
    strong = {scale: replace(guided, guidance_scale=scale) for scale in (0.0, 1.0001, 7.5, 100.0, 1000.0)}
    for scale, steps in {0.0: 50, 1.0001: 50, 7.5: 50, 100.0: 200}.items():  # D turns at up to g / 3 in log sigma
        yield from (by_solver(f"guidance {scale:g}", strong[scale], solver, steps) for solver in ("ddim", "dpm++2m"))
        yield to_tolerance(f"guidance {scale:g}", strong[scale])
    ended: dict[str, tuple[Problem, ReturnCode, dict[str, Any]]] = {
        "guidance 100 in 50 steps": (strong[100.0], DIVERGED, {"solver": "dpm++2m"}),
        "guidance 1000, ddim": (strong[1000.0], NON_FINITE, {"solver": "ddim"}),
        "guidance 1000, tolerance 0.1": (strong[1000.0], MAX_EVALUATIONS, {"tolerance": 0.1}),
        "tolerance within 2 evaluations": (guided, MAX_EVALUATIONS, {"tolerance": 1e-4, "max_evaluations": 2}),
    }
    for name, (problem, code, way) in ended.items():
        yield Case(name, partial(solve, problem, code, None, **way))
    for solver, problem, steps in product(SOLVERS, (mixture, PROBLEMS["gaussian-guided-30"]), (3, 5)):
        measure = partial(solve, problem, None, None, solver=solver, num_inference_steps=steps)
        yield Case(f"{problem.name} in {steps} steps, {solver}", measure)
    for solver, steps in product(("ddim", "dpm++2m"), (1, 1000)):
        yield by_solver(f"{steps} steps", plain, solver, steps)
    yield from (to_tolerance("mixture-7.5", mixture, tolerance) for tolerance in (1.0, 0.1, 1e-3))
    for name, config in SCHEDULES.items():
        problem = replace(plain, schedule_config=config, prediction_type="v_prediction")
        yield to_tolerance(name, problem)
        yield from (by_solver(name, problem, solver, 20) for solver in ("ddim", "dpm++2m"))


def network_cases() -> Iterator[Case]:
    """Networks that break, that are constant, and that round, under every solver and to a tolerance."""
    plain = PROBLEMS["conditioning-1e2"]
    largest, smallest = plain.schedule.sigma_max, plain.schedule.sigma_min

    def filled(value: float) -> Callable[[Tensor], Tensor]:
        return partial(torch.full_like, fill_value=value)

    def straight(problem: Problem) -> Tensor:
        """Where a constant dx/dsigma of 1e4 leads."""
        return problem.noise(4) * math.hypot(1.0, largest) - 1e4 * largest

    def bound(name: str, more: float = 0.0) -> float:
        return more + (within(plain, 1e-2) if name == STEPS_TO else a_priori(plain, name, 50))

    faults: dict[str, dict[str, Any]] = {
        "NaN at the first evaluation": {"change": filled(NAN), "at": 0},
        "Inf at a later evaluation": {"change": filled(INF), "at": 5},
        "1e38 throughout": {"change": filled(1e38)},
        "values beyond float16": {"change": lambda prediction: (1e5 * prediction).half()},
    }
    broken = partial(torch.index_fill, dim=0, index=torch.tensor(1), value=NAN)
    for name, way in WAYS.items():
        for fault, change in faults.items():
            yield Case(f"network gives {fault}, {name}", partial(solve, plain, NON_FINITE, None, **change, **way))
        codes = [SUCCESS, NON_FINITE, SUCCESS, SUCCESS]
        measure = partial(solve, plain, codes, change=broken, at=3, **way)
        yield Case(
            f"network gives NaN for one of four, {name}", measure, partial(bound, name), "the others as if alone"
        )
        measure = partial(solve, plain, DIVERGED, straight, change=filled(1e4), **way)
        yield Case(f"network gives 1e4, {name}", measure, 100 * ROUNDING, "a straight path")
        for dtype in (torch.float16, torch.bfloat16):
            # A rounding u moves x by u d(sigma) in a step, of which the flow keeps 1 / sigma of the result.
            roundings = torch.finfo(dtype).eps / 2 * (1 + math.log(2 * largest / smallest))
            measure = partial(solve, plain, change=partial(Tensor.to, dtype=dtype), **way)
            yield Case(f"network in {dtype}, {name}", measure, partial(bound, name, roundings), "order, and roundings")


# Pipelines ------------------------------------------------------------------------------------------------------------


def pipeline_cases(load: Callable[[torch.dtype], Any], kind: str) -> Iterator[Case]:
    """Extreme numbers, latents and embeddings, half precision and broken networks in calls of a pipeline."""
    embeds = {"touch-to-image": "touch_embeds", "x-to-touch": "condition_embeds"}.get(kind)
    touch, photo = example("brick"), example("wood", "image")
    of_kinds: dict[str, dict[str, Any]] = {
        "touch-to-image": {"touch": touch},
        "stylization": {"touch": touch, "image": photo, "init_strength": 1.0},  # from noise
        "x-to-touch": {"image": photo},
    }
    inputs = of_kinds[kind]

    def call(dtype: torch.dtype = torch.float32, **arguments: Any) -> tuple[Tensor, Sequence[ReturnCode]]:
        """Images and codes of one call; latents and embeddings are given as functions of noise of their shape."""
        pipe = load(dtype)
        pipe.set_progress_bar_config(disable=True)
        size = 8 * pipe.vae_scale_factor
        given: dict[str, Any] = {"guidance_scale": 2.0, "output_type": "latent", "throw": False, "height": size,
                                 "width": size, "generator": torch.Generator().manual_seed(0)}  # fmt: skip
        given |= {} if "tolerance" in arguments else {"num_inference_steps": 2}
        given |= {} if embeds in arguments else inputs
        shapes = {"latents": (1, pipe.unet.config.out_channels, 8, 8), "touch_embeds": (1, pipe.embedding_dim),
                  "condition_embeds": (1, 1, pipe.embedding_dim)}  # fmt: skip
        for name, value in arguments.items():
            noise = torch.randn(shapes.get(name, 0), generator=torch.Generator().manual_seed(1))
            given[name] = value(noise) if name in shapes else value
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UnfamiliarInputWarning)  # inputs are meant to be unfamiliar
            output = pipe(**given)
        return torch.as_tensor(output.images), output.report.codes

    def same(name: str, reason: str, one: dict[str, Any], other: dict[str, Any], bound: Any = SAME) -> Case:
        return Case(f"{kind}: {name}", lambda: error(*call(**one), exact=call(**other)[0]), bound, reason)

    def coded(name: str, code: ReturnCode, **arguments: Any) -> Case:
        return Case(f"{kind}: {name}", lambda: error(*call(**arguments), code))

    def interrupt(pipe: Any, *_: Any) -> dict:
        pipe._interrupt = True  # as diffusers documents it
        return {}

    def spoil(pipe: Any, step: int, timestep: Tensor, given: dict[str, Tensor]) -> dict[str, Tensor]:
        return {"latents": NAN * given["latents"]}

    yield same("guidance_scale 0", "no guidance", {"guidance_scale": 0.0}, {"guidance_scale": 1.0})
    yield coded("guidance_scale 1e6", DIVERGED, guidance_scale=1e6)
    yield coded("tolerance within 3 evaluations", MAX_EVALUATIONS, tolerance=1e-4, max_evaluations=3)
    yield coded("an interrupt", INTERRUPTED, callback_on_step_end=interrupt)
    yield coded("NaN latents from a callback", NON_FINITE, callback_on_step_end=spoil)
    yield coded("latents of size 1e3", DIVERGED, latents=lambda noise: 1e3 * noise)
    for name in filter(None, ("latents", embeds)):
        none, tiny = {name: lambda noise: 0 * noise}, {name: lambda noise: 1e-40 * noise}
        yield same(f"{name} of size 1e-40", "those of size 0", tiny, none)
        yield coded(f"{name} of size 3e38", NON_FINITE, **{name: lambda noise: 3e38 * noise.sign()})
    usual: Any = {"latents": lambda noise: noise, "num_inference_steps": 8}
    for dtype in (torch.float16, torch.bfloat16):
        bound = partial(roundings, load, dtype)
        yield same(str(dtype), "independent roundings of its layers", {**usual, "dtype": dtype}, usual, bound)

    def spoiled(part: str, value: float, *rows: int) -> tuple[Tensor, Tensor, Sequence[ReturnCode]]:
        """What a call makes, and one in which a network's output is spoiled in some rows of three."""

        def answer(_module: Any, _arguments: Any, output: Any) -> None:
            (output[0] if isinstance(output, tuple) else output)[list(rows)] = value

        three: dict[str, Any] = {"num_images_per_prompt": 3, "guidance_scale": 1.0, "output_type": "pt"}
        whole, handle = call(**three)[0], attrgetter(part)(load(torch.float32)).register_forward_hook(answer)
        try:
            return whole, *call(**three)
        finally:
            handle.remove()

    def one_of_three(part: str) -> float:
        whole, others, codes = spoiled(part, NAN, 1)
        return error(others, codes, [SUCCESS, NON_FINITE, SUCCESS], whole[[0, 2]])

    def all_of_three(part: str) -> float:
        return error(*spoiled(part, INF, 0, 1, 2)[1:], NON_FINITE)

    for part in ("unet", "vae.decoder"):
        yield Case(f"{kind}: {part} gives Inf", partial(all_of_three, part))
        one = partial(one_of_three, part)
        yield Case(f"{kind}: {part} gives NaN for one of three", one, SAME, "the others as if alone")


def roundings(load: Callable[[torch.dtype], Any], dtype: torch.dtype) -> float:
    """Relative error of independent roundings in each layer of a pipeline's network, in eight evaluations."""
    modules = load(torch.float32).unet.modules()
    layers = sum(any(True for _ in module.parameters(recurse=False)) for module in modules)
    return torch.finfo(dtype).eps / 2 * math.sqrt(8 * layers)
