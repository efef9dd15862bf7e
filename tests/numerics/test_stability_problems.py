"""Every case on exact problems ends as expected, and nothing that is not finite comes out."""

import math

import pytest

from unitouch_gen.numerics.problems import all_problems
from unitouch_gen.numerics.stability import Case, run_cases
from unitouch_gen.numerics.stability_problems import BOUNDS, problem_suite, solve, truth
from unitouch_gen.schedulers.solvers import SOLVERS

# numpy 2 on diffusers' DEIS, and numpy on schedules that cannot be.
pytestmark = [
    pytest.mark.filterwarnings("ignore:__array_wrap__ must accept context:DeprecationWarning"),
    pytest.mark.filterwarnings("ignore::RuntimeWarning:diffusers"),
]

SUITE = problem_suite()
LONG = ("1000 steps", "guidance 100", "tolerance 1e-05", "tolerance 0.0001", "10000 levels")


CASES = [
    pytest.param(case, id=case.name, marks=pytest.mark.slow if case.name.startswith(LONG) else ())
    for cases in SUITE.values()
    for case in cases
]


@pytest.mark.parametrize("case", CASES)
def test_case(case: Case):
    (outcome,) = run_cases({"": [case]})
    assert outcome.ok, f"{outcome.expected}; {outcome.seen}; {outcome.value}"


def test_every_stiff_problem_has_a_bound_of_its_own():
    assert {problem.name for problem in all_problems(stiff=True)} == set(BOUNDS)


@pytest.mark.parametrize("group", ["stiff", "predictions"])
def test_every_solver_is_tried(group):
    names = {case.name.rpartition(", ")[2] for case in SUITE[group]}
    assert names >= {*SOLVERS, "tolerance"}


def test_an_error_is_that_of_the_worst_sample():
    (problem,) = (problem for problem in all_problems(stiff=True) if problem.name == "conditioning-1e2")
    ended = solve(problem, "ddim", 10, batch_size=8)
    exact = truth(problem, 8).flatten(1)
    errors = (ended.output.double().flatten(1) - exact).norm(dim=1) / exact.norm(dim=1)
    assert ended.error == pytest.approx(errors.max().item())
    assert math.isfinite(ended.indicator)
