"""Every case of `unitouch-gen stability` ends as expected, and nothing that is not finite comes out of any."""

import re
import warnings

import pytest

from unitouch_gen.numerics.stability import Case, choose, run_case
from unitouch_gen.numerics.stability_suite import suite
from unitouch_gen.pipelines.tiny import tiny

SLOW = re.compile(r"(1000 steps|tolerance 0\.0001|guidance 100, d|guidance 1000, (tolerance|1000))")
"""Names of cases of about a second or more, beside all of the groups "many" and "precision"."""

CASES = [
    pytest.param(
        case, id=case.name, marks=pytest.mark.slow if group in ("many", "precision") or SLOW.match(case.name) else ()
    )
    for group, case in choose(suite(tiny))
]


@pytest.mark.parametrize("case", CASES)
def test_case(case: Case) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of libraries, on input that is meant to be odd
        found = run_case(case)
    assert found.ok, f"expected {found.expected}; seen {found.seen}, error {found.value:.2g}"
