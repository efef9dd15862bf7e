"""Reference solutions of a probability-flow ODE by scipy's DOP853, an explicit Runge-Kutta method of order 8.

It integrates in u = log sigma, where the linear part of the flow has rates between 0 and 1 however ill-conditioned the
data is. The state is z = alpha x, whose root mean square stays near 1 along the path,

    dz/du = alpha^2 z - alpha D(z / alpha, sigma),

so one tolerance serves as the relative and the absolute one.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
from scipy.integrate import solve_ivp
from torch import Tensor

from unitouch_gen.errors import NonFiniteError, NotConvergedError
from unitouch_gen.schedule import alpha
from unitouch_gen.solvers import Denoise


def relative_rms(value: Tensor, truth: Tensor) -> Tensor:
    """Root-mean-square distance of each sample (B, ...) to the truth, over the truth's own size, float64 (B,)."""
    truth = truth.double().flatten(1)
    return (value.double().flatten(1) - truth).norm(dim=1) / truth.norm(dim=1)


def solve_flow(denoise: Denoise, x: Tensor, sigmas: Sequence[float], rtol: float) -> list[Tensor]:
    """x at each of falling noise levels, (B, C, h, w) float64, from x at the first of them.

    Args:
        denoise: D(x, sigma) of float64 states.
        rtol: Tolerance of a step, relative to the RMS of each sample, from 1e-12.

    Raises:
        NonFiniteError: If D is not finite; the message names noise level and sample.
        NotConvergedError: If 100,000 evaluations are not enough.
    """
    evaluations = 0

    def slope(u: float, z: np.ndarray) -> np.ndarray:
        nonlocal evaluations
        sigma, evaluations = math.exp(u), evaluations + 1
        denoised = denoise(torch.from_numpy(z.reshape(x.shape)) / alpha(sigma), sigma)
        finite = denoised.flatten(1).isfinite().all(dim=1).tolist()
        if not all(finite):
            raise NonFiniteError(f"The prediction for sample {finite.index(False)} is not finite at sigma {sigma:.3g}.")
        if evaluations > 100_000:
            raise NotConvergedError(f"The reference is at sigma {sigma:.3g} after {evaluations} evaluations.")
        return alpha(sigma) ** 2 * z - alpha(sigma) * denoised.double().numpy().reshape(-1)

    levels, start = [math.log(sigma) for sigma in sigmas], (x.double() * alpha(sigmas[0])).reshape(-1).numpy()
    # Its norm is over the whole batch: divided by sqrt(B), no sample errs by more, even if all of the error is its own.
    tolerance = max(rtol / math.sqrt(len(x)), 1e-13)
    found = solve_ivp(slope, (levels[0], levels[-1]), start, "DOP853", levels, rtol=tolerance, atol=tolerance)
    if not found.success:
        raise NotConvergedError(f"The reference stopped after {evaluations} evaluations: {found.message}")
    return [torch.from_numpy(z.reshape(x.shape)) / alpha(sigma) for z, sigma in zip(found.y.T, sigmas, strict=True)]
