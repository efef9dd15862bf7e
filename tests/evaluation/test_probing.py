"""Linear probes against scikit-learn, and against what can be told by construction."""

import numpy as np
import pytest
import torch
from sklearn.linear_model import Ridge
from sklearn.metrics import balanced_accuracy_score
from sklearn.model_selection import LeaveOneGroupOut

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.evaluation import probing
from unitouch_gen.evaluation.probing import linear_probe, object_probe, object_probes, regressed, share_right


def clouds(count: int, spread: float, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Three classes around three corners."""
    generator = torch.Generator().manual_seed(seed)
    labels = torch.arange(count) % 3
    return torch.eye(5)[labels] + spread * torch.randn(count, 5, generator=generator), labels


def test_classes_apart_are_all_told_and_noise_is_not():
    (train, fitted), (val, chosen), (test, known) = (clouds(60, 0.05, seed) for seed in range(3))
    assert share_right(linear_probe(train, fitted, val, chosen, test), known) == 1.0
    (train, fitted), (val, chosen), (test, known) = (clouds(600, 100.0, seed) for seed in range(3))
    assert share_right(linear_probe(train, fitted, val, chosen, test), known) == pytest.approx(1 / 3, abs=0.07)


def test_the_validation_split_chooses_the_penalty():
    """A feature that says the class in the training split alone is one not to lean on."""
    (train, fitted), (val, chosen), (test, known) = (clouds(90, 0.5, seed) for seed in range(3))
    leak = 3.0 * torch.nn.functional.one_hot(fitted, 3)
    inputs = (torch.cat([train, leak], 1), fitted, torch.cat([val, torch.zeros(90, 3)], 1), chosen)
    asked = torch.cat([test, torch.zeros(90, 3)], 1)
    whole = share_right(linear_probe(*inputs, asked), known)
    assert whole > 0.5


@pytest.mark.parametrize("balanced", [True, False])
def test_shares_are_scikit_learns(balanced):
    generator = torch.Generator().manual_seed(0)
    labels, predicted = (torch.randint(3, (50,), generator=generator) ** 2 for _ in range(2))
    expected = balanced_accuracy_score(labels, predicted) if balanced else (labels == predicted).float().mean().item()
    assert share_right(predicted, labels, balanced=balanced) == pytest.approx(expected)


def test_an_object_is_predicted_from_the_others_as_by_scikit_learn(monkeypatch):
    rng = np.random.default_rng(0)
    labels, objects = rng.integers(0, 3, 60), np.repeat(np.arange(12), 5)
    features = np.eye(3)[labels] + 0.7 * rng.standard_normal((60, 3))
    monkeypatch.setattr(probing, "STRENGTHS", (10.0,))
    standard = (features - features.mean(axis=0)) / (features.std(axis=0) + 1e-6)
    x = np.c_[standard, np.ones(60)]
    expected = np.zeros(60, dtype=int)
    for train, test in LeaveOneGroupOut().split(x, labels, objects):
        ridge = Ridge(alpha=10.0 / 60, fit_intercept=False)
        ridge.fit(x[train], np.eye(3)[labels[train]], sample_weight=1 / np.bincount(labels[train])[labels[train]])
        expected[test] = ridge.predict(x[test]).argmax(axis=1)
    np.testing.assert_array_equal(object_probe(features, labels, objects), expected)


def test_what_an_object_alone_gives_away_helps_nobody():
    """Labels that hold within an object, and features that name the object."""
    objects = np.repeat(np.arange(20), 6)
    labels = np.random.default_rng(1).integers(0, 2, 20)[objects]
    found = object_probes(np.eye(20)[objects], {"one": labels, "other": 1 - labels}, objects)
    assert set(found) == {"one", "other", "mean", "deviation"}
    assert found["mean"] < 0.6


def test_regression_is_ridge_of_the_penalty_that_leaving_one_out_prefers():
    rng = np.random.default_rng(0)
    one = rng.normal(size=(80, 5)) * [1, 10, 0.1, 3, 1] + 7
    other = one @ rng.normal(size=(5, 3)) + rng.normal(size=(80, 3))
    queries = rng.normal(size=(4, 5)) + 7
    found = regressed(*(torch.from_numpy(part) for part in (one, other, queries)))
    scaled, asked = ((part - one.mean(0)) / one.std(0) for part in (one, queries))
    left = {}
    for alpha in np.logspace(-1, 5, 13):
        rows = [np.delete(np.arange(80), row) for row in range(80)]
        off = [other[row] - Ridge(alpha=alpha).fit(scaled[kept], other[kept]).predict(scaled[row : row + 1])[0]
               for row, kept in enumerate(rows)]  # fmt: skip
        left[alpha] = np.square(off).mean()
    best = Ridge(alpha=min(left, key=left.get)).fit(scaled, other)
    torch.testing.assert_close(found, torch.from_numpy(best.predict(asked)).float(), atol=1e-4, rtol=1e-4)


def test_a_single_class_or_object_is_refused():
    with pytest.raises(InvalidInputError, match="`labels` are all the same"):
        linear_probe(*[torch.randn(4, 2), torch.zeros(4, dtype=torch.long)] * 2, torch.randn(1, 2))
    for labels, objects in ((np.zeros(4, int), np.arange(4)), (np.arange(4) % 2, np.zeros(4, int))):
        with pytest.raises(InvalidInputError, match="two of each"):
            object_probe(np.eye(4), labels, objects)
