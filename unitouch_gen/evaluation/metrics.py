"""Metrics of embeddings: retrieval, canonical correlation, and the distance of two sets; linear probes."""

import warnings

import numpy as np
import torch
import torch.nn.functional as F
from scipy.stats import hypergeom
from sklearn.cross_decomposition import CCA, PLSCanonical
from sklearn.exceptions import ConvergenceWarning
from sklearn.linear_model import LogisticRegression, RidgeCV
from sklearn.metrics import accuracy_score, balanced_accuracy_score, label_ranking_average_precision_score
from sklearn.model_selection import GridSearchCV, PredefinedSplit
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from torch import Tensor
from torchmetrics.functional.classification import multiclass_calibration_error

# Retrieval ------------------------------------------------------------------------------------------------------------


def retrieve(queries: Tensor, gallery: Tensor, top: int = 5) -> tuple[Tensor, Tensor]:
    """Rows of a gallery (N, D) nearest to each query (Q, D), best first, and their cosines, (Q, top) each.

    Example:
        >>> rows, cosines = retrieve(torch.eye(2), torch.tensor([[0.0, 2.0], [1.0, 0.0]]), top=1)
        >>> rows.tolist()
        [[1], [0]]
    """
    best = _cosines(queries, gallery).topk(top, dim=1)
    return best.indices, best.values


def retrieval(queries: Tensor, gallery: Tensor, labels: Tensor, rows: Tensor | None = None, *, size: int = 64) -> float:
    """Expected share of queries that are nearest, by cosine, to their own sample among `size`; chance is 1 / size.

    The other `size` - 1 are of the same class. The expectation is over all their draws, so it has no seed. Samples
    that are equally near are as likely to come first.

    Args:
        queries: (Q, D).
        gallery: (N, D).
        labels: Of the gallery, int64 (N,).
        rows: The sample of each query in the gallery, int64 (Q,); the first is the first's, and so on, if left out.
        size: Samples that a query is compared to, its own among them; no class asked about may have fewer.
    """
    rows = torch.arange(len(queries)) if rows is None else rows
    place, cosine = torch.arange(len(rows)), _cosines(queries, gallery)
    rivals = labels[rows, None] == labels[None, :]
    rivals[place, rows] = False
    own = cosine[place, rows, None]
    nearer, equal = ((rivals & found).sum(dim=1).tolist() for found in (cosine > own, cosine == own))
    shares = []
    for before, ties, count in zip(nearer, equal, rivals.sum(dim=1).tolist(), strict=True):
        places = np.arange(before, before + ties + 1)  # how many come before, whichever way ties fall
        shares.append(hypergeom.cdf(0, count, places, size - 1).mean())  # that none of these is drawn
    return float(np.mean(shares))


def mean_average_precision(queries: Tensor, gallery: Tensor, objects: Tensor) -> float:
    """Mean average precision of a gallery ranked by cosine, where all contacts of a query's object count.

    That is how Gao et al. (2023), "The ObjectFolder Benchmark", have it. Both are (N, D), of the same N contacts.
    """
    relevant = (objects[:, None] == objects[None]).cpu().numpy()
    return float(label_ranking_average_precision_score(relevant, _cosines(queries, gallery).cpu().numpy()))


def _cosines(queries: Tensor, gallery: Tensor) -> Tensor:
    return F.normalize(queries.double(), dim=1) @ F.normalize(gallery.double(), dim=1).T


CORRELATED = {"CCA": CCA, "PLSCA": PLSCanonical}
"""Canonical correlation analysis (Hotelling, 1936) and partial least squares (Wegelin, 2000)."""


def correlated(
    method: str, pairs: tuple[Tensor, Tensor], queries: Tensor, gallery: Tensor, components: int = 10
) -> tuple[Tensor, Tensor]:
    """Queries (Q, D) and gallery (N, E) in the space in which pairs (M, D) and (M, E) correlate most.

    Returns:
        (Q, K) and (N, K), whose components have unit variance over the pairs, so that cosines compare the two.
    """
    one, other, asked, stored = (part.double().cpu().numpy() for part in (*pairs, queries, gallery))
    fitted = CORRELATED[method](min(components, one.shape[1], other.shape[1], len(one) - 1), max_iter=500)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        fitted.fit(one, other)
    found = fitted.transform(asked, np.zeros((len(asked), other.shape[1])))[0]
    found_in = fitted.transform(np.zeros((len(stored), one.shape[1])), stored)[1]
    deviations = [side.std(axis=0) for side in fitted.transform(one, other)]
    # A component that does not vary over the pairs says nothing.
    scales = [np.where(each > 1e-9 * each.max(), 1.0 / np.maximum(each, 1e-300), 0.0) for each in deviations]
    return torch.from_numpy(found * scales[0]), torch.from_numpy(found_in * scales[1])


def frechet_distance(one: Tensor, other: Tensor) -> float:
    """||m1 - m2||^2 + Tr(C1 + C2 - 2 (C1 C2)^(1/2)) of features (N, D) and (M, D) (Heusel et al., 2017).

    It falls with N and M, so only distances of as many samples compare, and those of one network. torchmetrics' takes
    images, and the root of a product that is singular where there are fewer samples than features.
    """
    a, b = (features.double().cpu().numpy() for features in (one, other))
    # Tr (C1 C2)^(1/2) is the sum of singular values of A B', where A' A = C1 and B' B = C2.
    first, second = (np.linalg.qr(part - part.mean(axis=0), mode="r") / np.sqrt(len(part) - 1) for part in (a, b))
    roots = np.linalg.svd(first @ second.T, compute_uv=False)
    apart = a.mean(axis=0) - b.mean(axis=0)
    return max(float(apart @ apart + np.square(first).sum() + np.square(second).sum() - 2.0 * roots.sum()), 0.0)


# Linear probes (Section 4.1 of the paper) -----------------------------------------------------------------------------


def linear_probe(
    train: Tensor, labels: Tensor, val: Tensor, val_labels: Tensor, test: Tensor, *, balanced: bool = False
) -> Tensor:
    """Classes (N,) of `test` by logistic regression on standardised features, whose penalty `val` chooses.

    Features are (M, D), (K, D) and (N, D), labels int64 (M,) and (K,); `balanced` classes weigh alike.
    """
    strengths = {"logisticregression__C": (1e-3, 1e-2, 1e-1, 1.0)}
    regression = LogisticRegression(max_iter=300, class_weight="balanced" if balanced else None)
    split = PredefinedSplit([-1] * len(train) + [0] * len(val))
    score = "balanced_accuracy" if balanced else "accuracy"
    probe = GridSearchCV(make_pipeline(StandardScaler(), regression), strengths, scoring=score, cv=split)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # an early end is a penalty, too
        probe.fit(torch.cat([train, val]).double().numpy(), torch.cat([labels, val_labels]).numpy())
    return torch.from_numpy(probe.predict(test.double().numpy()))


def regressed(one: Tensor, other: Tensor, queries: Tensor) -> Tensor:
    """Another modality's features (Q, E) of queries (Q, D), by ridge regression over pairs (M, D) and (M, E)."""
    fitted = make_pipeline(StandardScaler(), RidgeCV(np.logspace(-1, 5, 13)))
    fitted.fit(one.double().cpu().numpy(), other.double().cpu().numpy())
    return torch.from_numpy(fitted.predict(queries.double().cpu().numpy())).float()


def share_right(predicted: Tensor, labels: Tensor, *, balanced: bool = False) -> float:
    """Share of classes (N,) that are the labels (N,), or its mean over the labels' classes, if balanced."""
    score = balanced_accuracy_score if balanced else accuracy_score
    return float(score(labels.cpu().numpy(), predicted.cpu().numpy()))


def calibration_error(probabilities: Tensor, labels: Tensor) -> float:
    """Mean gap between confidence and accuracy over 15 bins of confidence (Guo et al., 2017, Eq. 3)."""
    return multiclass_calibration_error(probabilities, labels, probabilities.shape[1], n_bins=15).item()
