"""Bodies of objects as height fields: balls, rods, edges, rims and the like."""

import torch
from torch import Tensor

NOTHING = -1e3  # height where there is no body, mm, out of reach of any gel


def body(shape: str, x: Tensor, y: Tensor, size: Tensor, numbers: Tensor) -> Tensor:
    """Heights (N, R, R), mm, of bodies, with their top near 0 and `NOTHING` beside them.

    Args:
        shape: A name in `SHAPES`.
        x, y: Positions in the frame of each body, mm, (N, R, R).
        size: Radius, or half a side, mm, (N, 1, 1).
        numbers: Three numbers in [0, 1) that set the proportions of each body, (N, 3, 1, 1).
    """
    a, b, _ = numbers.unbind(1)
    match shape:
        case "ball":
            return cap(x**2 + y**2, size)
        case "rod":  # with round ends, and possibly tilted
            beyond = (x.abs() - size * (1.0 + 8.0 * a)).clamp_min(0.0)
            return cap(y**2 + beyond**2, size) + 0.15 * (b - 0.5) * x
        case "blob":  # a fruit, or a knuckle: an ellipsoid with dents
            dent = torch.sin(x * (0.6 + a) + 6.0 * b) * torch.sin(y * (0.6 + b) + 6.0 * a)
            return cap(x**2 + (1.0 + 1.5 * a) * y**2, 1.5 * size) + 0.25 * b * dent
        case "edge":
            return slab(x, 0.1 + 0.5 * a) + 0.1 * (b - 0.5) * x
        case "corner":
            other_side = y * (0.6 + 0.4 * b) + x * 0.4 * b
            return slab(torch.maximum(x, other_side), 0.1 + 0.5 * a)
        case "box":
            beyond_x = x.abs() - size
            beyond_y = y.abs() - size * (0.4 + 1.6 * b)
            return slab(torch.maximum(beyond_x, beyond_y), 0.1 + 0.4 * a)
        case "coin":  # a disc with a raised rim and a raised figure in its middle
            radius = torch.hypot(x, y)
            rim = 0.15 * torch.exp(-(((radius - 0.9 * size) / (0.06 * size)) ** 2))
            inner = 0.1 * torch.cos(2 * torch.atan2(y, x) * torch.floor(1.0 + 3.0 * a)) * (radius < 0.6 * size)
            return slab(radius - size, 0.1) + rim + inner - 0.15
        case "ring":  # a rim, or a washer: a tube bent into a circle
            return cap((torch.hypot(x, y) - size) ** 2, 0.15 * size * (0.5 + a))
        case _:
            return torch.zeros_like(x)


def cap(distance2: Tensor, radius: Tensor) -> Tensor:
    """Height of the top of a sphere or cylinder by the squared distance from its axis; `NOTHING` beyond the radius."""
    height = (radius**2 - distance2).clamp_min(0.0).sqrt() - radius
    return torch.where(distance2 < radius**2, height, NOTHING)


def slab(beyond: Tensor, rounding: Tensor | float) -> Tensor:
    """Height of a flat face with a rounded rim, by the signed distance from the rim, mm; `NOTHING` outside of it."""
    inside = (beyond + rounding).clamp_min(0.0)
    height = (rounding**2 - inside**2).clamp_min(0.0).sqrt() - rounding
    return torch.where(beyond < 0.0, height, NOTHING)
