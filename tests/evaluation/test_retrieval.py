"""Retrieval across modalities: a case worked by hand, and pairs that share what can be found."""

import pytest
import torch
import torch.nn.functional as F
from sklearn.metrics import average_precision_score

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.evaluation.retrieval import correlated, mean_average_precision, retrieve


def test_the_nearest_come_first_whatever_their_length():
    gallery = torch.tensor([[0.0, 3.0], [5.0, 0.1], [1.0, 1.0]])
    rows, cosines = retrieve(torch.tensor([[2.0, 0.0], [0.0, 0.1]]), gallery, top=2)
    assert rows.tolist() == [[1, 2], [0, 2]]
    torch.testing.assert_close(cosines[:, 1], torch.full((2,), 0.5**0.5))


def test_average_precision_is_that_of_a_case_worked_by_hand():
    """Ranked 1, 0, 2 of objects a, b, a: the first and third place count, (1 / 1 + 2 / 3) / 2."""
    gallery = torch.tensor([[0.9, 0.4358899], [1.0, 0.0], [0.6, 0.8]])
    found = mean_average_precision(
        torch.tensor([[1.0, 0.0]]), gallery, torch.tensor([7]), gallery_objects=torch.tensor([3, 7, 7])
    )
    assert found == pytest.approx((1.0 + 2.0 / 3.0) / 2.0)


def test_mean_average_precision_is_that_of_each_query_by_itself():
    """With ties, as class means make them."""
    generator = torch.Generator().manual_seed(0)
    queries, gallery = (torch.randn(30, 3, generator=generator).round() + 0.1 for _ in range(2))
    objects = torch.arange(30) // 3
    cosine = F.normalize(queries.double(), dim=1) @ F.normalize(gallery.double(), dim=1).T
    each = [
        average_precision_score(objects == one, scores) for one, scores in zip(objects, cosine.numpy(), strict=True)
    ]
    assert mean_average_precision(queries, gallery, objects, objects) == pytest.approx(sum(each) / len(each), abs=1e-9)


def test_own_objects_in_front_are_all_and_strangers_chance():
    generator = torch.Generator().manual_seed(0)
    objects = torch.arange(40).repeat_interleave(5)
    own = torch.eye(40)[objects] + 0.01 * torch.randn(200, 40, generator=generator)
    assert mean_average_precision(own, own, objects, objects) == pytest.approx(1.0)
    noise = torch.randn(200, 40, generator=generator)
    assert mean_average_precision(noise, own, objects, objects) < 0.1


@pytest.mark.parametrize(("method", "least"), [("CCA", 0.99), ("PLSCA", 0.4)])  # PLS is drawn to what varies most
def test_what_two_views_share_is_found(method, least):
    generator = torch.Generator().manual_seed(0)
    shared = torch.randn(400, 4, generator=generator, dtype=torch.double)
    one, other = (shared @ torch.randn(4, width, generator=generator, dtype=torch.double) for width in (12, 8))
    pairs = (one[:200], other[:200], one[200:], other[200:])
    rows = torch.arange(200)
    assert mean_average_precision(*correlated(method, *pairs, components=4), rows, rows) > least
    strange = torch.randn(200, 8, generator=generator)
    assert mean_average_precision(*correlated(method, *pairs[:3], strange, components=4), rows, rows) < 0.1


def test_what_cannot_be_found_is_refused():
    rows = torch.arange(3)
    with pytest.raises(InvalidInputError, match="`gallery_objects` lacks"):
        mean_average_precision(torch.eye(3), torch.eye(3), rows + 1, rows)
    with pytest.raises(InvalidInputError, match="`top`"):
        retrieve(torch.eye(3), torch.eye(3), top=4)
    with pytest.raises(InvalidInputError, match="`queries`"):
        retrieve(torch.eye(2), torch.eye(3))
