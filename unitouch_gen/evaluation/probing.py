"""Linear probes: what can be read off frozen features by a linear map (Section 4.1 of the paper)."""

import warnings
from collections.abc import Mapping

import numpy as np
import torch
from sklearn.exceptions import ConvergenceWarning
from sklearn.linear_model import LogisticRegression, RidgeCV
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from torch import Tensor

from unitouch_gen.errors import InvalidInputError, check_tensor

INVERSE_STRENGTHS = (1e-3, 1e-2, 1e-1, 1.0)
"""Inverse penalties of logistic regressions, scikit-learn's C; the validation split chooses."""

STRENGTHS = (1e-1, 1.0, 1e1, 1e2, 1e3)
"""Penalties of ridge regressions that leave objects out; the best is taken for everyone alike."""

ITERATIONS = 300


def linear_probe(
    train: Tensor, labels: Tensor, val: Tensor, val_labels: Tensor, test: Tensor, *, balanced: bool = False
) -> Tensor:
    """Classes (N,) of `test` by logistic regression on standardised features.

    Args:
        train, val, test: Features, (M, D), (K, D) and (N, D).
        labels, val_labels: Classes of the first two, int64 (M,) and (K,). The penalty is chosen by `val`.
        balanced: Whether classes weigh alike, however many samples they have, and are counted so.

    Raises:
        InvalidInputError, InvalidTypeError: If shapes do not fit, or there is a single class.
    """
    for name, features, known in (("train", train, labels), ("val", val, val_labels)):
        check_tensor(name, features, "N", train.shape[1]), check_tensor("labels", known, len(features), integers=True)
    check_tensor("test", test, "N", train.shape[1])
    if len(labels.unique()) < 2:
        raise InvalidInputError("`labels` are all the same; a probe tells one class from another, so pass two or more.")
    x, y, best = train.double().cpu().numpy(), labels.cpu().numpy(), (-1.0, test.new_zeros(len(test)))
    for strength in INVERSE_STRENGTHS:
        weight = "balanced" if balanced else None
        probe = make_pipeline(
            StandardScaler(), LogisticRegression(C=strength, max_iter=ITERATIONS, class_weight=weight)
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)  # an early end is a penalty, too
            probe.fit(x, y)
        right = share_right(torch.from_numpy(probe.predict(val.double().cpu().numpy())), val_labels, balanced=balanced)
        if right > best[0]:
            best = (right, torch.from_numpy(probe.predict(test.double().cpu().numpy())))
    return best[1]


def regressed(one: Tensor, other: Tensor, queries: Tensor) -> Tensor:
    """What pairs say of another modality: its features (Q, E) by ridge regression on standardised features.

    Args:
        one, other: Features of pairs, (M, D) and (M, E); leaving one out chooses the penalty.
        queries: Of the first modality, (Q, D).
    """
    fitted = make_pipeline(StandardScaler(), RidgeCV(alphas=np.logspace(-1, 5, 13)))
    fitted.fit(one.double().cpu().numpy(), other.double().cpu().numpy())
    return torch.from_numpy(fitted.predict(queries.double().cpu().numpy())).float()


def share_right(predicted: Tensor, labels: Tensor, *, balanced: bool = False) -> float:
    """Share of classes (N,) that are the labels (N,); the mean of this over the classes that there are, if balanced."""
    right = (predicted.cpu() == labels.cpu()).double()
    parts = [right[labels.cpu() == number] for number in labels.cpu().unique()] if balanced else [right]
    return torch.stack([part.mean() for part in parts]).mean().item()


def object_probe(features: np.ndarray, labels: np.ndarray, objects: np.ndarray) -> np.ndarray:
    """Classes (N,) of few samples by ridge regression onto one-hot labels weighted by class.

    Each object is predicted from the others.

    Args:
        features: (N, D).
        labels: int64 (N,), from 0.
        objects: What is left out together, (N,).

    Raises:
        InvalidInputError: If there are fewer than two classes or objects.
    """
    check_probed(labels, objects)
    names, classes = np.unique(objects), int(labels.max(initial=0)) + 1
    standard = (features - features.mean(axis=0)) / (features.std(axis=0) + 1e-6)
    x, best = np.c_[standard, np.ones(len(standard))], (-1.0, labels)
    for strength in STRENGTHS:
        predicted = np.zeros(len(labels), dtype=int)
        for name in names:
            train = objects != name
            counts = np.bincount(labels[train], minlength=classes)
            weighted = (x[train] / counts[labels[train]][:, None]).T
            solved = np.linalg.solve(
                weighted @ x[train] + strength / len(labels) * np.eye(x.shape[1]),
                weighted @ np.eye(classes)[labels[train]],
            )
            predicted[~train] = (x[~train] @ solved).argmax(axis=1)
        best = max(best, (_balanced(predicted, labels), predicted), key=lambda found: found[0])
    return best[1]


def check_probed(labels: np.ndarray, objects: np.ndarray, named: str = "`labels` are") -> None:
    """Refuses labels (N,) of fewer than two classes, or objects (N,) of fewer than two.

    Raises:
        InvalidInputError: If they are; the message begins with what they are `named`.
    """
    classes, count = len(np.unique(labels)), len(np.unique(objects))
    if classes < 2 or count < 2:
        raise InvalidInputError(
            f"{named} of {classes} classes and {count} objects; a probe that leaves objects out needs two of each."
        )


def object_probes(
    features: np.ndarray, truth: Mapping[str, np.ndarray], objects: np.ndarray, draws: int = 200
) -> dict[str, float]:
    """Balanced accuracy of several labels by `object_probe`, and "mean" of all, with its "deviation" over draws of
    objects (Efron, 1979).

    Args:
        features: (N, D).
        truth: By name, int64 (N,).
        objects: (N,).
        draws: Of as many objects, with replacement.
    """
    predictions = {name: object_probe(features, labels, objects) for name, labels in truth.items()}
    rng, names, means = np.random.default_rng(0), np.unique(objects), []
    rows_of = {name: np.flatnonzero(objects == name) for name in names}
    for _ in range(draws):
        rows = np.concatenate([rows_of[name] for name in rng.choice(names, len(names))])
        means.append(np.mean([_balanced(predictions[name][rows], truth[name][rows]) for name in truth]))
    shares = {name: _balanced(predictions[name], truth[name]) for name in truth}
    return {**shares, "mean": float(np.mean(list(shares.values()))), "deviation": float(np.std(means))}


def _balanced(predicted: np.ndarray, labels: np.ndarray) -> float:
    return share_right(torch.from_numpy(predicted), torch.from_numpy(labels), balanced=True)
