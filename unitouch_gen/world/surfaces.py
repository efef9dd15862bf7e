"""Surfaces: a material's relief on a macro shape, as a height field and an albedo."""

from dataclasses import dataclass

import torch
from torch import Tensor

from unitouch_gen.world.draws import Draws, white_spectrum
from unitouch_gen.world.fields import Fields, pixel_axis
from unitouch_gen.world.materials import MATERIALS, SHAPE_NAMES
from unitouch_gen.world.textures import TEXTURES, smooth_step

EDGE_DROP = 4.0
"""How far a surface falls beyond an edge or corner, mm: out of any gel's reach."""

SAG_LIMIT = 8.0
"""Beyond this much below its top, a curved shape counts as background, mm."""


@dataclass
class Surfaces:
    """N square patches of surface.

    Attributes:
        height: Height toward the sensor and the camera, mm, (N, R, R); the highest macro point is near 0.
        albedo: Linear RGB reflectance in [0, 1], (N, 3, R, R); `None` where only shapes were asked for.
        body: 1 where there is an object, 0 where the background shows behind it, (N, R, R).
    """

    height: Tensor
    albedo: Tensor | None
    body: Tensor


def macro_shape(draws: Draws, resolution: int) -> tuple[Tensor, Tensor]:
    """Height (mm) and body mask of each contact's macro shape, both (N, R, R)."""
    axis = pixel_axis(resolution)
    x = axis[None, None, :] - draws.shape_offset[:, 0, None, None]
    y = axis[None, :, None] - draws.shape_offset[:, 1, None, None]
    cos, sin = torch.cos(draws.shape_angle)[:, None, None], torch.sin(draws.shape_angle)[:, None, None]
    u, v = cos * x + sin * y, -sin * x + cos * y
    radius = draws.shape_radius[:, None, None]

    # Each shape is one signed "distance beyond the rim" (edge, corner) or one squared distance from the top (curved).
    rim = torch.full_like(u, -1.0)
    sag = torch.zeros_like(u)
    kind = draws.shape[:, None, None]
    rim = torch.where(kind == SHAPE_NAMES.index("edge"), u - 2.0, rim)
    rim = torch.where(kind == SHAPE_NAMES.index("corner"), torch.maximum(u - 2.0, v - 2.0), rim)
    sag = torch.where(kind == SHAPE_NAMES.index("bump"), u * u + v * v, sag)
    sag = torch.where(kind == SHAPE_NAMES.index("cylinder"), u * u, sag)

    fallen = smooth_step(rim / 0.8)
    curve = radius - (radius * radius - sag).clamp_min(0.0).sqrt()
    curve = curve.clamp_max(SAG_LIMIT)
    body = (1.0 - fallen) * (curve < SAG_LIMIT)
    return -EDGE_DROP * fallen - curve, body


def surfaces(seed: int, draws: Draws, resolution: int, *, coloured: bool = True) -> Surfaces:
    """Builds the patches of N contacts at `resolution` pixels a side, without colours if nobody will see them."""
    height, body = macro_shape(draws, resolution)
    albedo = torch.empty(len(draws), 3, resolution, resolution) if coloured else None
    axis = pixel_axis(resolution)
    for index in draws.material.unique().tolist():
        rows = torch.nonzero(draws.material == index)[:, 0]
        relief, shade = TEXTURES[MATERIALS[index].name](_fields(seed, draws, rows, axis))
        height[rows] += relief * body[rows]
        if albedo is not None:
            albedo[rows] = _albedo(MATERIALS[index].second, MATERIALS[index].contrast, draws.colour[rows], shade)
    return Surfaces(height, albedo, body)


def _fields(seed: int, draws: Draws, rows: Tensor, axis: Tensor) -> Fields:
    def column(values: Tensor) -> Tensor:
        return values[rows][:, None, None]

    angle = column(draws.angle)
    x = axis[None, None, :] + column(draws.offset[:, 0])
    y = axis[None, :, None] + column(draws.offset[:, 1])
    return Fields(
        x=torch.cos(angle) * x + torch.sin(angle) * y,
        y=-torch.sin(angle) * x + torch.cos(angle) * y,
        angle=angle,
        scale=column(draws.scale),
        amplitude=column(draws.amplitude),
        spectrum=white_spectrum(seed, draws.material[rows], draws.object[rows], draws.contact[rows]),
        cell_seed=column(draws.cell_seed),
    )


def _albedo(second: tuple[float, float, float] | None, contrast: float, colour: Tensor, shade: Tensor) -> Tensor:
    """(N, 3, R, R): the base colour, mixed toward the second (or toward black) where the shade is negative."""
    base = colour[:, :, None, None]
    shade = shade.clamp(-1.2, 1.2)[:, None]
    dark = 0.35 * base if second is None else torch.tensor(second)[None, :, None, None].expand_as(base)
    below = contrast * (0.5 - 0.5 * shade).clamp(0.0, 1.0)
    return (base * (1.0 - below) + dark * below + 0.08 * contrast * shade.clamp_min(0.0)).clamp(0.0, 1.0)
