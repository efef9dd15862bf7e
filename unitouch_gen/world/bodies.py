"""Bodies as contacts have them: balls, rods, edges, rims and the like, as height fields.

Each is a function of position in its own frame (mm), of a size (mm) and of three numbers in [0, 1) that pick its
proportions; it gives heights of which the highest is near 0, and `NOTHING` where there is no body.
"""

from collections.abc import Callable

import torch
from torch import Tensor

NOTHING = -1e3
"""Height where there is no body, mm: out of any gel's reach."""

Body = Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]
"""Heights (N, R, R) from x and y, (N, R, R), the size (N, 1, 1) and three numbers (N, 3, 1, 1)."""


def cap(distance2: Tensor, radius: Tensor | float) -> Tensor:
    """Height of a sphere's or cylinder's top by the squared distance from its axis; nothing beyond the radius."""
    return torch.where(distance2 < radius**2, (radius**2 - distance2).clamp_min(0.0).sqrt() - radius, NOTHING)


def slab(beyond: Tensor, rounding: Tensor | float) -> Tensor:
    """A flat face up to where `beyond` (mm outside of its rim) is 0, whose rim is rounded."""
    inside = (beyond + rounding).clamp_min(0.0)
    return torch.where(beyond < 0.0, (rounding**2 - inside**2).clamp_min(0.0).sqrt() - rounding, NOTHING)


def ball(x: Tensor, y: Tensor, size: Tensor, numbers: Tensor) -> Tensor:
    return cap(x**2 + y**2, size)


def rod(x: Tensor, y: Tensor, size: Tensor, numbers: Tensor) -> Tensor:
    length = size * (1.0 + 8.0 * numbers[:, 0])
    beyond = (x.abs() - length).clamp_min(0.0)
    return cap(y**2 + beyond**2, size) + 0.15 * (numbers[:, 1] - 0.5) * x  # which may lie askew


def blob(x: Tensor, y: Tensor, size: Tensor, numbers: Tensor) -> Tensor:
    """A fruit, or a knuckle: an ellipsoid with dents."""
    a, b, _ = numbers.unbind(1)
    dent = torch.sin(x * (0.6 + a) + 6.0 * b) * torch.sin(y * (0.6 + b) + 6.0 * a)
    return cap((x**2 + (1.0 + 1.5 * a) * y**2), 1.5 * size) + 0.25 * b * dent


def edge(x: Tensor, y: Tensor, size: Tensor, numbers: Tensor) -> Tensor:
    return slab(x, 0.1 + 0.5 * numbers[:, 0]) + 0.1 * (numbers[:, 1] - 0.5) * x


def corner(x: Tensor, y: Tensor, size: Tensor, numbers: Tensor) -> Tensor:
    return slab(torch.maximum(x, y * (0.6 + 0.4 * numbers[:, 1]) + x * 0.4 * numbers[:, 1]), 0.1 + 0.5 * numbers[:, 0])


def box(x: Tensor, y: Tensor, size: Tensor, numbers: Tensor) -> Tensor:
    wide = size * (0.4 + 1.6 * numbers[:, 1])
    return slab(torch.maximum(x.abs() - size, y.abs() - wide), 0.1 + 0.4 * numbers[:, 0])


def coin(x: Tensor, y: Tensor, size: Tensor, numbers: Tensor) -> Tensor:
    """A disc with a raised rim, and something raised in its middle."""
    radius = torch.hypot(x, y)
    rim = 0.15 * torch.exp(-(((radius - 0.9 * size) / (0.06 * size)) ** 2))
    inner = 0.1 * torch.cos(2 * torch.atan2(y, x) * torch.floor(1.0 + 3.0 * numbers[:, 0])) * (radius < 0.6 * size)
    return slab(radius - size, 0.1) + rim + inner - 0.15


def ring(x: Tensor, y: Tensor, size: Tensor, numbers: Tensor) -> Tensor:
    """A rim, or a washer: a tube that is bent into a circle."""
    tube = 0.15 * size * (0.5 + numbers[:, 0])
    return cap((torch.hypot(x, y) - size) ** 2, tube)


BODIES: dict[str, Body] = {body.__name__: body for body in (ball, rod, blob, edge, corner, box, coin, ring)}
"""By name."""
