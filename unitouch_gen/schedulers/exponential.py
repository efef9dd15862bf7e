"""Exponential integration of the probability-flow ODE in log sigma.

With lambda = -log sigma the ODE reads dx/dlambda = D - x, linear but for the data prediction D (Lu et al., 2022,
Section 3.2, in the variance-exploding frame), so that over a step of h

    x(lambda + h) = e^-h x(lambda) + integral from 0 to h of e^-(h - tau) D(lambda + tau) dtau.

Where D is the polynomial through its values at some nodes, the integral is a weighted sum of these.
"""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from torch import Tensor

SAME_LEVEL = 1e-5
"""Noise levels that differ by less than this share are one: Heun's two evaluations at the end of a step."""


def weights(step: float, nodes: Sequence[float]) -> list[float]:
    """Weights of D at each node in the integral over a step.

    Args:
        step: h > 0.
        nodes: tau of each, distinct; 0 is where the step begins, h where it ends.

    Returns:
        As many numbers; they sum to 1 - e^-h.
    """
    return list(_weights(step, tuple(nodes)))


@lru_cache(maxsize=4096)  # a schedule has the same steps in every run
def _weights(step: float, nodes: tuple[float, ...]) -> tuple[float, ...]:
    moments = [-np.expm1(-step)]  # integral of tau^m e^-(h - tau) = h^m - m times the one before
    for power in range(1, len(nodes)):
        moments.append(step**power - power * moments[-1])
    powers = np.vander(np.asarray(nodes, dtype=np.float64), increasing=True).T
    return tuple(np.linalg.solve(powers, np.asarray(moments)).tolist())


def exponential_integral(step: float, nodes: Sequence[float], values: Sequence[Tensor]) -> Tensor:
    """The integral over a step: what it adds to e^-h x, from D at each node (B, C, h, w)."""
    return sum(weight * value for weight, value in zip(weights(step, nodes), values, strict=True))  # type: ignore[return-value]


def advance(state: Tensor, step: float, gain: Tensor) -> Tensor:
    """x at the end of a step, from x at its beginning and what the step adds, (B, C, h, w)."""
    return state * float(np.exp(-step)) + gain


class FinalExtrapolation:
    """From the smallest noise level to none: D at sigma = 0, which is x there.

    Along a trajectory D is even in sigma where the density is smooth, so it is continued by the line in sigma^2 through
    two levels. To leave D at the smallest level is the first-order step, with an error of sigma^2 / 2 s^2 for Gaussian
    data of deviation s. The two levels are at least a factor of `APART` apart where there are any, as a network's own
    error is magnified by 1 / (APART^2 - 1) at most.
    """

    APART = 1.5

    def __init__(self) -> None:
        self.levels: list[tuple[float, Tensor]] = []  # the latest level that is far enough, and those after it

    def add(self, sigma: float, denoised: Tensor) -> None:
        """D (B, C, h, w) at the next noise level; it takes the place of those that are not above it."""
        while self.levels and sigma > self.levels[-1][0] * (1 - SAME_LEVEL):
            self.levels.pop()
        self.levels.append((sigma, denoised))
        while len(self.levels) > 1 and self.levels[1][0] >= self.APART * sigma:
            self.levels.pop(0)

    def result(self) -> Tensor:
        """D at sigma = 0, (B, C, h, w)."""
        (before, earlier), (sigma, last) = self.levels[0], self.levels[-1]
        if len(self.levels) == 1:
            return last
        return last + (last - earlier) * (sigma**2 / (before**2 - sigma**2))
