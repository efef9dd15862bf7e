"""Every case of the stability table keeps its bound."""

import math
import re
import warnings

import pytest
import torch

from unitouch_gen.numerics.stability import Case, cases, error
from unitouch_gen.pipelines.tiny import tiny
from unitouch_gen.sampling import ReturnCode

KINDS = ("touch-to-image", "stylization", "x-to-touch")
TABLE = cases(tiny, KINDS)


def is_slow(case: Case) -> bool:
    """Whether a case takes a pipeline in half precision."""
    return ": torch." in case.name


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
