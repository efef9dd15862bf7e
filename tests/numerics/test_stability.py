"""What the suite is made of: a case that cannot fail says nothing, so each kind of failure has to be seen."""

import json
import math

import pytest
import torch

from unitouch_gen.errors import InvalidInputError, NonFiniteError, NotConvergedError
from unitouch_gen.numerics.stability import (
    Case,
    Ended,
    Seen,
    choose,
    ends,
    largest_error,
    raises,
    refused,
    run_cases,
    summary,
)
from unitouch_gen.sampling import ReturnCode

SUCCESS, NON_FINITE = ReturnCode.SUCCESS, ReturnCode.NON_FINITE
TWO = torch.ones(2, 3)


def seen(case: Case) -> Seen:
    (outcome,) = run_cases({"group": [case]})
    assert (outcome.group, outcome.name, outcome.expected) == ("group", case.name, case.expected)
    return Seen(outcome.ok, outcome.seen, outcome.value, outcome.silent)


# Runs that end --------------------------------------------------------------------------------------------------------


def test_a_run_that_ends_as_expected():
    case = ends("a", lambda: Ended([SUCCESS] * 2, TWO, 1e-3), bound=1e-2)
    assert case.expected == "success, error <= 0.01"
    assert seen(case) == Seen(True, "success", 1e-3)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_and_said_to_be_is_silent(value):
    output = TWO.clone()
    output[1, 2] = value
    result = seen(ends("a", lambda: Ended([SUCCESS] * 2, output)))
    assert not result.ok and result.silent
    assert result.words == "success, but not finite"


def test_a_silent_case_fails_whatever_it_says_itself():
    assert not seen(Case("a", "anything", lambda: Seen(True, "fine", silent=True))).ok


@pytest.mark.parametrize("error", [0.1, math.nan, math.inf])
def test_an_error_above_its_bound_or_unknown_is_seen(error):
    assert not seen(ends("a", lambda: Ended([SUCCESS] * 2, TWO, error), bound=1e-2)).ok


def test_another_code_is_seen():
    result = seen(ends("a", lambda: Ended([SUCCESS, ReturnCode.MAX_EVALUATIONS], TWO)))
    assert not result.ok and not result.silent
    assert result.words == "success x 1, max_evaluations x 1"


def test_each_sample_may_have_a_code_of_its_own():
    codes = [SUCCESS, NON_FINITE, SUCCESS]
    assert seen(ends("a", lambda: Ended(codes, TWO), codes)).ok
    assert not seen(ends("a", lambda: Ended([NON_FINITE, SUCCESS, SUCCESS], TWO), codes)).ok


@pytest.mark.parametrize("rows", [1, 3])
def test_samples_that_are_missing_or_too_many_are_seen(rows):
    """One that broke is not to come out, and one that did not is."""
    assert not seen(ends("a", lambda: Ended([SUCCESS, NON_FINITE, SUCCESS], torch.ones(rows, 3)))).ok


def test_a_result_that_is_all_broken_is_empty():
    assert seen(ends("a", lambda: Ended([NON_FINITE], torch.zeros(0, 3)), NON_FINITE)).ok


def test_errors_are_relative_and_the_largest_counts():
    truth = torch.tensor([[3.0, 4.0], [0.3, 0.4]])
    assert largest_error(truth + torch.tensor([[0.05, 0.0], [0.05, 0.0]]), truth) == pytest.approx(0.1)
    assert math.isnan(largest_error(truth[:0], truth[:0]))


# Calls that do not ----------------------------------------------------------------------------------------------------


def stop(error: Exception):
    def call() -> None:
        raise error

    return call


def test_a_refusal_has_to_name_the_argument():
    assert seen(refused("a", stop(InvalidInputError("`eta` is 2")), "eta")).ok
    assert not seen(refused("a", stop(InvalidInputError("`zeta` is 2")), "eta")).ok
    assert not seen(refused("a", lambda: None, "eta")).ok


def test_an_argument_that_is_not_there_is_refused_by_python():
    def call(eta: float) -> float:
        return eta

    assert seen(refused("a", lambda: call(eta=1.0, zeta=2.0), "zeta")).ok


@pytest.mark.parametrize(
    "error", [RuntimeError("`eta`"), IndexError("`eta`"), KeyError("`eta`"), AssertionError("`eta`")]
)
def test_another_error_is_no_refusal(error):
    result = seen(refused("a", stop(error), "eta"))
    assert not result.ok
    assert result.words.startswith(f"raised {type(error).__name__}")


@pytest.mark.parametrize(
    ("code", "error"),
    [(NON_FINITE, NonFiniteError("a")), (ReturnCode.MAX_EVALUATIONS, NotConvergedError("a"))],
)
def test_a_call_may_raise_the_error_of_a_code(code, error):
    assert seen(raises("a", stop(error), code)).ok
    assert not seen(raises("a", stop(ArithmeticError("a")), code)).ok
    assert not seen(raises("a", lambda: None, code)).ok


# The suite ------------------------------------------------------------------------------------------------------------

SUITE = {
    "first": [ends("a", lambda: Ended([SUCCESS], TWO[:1])), ends("b", lambda: Ended([SUCCESS], TWO[:1] * math.nan))],
    "second": [Case("c", "works", stop(RuntimeError("out of order")))],
}


def test_a_case_that_raises_stops_no_other():
    outcomes = list(run_cases({"group": [SUITE["second"][0], SUITE["first"][0]]}))
    assert [outcome.ok for outcome in outcomes] == [False, True]
    assert outcomes[0].seen == "raised RuntimeError: out of order"


def test_the_summary_counts():
    assert summary(list(run_cases(SUITE))).startswith("3 cases: 1 as expected, 2 not, 1 silently not finite; ")


def test_outcomes_are_plain_values_for_json():
    rows = [outcome.to_dict() for outcome in run_cases(SUITE)]
    read = json.loads(json.dumps(rows, allow_nan=False))
    assert [row["value"] for row in read] == [None, None, None]
    assert [row["silent"] for row in read] == [False, True, False]


def test_cases_are_chosen_by_group_and_by_name():
    assert [case.name for cases in choose(SUITE).values() for case in cases] == ["a", "b", "c"]
    assert list(choose(SUITE, ["second"])) == ["second"]
    assert {group: [case.name for case in cases] for group, cases in choose(SUITE, names=["b", "c"]).items()} == {
        "first": ["b"],
        "second": ["c"],
    }


def test_what_is_not_there_cannot_be_chosen():
    with pytest.raises(InvalidInputError, match=r"`group` is 'secnd'; .*'first', 'second'. Did you mean 'second'\?"):
        choose(SUITE, ["secnd"])
    with pytest.raises(InvalidInputError, match="`only` is 'z'"):
        choose(SUITE, names=["z"])


def test_no_two_cases_may_share_a_name():
    with pytest.raises(InvalidInputError, match="'a' twice"):
        choose({**SUITE, "third": SUITE["first"][:1]})
