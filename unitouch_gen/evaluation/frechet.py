"""Distance of two sets of images as Gaussians of their features (Heusel et al., 2017)."""

import numpy as np
from scipy.linalg import eigvals
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
    first, second = (np.atleast_2d(np.cov(features, rowvar=False)) for features in (a, b))
    roots = np.sqrt(eigvals(first @ second).real.clip(0.0))  # of a product of two covariances: none is negative
    apart = a.mean(axis=0) - b.mean(axis=0)
    return max(float(apart @ apart + np.trace(first) + np.trace(second) - 2.0 * roots.sum()), 0.0)
