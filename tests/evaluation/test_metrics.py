"""Metrics, probes and controls on values of which the answer is known, and against other implementations."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from sklearn.metrics import average_precision_score

from unitouch_gen.evaluation import metrics
from unitouch_gen.evaluation.controls import class_means, others, statistics, with_controls

LABELS = torch.arange(4).repeat(20)


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("count", [2, 3, 64])
def test_others_are_each_sample_once_and_never_the_same_one(count):
    rows = others(count)
    assert rows.sort().values.tolist() == list(range(count))
    assert not bool((rows == torch.arange(count)).any())


def test_class_means_are_those_of_each_class():
    values = random(80, 2, 3)
    means = class_means(values, LABELS)
    for label in range(4):
        expected = values[label == LABELS].mean(dim=0).expand(20, -1, -1)
        torch.testing.assert_close(means[label == LABELS], expected)
    torch.testing.assert_close(class_means(values, LABELS, torch.tensor([3, 1])), means[[3, 1]])


def test_controls_stand_beside_each_figure():
    values = random(80, 5)

    def measure(samples: torch.Tensor) -> dict[str, float]:
        return {"own": metrics.retrieval(samples, values, LABELS, size=16), "length": samples.norm().item()}

    found = with_controls(measure, {"value": values, "class_mean": class_means(values, LABELS), "ceiling": values})
    assert set(found) == {"own", "length"}
    assert found["own"]["value"] == found["own"]["ceiling"] == 1.0
    assert found["own"]["class_mean"] == pytest.approx(1 / 16)
    assert found["own"]["shuffled"] < 0.15
    assert found["length"]["shuffled"] == pytest.approx(found["length"]["value"])


def test_statistics_tell_how_strong_and_how_fine_a_change_is():
    flat = np.zeros((32, 32, 3))
    ramp = np.broadcast_to(np.arange(32.0)[:, None, None], (32, 32, 3))
    nothing, one, twice = statistics([flat, ramp, 2 * ramp])
    assert not nothing.any()
    np.testing.assert_allclose(twice, 2 * one)
    assert one[0] == pytest.approx(1.0)  # the mean gradient


def test_others_of_the_class_are_those_of_all_draws():
    # One of three rivals is nearer: where one is drawn it is that one in a third of all draws, of two in two thirds.
    gallery = torch.tensor([[1.0, 0.2], [1.0, 0.0], [0.0, 1.0], [0.0, -1.0], [1.0, 0.01]])
    labels = torch.tensor([0, 0, 0, 0, 1])
    query = torch.tensor([[1.0, 0.0]])
    for size, share in ((2, 2 / 3), (3, 1 / 3), (4, 0.0)):
        assert metrics.retrieval(query, gallery, labels, torch.tensor([0]), size=size) == pytest.approx(share)
    alike = torch.ones(80, 2)
    for first in (1, 5):
        assert metrics.retrieval(alike, alike, LABELS, size=8, first=first) == pytest.approx(first / 8)


def test_several_places_count_where_they_are_asked_for():
    # Rivals of the query at (1, 0) in the order of their distance; its own sample comes third.
    gallery = torch.tensor([[1.0, 0.3], [1.0, 0.1], [1.0, -0.2], [0.0, 1.0], [-1.0, 0.0]])
    query = torch.tensor([[1.0, 0.0]])
    row = torch.tensor([0])
    labels = torch.zeros(5, dtype=torch.int64)
    found = [metrics.retrieval(query, gallery, labels, row, size=5, first=first) for first in range(1, 6)]
    assert found == pytest.approx([0.0, 0.0, 1.0, 1.0, 1.0])


def test_mean_average_precision_is_scikit_learns():
    queries = random(30, 3)
    gallery = random(30, 3, seed=1)
    objects = torch.arange(30) // 3
    cosine = F.normalize(queries.double(), dim=1) @ F.normalize(gallery.double(), dim=1).T
    each = [average_precision_score(objects == one, row) for one, row in zip(objects, cosine.numpy(), strict=True)]
    assert metrics.mean_average_precision(queries, gallery, objects) == pytest.approx(np.mean(each), abs=1e-6)
    assert metrics.mean_average_precision(torch.eye(30), torch.eye(30)[objects * 3], objects) > 0.3
    assert metrics.mean_average_precision(torch.eye(30)[objects], torch.eye(30)[objects], objects) == pytest.approx(1.0)


@pytest.mark.parametrize(("method", "least"), [("CCA", 0.99), ("PLSCA", 0.4)])  # PLS is drawn to what varies most
def test_cca_and_plsca_find_what_two_views_share(method, least):
    shared = random(400, 4).double()
    one, other = (shared @ random(4, width, seed=width).double() for width in (12, 8))
    pairs = (one[:200], other[:200])
    rows = torch.arange(200)
    found = metrics.correlated(method, pairs, one[200:], other[200:], components=4)
    assert metrics.mean_average_precision(*found, rows) > least
    strange = metrics.correlated(method, pairs, one[200:], random(200, 8, seed=3), components=4)
    assert metrics.mean_average_precision(*strange, rows) < 0.1


def test_the_distance_of_gaussians_is_that_of_their_moments():
    seen = random(4000, 3).double()
    seen = seen - seen.mean(dim=0)
    white = seen @ torch.linalg.inv(torch.linalg.cholesky(torch.cov(seen.T))).T  # deviation 1, uncorrelated
    scale = torch.tensor([1.0, 2.0, 0.5]).double()
    shift = torch.tensor([0.0, 1.0, -2.0]).double()
    expected = (shift**2).sum() + ((scale - 1.0) ** 2).sum()
    assert metrics.frechet_distance(white * scale + shift, white) == pytest.approx(expected.item(), rel=1e-6)
    assert metrics.frechet_distance(white, white) == pytest.approx(0.0, abs=1e-6)


def clouds(count: int, spread: float, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Three classes around three corners."""
    labels = torch.arange(count) % 3
    return torch.eye(5)[labels] + spread * random(count, 5, seed=seed), labels


def test_classes_apart_are_all_told_and_noise_is_not():
    for count, spread, share in ((60, 0.05, 1.0), (600, 100.0, pytest.approx(1 / 3, abs=0.07))):
        (train, fitted), (val, chosen), (test, known) = (clouds(count, spread, seed) for seed in range(3))
        assert metrics.share_right(metrics.linear_probe(train, fitted, val, chosen, test), known) == share


def test_the_validation_split_chooses_the_penalty():
    """A feature that says the class in the training split alone is one not to lean on."""
    (train, fitted), (val, chosen), (test, known) = (clouds(90, 0.5, seed) for seed in range(3))
    leak = 3.0 * F.one_hot(fitted, 3)
    inputs = (torch.cat([train, leak], 1), fitted, torch.cat([val, torch.zeros(90, 3)], 1), chosen)
    assert metrics.share_right(metrics.linear_probe(*inputs, torch.cat([test, torch.zeros(90, 3)], 1)), known) > 0.5
