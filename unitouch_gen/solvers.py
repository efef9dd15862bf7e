"""Solvers as plain functions of a denoiser, a state and noise levels.

In the variance-exploding frame x = x_0 + sigma n the probability-flow ODE is dx/dsigma = (x - D(x, sigma)) / sigma
(Karras et al., 2022, Equation 3), where the denoiser D predicts x_0. In lambda = -log sigma it is dx/dlambda = D - x.
The `sigmas` of a solver fall and end in 0.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from unitouch_gen.schedule import NoiseSchedule

Denoise = Callable[[Tensor, float], Tensor]
"""D(x, sigma), (B, C, h, w) each."""

AfterStep = Callable[[int, Tensor, float], Tensor]
"""Called with the number of a step from 0, x behind it and its sigma; returns the x to go on from."""

Levels = list[tuple[float, Tensor]]
"""Noise levels, falling, and D at each."""


def unchanged(step: int, x: Tensor, sigma: float) -> Tensor:
    return x


def sample_ddim(
    denoise: Denoise,
    x: Tensor,
    sigmas: Sequence[float],
    after_step: AfterStep = unchanged,
    eta: float = 0.0,
    draw: Callable[[Tensor], Tensor] = torch.randn_like,
) -> Tensor:
    """DDIM, of order 1; at eta = 1 it adds as much noise as DDPM (Song et al., 2021, Equations 12 and 16)."""
    for step, (sigma, target) in enumerate(pairwise(sigmas)):
        denoised = denoise(x, sigma)
        added = eta * target * math.sqrt(1 - (target / sigma) ** 2)
        x = denoised + math.sqrt(target**2 - added**2) / sigma * (x - denoised)
        if added > 0.0:
            x = x + added * draw(x)
        x = after_step(step, x, target)
    return x


def sample_euler(denoise: Denoise, x: Tensor, sigmas: Sequence[float], after_step: AfterStep = unchanged) -> Tensor:
    """Euler, of order 1 (the first half of Algorithm 1 of Karras et al., 2022)."""
    for step, (sigma, target) in enumerate(pairwise(sigmas)):
        slope = (x - denoise(x, sigma)) / sigma
        x = after_step(step, x + (target - sigma) * slope, target)
    return x


def sample_heun(denoise: Denoise, x: Tensor, sigmas: Sequence[float], after_step: AfterStep = unchanged) -> Tensor:
    """Heun, of order 2, two evaluations a step but for the last (Algorithm 1 of Karras et al., 2022)."""
    levels: Levels = []
    for step, (sigma, target) in enumerate(pairwise(sigmas)):
        levels.append((sigma, denoised := denoise(x, sigma)))
        if target == 0.0:
            return after_step(step, denoised_at_zero(levels), target)
        slope = (x - denoised) / sigma
        ahead = x + (target - sigma) * slope
        slope_ahead = (ahead - denoise(ahead, target)) / target
        x = after_step(step, x + (target - sigma) * (slope + slope_ahead) / 2, target)
    return x


def sample_dpmpp_2m(denoise: Denoise, x: Tensor, sigmas: Sequence[float], after_step: AfterStep = unchanged) -> Tensor:
    """DPM-Solver++(2M), of order 2 (Lu et al., 2022, "DPM-Solver++", Algorithm 2)."""
    levels: Levels = []
    for step, (sigma, target) in enumerate(pairwise(sigmas)):
        levels.append((sigma, denoise(x, sigma)))
        x = after_step(step, multistep(levels, x, sigma, target), target)
    return x


def sample_deis(denoise: Denoise, x: Tensor, sigmas: Sequence[float], after_step: AfterStep = unchanged) -> Tensor:
    """DEIS of order 2: the slope is a line in log sigma (Zhang & Chen, 2023, Equation 15)."""
    levels: Levels = []
    earlier = torch.zeros_like(x)  # the slope one level before
    for step, (sigma, target) in enumerate(pairwise(sigmas)):
        levels.append((sigma, denoised := denoise(x, sigma)))
        if target == 0.0:
            return after_step(step, denoised_at_zero(levels), target)
        slope = (x - denoised) / sigma
        x = x + (target - sigma) * slope
        if step > 0:
            rise = (slope - earlier) / math.log(sigma / levels[-2][0])
            x = x + (target * math.log(target / sigma) - (target - sigma)) * rise
        x, earlier = after_step(step, x, target), slope
    return x


def sample_unipc(denoise: Denoise, x: Tensor, sigmas: Sequence[float], after_step: AfterStep = unchanged) -> Tensor:
    """UniPC with B_2(h), of order 3: the step of DPM-Solver++(2M), corrected through the evaluation that it leads to
    (Zhao et al., 2023, Algorithms 1 and 2)."""
    levels: Levels = [(sigmas[0], denoise(x, sigmas[0]))]
    for step, (sigma, target) in enumerate(pairwise(sigmas)):
        predicted = multistep(levels, x, sigma, target)
        if target == 0.0:
            return after_step(step, predicted, target)
        levels.append((target, denoise(predicted, target)))
        x = after_step(step, target / sigma * x + exponential_integral(levels[-3:], sigma, target), target)
    return x


def multistep(levels: Levels, x: Tensor, sigma: float, target: float) -> Tensor:
    """A step of DPM-Solver++(2M): by D half-way in log sigma, on the line through the last two levels."""
    if target == 0.0:
        return denoised_at_zero(levels)
    midway = levels[-1][1]
    if len(levels) > 1:
        before, earlier = levels[-2]
        ratio = math.log(sigma / target) / math.log(before / sigma)  # of this step to the one before
        midway = midway + ratio / 2 * (midway - earlier)
    return target / sigma * x + (1 - target / sigma) * midway


def exponential_integral(levels: Levels, sigma: float, target: float) -> Tensor:
    """What a step adds to (target / sigma) x, where D is the polynomial in log sigma through its values at some levels.

    dx/dlambda = D - x is linear but for D (Lu et al., 2022, "DPM-Solver", Section 3.2), so that over a step of h

        x(lambda + h) = e^-h x(lambda) + integral from 0 to h of e^-(h - tau) D(lambda + tau) dtau.
    """
    step = math.log(sigma / target)
    nodes = [math.log(sigma / level) for level, _ in levels]  # tau of each
    moments = [-math.expm1(-step)]  # integral of tau^m e^-(h - tau) = h^m - m times the one before
    for power in range(1, len(nodes)):
        moments.append(step**power - power * moments[-1])
    weights = np.linalg.solve(np.vander(nodes, increasing=True).T, moments).tolist()
    return sum(weight * denoised for weight, (_, denoised) in zip(weights, levels, strict=True))  # type: ignore[return-value]


APART = 1.5
"""Ratio of the two levels, or more, of the last step: it magnifies a network's own error by 1 / (APART^2 - 1)."""


def denoised_at_zero(levels: Levels) -> Tensor:
    """D at sigma = 0, which is x there: the last step, in second order.

    Along a trajectory D is even in sigma where the density is smooth, so it is continued by the line in sigma^2 through
    two levels. To leave D at the smallest level is the first-order step, with an error of sigma^2 / 2 s^2 for Gaussian
    data of deviation s.
    """
    sigma, denoised = levels[-1]
    before, earlier = next((level for level in reversed(levels) if level[0] >= APART * sigma), levels[0])
    if before == sigma:
        return denoised
    return denoised + (denoised - earlier) * (sigma**2 / (before**2 - sigma**2))


# Steps to a tolerance -------------------------------------------------------------------------------------------------


def sample_adaptive(
    denoise: Denoise,
    x: Tensor,
    ends: tuple[float, float],
    tolerance: float,
    after_step: AfterStep,
    after_refusal: Callable[[float], object],
    counting: Callable[[], Sequence[bool]],
) -> Tensor:
    """Steps from the first to the second of two sigmas, chosen so that the result is within a relative RMS tolerance.

    A predictor of order 2 and a corrector of order 3 are an embedded pair: their difference is the local error. A step
    costs one evaluation, accepted or not. One sequence of steps serves the whole batch, as fine as the sample with the
    largest error needs, of those that `counting` tells. `after_refusal` gets the size in log sigma of a refused step.
    """
    local = 0.5 * tolerance  # for one step: errors partly cancel, and the corrector is better than the predictor
    (sigma, last), taken, last_error = ends, 0, 1.0
    levels: Levels = [(sigma, denoise(x, sigma))]
    wish = 0.6 * local**0.5  # in log sigma; the error of the first step goes with its square
    while sigma > last:
        step = propose(wish, math.log(sigma / last))
        target = max(sigma * math.exp(-step), last)
        predicted = exponential_integral(levels[-2:], sigma, target)
        ahead = (target, denoise(target / sigma * x + predicted, target))
        corrected = exponential_integral([*levels[-2:], ahead], sigma, target)
        error = local_error(corrected - predicted, *ahead, counting()) / local
        wish = next_step(step, error, last_error, order=len(levels[-2:]) + 1)
        if error > 1.0:
            after_refusal(step)
        else:
            levels.append(ahead)
            x = after_step(taken, target / sigma * x + corrected, target)
            sigma, last_error, taken = target, max(error, 1e-4), taken + 1
    return after_step(taken, denoised_at_zero(levels), 0.0)


def propose(wish: float, left: float) -> float:
    """The step wished for, or what is left of the way, or half of that, in log sigma."""
    if wish >= left:
        return left
    return left / 2 if 2 * wish > left else max(wish, 1e-4)


def next_step(step: float, error: float, last_error: float, order: int) -> float:
    """The step to wish for after one with an error, in units of the tolerance, and an accepted one before it.

    A PI controller (Hairer & Wanner, Solving Ordinary Differential Equations II, Section IV.2).
    """
    if error > 1.0:
        return step * max(0.9 * error ** (-1 / order), 0.3)
    change = 0.9 * max(error, 1e-4) ** (-0.7 / order) * last_error ** (0.4 / order)
    return step * min(max(change, 0.3), 2.5)


def local_error(difference: Tensor, sigma: float, denoised: Tensor, counting: Sequence[bool]) -> float:
    """The largest RMS difference (B, C, h, w) of the samples that count, relative to the expected size of the result.

    That is the root of |D|^2 and what noise still hides: sigma^2 / (1 + sigma^2) of latents of unit variance. |D| is
    counted up to 2, that of the most extreme pictures: where a run diverges its D grows along.
    """
    size = denoised.flatten(1).square().mean(dim=1).clamp(max=4.0) + sigma**2 / (1 + sigma**2)
    errors = (difference.flatten(1).square().mean(dim=1) / size).sqrt().nan_to_num(nan=math.inf)
    errors = errors.masked_fill(~difference.flatten(1).isfinite().all(dim=1), 0.0)  # a broken sample is not judged
    return max((error for error, counts in zip(errors.tolist(), counting, strict=True) if counts), default=0.0)


# By name --------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Solver:
    """A solver, its nominal order of convergence, and the spacing of its noise levels."""

    sample: Callable[..., Tensor]
    order: int
    spacing: Callable[[NoiseSchedule, int], list[float]]


SOLVERS: dict[str, Solver] = {
    "ddim": Solver(sample_ddim, 1, NoiseSchedule.trailing),
    # Levels that are even in time lie too far apart near the end, and hold multistep solvers at first order.
    "euler": Solver(sample_euler, 1, NoiseSchedule.karras),
    "heun": Solver(sample_heun, 2, NoiseSchedule.karras),
    "dpm++2m": Solver(sample_dpmpp_2m, 2, NoiseSchedule.karras),
    "unipc": Solver(sample_unipc, 3, NoiseSchedule.karras),
    "deis": Solver(sample_deis, 2, NoiseSchedule.karras),
}
