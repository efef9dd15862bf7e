"""How far a run is from the exact solution, estimated from its own evaluations."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from unitouch_gen.diffusion.exponential import SAME_LEVEL, weights
from unitouch_gen.errors import check_number


@dataclass(frozen=True)
class Calibration:
    """error = factor * indicator^power, fitted on seeds and conditions apart from those it is judged on.

    Attributes:
        factor, power: Above 0.
    """

    factor: float = 1.0
    power: float = 1.0

    def __post_init__(self) -> None:
        for name in ("factor", "power"):
            check_number(name, getattr(self, name), torch.finfo(torch.float32).tiny)

    def error(self, indicator: float) -> float:
        """Estimated relative RMS error of a sample."""
        return self.factor * indicator**self.power

    def indicator(self, error: float) -> float:
        """The indicator that stands for a relative RMS error."""
        return (error / self.factor) ** (1 / self.power)


UNCALIBRATED = Calibration()


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

    def add(self, sigma: float, denoised: Tensor) -> None:
        """One evaluation: D (B, C, h, w) at a noise level."""
        level = -math.log(sigma)
        if self.levels and level - self.levels[-1] < SAME_LEVEL:
            self.levels[-1], self.values[-1] = level, denoised
            return
        if self.levels:
            self.sum_of_squares = self.sum_of_squares + self._left_out(level, denoised)
        self.levels, self.values = [*self.levels[-1:], level], [*self.values[-1:], denoised]

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

        `None` after a single evaluation, which there is nothing to compare with.
        """
        if len(self.levels) < 2:
            return None
        size = result.float().flatten(1).square().mean(dim=1)
        return (torch.as_tensor(self.sum_of_squares).to(size) / size.clamp_min(torch.finfo(size.dtype).tiny)).sqrt()
