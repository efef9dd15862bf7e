"""Reference solutions of a probability-flow ODE by scipy's DOP853, an explicit Runge-Kutta method of order 8.

It integrates in u = log sigma, where the linear part of the flow has rates between 0 and 1 however ill-conditioned the
data is. The state is y = x / c with c = sqrt(sigma^2 + scale^2), whose root mean square stays near 1 along the path,

    dy/du = (scale / c)^2 y - D(c y, sigma) / c,

so one tolerance serves as the relative and the absolute one. A second solution at a tenth of the tolerance tells the
error of the first. The batch is solved whole, as the conditions of a network are bound to its rows. The solver's norm
is the root mean square over all of it: with the tolerance divided by sqrt(B) no sample errs more in a step than it was
allowed, even if all of the error is its own.
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import torch
from scipy.integrate import solve_ivp
from torch import Tensor

from unitouch_gen.errors import (
    InvalidInputError,
    NonFiniteError,
    NotConvergedError,
    check_choice,
    check_finite,
    check_integer,
    check_number,
    describe,
)
from unitouch_gen.schedulers.schedule import NoiseSchedule

ENDS = ("denoise", "extrapolate", "zero")

APART = 1.5
"""Ratio of the two noise levels from which D is extrapolated to none, as named solvers do."""

SOLUTIONS = {"coarse": (1.0, 1.0), "fine": (0.1, 0.5)}
"""Two solutions: shares of the tolerance, and of the last noise level where the flow goes on to sigma = 0, so that too
high a level shows as well."""

LEAST = 1e-13
"""Least relative tolerance that scipy takes without a warning, rounded up."""

Progress = Callable[[str, float], None]
"""(name of the solution, share of its path that is done, from 0 to 1)."""


@dataclass(frozen=True, eq=False)
class Flow:
    """The probability-flow ODE of a denoiser, exact or trained, from the largest noise level of a schedule.

    In the variance-exploding frame x = x_0 + sigma n it is dx/dsigma = (x - D(x, sigma)) / sigma (Karras et al., 2022,
    Equation 3), from unit-variance noise taken as the variance-preserving state at the largest noise level.

    Attributes:
        denoise: D: (x (B, C, h, w) float64 on the CPU, sigma) -> prediction of x_0, alike; with guidance, guided.
        schedule: Where the flow starts and the network's knowledge ends.
        scale: Size of a coordinate of x_0; states are measured against sqrt(sigma^2 + scale^2).
        last_sigma: A noise level far below any structure of the data, for a flow that goes on to sigma = 0; `None`
            where the denoiser knows nothing below the schedule's smallest level.
    """

    denoise: Callable[[Tensor, float], Tensor]
    schedule: NoiseSchedule
    scale: float = 1.0
    last_sigma: float | None = None

    def start(self, noise: Tensor) -> Tensor:
        """x at the largest noise level, float64 on the CPU: z = `noise` (B, C, h, w), x = z sqrt(1 + sigma^2)."""
        return noise.detach().cpu().double() * math.hypot(1.0, self.schedule.sigma_max)


@dataclass(frozen=True, eq=False)
class Reference:
    """A reference solution and how far it can be trusted.

    Attributes:
        latents: x at sigma = 0, the fine solution, float64 (B, C, h, w).
        disagreement: Relative RMS distance of the coarse solution, float64 (B,): a bound on the reference's own error.
        evaluations: Calls of the denoiser, by solution; with guidance one holds both branches. Empty for a closed form.
        seconds: Time by solution.
    """

    latents: Tensor
    disagreement: Tensor
    evaluations: dict[str, int] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)

    @classmethod
    def exact(cls, latents: Tensor) -> "Reference":
        """A solution in closed form, or one whose own error is not asked for."""
        return cls(latents, torch.zeros(len(latents), dtype=torch.float64))

    @classmethod
    def joined(cls, parts: Sequence["Reference"]) -> "Reference":
        """One reference of several: samples in a row, evaluations and seconds summed."""

        def total(name: str) -> dict[str, Any]:
            return {key: sum(getattr(part, name)[key] for part in parts) for key in getattr(parts[0], name)}

        latents, disagreement = (
            torch.cat([getattr(part, name) for part in parts]) for name in ("latents", "disagreement")
        )
        return cls(latents, disagreement, total("evaluations"), total("seconds"))


def relative_rms(value: Tensor, truth: Tensor) -> Tensor:
    """Root-mean-square distance of each sample (B, ...) to the truth over the truth's root mean square, float64 (B,).

    Raises:
        InvalidInputError: If the shapes differ.
    """
    if value.shape != truth.shape:
        raise InvalidInputError(f"`value` is {describe(value)} and `truth` {describe(truth)}; pass the same shape.")
    truth = truth.double().flatten(1)
    distance = (value.to(truth.device).double().flatten(1) - truth).norm(dim=1)
    return distance / truth.norm(dim=1).clamp_min(torch.finfo(torch.float64).tiny)


def solve_reference(
    flow: Flow,
    noise: Tensor,
    *,
    rtol: float = 1e-6,
    end: str = "denoise",
    max_evaluations: int = 100_000,
    progress: Progress | None = None,
) -> Reference:
    """Solves a flow twice, at a tolerance and at a tenth of it.

    Args:
        flow: That of an exact problem or of a trained network.
        noise: Unit-variance, the variance-preserving state at the largest noise level, (B, C, h, w).
        rtol: Tolerance of a step relative to a sample's RMS, from 1e-12 to 1e-1. Trained networks change with every
            timestep and pull neighbouring paths apart, so they take thousands of evaluations below 1e-5.
        end: "denoise": the denoiser's prediction at the smallest noise level of the schedule. "extrapolate": continued
            from there and 1.5 times that level to sigma = 0 along a line in sigma^2, as named solvers do. "zero": the
            flow goes on to sigma = 0, for denoisers that know what is there.
        max_evaluations: After which a solution is given up.
        progress: Called after every evaluation.

    Raises:
        NonFiniteError: If the denoiser returns values that are not finite; the message names noise level and sample.
        NotConvergedError: If a solution is given up.
        InvalidInputError: If an argument is out of range, or the flow knows nothing below its schedule and `end` is
            "zero".
    """
    check_number("rtol", rtol, 1e-12, 0.1)
    check_choice("end", end, ENDS)
    check_integer("max_evaluations", max_evaluations, 1)
    check_finite("noise", noise)
    if end == "zero" and flow.last_sigma is None:
        raise InvalidInputError(
            "`end` is 'zero', but this flow's denoiser knows nothing below the smallest noise level of its schedule; "
            "take 'denoise', or set `last_sigma` of the flow."
        )
    results, evaluations, seconds = [], {}, {}
    for name, (share, part) in SOLUTIONS.items():
        started = time.perf_counter()
        last = flow.schedule.sigma_min if end != "zero" or flow.last_sigma is None else part * flow.last_sigma
        levels = [APART * last, last] if end == "extrapolate" else [last]
        told = None if progress is None else partial(progress, name)
        states, evaluations[name] = _solve(flow, noise, share * rtol, levels, max_evaluations, told)
        x, result = states[-1]
        if end == "extrapolate":  # D is even in sigma where the density is smooth
            result = result + (result - states[0][1]) / (APART**2 - 1)
        elif end == "zero":
            # One step in tau = sigma^2, in which the flow is smooth at 0: dx/dtau = (x - D) / (2 tau), so
            # x - tau dx/dtau = (x + D) / 2. What is left out is of the order (tau / variance)^2.
            result = (x + result) / 2
        results.append(result)
        seconds[name] = time.perf_counter() - started
    coarse, fine = results
    return Reference(fine, relative_rms(coarse, fine), evaluations, seconds)


def _solve(
    flow: Flow,
    noise: Tensor,
    rtol: float,
    levels: Sequence[float],
    max_evaluations: int,
    progress: Callable[[float], None] | None,
) -> tuple[list[tuple[Tensor, Tensor]], int]:
    """x and D(x) at falling noise levels, (B, C, h, w) each, and the number of evaluations."""
    evaluations, done, first = 0, 0.0, flow.schedule.sigma_max

    def denoise(x: Tensor, sigma: float) -> Tensor:
        nonlocal evaluations
        if evaluations == max_evaluations:
            raise NotConvergedError(
                f"The reference is at noise level {sigma:.3g} after {evaluations} evaluations; raise `rtol` or "
                "`max_evaluations`."
            )
        evaluations += 1
        denoised = flow.denoise(x, sigma)
        broken = torch.nonzero(~torch.isfinite(denoised.flatten(1)).all(dim=1))
        if len(broken):
            raise NonFiniteError(
                f"The prediction for sample {int(broken[0])} is not finite at noise level {sigma:.3g}, so it has no "
                "reference; lower the guidance, or run the network in float32."
            )
        return denoised

    def state(y: np.ndarray, sigma: float) -> Tensor:
        return torch.from_numpy(y.reshape(noise.shape) * math.hypot(sigma, flow.scale))

    def slope(u: float, y: np.ndarray) -> np.ndarray:
        nonlocal done
        sigma = math.exp(u)
        size = math.hypot(sigma, flow.scale)
        denoised = denoise(state(y, sigma), sigma).numpy()
        if progress is not None:
            done = max(done, min(math.log(first / sigma) / math.log(first / levels[-1]), 1.0))
            progress(done)
        return (flow.scale / size) ** 2 * y - denoised.reshape(-1) / size

    y, tolerance = flow.start(noise) / math.hypot(first, flow.scale), max(rtol / math.sqrt(len(noise)), LEAST)
    span, at = (math.log(first), math.log(levels[-1])), [math.log(sigma) for sigma in levels]  # keeps no other states
    solution = solve_ivp(slope, span, y.reshape(-1).numpy(), "DOP853", at, rtol=tolerance, atol=tolerance)
    if not solution.success:
        raise NotConvergedError(
            f"The reference stopped after {evaluations} evaluations: {solution.message} Raise `rtol`."
        )
    states = [state(y, sigma) for y, sigma in zip(solution.y.T, levels, strict=True)]
    found = [(x, denoise(x, sigma)) for x, sigma in zip(states, levels, strict=True)]
    return found, evaluations
