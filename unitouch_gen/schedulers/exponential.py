"""Exponential integration of the probability-flow ODE in log sigma, and the error that its steps leave.

With lambda = -log sigma the ODE reads dx/dlambda = D - x, linear but for the data prediction D (Lu et al., 2022,
Section 3.2, in the variance-exploding frame), so that over a step of h

    x(lambda + h) = e^-h x(lambda) + integral from 0 to h of e^-(h - tau) D(lambda + tau) dtau.

Where D is the polynomial through its values at some nodes, the integral is a weighted sum of these. How far a run is
from the exact solution is estimated from its own evaluations, as what a step of order two leaves out.
"""

import math
from bisect import bisect_right
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor

from unitouch_gen.errors import InvalidInputError

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


TRUSTED = 0.8
"""Least share of samples with estimates from 0.3 to 3 times the error, for estimates to be told."""


@dataclass(frozen=True)
class Calibration:
    """What errors indicators stand for: a rising line in log-log coordinates, straight between points and beyond them.

    Fitted on seeds and conditions apart from those it is judged on: see `numerics.fit`.

    Attributes:
        indicators, errors: Of each point, at least two, rising, above 0.
        share: Of samples apart from those that it was fitted to, how many it told 0.3 to 3 times the error of.

    Raises:
        InvalidInputError: If they are not.
    """

    indicators: tuple[float, ...]
    errors: tuple[float, ...]
    share: float = 1.0

    def __post_init__(self) -> None:
        for name in ("indicators", "errors"):
            values = getattr(self, name)
            smallest = torch.finfo(torch.float32).tiny
            rising = all(low < high for low, high in pairwise(values))
            if len(values) < 2 or not rising or not values[0] >= smallest or not math.isfinite(values[-1]):
                raise InvalidInputError(f"`{name}` is {values}; pass at least two numbers above 0, rising.")
        if len(self.indicators) != len(self.errors):
            raise InvalidInputError(
                f"`errors` holds {len(self.errors)} for {len(self.indicators)} `indicators`; pass one each."
            )

    @classmethod
    def find(
        cls, stored: Mapping[str, Iterable[Mapping[str, Any]]], solver: str, guidance: Any, steps: int | None = None
    ) -> "Calibration | None":
        """That of a solver at the guidance scale and then the number of steps nearest to a call's.

        `None` if the scale does not lie among those that were measured, or the number is more than twice or less than
        half of the nearest. Guidance is off up to 1.

        Args:
            stored: As checkpoints hold them: for each solver, scale and number of steps "guidance_scale", "steps",
                "indicators", "errors" and "share"; without "steps", of any number.
            solver, guidance: Of the run.
            steps: Of the run; `None` to a tolerance.
        """
        entries, scale = list(stored.get(solver, ())), max(float(guidance), 1.0)
        scales = [max(entry["guidance_scale"], 1.0) for entry in entries]
        if not entries or not min(scales) <= scale <= max(scales):
            return None

        def apart(entry: Mapping[str, Any]) -> tuple[float, float]:
            number = entry.get("steps")
            away = abs(math.log(number / steps)) if number and steps else 0.0
            return abs(math.log(max(entry["guidance_scale"], 1.0) / scale)), away

        entry = min(entries, key=apart)
        if apart(entry)[1] > math.log(2.0):
            return None
        return cls(tuple(entry["indicators"]), tuple(entry["errors"]), entry.get("share", 1.0))

    @property
    def trusted(self) -> bool:
        """Whether its estimates are worth telling."""
        return self.share >= TRUSTED

    def error(self, indicator: float) -> float:
        """Estimated relative RMS error of a sample; of an exact one 0."""
        return _along(indicator, self.indicators, self.errors)

    def indicator(self, error: float) -> float:
        """The indicator that stands for a relative RMS error."""
        return _along(error, self.errors, self.indicators)


def _along(value: float, known: Sequence[float], wanted: Sequence[float]) -> float:
    """The log-log line through points at a value of one coordinate."""
    if not value > 0.0:
        return value  # 0 and NaN stay what they are
    place = min(max(bisect_right(known, value), 1), len(known) - 1)
    (low, high), (start, end) = known[place - 1 : place + 1], wanted[place - 1 : place + 1]
    share = math.log(value / low) / math.log(high / low)
    return start * (end / start) ** share


UNCALIBRATED = Calibration((1e-6, 1.0), (1e-6, 1.0))
"""The indicator as it is."""


class ErrorIndicator:
    """Root sum square over a run of what a second-order step leaves out, relative to the result, at no evaluation.

    Each evaluation is compared with the line through the two before it (with the one before it at the second), weighted
    by what the step makes of the difference. That is the local error of an exponential multistep solver of order two;
    for any other solver it tells how well its steps resolve the path.
    """

    def __init__(self) -> None:
        self.levels: list[float] = []  # lambda = -log sigma of the last two evaluations, and D there
        self.values: list[Tensor] = []
        self.sum_of_squares: Tensor | float = 0.0
        self.compared = 0

    def add(self, sigma: float, denoised: Tensor) -> None:
        """One evaluation: D (B, C, h, w) at a noise level; it takes the place of those that are not above it."""
        level, repeated = -math.log(sigma), False
        while self.levels and level - self.levels[-1] < SAME_LEVEL:
            self.levels.pop()
            self.values.pop()
            repeated = True
        if self.levels and not repeated:
            self.sum_of_squares = self.sum_of_squares + self._left_out(level, denoised)
            self.compared += 1
        self.levels, self.values = [*self.levels[-1:], level], [*self.values[-1:], denoised]

    def restart(self) -> None:
        """Compares what comes with nothing that was, as D is discontinuous where guidance changes."""
        self.levels, self.values = [], []

    def _left_out(self, level: float, denoised: Tensor) -> Tensor:
        """Mean square of each sample, (B,), for a step that ends at `level`."""
        step = level - self.levels[-1]
        nodes = [earlier - self.levels[-1] for earlier in self.levels]
        expected = self.values[-1]
        if len(nodes) == 2:
            expected = expected + (self.values[-1] - self.values[0]) * (step / -nodes[0])
        share = weights(step, [step, *nodes])[0]
        return (share * (denoised - expected)).flatten(1).square().mean(dim=1)

    def of(self, result: Tensor) -> Tensor | None:
        """Indicator of each sample, (B,), relative to the latents that came out (B, C, h, w).

        `None` after one or two evaluations, which say nothing: near no noise D repeats what it is given.
        """
        if self.compared < 2:
            return None
        size = result.float().flatten(1).square().mean(dim=1)
        return (torch.as_tensor(self.sum_of_squares).to(size) / size.clamp_min(torch.finfo(size.dtype).tiny)).sqrt()
