"""The sensor bank: retrieval by L1 distance against numpy, names, reaches, and a bank of none."""

import numpy as np
import pytest
import torch

from unitouch_gen.models import SensorBank, SensorMatch

NAMES = ("gelsight", "digit", "taxim")


def reaching(**reaches: float) -> SensorBank:
    """Two sensors with flat looks, 0.2 and 0.8, and how far their touches lie."""
    bank = SensorBank(tuple(reaches), 5, 16, 32, reaches=reaches)
    for name, level in zip(reaches, (0.2, 0.8), strict=True):
        bank.set_prototype(name, torch.full((3, 32, 32), level))
    return bank


def levels(*values: float) -> torch.Tensor:
    return torch.tensor(values)[:, None, None, None].expand(-1, 3, 32, 32)


def test_retrieval_is_the_smallest_mean_absolute_difference() -> None:
    torch.manual_seed(0)
    bank = SensorBank(NAMES, 5, 16, 8)
    images = torch.rand(20, 3, 8, 8)
    for name in NAMES:
        bank.set_prototype(name, torch.rand(3, 8, 8))
    gaps = np.abs(images.numpy()[:, None] - torch.stack([bank.prototype(name) for name in NAMES]).numpy()[None])
    distances = gaps.reshape(20, 3, -1).mean(axis=2)
    np.testing.assert_allclose(bank.distances(images), distances, rtol=1e-5)
    matches = bank.match(images)
    assert [match.name for match in matches] == [NAMES[index] for index in distances.argmin(axis=1)]
    np.testing.assert_allclose([match.distance for match in matches], distances.min(axis=1), rtol=1e-5)


def test_sensors_without_prototypes_are_named_but_never_retrieved() -> None:
    bank = SensorBank(NAMES, 5, 16, 8)
    black = torch.zeros(1, 3, 8, 8)
    assert bank.match(black, "digit") == [SensorMatch("digit", None)]
    bank.set_prototype("taxim", torch.ones(3, 8, 8))
    assert bank.match(black) == [SensorMatch("taxim", 1.0)]  # unset ones are zeros: nearer, but unknown


def test_a_bank_of_none_matches_none() -> None:
    bank = SensorBank((), 5, 16, 8)
    assert bank.match(torch.rand(2, 3, 8, 8)) == [SensorMatch(None, None)] * 2


def test_an_image_out_of_reach_of_all_is_of_none_unless_the_nearest_is_asked_for() -> None:
    bank = reaching(dark=0.05, bright=0.05)
    assert [match.name for match in bank.match(levels(0.24, 0.26, 0.76))] == ["dark", None, "bright"]
    assert bank.match(levels(0.26))[0].distance == pytest.approx(0.06 / 0.05, rel=1e-5)
    assert bank.match(levels(0.45), "bright")[0].name == "bright"
    assert bank.match(levels(0.45), nearest=True)[0].name == "dark"


def test_reaches_are_of_areas_and_the_sensor_whose_own_touches_lie_as_far_is_retrieved() -> None:
    assert reaching(dark=0.05, bright=0.4).match(levels(0.41))[0].name == "bright"  # nearer to the dark one
    checks = 0.2 + 0.2 * (-1.0) ** (torch.arange(32)[:, None] + torch.arange(32)).expand(1, 3, 32, 32)
    assert reaching(dark=0.01, bright=0.01).match(checks)[0].name == "dark"
