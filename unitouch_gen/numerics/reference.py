"""Reference solutions of a probability-flow ODE, by two different converged solvers.

The two have nothing in common but the ODE: DOP853 (Hairer, Nørsett & Wanner, 1993) is an explicit Runge-Kutta method of
order 8, and VODE's (Brown, Byrne & Hindmarsh, 1989) is an implicit Adams multistep method of orders up to 12. It solves
its implicit equations by functional iteration, so it never asks for a Jacobian, which would take as many evaluations as
there are latents. Where they differ is the reference's own error.

Both integrate in u = log sigma, where the linear part of the flow has rates between 0 and 1 however ill-conditioned the
data is. Their state is y = x / c with c = sqrt(sigma^2 + scale^2), whose root mean square stays near 1 along the path,

    dy/du = (scale / c)^2 y - D(c y, sigma) / c,

so one tolerance serves as the relative and the absolute one. The batch is solved whole, as the conditions of a network
are bound to its rows. The solvers' norms are root mean squares over all of it: with the tolerance divided by sqrt(B)
no sample errs more in a step than it was allowed, even if all of the error is its own.
"""

import math
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from scipy.integrate import DOP853, ode
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

TIGHTER = 0.1
"""Share of the tolerance for the Adams method, which accumulates about ten times the error of DOP853 at the same."""

Progress = Callable[[str, float], None]
"""(name of the solver, share of its path that is done, from 0 to 1)."""


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
        latents: x at sigma = 0, by DOP853, float64 (B, C, h, w).
        disagreement: Relative RMS distance of the other solver's, float64 (B,): the reference's own error.
        evaluations: Calls of the denoiser, by solver; with guidance one holds both branches. Empty for a closed form.
        seconds: Time by solver.
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
    """Solves a flow with both solvers.

    Args:
        flow: That of an exact problem or of a trained network.
        noise: Unit-variance, the variance-preserving state at the largest noise level, (B, C, h, w).
        rtol: Tolerance of a step relative to a sample's RMS, from 1e-12 to 1e-1. Exact problems reach 1e-10 in some
            hundred evaluations. Trained networks change with every timestep and pull neighbouring paths apart: 1e-5
            took the built-in ones a thousand to two of either solver, for an error of 1e-4 to 1e-3.
        end: "denoise": the denoiser's prediction at the smallest noise level of the schedule. "extrapolate": continued
            from there and 1.5 times that level to sigma = 0 along a line in sigma^2, as named solvers do. "zero": the
            flow goes on to sigma = 0, for denoisers that know what is there.
        max_evaluations: After which a solver gives up.
        progress: Called after every evaluation.

    Raises:
        NonFiniteError: If the denoiser returns values that are not finite; the message names noise level and sample.
        NotConvergedError: If a solver gives up.
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
    # To sigma = 0 the second one's path goes on to half the level, so that too high a level shows as well.
    for name, solve, tolerance, part in (("dop853", _dop853, rtol, 1.0), ("adams", _adams, TIGHTER * rtol, 0.5)):
        started = time.perf_counter()
        last = flow.schedule.sigma_min if flow.last_sigma is None or end != "zero" else part * flow.last_sigma
        path = _Path(flow, name, noise.shape, last, max_evaluations, progress)
        begin, denoised = path.span[0], []
        state = (flow.start(noise) / math.hypot(math.exp(begin), flow.scale)).reshape(-1).numpy()
        for sigma in [APART * last, last] if end == "extrapolate" else [last]:
            state = solve(path, state, (begin, math.log(sigma)), tolerance / math.sqrt(len(noise)))
            begin, x = math.log(sigma), path.x(state, sigma)
            denoised.append(path.denoise(x, sigma))
        result = denoised[-1]
        if end == "extrapolate":  # D is even in sigma where the density is smooth
            result = result + (result - denoised[0]) / (APART**2 - 1)
        elif end == "zero":
            # One step in tau = sigma^2, in which the flow is smooth at 0: dx/dtau = (x - D) / (2 tau), so
            # x - tau dx/dtau = (x + D) / 2. What is left out is of the order (tau / variance)^2.
            result = (x + result) / 2
        results.append(result)
        evaluations[name], seconds[name] = path.evaluations, time.perf_counter() - started
    return Reference(results[0], relative_rms(results[1], results[0]), evaluations, seconds)


@dataclass
class _Path:
    """The ODE as the solvers see it: flat arrays y over u = log sigma, and what it took."""

    flow: Flow
    name: str
    shape: torch.Size
    last_sigma: float
    max_evaluations: int
    progress: Progress | None
    evaluations: int = 0
    share: float = 0.0

    @property
    def span(self) -> tuple[float, float]:
        """First and last u."""
        return math.log(self.flow.schedule.sigma_max), math.log(self.last_sigma)

    def x(self, y: np.ndarray, sigma: float) -> Tensor:
        """x of a state at a noise level, (B, C, h, w)."""
        return torch.from_numpy(y.reshape(self.shape) * math.hypot(sigma, self.flow.scale))

    def __call__(self, u: float, y: np.ndarray) -> np.ndarray:
        """dy/du."""
        sigma = math.exp(u)
        size = math.hypot(sigma, self.flow.scale)
        denoised = self.denoise(self.x(y, sigma), sigma).numpy()
        if self.progress is not None:
            begin, end = self.span
            self.share = max(self.share, min((u - begin) / (end - begin), 1.0))
            self.progress(self.name, self.share)
        return (self.flow.scale / size) ** 2 * y - denoised.reshape(-1) / size

    def denoise(self, x: Tensor, sigma: float) -> Tensor:
        """D(x, sigma), counted and checked."""
        if self.evaluations == self.max_evaluations:
            raise NotConvergedError(
                f"{self.name} is at noise level {sigma:.3g} after {self.evaluations} evaluations; raise `rtol` or "
                "`max_evaluations`."
            )
        self.evaluations += 1
        denoised = self.flow.denoise(x, sigma)
        broken = torch.nonzero(~torch.isfinite(denoised.flatten(1)).all(dim=1))
        if len(broken):
            raise NonFiniteError(
                f"The prediction for sample {int(broken[0])} is not finite at noise level {sigma:.3g}, so it has no "
                "reference; lower the guidance, or run the network in float32."
            )
        return denoised


def _dop853(path: _Path, state: np.ndarray, span: tuple[float, float], tolerance: float) -> np.ndarray:
    solver = DOP853(path, span[0], state, span[1], rtol=tolerance, atol=tolerance)
    while solver.status == "running":
        message = solver.step()
    if solver.status == "failed":
        raise NotConvergedError(f"dop853 stopped at noise level {math.exp(solver.t):.3g}: {message} Raise `rtol`.")
    return solver.y


def _adams(path: _Path, state: np.ndarray, span: tuple[float, float], tolerance: float) -> np.ndarray:
    raised: list[BaseException] = []

    def guarded(u: float, y: np.ndarray) -> np.ndarray:
        """The slope, or 0 once it has raised: VODE swallows errors, and comes to its end soon where nothing changes."""
        try:
            return np.zeros_like(y) if raised else path(u, y)
        except BaseException as error:  # also a keyboard's
            raised.append(error)
            return np.zeros_like(y)

    solver = ode(guarded).set_integrator("vode", method="adams", rtol=tolerance, atol=tolerance, nsteps=10**7)
    solver.set_initial_value(state, span[0])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the return code says the same
        state = solver.integrate(span[1])
    if raised:
        raise raised[0]
    if not solver.successful():
        reason = solver._integrator.messages.get(solver.get_return_code(), "Unexpected return code.")
        raise NotConvergedError(f"adams stopped at noise level {math.exp(solver.t):.3g}: {reason} Raise `rtol`.")
    return state
