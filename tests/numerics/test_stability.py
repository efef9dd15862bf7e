"""Every case of the stability table keeps its bound; the bounds against closed forms."""

import math
import re
import warnings
from dataclasses import replace

import pytest
import torch

from unitouch_gen.numerics.problems import PROBLEMS
from unitouch_gen.numerics.stability import Case, a_priori, carried, cases, error, solve
from unitouch_gen.pipelines.tiny import tiny
from unitouch_gen.sampling import ReturnCode

KINDS = ("touch-to-image", "stylization", "x-to-touch")
TABLE = cases(tiny, KINDS)


def is_slow(case: Case) -> bool:
    """Whether a case takes hundreds of evaluations or a pipeline in half precision."""
    return any(words in case.name for words in ("1000 steps", "guidance 100", "0.001", ": torch."))


GROUPS: dict[tuple[str, bool], list[Case]] = {}
"""Cases by problem or pipeline, slow ones apart."""
for each in TABLE:
    GROUPS.setdefault((re.split("[,:]", each.name)[0], is_slow(each)), []).append(each)


@pytest.mark.parametrize(
    "group", [pytest.param(key, id=key[0], marks=pytest.mark.slow if key[1] else ()) for key in GROUPS]
)
def test_every_case_keeps_its_bound(group: tuple[str, bool]) -> None:
    above = []
    for case in GROUPS[group]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # libraries warn of extreme input
            value, bound = case.run()
        above += [] if value <= bound else [f"{case.name}: {value:.2g} is above {bound:.2g} ({case.reason})"]
    assert not above


def test_names_are_unique_and_no_pipeline_is_loaded_to_list_them() -> None:
    found = cases(lambda kind, dtype: pytest.fail(f"{kind} was loaded"), KINDS)
    assert len({case.name for case in found}) == len(TABLE) == len(found)


def test_what_is_not_finite_or_ends_otherwise_has_an_infinite_error() -> None:
    result, ones, codes = torch.tensor([[1.0, math.nan], [1.0, 1.0]]), torch.ones(2, 2), [ReturnCode.SUCCESS] * 2
    assert error(result, codes, exact=ones) == math.inf
    assert error(ones, codes, ReturnCode.DIVERGED) == math.inf
    assert error(ones, codes, exact=2 * ones) == 0.5


@pytest.mark.parametrize("scale", [1.0, 7.5])
def test_a_difference_grows_as_that_of_two_exact_flows(scale: float) -> None:
    problem = replace(PROBLEMS["gaussian-guided"], guidance_scale=scale)
    noise, sigma = problem.noise(2), problem.schedule.sigma_max
    ends, starts = problem.solution(noise).flatten(1), noise.flatten(1) * math.hypot(1.0, sigma)
    expected = carried(problem, sigma) * (starts[1] - starts[0])
    torch.testing.assert_close(ends[1] - ends[0], expected, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize(
    ("solver", "least", "steps"), [("ddim", 0.95, 50), ("euler", 0.95, 200), ("dpm++2m", 0.13, 50)]
)
def test_a_priori_errors_are_above_those_of_solvers_and_near_them(solver: str, least: float, steps: int) -> None:
    problem = PROBLEMS["conditioning-1e2"]
    bound = a_priori(problem, solver, steps)
    assert least * bound < solve(problem, solver=solver, num_inference_steps=steps) < bound
