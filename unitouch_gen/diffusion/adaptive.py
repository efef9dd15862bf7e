"""Steps that are chosen as the run goes, to a tolerance.

An embedded pair of exponential multistep formulas of variable step, in log sigma: a predictor of order two through the
last two evaluations, and a corrector of order three that adds the one at the new level; their difference is the local
error. (UniPC has the same two for fixed steps; Zhao et al., 2023.) A step costs one evaluation, accepted or not; a PI
controller sets the size of the next (Hairer & Wanner, Solving Ordinary Differential Equations II, Section IV.2).
"""

import math

import torch
from torch import Tensor

from unitouch_gen.diffusion.estimate import UNCALIBRATED, Calibration, ErrorIndicator
from unitouch_gen.diffusion.exponential import LastJump, advance, gained
from unitouch_gen.diffusion.prediction import data_scale, to_denoised
from unitouch_gen.diffusion.report import ReturnCode
from unitouch_gen.diffusion.schedule import NoiseSchedule

ADAPTIVE = "adaptive"
"""What reports and calibrations call this solver."""

FIRST_STEP = 0.6
"""In log sigma, at a tolerance of 1; the local error of the first step goes with its square."""

SAFETY = 0.9
"""Of the step that would just be accepted."""

SHRINK, GROW = 0.3, 2.5
"""A step is at least and at most so many times the last one."""

SMALLEST_STEP = 1e-4
"""In log sigma; below it float32 cannot tell states apart, and the run is given up."""

LOCAL_SHARE = 0.5
"""Share of the tolerance that one step may spend: errors of single steps partly cancel, and the corrector is better
than the predictor that is judged. Measured on the exact problems."""


class AdaptiveSteps:
    """Chooses noise levels such that the result is within a relative RMS tolerance; see `diffusion.steps.Steps`.

    One sequence of steps serves the whole batch: a step is accepted when the sample with the largest error is within
    tolerance, so neighbours can make a sample better than it has to be, and never worse.

    Args:
        schedule: Noise levels the network knows.
        prediction_type: Of the network.
        latents: Variance-preserving state at `start_sigma`, (B, C, h, w).
        tolerance: Relative RMS error of the result.
        calibration: Of the error indicator, if the checkpoint has one.
        max_evaluations: After which the run ends where it is.
        start_sigma: Where to start; the largest level when left out.
    """

    def __init__(
        self,
        schedule: NoiseSchedule,
        prediction_type: str,
        latents: Tensor,
        tolerance: float,
        *,
        calibration: Calibration = UNCALIBRATED,
        max_evaluations: int = 1000,
        start_sigma: float | None = None,
    ):
        self.schedule, self.prediction_type = schedule, prediction_type
        self.latents = latents.float()
        self.local_tolerance = LOCAL_SHARE * calibration.indicator(tolerance)
        self.max_evaluations = max_evaluations
        self.level = -math.log(schedule.sigma_max if start_sigma is None else start_sigma)  # lambda of `latents`
        self.end = -math.log(schedule.sigma_min)
        self.nodes: list[tuple[float, Tensor]] = []  # the last two accepted levels, and D there
        self.step = 0.0
        self.first, self.planned = self.level, 100
        self.target = self.level  # where the next evaluation is made
        self.predicted_gain: Tensor | None = None  # of the step there; none at the first level
        self.ratio = 1.0  # of the last accepted step: its error in units of what it may be
        self.evaluations = self.steps = self.rejected = 0
        self.code: ReturnCode | None = None  # how it ended, once it has
        self.errors, self.jump = ErrorIndicator(), LastJump()

    @property
    def number(self) -> int:
        return self.steps

    @property
    def done(self) -> int:
        """Percent of the way in log sigma."""
        return 100 if self.level >= self.end else int(100 * (self.level - self.first) / (self.end - self.first))

    def next(self) -> tuple[Tensor, Tensor] | None:
        if self.code is None and self.evaluations == self.max_evaluations:
            self._finish(ReturnCode.MAX_EVALUATIONS)
        if self.code is not None:
            return None
        state = self._state()
        if self.predicted_gain is not None:
            state = advance(state, self.step, self.predicted_gain)
        sigma = math.exp(-self.target)
        self.seen = state * data_scale(sigma)
        return self.seen, self.schedule.timestep(sigma).to(state)

    def take(self, prediction: Tensor, alive: Tensor) -> bool:
        self.evaluations += 1
        level = self.target
        denoised = to_denoised(prediction, self.seen, math.exp(-level), self.prediction_type)
        if self.predicted_gain is None:
            self._accept(level, denoised)
            self._propose(FIRST_STEP * self.local_tolerance**0.5)
            return self.code is not None
        nodes = [self.step, *(earlier - self.level for earlier, _ in reversed(self.nodes))]
        values = [denoised, *(value for _, value in reversed(self.nodes))]
        gain = gained(self.step, nodes, values)
        order = len(nodes)  # of the local error
        ratio = self._error(gain - self.predicted_gain, denoised, alive) / self.local_tolerance
        if ratio > 1.0:
            self.rejected += 1
            if self.step <= SMALLEST_STEP:
                self._finish(ReturnCode.STEP_TOO_SMALL)
                return True
            self._propose(self.step * max(SHRINK, SAFETY * ratio ** (-1 / order)))
            return False
        self.steps += 1
        self.latents = advance(self._state(), self.step, gain) * data_scale(math.exp(-level))
        self._accept(level, denoised)
        ratio = max(ratio, 1e-4)
        factor = SAFETY * ratio ** (-0.7 / order) * self.ratio ** (0.4 / order)
        self.ratio = ratio
        self._propose(self.step * min(max(factor, SHRINK), GROW))
        return True

    def indicator(self) -> Tensor | None:
        return self.errors.of(self.latents)

    def _state(self) -> Tensor:
        """x at the last accepted level."""
        return self.latents / data_scale(math.exp(-self.level))

    def _error(self, difference: Tensor, denoised: Tensor, alive: Tensor) -> float:
        """The largest local error of the samples that count, relative to the expected size of the result.

        That is the root of |D|^2 and what noise still hides: sigma^2 / (1 + sigma^2) of latents of unit variance.
        """
        sigma = math.exp(-self.target)
        size = denoised.flatten(1).square().mean(dim=1) + sigma**2 / (1 + sigma**2)
        errors = (difference.flatten(1).square().mean(dim=1) / size).sqrt()
        known = torch.isfinite(difference.flatten(1)).all(dim=1)  # what is not finite goes on, for the loop to find
        errors = errors[alive & known].nan_to_num(nan=math.inf)  # squares may be beyond float32 where states are not
        return errors.max().item() if len(errors) else 0.0

    def _accept(self, level: float, denoised: Tensor) -> None:
        """Goes on from a level where D is now known."""
        self.level = level
        self.nodes = [*self.nodes[-1:], (level, denoised)]
        self.errors.add(math.exp(-level), denoised)
        self.jump.add(math.exp(-level), denoised)
        if level >= self.end:
            self._finish(ReturnCode.SUCCESS)

    def _propose(self, step: float) -> None:
        """The next level to evaluate at, and the state predicted there."""
        left = self.end - self.level
        if left <= 0.0:
            return
        self.step = left if step >= left else min(max(step, SMALLEST_STEP), 0.5 * left if 2 * step > left else step)
        nodes = [level - self.level for level, _ in reversed(self.nodes)]
        # Kept apart from the state, beside which it may be lost in rounding at large noise levels.
        self.predicted_gain = gained(self.step, nodes, [value for _, value in reversed(self.nodes)])
        self.target = self.end if self.step == left else self.level + self.step

    def _finish(self, code: ReturnCode) -> None:
        """Ends with what is known best: at the smallest level, D continued to none; before, the last D."""
        self.code = code
        self.latents = self.jump.result() if code is ReturnCode.SUCCESS else self.nodes[-1][1]
