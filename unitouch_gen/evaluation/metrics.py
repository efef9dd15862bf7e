"""Metrics of embeddings: retrieval, canonical correlation, Frechet distance, and linear probes."""

import warnings

import numpy as np
import torch
import torch.nn.functional as F
from scipy.stats import hypergeom
from sklearn.cross_decomposition import CCA, PLSCanonical
from sklearn.exceptions import ConvergenceWarning
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import accuracy_score, balanced_accuracy_score, label_ranking_average_precision_score
from sklearn.model_selection import GridSearchCV, PredefinedSplit
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from torch import Tensor

FOREIGN_CLASSES = "y_pred contains classes not in y_true"  # scikit-learn's warning; such predictions are wrong ones


def cosines(queries: Tensor, gallery: Tensor) -> Tensor:
    """Cosines of queries (Q, D) and a gallery (N, D), float64 (Q, N)."""
    return F.normalize(queries.double(), dim=1) @ F.normalize(gallery.double(), dim=1).T


def retrieval(
    queries: Tensor, gallery: Tensor, labels: Tensor, rows: Tensor | None = None, *, size: int = 64, first: int = 1
) -> float:
    """Expected share of queries whose own sample is among the `first` nearest, by cosine, of `size`.

    Chance is first / size.

    The other `size` - 1 samples are of the same class, so no class may have fewer samples. The expectation is over all
    choices of them, so it has no seed. Ties are broken in all ways with equal probability.

    Args:
        queries, gallery: (Q, D) and (N, D).
        labels: Of the gallery, int64 (N,).
        rows: Row of each query's own sample in the gallery, int64 (Q,); 0, 1, 2 and so on if left out.
        size: Samples that are ranked, the own one among them.
        first: Places that count; 1 is the nearest alone.
    """
    rows = torch.arange(len(queries)) if rows is None else rows
    cosine = cosines(queries, gallery)
    is_rival = labels[rows, None] == labels[None, :]  # (Q, N)
    is_rival[torch.arange(len(rows)), rows] = False
    own = cosine.gather(1, rows[:, None])
    nearer = (is_rival & (cosine > own)).sum(dim=1).tolist()
    equal = (is_rival & (cosine == own)).sum(dim=1).tolist()
    rivals = is_rival.sum(dim=1).tolist()
    probabilities = []
    for nearer_rivals, ties, count in zip(nearer, equal, rivals, strict=True):
        ranked_before = np.arange(nearer_rivals, nearer_rivals + ties + 1)  # for every way that ties are broken
        fewer_are_chosen = hypergeom.cdf(first - 1, count, ranked_before, size - 1)
        probabilities.append(fewer_are_chosen.mean())
    return float(np.mean(probabilities))


def mean_average_precision(queries: Tensor, gallery: Tensor, objects: Tensor) -> float:
    """Mean average precision of a gallery ranked by cosine; all contacts of a query's object are relevant.

    Queries and gallery are (N, D), of the same N contacts (Gao et al., 2023, "The ObjectFolder Benchmark").
    """
    relevant = (objects[:, None] == objects[None]).cpu().numpy()
    return float(label_ranking_average_precision_score(relevant, cosines(queries, gallery).cpu().numpy()))


CORRELATED = {"CCA": CCA, "PLSCA": PLSCanonical}  # Hotelling, 1936; Wegelin, 2000


def correlated(
    method: str, pairs: tuple[Tensor, Tensor], queries: Tensor, gallery: Tensor, components: int = 10
) -> tuple[Tensor, Tensor]:
    """Queries (Q, D) and gallery (N, E) in the K-dimensional space in which pairs (M, D) and (M, E) correlate most.

    The components have unit variance over the pairs, so that cosines can compare the two.
    """
    first = _array(pairs[0])
    second = _array(pairs[1])
    dimensions = min(components, first.shape[1], second.shape[1], len(first) - 1)
    model = CORRELATED[method](dimensions, max_iter=500)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        model.fit(first, second)
    first_pairs, second_pairs = model.transform(first, second)
    query_components, gallery_components = model.transform(_array(queries), _array(gallery))
    query_components = query_components / _scale(first_pairs)
    gallery_components = gallery_components / _scale(second_pairs)
    return torch.from_numpy(query_components), torch.from_numpy(gallery_components)


def _array(features: Tensor) -> np.ndarray:
    return features.double().cpu().numpy()


def _scale(components: np.ndarray) -> np.ndarray:
    """Deviations of components (M, K); infinite for a component that does not vary, so that it becomes 0."""
    deviation = components.std(axis=0)
    return np.where(deviation > 1e-9 * deviation.max(), deviation, np.inf)


def frechet_distance(one: Tensor, other: Tensor) -> float:
    """||m1 - m2||^2 + Tr(C1 + C2 - 2 (C1 C2)^(1/2)) of features (N, D) and (M, D) (Heusel et al., 2017).

    Distances are comparable at equal N and M only. torchmetrics' function takes images, and its product of covariances
    is singular if there are fewer samples than features.
    """
    first = _array(one)
    second = _array(other)
    # Tr (C1 C2)^(1/2) is the sum of the singular values of R1 R2', where R1' R1 = C1 and R2' R2 = C2.
    first_root = _covariance_root(first)
    second_root = _covariance_root(second)
    singular_values = np.linalg.svd(first_root @ second_root.T, compute_uv=False)
    between = first.mean(axis=0) - second.mean(axis=0)
    traces = np.square(first_root).sum() + np.square(second_root).sum()
    return max(float(between @ between + traces - 2.0 * singular_values.sum()), 0.0)


def _covariance_root(features: np.ndarray) -> np.ndarray:
    """R with R' R the covariance of features (N, D)."""
    centred = features - features.mean(axis=0)
    return np.linalg.qr(centred, mode="r") / np.sqrt(len(features) - 1)


def linear_probe(
    train: Tensor, labels: Tensor, val: Tensor, val_labels: Tensor, test: Tensor, *, balanced: bool = False
) -> Tensor:
    """Classes (N,) of `test` by logistic regression on standardised features; `val` chooses the penalty (Sec. 4.1).

    Features are (M, D), (K, D) and (N, D), labels int64 (M,) and (K,). With `balanced`, classes have equal weights.
    """
    grid = {"logisticregression__C": (1e-3, 1e-2, 1e-1, 1.0)}
    regression = LogisticRegression(max_iter=300, class_weight="balanced" if balanced else None)
    split = PredefinedSplit([-1] * len(train) + [0] * len(val))
    scoring = "balanced_accuracy" if balanced else "accuracy"
    probe = GridSearchCV(make_pipeline(StandardScaler(), regression), grid, scoring=scoring, cv=split)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # early stopping regularises, too
        warnings.filterwarnings("ignore", message=FOREIGN_CLASSES)
        probe.fit(torch.cat([train, val]).double().numpy(), torch.cat([labels, val_labels]).numpy())
    return torch.from_numpy(probe.predict(test.double().numpy()))


def share_right(predicted: Tensor, labels: Tensor, *, balanced: bool = False) -> float:
    """Accuracy of classes (N,) against labels (N,); with `balanced` the mean over the labels' classes."""
    score = balanced_accuracy_score if balanced else accuracy_score
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=FOREIGN_CLASSES)
        return float(score(labels.cpu().numpy(), predicted.cpu().numpy()))
