"""Bodies as contacts have them: balls, rods, edges, rims, screws, meshes, letters and the like, as height fields.

Each is a function of position in its own frame (mm), of a size (mm) and of three numbers in [0, 1) that pick its
proportions; it gives heights of which the highest is near 0, and `NOTHING` where there is no body.
"""

import math
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


def repeated(x: Tensor, pitch: Tensor) -> Tensor:
    """Distance from the nearest multiple of a pitch, signed."""
    return x - pitch * torch.round(x / pitch)


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


def blade(x: Tensor, y: Tensor, size: Tensor, numbers: Tensor) -> Tensor:
    """Two faces that meet in a line."""
    return -y.abs() * (0.2 + 1.5 * numbers[:, 0])


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


def screw(x: Tensor, y: Tensor, size: Tensor, numbers: Tensor) -> Tensor:
    pitch = 0.4 + 1.2 * numbers[:, 0]
    thread = repeated(x + 0.25 * pitch * y / size, pitch).abs() / pitch
    return cap(y**2, size) - 0.8 * pitch * thread


def mesh(x: Tensor, y: Tensor, size: Tensor, numbers: Tensor) -> Tensor:
    """Wires that go over and under each other."""
    pitch = 0.8 + 3.0 * numbers[:, 0]
    wire = pitch * (0.12 + 0.15 * numbers[:, 1])
    over = 0.6 * wire * torch.cos(math.pi * x / pitch) * torch.cos(math.pi * y / pitch)
    return torch.maximum(cap(repeated(y, pitch) ** 2, wire) + over, cap(repeated(x, pitch) ** 2, wire) - over) - wire


def wires(x: Tensor, y: Tensor, size: Tensor, numbers: Tensor) -> Tensor:
    """A few of them side by side, each bent its own way."""
    height = torch.full_like(x, NOTHING)
    for index in range(4):
        turn = 0.5 * torch.sin(7.0 * numbers[:, 0] + 2.0 * index)
        place = (index - 1.5) * 2.0 * size * (0.6 + numbers[:, 1])
        bend = size * torch.sin(x * 0.3 + 5.0 * numbers[:, 2] + index)
        height = torch.maximum(height, cap((y - place - turn * x - bend) ** 2, 0.25 * size))
    return height


def beads(x: Tensor, y: Tensor, size: Tensor, numbers: Tensor) -> Tensor:
    """Balls, or grains of rice, that lie beside each other."""
    pitch = 0.8 + 0.5 * size
    row = torch.round(y / (0.87 * pitch))
    across = repeated(y, 0.87 * pitch)
    along = repeated(x + 0.5 * pitch * row, pitch)
    column = torch.round((x + 0.5 * pitch * row) / pitch)
    lifted = 0.25 * pitch * numbers[:, 0] * torch.sin(12.9898 * row + 78.233 * column + 50.0 * numbers[:, 2])
    return (
        cap((along**2 * (1.0 - 0.6 * numbers[:, 1]) + across**2), 0.5 * pitch) + lifted - 0.25 * pitch * numbers[:, 0]
    )


def bristles(x: Tensor, y: Tensor, size: Tensor, numbers: Tensor) -> Tensor:
    """The ends of hairs or pins, of different lengths."""
    pitch = 0.7 + 2.5 * numbers[:, 0]
    row, column = torch.round(y / pitch), torch.round(x / pitch)
    noise = torch.sin(12.9898 * row + 78.233 * column + 50.0 * numbers[:, 2]) * 43758.5453  # of each bristle
    noise = noise - torch.floor(noise)
    away = torch.hypot(
        repeated(x, pitch) - 0.3 * pitch * (noise - 0.5),
        repeated(y, pitch) + 0.3 * pitch * (torch.frac(7 * noise) - 0.5),
    )
    return cap(away**2, 0.15 * pitch + 0.1) - 0.8 * numbers[:, 1] * torch.frac(31 * noise)


def holes(x: Tensor, y: Tensor, size: Tensor, numbers: Tensor) -> Tensor:
    """A plate with holes, as strainers have them."""
    pitch = 1.2 + 3.0 * numbers[:, 0]
    away = torch.hypot(repeated(x, pitch), repeated(y, pitch)) - pitch * (0.2 + 0.2 * numbers[:, 1])
    return slab(-away, 0.1 + 0.1 * pitch)


def ribs(x: Tensor, y: Tensor, size: Tensor, numbers: Tensor) -> Tensor:
    """Grooves side by side: a handle, a zip, corduroy."""
    pitch = 0.6 + 3.5 * numbers[:, 0]
    wave = torch.cos(2 * math.pi * y / pitch)
    return (0.05 + 0.25 * numbers[:, 1]) * pitch * (wave.sign() * wave.abs() ** (0.3 + numbers[:, 2]) - 1.0) * 0.5


STROKES: tuple[tuple[tuple[float, float, float, float], ...], ...] = (
    ((-1, 1, 0, -1), (0, -1, 1, 1), (-0.5, 0, 0.5, 0)),  # A
    ((-1, -1, 1, -1), (-1, -1, -1, 1), (-1, 0, 0.6, 0), (-1, 1, 1, 1)),  # E
    ((-1, -1, -1, 1), (1, -1, 1, 1), (-1, 0, 1, 0)),  # H
    ((-1, -1, -1, 1), (1, -1, -1, 0), (-1, 0, 1, 1)),  # K
    ((-1, -1, -1, 1), (-1, 1, 1, 1)),  # L
    ((-1, 1, -1, -1), (-1, -1, 0, 0), (0, 0, 1, -1), (1, -1, 1, 1)),  # M
    ((-1, 1, -1, -1), (-1, -1, 1, 1), (1, 1, 1, -1)),  # N
    ((-1, -1, 1, -1), (0, -1, 0, 1)),  # T
    ((-1, -1, 0, 1), (0, 1, 1, -1)),  # V
    ((-1, -1, 1, 1), (-1, 1, 1, -1)),  # X
    ((-1, -1, 1, -1), (1, -1, -1, 1), (-1, 1, 1, 1)),  # Z
)
"""Letters as lines from (x, y) to (x, y) in a square."""


def letters(x: Tensor, y: Tensor, size: Tensor, numbers: Tensor) -> Tensor:
    """Raised or engraved letters on a flat face."""
    half = 0.6 + 0.35 * size
    index = torch.round(x / (3.0 * half))
    u, v = repeated(x, 3.0 * half) / half, y / (1.3 * half)
    nearest = torch.full_like(x, 10.0)
    first = (numbers[:, 0] * len(STROKES)).floor()
    which = torch.remainder(first + index, float(len(STROKES)))
    for number, strokes in enumerate(STROKES):
        away = torch.full_like(x, 10.0)
        for ax, ay, bx, by in strokes:
            dx, dy = bx - ax, by - ay
            along = (((u - ax) * dx + (v - ay) * dy) / (dx * dx + dy * dy)).clamp(0.0, 1.0)
            away = torch.minimum(away, torch.hypot(u - ax - along * dx, v - ay - along * dy))
        nearest = torch.where(which == number, away, nearest)
    stroke = torch.sigmoid((0.28 - nearest) * half / 0.08)
    depth = (0.1 + 0.4 * numbers[:, 1]) * torch.where(numbers[:, 2] < 0.6, 1.0, -1.0)
    return depth * stroke - depth.clamp_min(0.0)


BODIES: dict[str, Body] = {
    body.__name__: body
    for body in (
        ball, rod, blob, edge, corner, blade, box, coin, ring, screw,
        mesh, wires, beads, bristles, holes, ribs, letters,
    )
}  # fmt: skip
"""By name."""
