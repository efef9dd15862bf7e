"""What cases are made of: one that cannot fail says nothing, so each kind of failure has to be seen."""

import math

import pytest
import torch

from unitouch_gen.errors import InvalidInputError, NonFiniteError, NotConvergedError
from unitouch_gen.numerics.stability import Case, Ended, Outcome, choose, run_case, summary
from unitouch_gen.sampling import ReturnCode

SUCCESS, NON_FINITE = ReturnCode.SUCCESS, ReturnCode.NON_FINITE
TWO = torch.ones(2, 3)


def ends(ended: Ended, *arguments, **options) -> Case:
    return Case("a", lambda: ended, *arguments, **options)


def raising(error: Exception, **options) -> Case:
    def ask() -> Ended:
        raise error

    return Case("a", ask, **options)


def outcome(case: Case) -> Outcome:
    found = run_case(case, "group")
    assert (found.group, found.name, found.expected) == ("group", case.name, case.expected)
    return found


# One case -------------------------------------------------------------------------------------------------------------


def test_a_run_that_ends_as_expected():
    case = ends(Ended(TWO, 1e-3, [SUCCESS] * 2), 1e-2, "order 1")
    assert case.expected == "success, error <= 0.01 (order 1)"
    found = outcome(case)
    assert (found.ok, found.seen, found.value, found.silent) == (True, "success", 1e-3, False)


def test_what_is_not_sampled_has_no_code():
    case = ends(Ended(TWO, 1e-3), 1e-2, "a closed form", codes=())
    assert case.expected == "error <= 0.01 (a closed form)" and outcome(case).ok


def test_a_bound_may_be_told_when_it_is_asked_for():
    asked = []
    case = ends(Ended(TWO, 1e-3, [SUCCESS] * 2), lambda: asked.append(1) or 1e-4, "a closed form")
    assert case.expected == "success, error bounded (a closed form)" and not asked
    assert not outcome(case).ok and asked == [1]
    assert case.expected == "success, error <= 0.0001 (a closed form)"


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_and_said_to_be_is_silent(value):
    output = TWO.clone()
    output[1, 2] = value
    found = outcome(ends(Ended(output, 0.0, [SUCCESS] * 2)))
    assert (found.ok, found.silent, found.seen) == (False, True, "success, but not finite")


@pytest.mark.parametrize("error", [0.1, math.nan, math.inf])
def test_an_error_above_its_bound_or_unknown_is_seen(error):
    assert not outcome(ends(Ended(TWO, error, [SUCCESS] * 2), 1e-2)).ok


def test_another_code_is_seen():
    found = outcome(ends(Ended(TWO, 0.0, [SUCCESS, ReturnCode.MAX_EVALUATIONS])))
    assert (found.ok, found.silent, found.seen) == (False, False, "success x 1, max_evaluations x 1")


def test_each_sample_may_have_a_code_of_its_own():
    codes = [SUCCESS, NON_FINITE, SUCCESS]
    assert outcome(ends(Ended(TWO, 0.0, codes), codes=codes)).ok
    assert not outcome(ends(Ended(TWO, 0.0, [NON_FINITE, SUCCESS, SUCCESS]), codes=codes)).ok


@pytest.mark.parametrize("rows", [1, 3])
def test_samples_that_are_missing_or_too_many_are_seen(rows):
    """One that broke is not to come out, and one that did not is."""
    codes = [SUCCESS, NON_FINITE, SUCCESS]
    assert not outcome(ends(Ended(torch.ones(rows, 3), 0.0, codes), codes=codes)).ok


def test_a_result_that_is_all_broken_is_empty():
    assert outcome(ends(Ended(torch.zeros(0, 3), math.nan, [NON_FINITE]), codes=NON_FINITE)).ok


@pytest.mark.parametrize("kind", [NonFiniteError, NotConvergedError])
def test_an_error_may_be_what_has_to_come(kind):
    assert outcome(raising(kind("a"), raises=kind)).ok
    assert not outcome(raising(ArithmeticError("a"), raises=kind)).ok
    assert not outcome(ends(Ended(TWO, 0.0, [SUCCESS] * 2), raises=kind)).ok


def test_an_error_that_was_not_expected_is_seen():
    found = outcome(raising(NonFiniteError("after step 3")))
    assert (found.ok, found.seen) == (False, "raised NonFiniteError: after step 3")


# All of them ----------------------------------------------------------------------------------------------------------

FINE = Case("b", lambda: Ended(TWO, math.nan, [SUCCESS] * 2))
SUITE = {
    "first": [FINE, Case("c", lambda: Ended(TWO * math.nan, 0.0, [SUCCESS] * 2))],
    "second": [raising(RuntimeError("out of order"))],
}


def test_whatever_a_case_raises_is_seen():
    found = outcome(SUITE["second"][0])
    assert (found.ok, found.seen) == (False, "raised RuntimeError: out of order")


def test_the_summary_counts():
    outcomes = [run_case(case, group) for group, case in choose(SUITE)]
    assert summary(outcomes).startswith("3 cases: 1 as expected, 2 not, 1 silently not finite; ")


def test_cases_are_chosen_by_group_and_by_name():
    assert [case.name for _, case in choose(SUITE)] == ["b", "c", "a"]
    assert [group for group, _ in choose(SUITE, ["second"])] == ["second"]
    assert [(group, case.name) for group, case in choose(SUITE, names=["a", "c"])] == [("first", "c"), ("second", "a")]


def test_what_is_not_there_cannot_be_chosen():
    with pytest.raises(InvalidInputError, match=r"`group` is 'secnd'; .*'first', 'second'. Did you mean 'second'\?"):
        choose(SUITE, ["secnd"])
    with pytest.raises(InvalidInputError, match="`only` is 'z'"):
        choose(SUITE, names=["z"])
