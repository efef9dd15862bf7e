"""Steps that are chosen as the run goes, to a tolerance.

An embedded pair of exponential multistep formulas of variable step, in log sigma: a predictor of order two through the
last two evaluations, and a corrector of order three that adds the one at the new level; their difference is the local
error. (UniPC has the same two for fixed steps; Zhao et al., 2023.) A step costs one evaluation, accepted or not; a PI
controller sets the size of the next (Hairer & Wanner, Solving Ordinary Differential Equations II, Section IV.2).

Where the prediction is known to jump, as it does at the ends of a guidance interval, a step ends just before and the
next one starts afresh just behind, as formulas through points on both sides would be of no order at all.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from unitouch_gen.report import ReturnCode
from unitouch_gen.schedulers.estimate import UNCALIBRATED, Calibration, ErrorIndicator
from unitouch_gen.schedulers.exponential import FinalExtrapolation, advance, exponential_integral
from unitouch_gen.schedulers.schedule import NoiseSchedule, alpha, to_denoised

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


LARGEST_DATA = 2.0
"""Root mean square of D, beyond which errors are not judged by it: that of the most extreme pictures. Where an diverged
run grows, its D grows along, and the largest error would look small beside it."""

BESIDE = 1e-6
"""Share of all timesteps from a jump to where steps end before it, and start behind it; float32 tells them apart."""


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
        jumps: Timesteps at which the prediction jumps, in [0, T - 1]; where there is no step across, it is ignored.
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
        jumps: Sequence[float] = (),
    ):
        self.schedule, self.prediction_type = schedule, prediction_type
        self.latents = latents.float()
        # What an indicator stands for is known of most samples, not of all: it makes steps shorter, never longer.
        self.local_tolerance = LOCAL_SHARE * min(calibration.indicator(tolerance), tolerance)
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
        self.errors, self.last_jump = ErrorIndicator(), FinalExtrapolation()
        self.jumps = [pair for pair in jump_levels(schedule, jumps) if pair[0] > self.level]

    @property
    def number(self) -> int:
        return self.steps

    @property
    def done(self) -> int:
        """Percent of the way in log sigma."""
        return 100 if self.level >= self.end else int(100 * (self.level - self.first) / (self.end - self.first))

    def state(self) -> Tensor:
        return self.latents

    def jump(self) -> None:
        self.errors.restart()
        self.last_jump = FinalExtrapolation()

    def next(self) -> tuple[Tensor, Tensor] | None:
        if self.code is None and self.evaluations == self.max_evaluations:
            self._finish(ReturnCode.MAX_EVALUATIONS)
        if self.code is not None:
            return None
        state = self._x()
        if self.predicted_gain is not None:
            state = advance(state, self.step, self.predicted_gain)
        sigma = math.exp(-self.target)
        self.seen = state * alpha(sigma)
        return self.seen, self.schedule.timestep(sigma).to(state)

    def take(self, prediction: Tensor, alive: Tensor) -> bool:
        self.evaluations += 1
        level = self.target
        denoised = to_denoised(prediction, self.seen, math.exp(-level), self.prediction_type)
        if self.predicted_gain is None:
            self.nodes = []
            self._accept(level, denoised)
            self._propose(max(FIRST_STEP * self.local_tolerance**0.5, self.step))  # behind a jump, as before it
            return self.code is not None
        nodes = [self.step, *(earlier - self.level for earlier, _ in reversed(self.nodes))]
        values = [denoised, *(value for _, value in reversed(self.nodes))]
        gain = exponential_integral(self.step, nodes, values)
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
        self.latents = advance(self._x(), self.step, gain) * alpha(math.exp(-level))
        self._accept(level, denoised)
        ratio = max(ratio, 1e-4)
        factor = SAFETY * ratio ** (-0.7 / order) * self.ratio ** (0.4 / order)
        self.ratio = ratio
        if self.jumps and level >= self.jumps[0][0]:
            self._cross(denoised)
        else:
            self._propose(self.step * min(max(factor, SHRINK), GROW))
        return True

    def indicator(self) -> Tensor | None:
        return self.errors.of(self.latents)

    def _x(self) -> Tensor:
        """x at the last accepted level."""
        return self.latents / alpha(math.exp(-self.level))

    def _error(self, difference: Tensor, denoised: Tensor, alive: Tensor) -> float:
        """The largest local error of the samples that count, relative to the expected size of the result.

        That is the root of |D|^2 and what noise still hides: sigma^2 / (1 + sigma^2) of latents of unit variance.
        """
        sigma = math.exp(-self.target)
        size = denoised.flatten(1).square().mean(dim=1).clamp(max=LARGEST_DATA**2) + sigma**2 / (1 + sigma**2)
        errors = (difference.flatten(1).square().mean(dim=1) / size).sqrt()
        known = torch.isfinite(difference.flatten(1)).all(dim=1)  # what is not finite goes on, for the loop to find
        errors = errors[alive & known].nan_to_num(nan=math.inf)  # squares may be beyond float32 where states are not
        return errors.max().item() if len(errors) else 0.0

    def _accept(self, level: float, denoised: Tensor) -> None:
        """Goes on from a level where D is now known."""
        self.level = level
        self.nodes = [*self.nodes[-1:], (level, denoised)]
        self.errors.add(math.exp(-level), denoised)
        self.last_jump.add(math.exp(-level), denoised)
        if level >= self.end:
            self._finish(ReturnCode.SUCCESS)

    def _cross(self, denoised: Tensor) -> None:
        """Starts afresh behind a jump, to which the last D is continued."""
        (before, behind), self.jumps = self.jumps[0], self.jumps[1:]
        step = behind - before
        self.latents = advance(self._x(), step, exponential_integral(step, [0.0], [denoised])) * alpha(
            math.exp(-behind)
        )
        self.level = self.target = behind
        self.predicted_gain, self.ratio = None, 1.0

    def _propose(self, step: float) -> None:
        """The next level to evaluate at, before a jump or the end, and the state predicted there."""
        end = self.jumps[0][0] if self.jumps else self.end
        left = end - self.level
        if left <= 0.0:
            return
        self.step = left if step >= left else min(max(step, SMALLEST_STEP), 0.5 * left if 2 * step > left else step)
        nodes = [level - self.level for level, _ in reversed(self.nodes)]
        # Kept apart from the state, beside which it may be lost in rounding at large noise levels.
        self.predicted_gain = exponential_integral(self.step, nodes, [value for _, value in reversed(self.nodes)])
        self.target = end if self.step == left else self.level + self.step

    def _finish(self, code: ReturnCode) -> None:
        """Ends with what is known best: at the smallest level, D continued to none; before, the last D."""
        self.code = code
        self.latents = self.last_jump.result() if code is ReturnCode.SUCCESS else self.nodes[-1][1]


def jump_levels(schedule: NoiseSchedule, jumps: Sequence[float]) -> list[tuple[float, float]]:
    """Where steps end before each jump and start behind it, in -log sigma, rising.

    Args:
        schedule: Of T noise levels.
        jumps: Timesteps; at 0 and T - 1 there are none.
    """
    last = len(schedule.log_sigmas) - 1
    pairs: list[tuple[float, float]] = []
    for timestep in sorted(jumps, reverse=True):
        if not 0.0 < timestep < last:
            continue
        before, behind = (
            -math.log(schedule.sigma(timestep + side * BESIDE * (last + 1)).item()) for side in (1.0, -1.0)
        )
        if pairs and before <= pairs[-1][1]:  # one jump to float32
            before = pairs.pop()[0]
        pairs.append((before, behind))
    return pairs
