"""What a touch holds that can be measured: of a contact, as one sensor meets it, not of the words for its material."""

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
"""In this order: share of the view in contact; logarithms of the greatest and mean indentation (mm), of the RMS slope
over the view and where there is contact, of the RMS relief (mm) finer than 3 % and from 3 to 12 % of the view; the
grain's direction as cos and sin of twice its angle, weighted by how clear it is; where the contact's middle lies and
how far it reaches, half views; and how soft the object is."""


def contact_attributes(indentation: Tensor, view: float, compliance: Tensor) -> Tensor:
    """Attributes (N, 13) of contacts, in the order of `ATTRIBUTES`.

    Args:
        indentation: How far surfaces reach into a gel where its camera sees it, mm, >= 0, (N, S, S).
        view: Side of what it sees, mm, > 0.
        compliance: Of the objects, from 0, rigid, to 1, as soft as the gel, (N,).
    """
    size = indentation.shape[-1]
    touched = (indentation > 1e-4).float()
    cover = touched.mean(dim=(-2, -1))
    area = touched.sum(dim=(-2, -1)).clamp_min(1.0)
    along_y, along_x = _gradient(indentation, view)
    xx, yy, xy = ((a * b).mean(dim=(-2, -1)) for a, b in ((along_x, along_x), (along_y, along_y), (along_x, along_y)))
    power = xx + yy
    clear = power / (power + 1e-4) / power.clamp_min(1e-6)
    smooth = gaussian_blur(indentation, 0.03 * size)
    few = F.avg_pool2d(smooth, 4) if size % 4 == 0 else smooth  # which holds nothing finer
    parts = indentation - smooth, few - gaussian_blur(few, 0.12 * few.shape[-1])
    fine, coarse = (part.square().mean(dim=(-2, -1)).sqrt() for part in parts)
    axis = pixel_axis(size, 2.0)
    x = (touched * axis).sum(dim=(-2, -1)) / area
    y = (touched * axis[:, None]).sum(dim=(-2, -1)) / area
    away = (axis - x[:, None, None]) ** 2 + (axis[:, None] - y[:, None, None]) ** 2
    columns = (
        cover,
        torch.log(indentation.amax(dim=(-2, -1)) + 0.02),
        torch.log(indentation.mean(dim=(-2, -1)) + 0.003),
        torch.log(power.sqrt() + 0.01),
        0.5 * torch.log(power / cover.clamp_min(1e-3) + 1e-3),
        torch.log(fine + 1e-3),
        torch.log(coarse + 2e-3),
        clear * (xx - yy),
        clear * 2 * xy,
        x,
        y,
        ((touched * away).sum(dim=(-2, -1)) / area).sqrt(),
        compliance,
    )
    return torch.stack(columns, dim=1)


MAPS: tuple[str, ...] = ("depth", "slope x", "slope y", "steepness")
"""In this order: logarithm of the mean depth (mm), mean slopes, and logarithm of the mean squared slope."""

CELLS = 8  # along each side of a view


def contact_maps(depth: Tensor, view: float) -> Tensor:
    """What a gel does in each of 8 x 8 squares of its view, (N, 4, 8, 8), in the order of `MAPS`.

    Args:
        depth: How far a gel is displaced where its camera sees it, mm, (N, S, S).
        view: Side of what it sees, mm, > 0.
    """
    along_y, along_x = _gradient(depth, view)
    parts = torch.stack([depth, along_x, along_y, along_x**2 + along_y**2], dim=1)
    deep, slope_x, slope_y, steep = F.adaptive_avg_pool2d(parts, CELLS).unbind(dim=1)
    return torch.stack([torch.log(deep.clamp_min(0.0) + 0.02), slope_x, slope_y, torch.log(steep + 1e-4)], dim=1)


def _gradient(depth: Tensor, view: float) -> list[Tensor]:
    """Slopes along y and x of depths (N, S, S) over `view` mm; those beyond 2 are of cliffs."""
    return [slope.clamp(-2.0, 2.0) for slope in torch.gradient(depth, spacing=view / depth.shape[-1], dim=(1, 2))]


def gaussian_blur(field: Tensor, deviation: float) -> Tensor:
    """A field (N, S, S) blurred by a Gaussian, deviation in pixels; its rim repeats."""
    reach = math.ceil(2.5 * deviation)
    weights = torch.exp(-0.5 * (torch.arange(-reach, reach + 1) / deviation) ** 2)
    return convolved(field, weights / weights.sum())
