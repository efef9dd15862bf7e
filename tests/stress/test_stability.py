"""Every case of `unitouch-gen stability` ends as expected, and nothing that is not finite comes out of any."""

import warnings

import pytest

from unitouch_gen.numerics.stability import Case, run_case
from unitouch_gen.numerics.stability_suite import suite
from unitouch_gen.pipelines.tiny import tiny

CASES = [
    pytest.param(case, id=case.name, marks=pytest.mark.slow if case.slow else ())
    for cases in suite(tiny).values()
    for case in cases
]


@pytest.mark.parametrize("case", CASES)
def test_case(case: Case) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of libraries, on input that is meant to be odd
        found = run_case(case)
    assert found.ok, f"expected {found.expected}; seen {found.seen}, error {found.value:.2g}"
