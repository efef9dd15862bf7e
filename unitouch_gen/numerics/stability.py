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
from itertools import count
from typing import Any

import torch
from torch import Tensor

from unitouch_gen.errors import UnfamiliarInputWarning
from unitouch_gen.examples import example
from unitouch_gen.numerics.problems import PROBLEMS, Problem
from unitouch_gen.numerics.reference import relative_rms
from unitouch_gen.sampling import SOLVERS, ReturnCode, prepare_steps
from unitouch_gen.solvers import MIN_LEVEL_RATIO

SUCCESS, NON_FINITE, DIVERGED = ReturnCode.SUCCESS, ReturnCode.NON_FINITE, ReturnCode.DIVERGED

ROUNDING = 4 * 2.0**-23
"""Relative error of a step of some four operations in float32."""


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
        return math.inf
    return 0.0 if exact is None else relative_rms(found, exact).max().item()


# Bounds of solvers ----------------------------------------------------------------------------------------------------


@cache
def truth(problem: Problem) -> Tensor:
    """Where the exact flow ends from four noises."""
    return problem.solution(problem.noise(4))


def a_priori(problem: Problem, solver: str, num_inference_steps: int = 50) -> float:
    """Relative error that a solver may leave on Gaussian data, of the worst of four samples.

    In lambda = -log sigma the flow is dx/dlambda = D - x. A step of h leaves out h^2 / 2 |D'| at order 1, and at order
    2 or more at most C h^3 (|D''| + 2 |D'|), with the C of two steps of Adams and Bashforth (5/12 where they are
    equal): that admits a line through D or the slope (x - D) / sigma, in log sigma or a power of sigma. The exact flow,
    along which D is known, carries these errors to the end (Hairer, Nørsett & Wanner, Solving Ordinary Differential
    Equations I, Section II.3). The step to sigma = 0 and roundings are added.
    """
    made = prepare_steps(problem.scheduler(), solver=solver, num_inference_steps=num_inference_steps)
    sigmas, higher = torch.tensor(made.sigmas[:-1], dtype=torch.float64), SOLVERS[solver].order > 1
    values = torch.stack(along(problem, sigmas.tolist()))  # D, (n, 4, d)
    steps = -sigmas.log().diff()[:, None, None]
    slopes = values.diff(dim=0) / steps
    local = steps**2 / 2 * slopes.abs()
    if higher:
        before, after = steps[:-1], steps[1:]
        curvatures = 2 * slopes.diff(dim=0) / (before + after)
        local[1:] = (after**3 / 6 + after**2 * before / 4) * (curvatures.abs() + 2 * slopes[1:].abs())
    at_the_end = (carried(problem, sigmas[1:, None])[:, None] * local).sum(dim=0)
    return worst(at_the_end + last_step(problem, sigmas.tolist(), higher), problem) + num_inference_steps * ROUNDING


def within(problem: Problem, tolerance: float) -> float:
    """A tolerance, and the error of the step to sigma = 0 from a line through two levels a factor of 2 apart."""
    last = problem.schedule.sigma_min
    return tolerance + (worst(last_step(problem, [2 * last, last], True), problem) if problem.is_gaussian else 0.0)


def along(problem: Problem, sigmas: list[float]) -> list[Tensor]:
    """D on the exact path at each noise level, (4, d)."""
    path = problem.path(problem.noise(4), sigmas)
    return [problem.denoise(x, sigma).flatten(1) for x, sigma in zip(path, sigmas, strict=True)]


def carried(problem: Problem, sigma: Tensor | float) -> Tensor:
    """Factor of the exact flow on a difference at a noise level by sigma = 0, along each axis, (d,)."""
    scale = problem.guidance_scale if problem.guidance.active else 1.0
    both = [(problem.unconditional or problem.data).variances[0], problem.data.variances[0]]
    other, conditional = (variances / (variances + sigma**2) for variances in both)
    return other ** ((1 - scale) / 2) * conditional ** (scale / 2)


def last_step(problem: Problem, sigmas: list[float], higher: bool) -> Tensor:
    """Error of the step to sigma = 0, (4, d): order 1 ends with D at the smallest level, higher ones with the line in
    sigma^2 through it and the last level that is 1.5 times as large."""
    wider = [sigma for sigma in sigmas if sigma >= MIN_LEVEL_RATIO * sigmas[-1]][-1:] if higher else []
    *earlier, end = along(problem, [*wider, sigmas[-1]])
    for sigma, value in zip(wider, earlier, strict=True):
        end = end + (end - value) * sigmas[-1] ** 2 / (sigma**2 - sigmas[-1] ** 2)
    return (end - truth(problem).flatten(1)).abs()


def worst(errors: Tensor, problem: Problem) -> float:
    """Errors (4, d) relative to where the flow ends, of the worst sample."""
    return (errors.norm(dim=1) / truth(problem).flatten(1).norm(dim=1)).max().item()


# Solvers on exact problems --------------------------------------------------------------------------------------------


def solve(
    problem: Problem,
    expected: Any = SUCCESS,
    exact: Callable[[Problem], Tensor] | None = truth,
    change: Callable[[Tensor], Tensor] | None = None,
    at: int | None = None,
    **way: Any,
) -> float:
    """Error of one run from four noises, of the samples that did not break.

    `way` is a solver with steps, or a tolerance; `change` is made to the predictions of the exact network, to all or
    `at` one evaluation.
    """
    network, calls = problem.network(4), count()

    def predict(z: Tensor, timestep: Tensor) -> Tensor:
        prediction = network(z, timestep)
        return prediction if change is None or at not in (None, next(calls)) else change(prediction)

    found, report = problem.run(problem.noise(4), throw=False, network=predict, **way)
    rows = [row for row, code in enumerate(report.codes) if code.finite]
    return error(found[rows], report.codes, expected, None if exact is None else exact(problem)[rows])


def bounded(name: str, problem: Problem, **way: Any) -> Case:
    """One run on a problem, with the bound that follows from it."""
    words, run = way.get("solver", f"tolerance {way.get('tolerance', 0):g}"), partial(solve, problem, **way)
    size = (problem.data.means**2 + problem.data.variances).mean().sqrt().item()  # RMS of a coordinate of x_0
    bound: float | Callable[[], float] = 3 * problem.smallest_deviation / size + 50 * ROUNDING
    reason = "both within 1.5 deviations of a mode"
    if "tolerance" in way:
        bound, reason = partial(within, problem, **way), "tolerance, and the step to sigma 0"
    elif problem.is_gaussian:
        bound, reason = partial(a_priori, problem, **way), "order along the exact flow"
    return Case(f"{name}, {words}", run, bound, reason)


def solver_cases() -> Iterator[Case]:
    """Stiff problems, extreme guidance and noise levels, very few and very many steps."""
    for problem in (each for each in PROBLEMS.values() if each.stiff):
        yield bounded(problem.name, problem, tolerance=0.01)
        if problem.is_gaussian or not problem.guidance.active:
            yield from (bounded(problem.name, problem, solver=solver) for solver in SOLVERS)
    for tolerance in (1.0, 0.1, 1e-3):
        yield bounded("mixture-7.5", PROBLEMS["mixture-7.5"], tolerance=tolerance)

    plain, guided = PROBLEMS["conditioning-1e2"], PROBLEMS["gaussian-guided"]
    little = {"beta_schedule": "linear", "beta_start": 1e-6, "beta_end": 2e-5}
    extremes: dict[str, tuple[Problem, int]] = {  # with steps
        "guidance 0": (replace(guided, guidance_scale=0.0), 50),
        "guidance 100": (replace(guided, guidance_scale=100.0), 200),  # D turns at up to g / 3 in log sigma
        "largest sigma 0.1": (replace(plain, schedule_config=little, prediction_type="v_prediction"), 20),
        "1 step": (plain, 1),
        "1000 steps": (plain, 1000),
    }
    for name, (problem, steps) in extremes.items():
        for solver in ("ddim", "dpm++2m"):
            yield bounded(name, problem, solver=solver, num_inference_steps=steps)
    for scale, code, way in (
        (100.0, DIVERGED, {"solver": "dpm++2m"}),
        (1000.0, NON_FINITE, {"solver": "ddim"}),
        (1000.0, ReturnCode.MAX_EVALUATIONS, {"tolerance": 0.1}),
    ):
        run = partial(solve, replace(guided, guidance_scale=scale), code, None, **way)
        yield Case(f"guidance {scale:g} ends as {code}", run)


def network_cases() -> Iterator[Case]:
    """Networks that break and that round."""
    plain = PROBLEMS["conditioning-1e2"]
    levels = 1 + math.log(2 * plain.schedule.sigma_max / plain.schedule.sigma_min)

    def rounded(dtype: torch.dtype, bound: Any) -> float:
        """A rounding u moves x by u d(sigma) in a step, of which the flow keeps 1 / sigma of the result."""
        return bound() + torch.finfo(dtype).eps / 2 * levels

    one = partial(torch.index_fill, dim=0, index=torch.tensor(1), value=math.nan)
    for way in ({"solver": "ddim"}, {"solver": "unipc"}, {"tolerance": 0.01}):
        case = bounded("network", plain, **way)
        run: Any = partial(solve, plain, **way)
        for value, at in ((math.nan, 0), (math.inf, 5), (1e38, None)):
            change = partial(torch.full_like, fill_value=value)
            yield Case(f"{case.name}, gives {value:g}", partial(run, NON_FINITE, None, change, at))
        alone = partial(run, [SUCCESS, NON_FINITE, SUCCESS, SUCCESS], change=one, at=3)
        yield Case(f"{case.name}, gives nan for one of four", alone, case.bound, "the others as if alone")
        for dtype in (torch.float16, torch.bfloat16):
            rounding = partial(run, change=partial(torch.Tensor.to, dtype=dtype))
            yield Case(
                f"{case.name}, in {dtype}", rounding, partial(rounded, dtype, case.bound), "order, and roundings"
            )


# Pipelines ------------------------------------------------------------------------------------------------------------


def pipeline_cases(load: Callable[[torch.dtype], Any], kind: str) -> Iterator[Case]:
    """Extreme guidance and latents, and half precision in calls of a pipeline."""
    touch, photo = example("brick"), example("wood", "image")
    of_kinds: dict[str, dict[str, Any]] = {
        "touch-to-image": {"touch": touch},
        "stylization": {"touch": touch, "image": photo},
        "x-to-touch": {"image": photo},
    }

    def call(dtype: torch.dtype = torch.float32, size: float = 1.0, **changed: Any) -> tuple[Tensor, list[ReturnCode]]:
        """Latents and codes of one call, from latents that are plus or minus a size everywhere."""
        pipe = load(dtype)
        pipe.set_progress_bar_config(disable=True)
        shape, side = (1, pipe.unet.config.out_channels, 8, 8), 8 * pipe.vae_scale_factor
        latents = size * torch.randn(shape, generator=torch.Generator().manual_seed(1)).sign()
        given = {"num_inference_steps": 2, "guidance_scale": 2.0, "latents": latents, "height": side, "width": side}
        given |= {"output_type": "latent", "throw": False, "generator": torch.Generator().manual_seed(0)}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UnfamiliarInputWarning)
            output = pipe(**given | of_kinds[kind] | changed)
        return output.images, output.report.codes

    def same(name: str, one: dict[str, Any], other: dict[str, Any], bound: Any, reason: str) -> Case:
        return Case(f"{kind}: {name}", lambda: error(*call(**one), exact=call(**other)[0]), bound, reason)

    def coded(name: str, code: ReturnCode, **changed: Any) -> Case:
        return Case(f"{kind}: {name}", lambda: error(*call(**changed), code))

    equal = 1e-4, "equal calls, some thousand roundings of float32 in another order"
    yield same("guidance_scale 0", {"guidance_scale": 0.0}, {"guidance_scale": 1.0}, *equal)
    yield same("latents of size 1e-40", {"size": 1e-40}, {"size": 0.0}, *equal)
    yield coded("guidance_scale 1e6", DIVERGED, guidance_scale=1e6)
    yield coded("latents of size 1e3", DIVERGED, size=1e3)
    yield coded("latents of size 3e38", NON_FINITE, size=3e38)

    def roundings(dtype: torch.dtype) -> float:
        layers = sum(any(True for _ in each.parameters(recurse=False)) for each in load(torch.float32).unet.modules())
        return torch.finfo(dtype).eps / 2 * math.sqrt(8 * layers)

    eight: Any = {"num_inference_steps": 8}
    for dtype in (torch.float16, torch.bfloat16):
        bound = partial(roundings, dtype)
        yield same(str(dtype), {**eight, "dtype": dtype}, eight, bound, "independent roundings of its layers")
