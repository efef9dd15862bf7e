"""Retrieval of the true contact among those of the same class: what an embedding knows that the class does not say."""

import numpy as np
import torch
import torch.nn.functional as F
from scipy.stats import hypergeom
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
