"""One relief for each material: height in mm and a shade in about [-1, 1] that colours it, both (N, R, R).

Positive shade keeps the object's base colour; negative shade mixes in the material's second colour.
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from unitouch_gen.world.fields import Fields

Relief = tuple[Tensor, Tensor]
TAU = 2 * math.pi


def smooth_step(x: Tensor) -> Tensor:
    """Cubic step from 0 at x <= 0 to 1 at x >= 1."""
    x = x.clamp(0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


def groove(x: Tensor, period: Tensor, width: float) -> Tensor:
    """1 on a line repeated every `period` mm, falling smoothly to 0 at `width` mm from it."""
    distance = torch.abs(torch.frac(x / period + 512.0) - 0.5) * period
    return 1.0 - smooth_step(distance / width)


def concrete(f: Fields) -> Relief:
    grain = f.noise(1.7, 0.5)
    pits = smooth_step((f.noise(3.2, 0.25, shift=1) - 1.1) / 0.5)
    return f.amplitude * (0.07 * grain - 0.38 * pits), 0.5 * grain - 1.5 * pits


def plastic(f: Fields) -> Relief:
    period = 2.1 * f.scale
    a, b = TAU * f.x / period, TAU * (0.5 * f.x + 0.866 * f.y) / period
    lattice = (torch.cos(a) + torch.cos(b) + torch.cos(a - b)) / 3.0  # three waves at 120 degrees: hexagonal
    return f.amplitude * 0.16 * smooth_step(lattice), 0.6 * lattice


def glass(f: Fields) -> Relief:
    swell = f.noise(14.0, 0.3)
    return f.amplitude * 0.02 * swell, swell


def wood(f: Fields) -> Relief:
    drift = f.noise(9.0, 0.3, stretch=3.0)
    rings = torch.sin(TAU * (f.y + 0.9 * drift) / (2.3 * f.scale))
    pores = smooth_step((f.noise(1.1, 0.3, stretch=6.0, shift=1) - 0.9) / 0.6)
    return f.amplitude * (0.09 * rings - 0.10 * pores), 0.7 * rings - 0.8 * pores


def metal(f: Fields) -> Relief:
    scratches = f.noise(0.95, 0.3, stretch=24.0)
    return f.amplitude * 0.045 * scratches, 0.7 * scratches


def brick(f: Fields) -> Relief:
    grain = f.noise(1.3, 0.5)
    course = 11.0 * f.scale
    row = torch.floor(f.y / course + 0.5)
    bed = groove(f.y, course, 1.5)
    head = groove(f.x + 0.5 * row * 2.1 * course, 2.1 * course, 1.5)
    joint = torch.maximum(bed, head)
    height = f.amplitude * 0.11 * grain * (1.0 - 0.6 * joint) - 0.75 * joint
    return height, 0.35 * grain * (1.0 - joint) + 0.4 - 2.0 * joint


def tile(f: Fields) -> Relief:
    period = 6.2 * f.scale
    joint = torch.maximum(groove(f.x, period, 0.75), groove(f.y, period, 0.75))
    glaze = f.noise(9.0, 0.3)
    return f.amplitude * (-0.42 * joint + 0.012 * glaze), 0.3 + 0.08 * glaze - 1.6 * joint


def leather(f: Fields) -> Relief:
    first, second, _ = f.cells(2.1)
    pebble = smooth_step((second - first) / 0.45)
    return f.amplitude * (0.17 * pebble + 0.02 * f.noise(4.0)), pebble - 0.6


def synthetic_fabric(f: Fields) -> Relief:
    period = 1.75 * f.scale
    a, b = math.pi * f.x / period, math.pi * f.y / period
    over = torch.sin(a) * torch.sin(b) > 0  # plain weave: warp and weft take turns on top
    weave = torch.where(
        over, torch.cos(a).abs() * 0.35 + torch.sin(b).abs(), torch.cos(b).abs() * 0.35 + torch.sin(a).abs()
    )
    return f.amplitude * 0.11 * weave, weave - 0.75


def natural_fabric(f: Fields) -> Relief:
    period = 3.3 * f.scale
    wobble = 0.30 * f.noise(6.0, 0.35)
    rib = torch.sin(TAU * (f.y + wobble) / period)
    twist = torch.sin(TAU * (f.x + 0.55 * f.y + wobble) / (0.62 * period))
    yarn = 0.65 * rib + 0.45 * twist * (0.6 + 0.4 * rib) + 0.15 * f.noise(1.1, shift=1)
    return f.amplitude * 0.19 * yarn, 0.8 * yarn


def rubber(f: Fields) -> Relief:
    period = 4.6 * f.scale
    a, b = TAU * (f.x + f.y) / (1.414 * period), TAU * (f.x - f.y) / (1.414 * period)
    stud = torch.sigmoid(9.0 * (torch.sin(a) * torch.sin(b) - 0.12))
    return f.amplitude * 0.40 * stud, 1.2 * stud - 0.6


def paper(f: Fields) -> Relief:
    fold, crease = f.noise(9.5, 0.28), f.noise(7.0, 0.28, shift=1)
    facets = -torch.minimum(fold.abs(), crease.abs())  # |noise| folds the sheet along its zero lines
    return f.amplitude * 0.34 * facets, 0.9 + 1.6 * facets + 0.1 * f.noise(0.9)


def tree(f: Fields) -> Relief:
    plates = f.noise(5.0, 0.3, stretch=3.2)
    ridge = 1.0 - 2.0 * torch.exp(-((plates / 0.42) ** 2))
    fibre = f.noise(1.4, 0.4, stretch=3.0, shift=1)
    return f.amplitude * (0.36 * ridge + 0.06 * fibre), 0.7 * ridge + 0.25 * fibre


def grass(f: Fields) -> Relief:
    top = torch.full_like(f.x, -1.0)
    for layer, (turn, period) in enumerate(((0.0, 3.1), (0.42, 3.9), (-0.38, 4.6))):
        bend = 1.1 * f.noise(11.0, 0.3, shift=layer)
        across = math.cos(turn) * f.y + math.sin(turn) * f.x + bend
        phase = (torch.frac(across / (period * f.scale) + 512.0) - 0.5) * period * f.scale
        blade = 1.0 - (phase.abs() / 0.62) ** 2
        top = torch.maximum(top, blade.clamp_min(-1.0) - 0.3 * layer)
    return f.amplitude * 0.36 * top.clamp_min(-0.6), 1.2 * top.clamp_min(-0.7)


def gravel(f: Fields) -> Relief:
    first, second, label = f.cells(5.4)
    stone = (1.0 - (first / 0.72) ** 2).clamp_min(0.0).sqrt() * smooth_step((second - first) / 0.30)
    height = stone * (0.75 + 0.45 * label)
    return f.amplitude * (0.85 * height + 0.03 * f.noise(1.5)), 1.5 * stone - 0.8 + 0.5 * (label - 0.5)


def sand(f: Fields) -> Relief:
    grain = f.noise(0.85, 0.22)
    ripple = torch.sin(TAU * (f.y + 0.8 * f.noise(10.0, 0.3, shift=1)) / (6.5 * f.scale))
    return f.amplitude * (0.055 * grain + 0.10 * ripple), 0.45 * grain + 0.35 * ripple


TEXTURES: dict[str, Callable[[Fields], Relief]] = {
    "concrete": concrete,
    "plastic": plastic,
    "glass": glass,
    "wood": wood,
    "metal": metal,
    "brick": brick,
    "tile": tile,
    "leather": leather,
    "synthetic fabric": synthetic_fabric,
    "natural fabric": natural_fabric,
    "rubber": rubber,
    "paper": paper,
    "tree": tree,
    "grass": grass,
    "gravel": gravel,
    "sand": sand,
}
