"""The stiff set of the world's physics: every case does what is expected of it, and a case that does not is seen."""

import math

import pytest
import torch

from unitouch_gen.numerics.physics_case import apart, at_most, in_range, rising
from unitouch_gen.numerics.physics_stability import physics_suite
from unitouch_gen.numerics.physics_stiff_gels import DECADES
from unitouch_gen.numerics.physics_stiff_sounds import DAMPING, energy
from unitouch_gen.numerics.stability import Case, choose, run_cases

SUITE = physics_suite()


@pytest.mark.parametrize("case", [pytest.param(case, id=case.name) for cases in SUITE.values() for case in cases])
def test_case(case: Case) -> None:
    (row,) = run_cases({"": [case]})
    assert row.ok, f"{row.expected}: {row.seen}"


def test_no_two_cases_share_a_name() -> None:
    assert sum(map(len, choose(SUITE).values())) > 20


def test_stiffness_goes_over_six_decades() -> None:
    assert max(DECADES) / min(DECADES) == pytest.approx(1e6)


def test_damping_goes_from_ringing_to_over_damped() -> None:
    assert min(DAMPING) < 1e-3
    assert max(DAMPING) > 1e3


@pytest.mark.parametrize("ratio", [0.0, 1e-3, 0.1])
def test_the_energy_of_a_mode_is_its_closed_form(ratio: float) -> None:
    w = 2000.0
    b, t = w * math.sqrt(1 - ratio**2), torch.linspace(1e-6, 0.3, 400, dtype=torch.float64)
    decay = torch.exp(-ratio * w * t)
    place = w * decay * torch.sin(b * t) / b
    speed = decay * (torch.cos(b * t) - ratio * w / b * torch.sin(b * t))
    torch.testing.assert_close(energy(ratio), place**2 + speed**2, rtol=1e-9, atol=1e-12)


# A check that cannot fail says nothing.


@pytest.mark.parametrize("value", [1.1, math.nan, math.inf])
def test_what_is_above_its_bound_or_not_a_number_is_seen(value: float) -> None:
    assert not at_most(value, 1.0).ok


@pytest.mark.parametrize("value", [-0.1, 1.1, math.nan, math.inf])
def test_what_is_out_of_range_is_seen(value: float) -> None:
    assert not in_range(torch.tensor([0.5, value])).ok


@pytest.mark.parametrize("value", [0.1, math.nan])
def test_what_falls_is_seen(value: float) -> None:
    assert not rising(torch.tensor([0.0, 0.2, value])).ok


@pytest.mark.parametrize("value", [0.5, math.nan])
def test_what_differs_is_seen(value: float) -> None:
    assert not apart(torch.tensor([0.0, value]), torch.zeros(2), 0.1).ok
