"""Stiff and extreme problems, networks that break or round, extreme calls of pipelines: each has an a-priori bound."""

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from itertools import count
from typing import Any

import pytest
import torch
from torch import Tensor

from unitouch_gen.arguments import SamplingArguments
from unitouch_gen.numerics.problems import PROBLEMS, Problem
from unitouch_gen.numerics.stability import Case, cases, error, within
from unitouch_gen.pipelines.tiny import tiny
from unitouch_gen.sampling import SOLVERS, ReturnCode, prepare_steps
from unitouch_gen.solvers import MIN_LEVEL_RATIO

SUCCESS = ReturnCode.SUCCESS
NON_FINITE = ReturnCode.NON_FINITE
DIVERGED = ReturnCode.DIVERGED

KINDS = ("touch-to-image", "stylization", "x-to-touch")

ROUNDING = 4 * 2.0**-23
"""Relative error of a step of some four operations in float32."""


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
    arguments = SamplingArguments(solver=solver, num_inference_steps=num_inference_steps)
    levels, _ = prepare_steps(problem.scheduler(), arguments)
    sigmas = torch.tensor(levels[:-1], dtype=torch.float64)
    higher = SOLVERS[solver].order > 1
    values = along(problem, tuple(sigmas.tolist()))
    steps = -sigmas.log().diff()[:, None, None]
    slopes = values.diff(dim=0) / steps
    local = steps**2 / 2 * slopes.abs()
    if higher:
        before = steps[:-1]
        after = steps[1:]
        curvatures = 2 * slopes.diff(dim=0) / (before + after)
        local[1:] = (after**3 / 6 + after**2 * before / 4) * (curvatures.abs() + 2 * slopes[1:].abs())
    at_the_end = (carried(problem, sigmas[1:, None])[:, None] * local).sum(dim=0)
    return worst(at_the_end + last_step(problem, sigmas, values, higher), problem) + num_inference_steps * ROUNDING


@cache
def along(problem: Problem, sigmas: tuple[float, ...]) -> Tensor:
    """D on the exact path at each noise level, (n, 4, d)."""
    path = problem.path(problem.noise(4), list(sigmas))
    return torch.stack([problem.denoise(x, sigma).flatten(1) for x, sigma in zip(path, sigmas, strict=True)])


def carried(problem: Problem, sigma: Tensor | float) -> Tensor:
    """Factor of the exact flow on a difference at a noise level by sigma = 0, along each axis, (d,)."""
    scale = problem.guidance_scale if problem.guidance.active else 1.0
    both = [(problem.unconditional or problem.data).variances[0], problem.data.variances[0]]
    other, conditional = (variances / (variances + sigma**2) for variances in both)
    return other ** ((1 - scale) / 2) * conditional ** (scale / 2)


def last_step(problem: Problem, sigmas: Tensor, values: Tensor, higher: bool) -> Tensor:
    """Error of the step to sigma = 0, (4, d), given D at all levels: order 1 ends with D at the smallest level, higher
    ones with the line in sigma^2 through it and the last level that is 1.5 times as large."""
    end = values[-1]
    wider = (sigmas >= MIN_LEVEL_RATIO * sigmas[-1]).nonzero().flatten()
    if higher and len(wider) > 0:
        other = wider[-1]
        end = end + (end - values[other]) * sigmas[-1] ** 2 / (sigmas[other] ** 2 - sigmas[-1] ** 2)
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
    network = problem.network(4)
    calls = count()

    def predict(z: Tensor, timestep: Tensor) -> Tensor:
        prediction = network(z, timestep)
        return prediction if change is None or at not in (None, next(calls)) else change(prediction)

    found, report = problem.run(problem.noise(4), throw=False, network=predict, **way)
    rows = [row for row, code in enumerate(report.codes) if code.finite]
    return error(found[rows], report.codes, expected, None if exact is None else exact(problem)[rows])


def bounded(name: str, problem: Problem, **way: Any) -> Case:
    """One run on a problem, with the bound that follows from it."""
    words = way.get("solver", f"tolerance {way.get('tolerance', 0):g}")
    run = partial(solve, problem, **way)
    size = (problem.data.means**2 + problem.data.variances).mean().sqrt().item()  # RMS of a coordinate of x_0
    bound: float | Callable[[], float] = 3 * problem.smallest_deviation / size + 50 * ROUNDING
    reason = "both within 1.5 deviations of a mode"
    if "tolerance" in way:
        bound = partial(within, problem, **way)
        reason = "tolerance, and the step to sigma 0"
    elif problem.is_gaussian:
        bound = partial(a_priori, problem, **way)
        reason = "order along the exact flow"
    return Case(f"{name}, {words}", run, bound, reason)


def solver_cases() -> Iterator[Case]:
    """Stiff problems, extreme guidance and noise levels, very few and very many steps."""
    for problem in (each for each in PROBLEMS.values() if each.stiff):
        if problem.is_gaussian or not problem.guidance.active:
            yield from (bounded(problem.name, problem, solver=solver) for solver in SOLVERS)
    for tolerance in (1.0, 0.1, 1e-3):
        yield bounded("mixture-7.5", PROBLEMS["mixture-7.5"], tolerance=tolerance)

    plain = PROBLEMS["conditioning-1e2"]
    guided = PROBLEMS["gaussian-guided"]
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


GROUPS: dict[tuple[str, bool], list[Case]] = {}
"""Cases by problem or pipeline, slow ones apart: hundreds of evaluations, and pipelines in half precision."""
for each in (*solver_cases(), *network_cases(), *cases(tiny, KINDS)):
    slow = any(words in each.name for words in ("1000 steps", "guidance 100", "0.001", ": torch."))
    GROUPS.setdefault((re.split("[,:]", each.name)[0], slow), []).append(each)


@pytest.mark.parametrize(
    "group", [pytest.param(key, id=key[0], marks=pytest.mark.slow if key[1] else ()) for key in GROUPS]
)
def test_every_stability_case_keeps_its_bound(group: tuple[str, bool]) -> None:
    for case in GROUPS[group]:
        value, bound = case.run()
        assert value <= bound, f"{case.name}: {value:.2g} is above {bound:.2g} ({case.reason})"


def test_names_are_unique_and_no_pipeline_is_loaded_to_list_them() -> None:
    found = cases(lambda kind, dtype: pytest.fail(f"{kind} was loaded"), KINDS)
    assert len({case.name for case in found}) == len(found)


def test_stability_error_is_infinite_for_non_finite_results_and_other_codes() -> None:
    result = torch.tensor([[1.0, math.nan], [1.0, 1.0]])
    ones = torch.ones(2, 2)
    codes = [SUCCESS] * 2
    assert error(result, codes, exact=ones) == math.inf
    assert error(ones, codes, DIVERGED) == math.inf
    assert error(ones, codes, exact=2 * ones) == 0.5


@pytest.mark.parametrize("scale", [1.0, 7.5])
def test_a_difference_grows_as_that_of_two_exact_flows(scale: float) -> None:
    problem = replace(PROBLEMS["gaussian-guided"], guidance_scale=scale)
    noise = problem.noise(2)
    sigma = problem.schedule.sigma_max
    ends = problem.solution(noise).flatten(1)
    starts = noise.flatten(1) * math.hypot(1.0, sigma)
    expected = carried(problem, sigma) * (starts[1] - starts[0])
    torch.testing.assert_close(ends[1] - ends[0], expected, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize(
    ("solver", "least", "steps"), [("ddim", 0.95, 50), ("euler", 0.95, 200), ("dpm++2m", 0.13, 50)]
)
def test_a_priori_errors_are_above_those_of_solvers_and_near_them(solver: str, least: float, steps: int) -> None:
    problem = PROBLEMS["conditioning-1e2"]
    bound = a_priori(problem, solver, steps)
    assert least * bound < solve(problem, solver=solver, num_inference_steps=steps) < bound
