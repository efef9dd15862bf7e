"""Metrics of embeddings: retrieval, canonical correlation, and the distance of two sets; linear probes."""

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


def cosines(queries: Tensor, gallery: Tensor) -> Tensor:
    """Of queries (Q, D) and a gallery (N, D) of any lengths, float64 (Q, N)."""
    return F.normalize(queries.double(), dim=1) @ F.normalize(gallery.double(), dim=1).T


def retrieval(queries: Tensor, gallery: Tensor, labels: Tensor, rows: Tensor | None = None, *, size: int = 64) -> float:
    """Expected share of queries that are nearest, by cosine, to their own sample among `size`; chance is 1 / size.

    The other `size` - 1 are of the same class, of which none may have fewer. The expectation is over all draws of them,
    so it has no seed. Samples that are equally near are as likely to come first.

    Args:
        queries, gallery: (Q, D) and (N, D).
        labels: Of the gallery, int64 (N,).
        rows: Row of each query's own sample in the gallery, int64 (Q,); 0, 1, 2 and so on if left out.
    """
    rows = torch.arange(len(queries)) if rows is None else rows
    cosine = cosines(queries, gallery)
    rivals = labels[rows, None] == labels[None, :]  # (Q, N)
    rivals[torch.arange(len(rows)), rows] = False
    own = cosine.gather(1, rows[:, None])
    nearer, equal = ((rivals & found).sum(dim=1).tolist() for found in (cosine > own, cosine == own))
    shares = []
    for before, ties, count in zip(nearer, equal, rivals.sum(dim=1).tolist(), strict=True):
        ahead = np.arange(before, before + ties + 1)  # rivals that come first, whichever way ties fall
        shares.append(hypergeom.cdf(0, count, ahead, size - 1).mean())  # none of them is drawn
    return float(np.mean(shares))


def mean_average_precision(queries: Tensor, gallery: Tensor, objects: Tensor) -> float:
    """Mean average precision of a gallery ranked by cosine; all contacts of a query's object count as found.

    Queries and gallery are (N, D), of the same N contacts (Gao et al., 2023, "The ObjectFolder Benchmark").
    """
    relevant = (objects[:, None] == objects[None]).cpu().numpy()
    return float(label_ranking_average_precision_score(relevant, cosines(queries, gallery).cpu().numpy()))


CORRELATED = {"CCA": CCA, "PLSCA": PLSCanonical}  # Hotelling, 1936; Wegelin, 2000


def correlated(
    method: str, pairs: tuple[Tensor, Tensor], queries: Tensor, gallery: Tensor, components: int = 10
) -> tuple[Tensor, Tensor]:
    """Queries (Q, D) and gallery (N, E) in the space in which pairs (M, D) and (M, E) correlate most, K-dimensional.

    Its components have unit variance over the pairs, so that cosines compare the two.
    """
    one, other, asked, stored = (part.double().cpu().numpy() for part in (*pairs, queries, gallery))
    fitted = CORRELATED[method](min(components, one.shape[1], other.shape[1], len(one) - 1), max_iter=500)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        fitted.fit(one, other)
    deviations = [side.std(axis=0) for side in fitted.transform(one, other)]
    # A component that does not vary over the pairs says nothing: it is set to 0.
    scales = [np.where(each > 1e-9 * each.max(), each, np.inf) for each in deviations]
    found, found_in = (side / scale for side, scale in zip(fitted.transform(asked, stored), scales, strict=True))
    return torch.from_numpy(found), torch.from_numpy(found_in)


def frechet_distance(one: Tensor, other: Tensor) -> float:
    """||m1 - m2||^2 + Tr(C1 + C2 - 2 (C1 C2)^(1/2)) of features (N, D) and (M, D) (Heusel et al., 2017).

    Distances compare at equal N and M only. torchmetrics' takes images, and a product that is singular where there are
    fewer samples than features.
    """
    a, b = (features.double().cpu().numpy() for features in (one, other))
    # Tr (C1 C2)^(1/2) is the sum of singular values of A B', where A' A = C1 and B' B = C2.
    first, second = (np.linalg.qr(part - part.mean(axis=0), mode="r") / np.sqrt(len(part) - 1) for part in (a, b))
    roots = np.linalg.svd(first @ second.T, compute_uv=False)
    apart = a.mean(axis=0) - b.mean(axis=0)
    return max(float(apart @ apart + np.square(first).sum() + np.square(second).sum() - 2.0 * roots.sum()), 0.0)


def linear_probe(
    train: Tensor, labels: Tensor, val: Tensor, val_labels: Tensor, test: Tensor, *, balanced: bool = False
) -> Tensor:
    """Classes (N,) of `test` by logistic regression on standardised features, whose penalty `val` chooses (Sec. 4.1).

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


def share_right(predicted: Tensor, labels: Tensor, *, balanced: bool = False) -> float:
    """Share of classes (N,) that are the labels (N,), or its mean over the labels' classes, if balanced."""
    score = balanced_accuracy_score if balanced else accuracy_score
    return float(score(labels.cpu().numpy(), predicted.cpu().numpy()))
