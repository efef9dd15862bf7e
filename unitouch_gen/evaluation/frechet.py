"""Distance of two sets of images as Gaussians of their features (Heusel et al., 2017)."""

import numpy as np
from torch import Tensor

from unitouch_gen.errors import InvalidInputError, check_tensor


def frechet_distance(one: Tensor, other: Tensor) -> float:
    """||m1 - m2||^2 + Tr(C1 + C2 - 2 (C1 C2)^(1/2)) (Dowson & Landau, 1982) of features (N, D) and (M, D).

    It falls with N and M, so only distances of as many samples compare, and those of one network.

    Raises:
        InvalidInputError, InvalidTypeError: If they are no such tensors, or of a single sample.
    """
    check_tensor("one", one, "N", "D")
    check_tensor("other", other, "M", one.shape[1])
    if min(len(one), len(other)) < 2:
        raise InvalidInputError(f"`one` and `other` have {len(one)} and {len(other)} rows; two of each are the least.")
    a, b = (features.double().cpu().numpy() for features in (one, other))
    # Tr (C1 C2)^(1/2) is the sum of singular values of A B', where A' A = C1 and B' B = C2.
    first, second = (
        np.linalg.qr(features - features.mean(axis=0), mode="r") / np.sqrt(len(features) - 1) for features in (a, b)
    )
    roots = np.linalg.svd(first @ second.T, compute_uv=False)
    apart = a.mean(axis=0) - b.mean(axis=0)
    spread = np.square(first).sum() + np.square(second).sum()
    return max(float(apart @ apart + spread - 2.0 * roots.sum()), 0.0)
