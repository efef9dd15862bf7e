"""Measurable attributes of a contact under one sensor, and maps of the gel's displacement."""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from unitouch_gen.world.grids import convolved, pixel_axis

ATTRIBUTES: tuple[str, ...] = (
    "cover",
    "depth",
    "load",
    "slope",
    "steepness",
    "fine relief",
    "coarse relief",
    "grain x",
    "grain y",
    "place x",
    "place y",
    "extent",
    "compliance",
)
"""In this order:
- share of the view in contact;
- logarithms of the greatest and of the mean indentation, mm;
- logarithms of the RMS slope over the view, and where there is contact;
- logarithms of the RMS relief finer than 3 % of the view, and from 3 to 12 % of it, mm;
- cos and sin of twice the angle of the grain, weighted by its coherence;
- middle of the contact along x and y, and its radius, half views;
- softness of the object, from 0 to 1."""


def contact_attributes(indentation: Tensor, view: float, compliance: Tensor) -> Tensor:
    """Attributes (N, 13) of contacts, in the order of `ATTRIBUTES`.

    Args:
        indentation: Depth of the surfaces in the gel, in the camera's view, mm, >= 0, (N, S, S).
        view: Side of the view, mm, > 0.
        compliance: Of the objects, from 0, rigid, to 1, as soft as the gel, (N,).
    """
    size = indentation.shape[-1]
    touched = (indentation > 1e-4).float()
    cover = touched.mean(dim=(-2, -1))
    area = touched.sum(dim=(-2, -1)).clamp_min(1.0)

    # Slopes and grain, by the structure tensor.
    slope_y, slope_x = _gradient(indentation, view)
    xx = (slope_x * slope_x).mean(dim=(-2, -1))
    yy = (slope_y * slope_y).mean(dim=(-2, -1))
    xy = (slope_x * slope_y).mean(dim=(-2, -1))
    power = xx + yy
    grain_weight = power / (power + 1e-4) / power.clamp_min(1e-6)

    # Relief in two bands. The smooth part has no detail, so fewer pixels hold it.
    smooth = gaussian_blur(indentation, 0.03 * size)
    pooled = F.avg_pool2d(smooth, 4) if size % 4 == 0 else smooth
    fine = _rms(indentation - smooth)
    coarse = _rms(pooled - gaussian_blur(pooled, 0.12 * pooled.shape[-1]))

    # Place and size.
    axis = pixel_axis(size, 2.0)
    x = (touched * axis).sum(dim=(-2, -1)) / area
    y = (touched * axis[:, None]).sum(dim=(-2, -1)) / area
    distance2 = (axis - x[:, None, None]) ** 2 + (axis[:, None] - y[:, None, None]) ** 2
    extent = ((touched * distance2).sum(dim=(-2, -1)) / area).sqrt()

    columns = (
        cover,
        torch.log(indentation.amax(dim=(-2, -1)) + 0.02),
        torch.log(indentation.mean(dim=(-2, -1)) + 0.003),
        torch.log(power.sqrt() + 0.01),
        0.5 * torch.log(power / cover.clamp_min(1e-3) + 1e-3),
        torch.log(fine + 1e-3),
        torch.log(coarse + 2e-3),
        grain_weight * (xx - yy),
        grain_weight * 2 * xy,
        x,
        y,
        extent,
        compliance,
    )
    return torch.stack(columns, dim=1)


def _rms(field: Tensor) -> Tensor:
    """Root mean square over the view of (N, S, S), (N,)."""
    return field.square().mean(dim=(-2, -1)).sqrt()


MAPS: tuple[str, ...] = ("depth", "slope x", "slope y", "steepness")
"""In this order: logarithm of the mean depth (mm), mean slopes, and logarithm of the mean squared slope."""

CELLS = 8  # cells along each side of a view


def contact_maps(depth: Tensor, view: float) -> Tensor:
    """Depth and slopes of a gel in each of 8 x 8 cells of its view, (N, 4, 8, 8), in the order of `MAPS`.

    Args:
        depth: Displacement of the gel in the camera's view, mm, (N, S, S).
        view: Side of the view, mm, > 0.
    """
    slope_y, slope_x = _gradient(depth, view)
    fields = torch.stack([depth, slope_x, slope_y, slope_x**2 + slope_y**2], dim=1)
    mean_depth, mean_slope_x, mean_slope_y, mean_square = F.adaptive_avg_pool2d(fields, CELLS).unbind(dim=1)
    log_depth = torch.log(mean_depth.clamp_min(0.0) + 0.02)
    steepness = torch.log(mean_square + 1e-4)
    return torch.stack([log_depth, mean_slope_x, mean_slope_y, steepness], dim=1)


def _gradient(depth: Tensor, view: float) -> list[Tensor]:
    """Slopes along y and x of depths (N, S, S) over `view` mm, clipped to +-2, beyond which are cliffs."""
    slopes = torch.gradient(depth, spacing=view / depth.shape[-1], dim=(1, 2))
    return [slope.clamp(-2.0, 2.0) for slope in slopes]


def gaussian_blur(field: Tensor, deviation: float) -> Tensor:
    """A field (N, S, S) blurred by a Gaussian, deviation in pixels; the border is replicated."""
    reach = math.ceil(2.5 * deviation)
    weights = torch.exp(-0.5 * (torch.arange(-reach, reach + 1) / deviation) ** 2)
    return convolved(field, weights / weights.sum())
