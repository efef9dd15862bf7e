"""Retrieval by cosine: across modalities (Section 4.3 of the paper), and of the true contact among those of its class,
which is what an embedding knows that the class does not say.
"""

import warnings

import numpy as np
import torch
import torch.nn.functional as F
from scipy.stats import hypergeom
from sklearn.cross_decomposition import CCA, PLSCanonical
from sklearn.exceptions import ConvergenceWarning
from sklearn.metrics import label_ranking_average_precision_score
from torch import Tensor

from unitouch_gen.errors import InvalidInputError, check_integer, check_tensor


def retrieval(
    queries: Tensor, gallery: Tensor, labels: Tensor, rows: Tensor | None = None, *, size: int = 64, top: int = 1
) -> float:
    """Expected share of queries whose own sample is among the `top` nearest of `size`, by cosine; chance is top / size.

    The other `size` - 1 are any of the same class; the expectation is over all their draws, so it has no seed. Samples
    that are equally near are as likely to come first.

    Args:
        queries: (Q, D).
        gallery: (N, D).
        labels: Of the gallery, int64 (N,).
        rows: The sample of each query in the gallery, int64 (Q,); the first is the first's, and so on, if left out.
        size: Samples that a query is compared to, its own among them; no class asked about may have fewer.
        top: How many count, below `size`.

    Raises:
        InvalidInputError, InvalidTypeError: If shapes or numbers do not fit, or a class has too few samples.
    """
    check_tensor("gallery", gallery, "N", "D")
    check_tensor("queries", queries, "Q", gallery.shape[1])
    check_integer("size", size, 2), check_integer("top", top, 1, size - 1)
    rows = torch.arange(len(queries)) if rows is None else rows
    few = int(torch.bincount(labels)[labels[rows]].min())
    if few < size:
        raise InvalidInputError(f"`size` is {size}, but a class has {few} samples; compare to no more.")
    cosine = F.normalize(queries.double(), dim=1) @ F.normalize(gallery.double(), dim=1).T
    rivals = labels[rows, None] == labels[None, :]
    rivals[torch.arange(len(rows)), rows] = False
    own = cosine[torch.arange(len(rows)), rows, None]
    nearer, equal = ((rivals & found).sum(dim=1).tolist() for found in (cosine > own, cosine == own))
    shares = []
    for before, ties, count in zip(nearer, equal, rivals.sum(dim=1).tolist(), strict=True):
        places = np.arange(before, before + ties + 1)  # how many come before, whichever way ties fall
        shares.append(hypergeom.cdf(top - 1, count, places, size - 1).mean())
    return float(np.mean(shares))


def retrieve(queries: Tensor, gallery: Tensor, top: int = 5) -> tuple[Tensor, Tensor]:
    """The rows of a gallery that are nearest to each query, best first.

    Args:
        queries: (Q, D), such as embeddings of touches.
        gallery: (N, D), such as embeddings of pictures, sounds or texts in the same space.
        top: How many, at most N.

    Returns:
        Rows of the gallery, int64 (Q, top), and their cosines, (Q, top).

    Raises:
        InvalidInputError, InvalidTypeError: If shapes or numbers do not fit.

    Example:
        >>> rows, cosines = retrieve(torch.eye(2), torch.tensor([[0.0, 2.0], [1.0, 0.0]]), top=1)
        >>> rows.tolist()
        [[1], [0]]
    """
    check_tensor("gallery", gallery, "N", "D")
    check_tensor("queries", queries, "Q", gallery.shape[1])
    check_integer("top", top, 1, len(gallery))
    best = (F.normalize(queries, dim=1) @ F.normalize(gallery, dim=1).T).topk(top, dim=1)
    return best.indices, best.values


def mean_average_precision(queries: Tensor, gallery: Tensor, objects: Tensor, gallery_objects: Tensor) -> float:
    """Mean over queries of the average precision of their rankings, where all of the same object count.

    That is how Gao et al., 2023, "The ObjectFolder Benchmark", have it.

    Args:
        queries: (Q, D).
        gallery: (N, D).
        objects: Of the queries, int64 (Q,); each has to be among the gallery's.
        gallery_objects: int64 (N,).

    Raises:
        InvalidInputError, InvalidTypeError: If shapes do not fit, or the gallery lacks an object.
    """
    check_tensor("gallery", gallery, "N", "D")
    check_tensor("queries", queries, "Q", gallery.shape[1])
    check_tensor("objects", objects, len(queries), integers=True)
    check_tensor("gallery_objects", gallery_objects, len(gallery), integers=True)
    relevant = (objects[:, None] == gallery_objects[None]).cpu().numpy()
    if not relevant.any(axis=1).all():
        raise InvalidInputError("`gallery_objects` lacks an object that is asked for; nothing could be found.")
    cosine = (F.normalize(queries.double(), dim=1) @ F.normalize(gallery.double(), dim=1).T).cpu().numpy()
    return float(label_ranking_average_precision_score(relevant, cosine))  # the same mean, of all queries at once


CORRELATED = {"CCA": CCA, "PLSCA": PLSCanonical}
"""scikit-learn's canonical correlation analysis (Hotelling, 1936) and partial least squares (Wegelin, 2000)."""

COMPONENTS = 10


def correlated(
    method: str, one: Tensor, other: Tensor, queries: Tensor, gallery: Tensor, components: int = COMPONENTS
) -> tuple[Tensor, Tensor]:
    """Queries and gallery in the space in which pairs of two modalities correlate most.

    Args:
        method: "CCA" or "PLSCA".
        one, other: Features of pairs that it is fitted to, (M, D) and (M, E).
        queries: Of the first modality, (Q, D).
        gallery: Of the other, (N, E).
        components: Of the space, at most.

    Returns:
        (Q, K) and (N, K), whose components have unit variance over the pairs, so that cosines compare the two.
    """
    count = min(components, one.shape[1], other.shape[1], len(one) - 1)
    fitted = CORRELATED[method](n_components=count, max_iter=500)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        fitted.fit(one.double().cpu().numpy(), other.double().cpu().numpy())
    pairs = fitted.transform(one.double().cpu().numpy(), other.double().cpu().numpy())
    found = fitted.transform(queries.double().cpu().numpy(), np.zeros((len(queries), other.shape[1])))[0]
    stored = fitted.transform(np.zeros((len(gallery), one.shape[1])), gallery.double().cpu().numpy())[1]
    return _in_deviations(found, pairs[0]), _in_deviations(stored, pairs[1])


def _in_deviations(scores: np.ndarray, fitted: np.ndarray) -> Tensor:
    """Scores (N, K) in units of the deviations of those fitted (M, K); components that do not vary say nothing."""
    spread = fitted.std(axis=0)
    varies = spread > 1e-9 * spread.max(initial=1e-9)
    return torch.from_numpy(np.where(varies, scores / np.where(varies, spread, 1.0), 0.0))
