"""Steps that are chosen as the run goes, to a tolerance.

An embedded pair of exponential multistep formulas of variable step, in log sigma: a predictor of order two through the
last two evaluations, and a corrector of order three that adds the one at the new level; their difference is the local
error. (UniPC has the same two for fixed steps; Zhao et al., 2023.) A step costs one evaluation, accepted or not; a PI
controller sets the size of the next (Hairer & Wanner, Solving Ordinary Differential Equations II, Section IV.2).

Where the prediction is known to be discontinuous, as it is at the ends of a guidance interval, a step ends just before
and the next one starts afresh just behind, as formulas through points on both sides would be of no order at all.
"""

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from unitouch_gen.schedulers.exponential import FinalExtrapolation, advance, exponential_integral
from unitouch_gen.schedulers.schedule import NoiseSchedule, alpha, to_denoised

ADAPTIVE = "adaptive"
"""What reports call this solver."""

FIRST_STEP = 0.6
"""In log sigma, at a tolerance of 1; the local error of the first step goes with its square."""

SAFETY = 0.9
"""Share of the step that would just be accepted."""

SHRINK, GROW = 0.3, 2.5
"""A step is at least and at most so many times the last one."""

SMALLEST_STEP = 1e-4
"""In log sigma; below it float32 cannot tell states apart, and the run is given up."""

LOCAL_SHARE = 0.5
"""Share of the tolerance that one step may spend: errors of single steps partly cancel, and the corrector is better
than the predictor that is judged. Measured on the exact problems."""


LARGEST_DATA = 2.0
"""Root mean square of D, beyond which errors are not judged by it: that of the most extreme pictures. Where a run
diverges, its D grows along, and the largest error would look small beside it."""

BESIDE = 1e-6
"""Share of all timesteps from a discontinuity to where steps end before it and start behind it, as float32 can tell."""


def adaptive_steps(
    run: Any,
    schedule: NoiseSchedule,
    prediction_type: str,
    tolerance: float,
    *,
    start: float,
    max_evaluations: int,
    discontinuities: Sequence[float],
) -> tuple[str, int, int]:
    """Goes from `run.latents` to the result within a relative RMS tolerance.

    One sequence of steps serves the whole batch: a step is accepted when the sample with the largest error is within
    tolerance, so neighbours can make a sample better than it has to be, and never worse.

    Args:
        run: A `sampling.Run` with the variance-preserving state at sigma `start`, (B, C, h, w).
        schedule, prediction_type: Of the network.
        tolerance: Relative RMS error of the result.
        start: sigma.
        max_evaluations: After which the run ends where it is.
        discontinuities: Timesteps in [0, T - 1]; where there is no step across, one is ignored.

    Returns:
        The return code, and the numbers of accepted and rejected steps.
    """
    local_tolerance = LOCAL_SHARE * tolerance
    first = level = -math.log(start)  # lambda of `run.latents`
    end = -math.log(schedule.sigma_min)
    breaks = [pair for pair in discontinuity_levels(schedule, discontinuities) if pair[0] > level]
    nodes: list[tuple[float, Tensor]] = []  # the last two accepted levels, and D there
    target, step = level, 0.0  # where the next evaluation is made, and how far that is
    predicted: Tensor | None = None  # what the step adds by the predictor; nothing at the first level
    before = 1.0  # error of the last accepted step, in units of what it may be
    final = FinalExtrapolation()
    evaluations = accepted = rejected = 0
    code = ""
    while not code:
        if evaluations == max_evaluations:
            code, run.latents = "max_evaluations", nodes[-1][1]
            break
        if run.interrupted:
            return "interrupted", accepted, rejected
        x, sigma = run.latents / alpha(math.exp(-level)), math.exp(-target)
        state = (x if predicted is None else advance(x, step, predicted)) * alpha(sigma)
        timestep = schedule.timestep(sigma).to(state)
        number = accepted
        prediction = run.evaluate(state, timestep)
        evaluations += 1
        if run.discontinuous:
            final = FinalExtrapolation()
        denoised = to_denoised(prediction, state, sigma, prediction_type)
        moved = True
        if predicted is None:  # at the start, or behind a discontinuity
            nodes, moved = [], False
            wish = max(FIRST_STEP * local_tolerance**0.5, step)
        else:
            levels = [step, *(earlier - level for earlier, _ in reversed(nodes))]
            corrected = exponential_integral(step, levels, [denoised, *(value for _, value in reversed(nodes))])
            order = len(levels)  # of the local error
            counting = run.finite & run.stable
            error = local_error(corrected - predicted, denoised, sigma, counting) / local_tolerance
            if error <= 1.0:
                accepted += 1
                run.latents = advance(x, step, corrected) * alpha(sigma)
                error = max(error, 1e-4)
                factor = SAFETY * error ** (-0.7 / order) * before ** (0.4 / order)
                before, wish = error, step * min(max(factor, SHRINK), GROW)
            else:
                rejected += 1
                wish = step * max(SHRINK, SAFETY * error ** (-1 / order))
                moved = step <= SMALLEST_STEP
                if moved:
                    code, run.latents = "step_too_small", nodes[-1][1]
        if predicted is None or (moved and not code):  # D is known at a level to go on from
            level = target
            nodes = [*nodes[-1:], (level, denoised)]
            final.add(sigma, denoised)
            if level >= end:
                code, run.latents, moved = "success", final.result(), True
        if breaks and level >= breaks[0][0]:  # starts afresh behind it, to where the last D is continued
            (stop, behind), breaks = breaks[0], breaks[1:]
            over = behind - stop
            x = advance(run.latents / alpha(math.exp(-level)), over, exponential_integral(over, [0.0], [denoised]))
            run.latents = x * alpha(math.exp(-behind))
            level = target = behind
            predicted, before = None, 1.0
        elif not code:  # on to the next level, before a discontinuity or the end
            stop = breaks[0][0] if breaks else end
            left = stop - level
            step = left if wish >= left else min(max(wish, SMALLEST_STEP), 0.5 * left if 2 * wish > left else wish)
            # Kept apart from the state, beside which it may be lost in rounding at large noise levels.
            predicted = exponential_integral(
                step, [earlier - level for earlier, _ in reversed(nodes)], [value for _, value in reversed(nodes)]
            )
            target = stop if step == left else level + step
        if moved:
            run.settle(number, timestep)
            if code in ("", "success"):  # what is given up is no state, and has its own code
                run.check_size(run.latents, number)
        if run.progress is not None:
            run.progress(min((level - first) / (end - first), 1.0))
    return code, accepted, rejected


def local_error(difference: Tensor, denoised: Tensor, sigma: float, counting: Tensor) -> float:
    """The largest local error of the samples that count, relative to the expected size of the result.

    That is the root of |D|^2 and what noise still hides: sigma^2 / (1 + sigma^2) of latents of unit variance.

    Args:
        difference: Of predictor and corrector, (B, C, h, w).
        denoised: D, (B, C, h, w), at noise level `sigma`.
        counting: Which samples count, bool (B,).
    """
    size = denoised.flatten(1).square().mean(dim=1).clamp(max=LARGEST_DATA**2) + sigma**2 / (1 + sigma**2)
    errors = (difference.flatten(1).square().mean(dim=1) / size).sqrt()
    known = torch.isfinite(difference.flatten(1)).all(dim=1)  # what is not finite goes on, for the loop to find
    errors = errors[counting & known].nan_to_num(nan=math.inf)  # squares may be beyond float32 where states are not
    return errors.max().item() if len(errors) else 0.0


def discontinuity_levels(schedule: NoiseSchedule, timesteps: Sequence[float]) -> list[tuple[float, float]]:
    """Where steps end before each discontinuity and start behind it, in -log sigma, rising.

    Args:
        schedule: Of T noise levels.
        timesteps: At 0 and T - 1 there are none.
    """
    last = len(schedule.log_sigmas) - 1
    pairs: list[tuple[float, float]] = []
    for timestep in sorted(timesteps, reverse=True):
        if not 0.0 < timestep < last:
            continue
        before, behind = (
            -math.log(schedule.sigma(timestep + side * BESIDE * (last + 1)).item()) for side in (1.0, -1.0)
        )
        if pairs and before <= pairs[-1][1]:  # one discontinuity to float32
            before = pairs.pop()[0]
        pairs.append((before, behind))
    return pairs
