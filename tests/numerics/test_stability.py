"""Every case of the stability table keeps its bound; the bounds and measures against closed forms."""

import math
import warnings
from dataclasses import replace

import pytest
import torch

from unitouch_gen.numerics.problems import make_problem
from unitouch_gen.numerics.stability import (
    Case,
    a_priori,
    apart,
    as_expected,
    beyond,
    carried,
    cases,
    energy,
    error,
    solve,
)
from unitouch_gen.pipelines.tiny import tiny
from unitouch_gen.sampling import ReturnCode

SUCCESS, NON_FINITE = ReturnCode.SUCCESS, ReturnCode.NON_FINITE
TABLE = cases(tiny)


def is_slow(case: Case) -> bool:
    """Whether a case takes hundreds of evaluations or a pipeline in half precision."""
    return any(words in case.name for words in ("1000 steps", "guidance 100", "0.001", ": float16", ": bfloat16"))


@pytest.mark.parametrize(
    "case", [pytest.param(case, id=case.name, marks=pytest.mark.slow if is_slow(case) else ()) for case in TABLE]
)
def test_a_case_keeps_its_bound(case: Case) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # libraries warn of extreme input
        value, bound = case.measure()
    assert value <= bound, f"{case.demand} {value:.2g} is above {bound:.2g} ({case.reason})"


def test_names_are_unique() -> None:
    names = [case.name for case in TABLE]
    assert len(names) == len(set(names))


def test_no_pipeline_is_loaded_to_list_the_cases() -> None:
    assert len(cases(lambda kind, dtype: pytest.fail(f"{kind} was loaded"))) == len(TABLE)


# Measures -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_result_that_is_not_finite_has_an_infinite_error(value: float) -> None:
    result = torch.ones(2, 3)
    result[1, 2] = value
    assert error(result, torch.ones(2, 3), [SUCCESS] * 2) == math.inf
    assert beyond(result) == math.inf


def test_an_unexpected_code_has_an_infinite_error() -> None:
    ones = torch.ones(2, 3)
    assert error(ones, ones, [SUCCESS, ReturnCode.DIVERGED]) == math.inf
    assert error(ones, 2 * ones, [SUCCESS] * 2) == 0.5
    assert as_expected(ones, [SUCCESS, NON_FINITE, SUCCESS], [SUCCESS, NON_FINITE, SUCCESS])
    assert not as_expected(ones, [SUCCESS, SUCCESS], [SUCCESS, NON_FINITE])


def test_distances() -> None:
    values = torch.tensor([0.0, 0.5, 0.25])
    assert apart(values, torch.zeros(3)) == 0.5
    assert (beyond(values), beyond(values, 0.125, 0.25)) == (0.0, 0.25)


# Bounds ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [1.0, 7.5])
def test_a_difference_grows_as_that_of_two_exact_flows(scale: float) -> None:
    problem = replace(make_problem("gaussian-guided"), guidance_scale=scale)
    noise, sigma = problem.noise(2), problem.schedule.sigma_max
    ends, starts = (problem.data.to_axes(x) for x in (problem.solution(noise), problem.flow.start(noise)))
    torch.testing.assert_close(ends[1] - ends[0], carried(problem, sigma) * (starts[1] - starts[0]))


@pytest.mark.parametrize(("solver", "least"), [("ddim", 0.95), ("euler", 0.95), ("dpm++2m", 0.45)])
def test_a_priori_errors_are_above_those_of_solvers_and_near_them(solver: str, least: float) -> None:
    problem = make_problem("conditioning-1e2")
    for steps in (50, 100, 200):
        assert (
            least * a_priori(problem, solver, steps) < solve(problem, solver, steps) < a_priori(problem, solver, steps)
        )


@pytest.mark.parametrize("ratio", [0.0, 1e-3, 0.1])
def test_the_energy_of_a_mode_is_its_closed_form(ratio: float) -> None:
    w = 2000.0
    b, t = w * (1 - ratio**2) ** 0.5, torch.linspace(1e-6, 0.3, 400, dtype=torch.float64)
    decay = torch.exp(-ratio * w * t)
    place = w * decay * torch.sin(b * t) / b
    speed = decay * (torch.cos(b * t) - ratio * w / b * torch.sin(b * t))
    torch.testing.assert_close(energy(ratio), place**2 + speed**2, rtol=1e-9, atol=1e-12)
