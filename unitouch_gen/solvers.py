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

from unitouch_gen.schedule import NoiseSchedule, alpha

Denoise = Callable[[Tensor, float], Tensor]
"""D(x, sigma), (B, C, h, w) each."""

Callback = Callable[[int, Tensor, float], Tensor]
"""Called after each step as `callback(step, x, sigma)`, with steps from 0; returns the x to go on from."""

Levels = list[tuple[float, Tensor]]
"""Noise levels, falling, and D at each."""

DIVERGED_RMS = 10.0
"""RMS of z = x / sqrt(1 + sigma^2) above which a sample has diverged. Networks are trained at RMS 1. The built-in
family in 20 steps reaches 1.3 at guidance 7.5, 7.4 at 100, and 10 to 24 at 1000."""


def no_callback(step: int, x: Tensor, sigma: float) -> Tensor:
    return x


def sample_ddim(
    denoise: Denoise,
    x: Tensor,
    sigmas: Sequence[float],
    callback: Callback = no_callback,
    eta: float = 0.0,
    draw: Callable[[Tensor], Tensor] = torch.randn_like,
) -> Tensor:
    """DDIM, of order 1; at eta = 1 it adds as much noise as DDPM (Song et al., 2021, Equations 12 and 16).

    At eta = 0 it is the method of Euler.
    """
    for step, (sigma, target) in enumerate(pairwise(sigmas)):
        denoised = denoise(x, sigma)
        added = eta * target * math.sqrt(1 - (target / sigma) ** 2)
        x = denoised + math.sqrt(target**2 - added**2) / sigma * (x - denoised)
        if added > 0.0:
            x = x + added * draw(x)
        x = callback(step, x, target)
    return x


def sample_heun(denoise: Denoise, x: Tensor, sigmas: Sequence[float], callback: Callback = no_callback) -> Tensor:
    """Heun, of order 2, two evaluations per step except the last (Algorithm 1 of Karras et al., 2022)."""
    levels: Levels = []
    for step, (sigma, target) in enumerate(pairwise(sigmas)):
        denoised = denoise(x, sigma)
        levels.append((sigma, denoised))
        if target == 0.0:
            return callback(step, denoised_at_zero(levels), target)
        slope = (x - denoised) / sigma
        ahead = x + (target - sigma) * slope
        slope_ahead = (ahead - denoise(ahead, target)) / target
        x = callback(step, x + (target - sigma) * (slope + slope_ahead) / 2, target)
    return x


def sample_dpmpp_2m(denoise: Denoise, x: Tensor, sigmas: Sequence[float], callback: Callback = no_callback) -> Tensor:
    """DPM-Solver++(2M), of order 2 (Lu et al., 2022, "DPM-Solver++", Algorithm 2)."""
    levels: Levels = []
    for step, (sigma, target) in enumerate(pairwise(sigmas)):
        levels.append((sigma, denoise(x, sigma)))
        x = callback(step, multistep(levels, x, sigma, target), target)
    return x


def sample_unipc(denoise: Denoise, x: Tensor, sigmas: Sequence[float], callback: Callback = no_callback) -> Tensor:
    """UniPC with B_2(h), of order 3 (Zhao et al., 2023, Algorithms 1 and 2): DPM-Solver++(2M) predictor; the corrector
    reuses the evaluation at the predicted point."""
    levels: Levels = [(sigmas[0], denoise(x, sigmas[0]))]
    for step, (sigma, target) in enumerate(pairwise(sigmas)):
        predicted = multistep(levels, x, sigma, target)
        if target == 0.0:
            return callback(step, predicted, target)
        levels.append((target, denoise(predicted, target)))
        x = callback(step, target / sigma * x + exponential_integral(levels[-3:], sigma, target), target)
    return x


def multistep(levels: Levels, x: Tensor, sigma: float, target: float) -> Tensor:
    """A step of DPM-Solver++(2M): uses D at the midpoint in log sigma, extrapolated from the last two levels."""
    if target == 0.0:
        return denoised_at_zero(levels)
    midpoint = levels[-1][1]
    if len(levels) > 1:
        previous_sigma, previous = levels[-2]
        ratio = math.log(sigma / target) / math.log(previous_sigma / sigma)  # of this step to the one before
        midpoint = midpoint + ratio / 2 * (midpoint - previous)
    return target / sigma * x + (1 - target / sigma) * midpoint


def exponential_integral(levels: Levels, sigma: float, target: float) -> Tensor:
    """Integral of e^-(h - tau) D over one step of h, D interpolated by a polynomial in log sigma through some levels.

    dx/dlambda = D - x is linear but for D (Lu et al., 2022, "DPM-Solver", Section 3.2), so that

        x(lambda + h) = e^-h x(lambda) + integral from 0 to h of e^-(h - tau) D(lambda + tau) dtau.
    """
    step = math.log(sigma / target)
    nodes = [math.log(sigma / level) for level, _ in levels]  # tau of each
    moments = [-math.expm1(-step)]  # integrals of tau^m e^-(h - tau): I_m = h^m - m I_(m - 1)
    for power in range(1, len(nodes)):
        moments.append(step**power - power * moments[-1])
    weights = np.linalg.solve(np.vander(nodes, increasing=True).T, moments).tolist()
    return sum(weight * denoised for weight, (_, denoised) in zip(weights, levels, strict=True))  # type: ignore[return-value]


MIN_LEVEL_RATIO = 1.5
"""Minimum ratio r of the two levels extrapolated to sigma 0, which magnifies a network's error by 1 / (r^2 - 1)."""


def denoised_at_zero(levels: Levels) -> Tensor:
    """D extrapolated to sigma = 0, where it equals x: the last step, of order 2.

    Along a trajectory D is even in sigma where the density is smooth: two levels give a line in sigma^2. Using D at the
    smallest level instead is first order: its error is sigma^2 / 2 s^2 for Gaussian data of deviation s.
    """
    sigma, denoised = levels[-1]
    higher_sigma, higher = next((each for each in reversed(levels) if each[0] >= MIN_LEVEL_RATIO * sigma), levels[0])
    if higher_sigma == sigma:
        return denoised
    return denoised + (denoised - higher) * (sigma**2 / (higher_sigma**2 - sigma**2))


# Adaptive steps -------------------------------------------------------------------------------------------------------


def sample_adaptive(
    denoise: Denoise,
    x: Tensor,
    sigmas: Sequence[float],
    tolerance: float,
    callback: Callback = no_callback,
    max_evaluations: int = 1000,
) -> tuple[Tensor, bool]:
    """Adaptive steps from the first to the last of `sigmas`, for a relative RMS tolerance of the result.

    A predictor of order 2 and a corrector of order 3 are an embedded pair: their difference is the local error. A step
    costs one evaluation, accepted or not. The whole batch shares its steps; the largest error of the samples that have
    not diverged decides. Steps are at least 1e-4 in log sigma: below, float32 cannot tell states apart.

    Returns x at sigma = 0 and `True`; or, after `max_evaluations` (at least 2), the last D and `False`.
    """
    sigma = sigmas[0]
    last = sigmas[-1]
    local_tolerance = 0.5 * tolerance  # errors partly cancel, and the corrector is better than the predictor
    proposed = 0.6 * local_tolerance**0.5  # in log sigma; the error of the first step grows with its square
    levels: Levels = [(sigma, denoise(x, sigma))]
    diverged = torch.zeros(len(x), dtype=torch.bool, device=x.device)
    evaluations = 1
    accepted = 0
    last_error = 1.0
    while sigma > last:
        if evaluations == max_evaluations:
            return levels[-1][1], False
        remaining = math.log(sigma / last)
        step = remaining / 2 if proposed < remaining < 2 * proposed else min(max(proposed, 1e-4), remaining)
        target = last if step == remaining else sigma * math.exp(-step)
        predicted = exponential_integral(levels[-2:], sigma, target)
        ahead = (target, denoise(target / sigma * x + predicted, target))
        corrected = exponential_integral([*levels[-2:], ahead], sigma, target)
        errors = local_errors(corrected - predicted, *ahead).masked_fill(diverged, 0.0)
        error = errors.max().item() / local_tolerance
        proposed = next_step(step, error, last_error, order=len(levels[-2:]) + 1)
        evaluations += 1
        if error <= 1.0:
            levels.append(ahead)
            x = callback(accepted, target / sigma * x + corrected, target)
            rms = (x * alpha(target)).flatten(1).square().mean(dim=1).sqrt()
            diverged = diverged | (rms > DIVERGED_RMS)
            sigma = target
            last_error = max(error, 1e-4)
            accepted += 1
    return callback(accepted, denoised_at_zero(levels), 0.0), True


def next_step(step: float, error: float, last_error: float, order: int) -> float:
    """Next step size from the last error and the last accepted error, both relative to the tolerance.

    A PI controller (Hairer & Wanner, Solving Ordinary Differential Equations II, Section IV.2).
    """
    if error > 1.0:
        return step * max(0.9 * error ** (-1 / order), 0.3)
    change = 0.9 * max(error, 1e-4) ** (-0.7 / order) * last_error ** (0.4 / order)
    return step * min(max(change, 0.3), 2.5)


def local_errors(difference: Tensor, sigma: float, denoised: Tensor) -> Tensor:
    """RMS differences of samples (B, C, h, w), relative to the expected RMS of the result, (B,); 0 if not finite.

    The square of that RMS is |D|^2 plus the posterior variance of unit-variance latents, sigma^2 / (1 + sigma^2). |D|
    is clamped to 2, that of the most extreme pictures: in a diverging run D grows, too.
    """
    size = denoised.flatten(1).square().mean(dim=1).clamp(max=4.0) + sigma**2 / (1 + sigma**2)
    errors = (difference.flatten(1).square().mean(dim=1) / size).sqrt().nan_to_num(nan=math.inf)
    return errors.masked_fill(~difference.flatten(1).isfinite().all(dim=1), 0.0)


# By name --------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Solver:
    """A solver, its nominal order of convergence, its default noise levels, and whether it takes `eta` and `draw`."""

    sample: Callable[..., Tensor]
    order: int
    spacing: Callable[[NoiseSchedule, int, float], list[float]]
    adds_noise: bool = False


SOLVERS: dict[str, Solver] = {
    "ddim": Solver(sample_ddim, 1, NoiseSchedule.trailing, adds_noise=True),
    # Levels even in time are too far apart near the end, which limits multistep solvers to first order.
    "euler": Solver(sample_ddim, 1, NoiseSchedule.karras),
    "heun": Solver(sample_heun, 2, NoiseSchedule.karras),
    "dpm++2m": Solver(sample_dpmpp_2m, 2, NoiseSchedule.karras),
    "unipc": Solver(sample_unipc, 3, NoiseSchedule.karras),
}
