"""Deep supervised cross-modal retrieval: its loss in a case worked by hand, and classes that are found across views."""

import math

import pytest
import torch

from unitouch_gen.evaluation.dscmr import INVARIANCE, PAIRWISE, dscmr, dscmr_loss
from unitouch_gen.evaluation.retrieval import mean_average_precision


def test_the_loss_is_that_of_a_case_worked_by_hand() -> None:
    """Two pairs of two classes, at right angles, named right by the first view and not at all by the other."""
    u, v = torch.eye(2), 2.0 * torch.eye(2)
    loss = dscmr_loss(u, v, torch.eye(2), torch.zeros(2, 2), torch.tensor([0, 1])).item()
    # Gamma is 1/2 on the diagonal, where classes agree, and 0 off it.
    pairwise = 3 * (2 * (math.log1p(math.exp(0.5)) - 0.5) + 2 * math.log(2.0)) / 4
    assert loss == pytest.approx(math.sqrt(2) / 2 + INVARIANCE * math.sqrt(2) / 2 + PAIRWISE * pairwise)


def views(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Two views of thirty objects, of which each has half in common with the other, and much besides."""
    generator = torch.Generator().manual_seed(seed)
    objects = torch.arange(30).repeat_interleave(8)
    shared = torch.randn(30, 6, generator=generator)[objects]
    one, other = (
        torch.cat([shared @ torch.randn(6, 12, generator=generator), 2 * torch.randn(240, 8, generator=generator)], 1)
        for _ in range(2)
    )
    return one, other, objects


def test_objects_are_found_that_nothing_was_fitted_to() -> None:
    one, other, objects = views()
    known = objects < 24
    pairs = (one[known], other[known], objects[known], one[~known], other[~known])
    found = mean_average_precision(*dscmr(*pairs), objects[~known], objects[~known])
    shuffled = pairs[1][torch.randperm(len(pairs[1]), generator=torch.Generator().manual_seed(0))]
    control = mean_average_precision(*dscmr(pairs[0], shuffled, *pairs[2:]), objects[~known], objects[~known])
    assert found > 0.5 > control


def test_it_leaves_the_random_state_as_it_is_and_repeats() -> None:
    one, other, objects = views()
    torch.manual_seed(3)
    wanted = torch.rand(2)
    torch.manual_seed(3)
    first = dscmr(one, other, objects, one[:4], other[:4])
    assert torch.equal(torch.rand(2), wanted)
    again = dscmr(one, other, objects, one[:4], other[:4])
    assert torch.equal(first[0], again[0]) and torch.equal(first[1], again[1])
