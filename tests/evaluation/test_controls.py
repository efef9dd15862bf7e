"""Measures that are not a word, on values of which the answer is known, and their controls."""

import math

import pytest
import torch

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.evaluation.attributes import attribute_agreement, controlled_agreement
from unitouch_gen.evaluation.controls import class_means, others
from unitouch_gen.evaluation.frechet import frechet_distance
from unitouch_gen.evaluation.retrieval import retrieval
from unitouch_gen.world import ATTRIBUTES

LABELS = torch.arange(4).repeat(20)


@pytest.mark.parametrize("count", [2, 3, 64])
def test_others_are_each_sample_once_and_never_the_same_one(count: int) -> None:
    rows = others(count)
    assert rows.sort().values.tolist() == list(range(count)) and not bool((rows == torch.arange(count)).any())


def test_class_means_are_those_of_each_class() -> None:
    values = torch.rand(80, 2, 3, generator=torch.Generator().manual_seed(0))
    means = class_means(values, LABELS)
    for label in range(4):
        expected = values[label == LABELS].mean(dim=0).expand(20, -1, -1)
        torch.testing.assert_close(means[label == LABELS], expected)
    torch.testing.assert_close(class_means(values, LABELS, torch.tensor([3, 1])), means[[3, 1]])


# Retrieval ------------------------------------------------------------------------------------------------------------


def test_what_is_the_same_is_always_found_and_a_class_mean_as_often_as_chance() -> None:
    gallery = torch.randn(80, 8, generator=torch.Generator().manual_seed(0))
    assert retrieval(gallery, gallery, LABELS, size=16) == 1.0
    for top in (1, 3):
        assert retrieval(class_means(gallery, LABELS), gallery, LABELS, size=16, top=top) == pytest.approx(top / 16)


def test_samples_that_are_equally_near_come_first_as_often_as_chance() -> None:
    assert retrieval(torch.ones(80, 2), torch.ones(80, 2), LABELS, size=8, top=2) == pytest.approx(2 / 8)


def test_others_of_the_class_are_those_of_all_draws() -> None:
    # One of three rivals is nearer: where one is drawn it is that one in a third of all draws, of two in two thirds.
    gallery = torch.tensor([[1.0, 0.2], [1.0, 0.0], [0.0, 1.0], [0.0, -1.0], [1.0, 0.01]])
    labels, query = torch.tensor([0, 0, 0, 0, 1]), torch.tensor([[1.0, 0.0]])
    for size, share in ((2, 2 / 3), (3, 1 / 3), (4, 0.0)):
        found = retrieval(query, gallery, labels, torch.tensor([0]), size=size)
        assert found == pytest.approx(share)


def test_groups_larger_than_a_class_are_refused() -> None:
    with pytest.raises(InvalidInputError, match="`size` is 64, but a class has 20 samples"):
        retrieval(torch.ones(80, 2), torch.ones(80, 2), LABELS)


# Attributes -----------------------------------------------------------------------------------------------------------


def contacts(count: int = 80) -> torch.Tensor:
    values = torch.rand(count, len(ATTRIBUTES), generator=torch.Generator().manual_seed(1))
    angle = 2 * math.pi * values[:, 0]
    values[:, ATTRIBUTES.index("grain x")], values[:, ATTRIBUTES.index("grain y")] = angle.cos(), angle.sin()
    return values


def test_the_truth_agrees_with_itself_in_any_unit() -> None:
    truth = contacts()
    read = truth.clone()
    read[:, ATTRIBUTES.index("depth")] = 3.0 * read[:, ATTRIBUTES.index("depth")] - 1.0
    found = attribute_agreement(read, truth, ATTRIBUTES)
    zero = {"grain degrees": 0.0, "place apart": 0.0}
    assert found == {key: pytest.approx(zero.get(key, 1.0), abs=1e-4) for key in found}
    assert len(found) == len(ATTRIBUTES) - 1  # two pairs, one of them with two figures


@pytest.mark.parametrize(("turn", "within"), [(15.0, 1.0), (25.0, 0.0), (-75.0, 0.0), (175.0, 1.0)])
def test_directions_are_apart_by_half_of_the_doubled_angle(turn: float, within: float) -> None:
    truth = contacts()
    x, y = truth[:, ATTRIBUTES.index("grain x")], truth[:, ATTRIBUTES.index("grain y")]
    turned = torch.atan2(y, x) + math.radians(2 * turn)
    read = torch.stack([turned.cos(), turned.sin()], dim=1) * 0.1  # unsure, but of the angle
    found = attribute_agreement(read, torch.stack([x, y], dim=1), ("grain x", "grain y"))
    assert found == {
        "grain within 20": within,
        "grain degrees": pytest.approx(min(abs(turn), 180 - abs(turn)), abs=1e-3),
    }


def test_controls_stand_beside_each_attribute() -> None:
    truth = contacts()
    truth[:, ATTRIBUTES.index("compliance")] = LABELS / 4  # all that a class tells
    again = contacts()[torch.randperm(80, generator=torch.Generator().manual_seed(2))]
    again[:, ATTRIBUTES.index("compliance")] = LABELS / 4
    found = controlled_agreement(truth, truth, class_means(again, LABELS, LABELS), truth, ATTRIBUTES)
    compliance, depth = found["compliance"], found["depth"]
    assert compliance.value == pytest.approx(1.0) and compliance.class_mean == pytest.approx(1.0)
    assert abs(depth.class_mean) < 0.5 > abs(depth.shuffled) and depth.ceiling == pytest.approx(1.0)
    assert found["place apart"].shuffled > 0.1 > found["place apart"].value


# The distance of features ---------------------------------------------------------------------------------------------


def test_the_distance_of_gaussians_is_that_of_their_moments() -> None:
    seen = torch.randn(4000, 3, generator=torch.Generator().manual_seed(0)).double()
    seen = seen - seen.mean(dim=0)
    white = seen @ torch.linalg.inv(torch.linalg.cholesky(torch.cov(seen.T))).T  # deviation 1, uncorrelated
    scale, shift = torch.tensor([1.0, 2.0, 0.5]).double(), torch.tensor([0.0, 1.0, -2.0]).double()
    expected = (shift**2).sum() + ((scale - 1.0) ** 2).sum()
    assert frechet_distance(white * scale + shift, white) == pytest.approx(expected.item(), rel=1e-6)
    assert frechet_distance(white, white) == pytest.approx(0.0, abs=1e-6)


def test_one_sample_has_no_distance() -> None:
    with pytest.raises(InvalidInputError, match="`one` and `other` have 1 and 5 rows"):
        frechet_distance(torch.ones(1, 2), torch.ones(5, 2))
