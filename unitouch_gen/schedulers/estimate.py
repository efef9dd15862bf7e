"""How far a run is from the exact solution, estimated from its own evaluations."""

import math
from bisect import bisect_right
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.schedulers.exponential import SAME_LEVEL, weights


@dataclass(frozen=True)
class Calibration:
    """What errors indicators stand for: a rising line in log-log coordinates, straight between points and beyond them.

    Fitted on seeds and conditions apart from those it is judged on: see `numerics.fit`.

    Attributes:
        indicators, errors: Of each point, at least two, rising, above 0.

    Raises:
        InvalidInputError: If they are not.
    """

    indicators: tuple[float, ...]
    errors: tuple[float, ...]

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
        cls, stored: Mapping[str, Iterable[Mapping[str, Any]]], solver: str, guidance: Any
    ) -> "Calibration | None":
        """That of a solver at a guidance scale, if there is one.

        Args:
            stored: As checkpoints hold them: for each solver and scale "guidance_scale", "indicators" and "errors".
            solver, guidance: Of the run.
        """
        for entry in stored.get(solver, ()):
            if entry["guidance_scale"] == guidance:
                return cls(tuple(entry["indicators"]), tuple(entry["errors"]))
        return None

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
        """One evaluation: D (B, C, h, w) at a noise level."""
        level = -math.log(sigma)
        if self.levels and level - self.levels[-1] < SAME_LEVEL:
            self.levels[-1], self.values[-1] = level, denoised
            return
        if self.levels:
            self.sum_of_squares = self.sum_of_squares + self._left_out(level, denoised)
            self.compared += 1
        self.levels, self.values = [*self.levels[-1:], level], [*self.values[-1:], denoised]

    def restart(self) -> None:
        """Compares what comes with nothing that was, as D jumps here: it does where guidance changes."""
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
