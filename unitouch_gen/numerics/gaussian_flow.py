"""The probability-flow ODE of Gaussian data in closed form, with and without guidance.

Along an axis of a Gaussian N(m, v), with tau = sigma^2, D(x) = (v x + tau m) / (v + tau), so the flow's
dx/dsigma = (x - D) / sigma is linear: dx/dtau = (x - m) / (2 (v + tau)), and x - m goes as sqrt(v + tau). Guidance of
scale g between two Gaussians that share their axes adds two such terms,

    dx/dtau = [(1 - g) (x - m_u) / (v_u + tau) + g (x - m_c) / (v_c + tau)] / 2,

whose homogeneous solution is h(tau) = (v_u + tau)^((1 - g) / 2) (v_c + tau)^(g / 2). What the difference of the means
adds is an integral (variation of constants), an incomplete beta function, taken here by Gauss-Legendre quadrature to
rounding error.
"""

import math

import numpy as np
import torch
from torch import Tensor

from unitouch_gen.errors import InvalidInputError, check_number
from unitouch_gen.numerics.exact import GaussianMixture, check_same_space

NODES = 12
PANELS = 8
"""Of the quadrature, for each unit of log(v + tau) and at least; the integrand changes by about e^(1/2) across one."""


def has_flow(data: GaussianMixture, unconditional: GaussianMixture | None = None) -> bool:
    """Whether the flow is known: one Gaussian, or two along the same axes."""
    if unconditional is None:
        return data.is_gaussian
    return data.is_gaussian and unconditional.is_gaussian and _same_axes(data, unconditional)


def gaussian_flow(
    data: GaussianMixture,
    x: Tensor,
    sigma_from: float,
    sigma_to: float = 0.0,
    *,
    unconditional: GaussianMixture | None = None,
    guidance_scale: float = 1.0,
) -> Tensor:
    """Where the flow takes states from one noise level to a lower one.

    Args:
        data: One Gaussian.
        x: States x_0 + sigma n at `sigma_from`, (B, ...).
        sigma_from, sigma_to: `sigma_from` >= `sigma_to` >= 0.
        unconditional: For guidance, one Gaussian along the same axes.
        guidance_scale: g; up to 1 there is no guidance, as in `diffusion.sampling.Guidance`.

    Returns:
        States at `sigma_to`, in the shape of `x`, float64.

    Raises:
        InvalidInputError: If there is no closed form, or the noise levels are out of range.
    """
    check_number("sigma_to", sigma_to, 0.0)
    check_number("sigma_from", sigma_from, sigma_to, hint="The flow runs towards less noise.")
    check_same_space(data, unconditional)
    if unconditional is None or guidance_scale <= 1.0:
        unconditional, guidance_scale = data, 1.0
    if not has_flow(data, unconditional):
        raise InvalidInputError(
            "`data` or `unconditional` is a mixture, or their axes differ, and such a flow has no closed form; solve "
            "it with `solve_reference`."
        )
    high, low = sigma_from**2, sigma_to**2
    conditional, other = data.variances[0], unconditional.variances[0]
    mean, shift = data.axis_means[0], data.axis_means[0] - unconditional.axis_means[0]
    kept = _growth(other, conditional, guidance_scale, low, high)
    offset = mean + 0.5 * (guidance_scale - 1) * shift * _integral(other, conditional, guidance_scale, low, high)
    device = x.device
    return data.from_axes(offset.to(device) + kept.to(device) * (data.to_axes(x) - mean.to(device)), x.shape)


def _growth(other: Tensor, conditional: Tensor, scale: float, low: float, high: float) -> Tensor:
    """h(low) / h(high), (d,)."""
    logarithm = (1 - scale) * ((other + low) / (other + high)).log()
    return (0.5 * (logarithm + scale * ((conditional + low) / (conditional + high)).log())).exp()


def _integral(other: Tensor, conditional: Tensor, scale: float, low: float, high: float) -> Tensor:
    """Integral of h(low) / (h(tau) (v_u + tau)) over tau from low to high, (d,).

    In p = log(smallest v + tau) the integrand is smooth everywhere: its nearest poles are pi away from the real axis.
    """
    if scale == 1.0 or low == high:
        return torch.zeros_like(other)
    smallest = torch.minimum(other, conditional)
    begin, end = (smallest + low).log(), (smallest + high).log()
    panels = math.ceil((end - begin).max().item() * max(PANELS, scale))
    nodes, weights = (torch.from_numpy(values) for values in np.polynomial.legendre.leggauss(NODES))
    places = ((torch.arange(panels, dtype=torch.float64)[:, None] + (nodes + 1) / 2) / panels).reshape(-1, 1)
    level = (begin + (end - begin) * places).exp()  # smallest v + tau, (n, d)
    spread_u, spread_c = other - smallest + level, conditional - smallest + level
    logarithm = (1 - scale) * ((other + low) / spread_u).log() + scale * ((conditional + low) / spread_c).log()
    values = (0.5 * logarithm).exp() / spread_u * level
    return (end - begin) * (weights.repeat(panels) @ values) / (2 * panels)


def _same_axes(data: GaussianMixture, unconditional: GaussianMixture) -> bool:
    if data.rotation is None or unconditional.rotation is None:
        return data.rotation is unconditional.rotation
    return torch.equal(data.rotation, unconditional.rotation)
