"""Surfaces of contacts: bodies covered by the relief of their material, their colours, and pictures of them."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from unitouch_gen.world.bodies import body
from unitouch_gen.world.draws import SHAPES, Draws
from unitouch_gen.world.grids import PATCH_MM, pixel_axis, slopes
from unitouch_gen.world.materials import MATERIALS, Material
from unitouch_gen.world.reliefs import Fields, relief, turned
from unitouch_gen.world.scans import scanned_patches

DEEPEST_GROUND = -8.0  # height of the background behind a body, mm
GAMMA = 1.8  # of the pictures; like the weights of light, it is chosen to make materials distinct, not measured


@dataclass
class Surfaces:
    """N square patches of surface."""

    height: Tensor  # toward the sensor and the camera, mm, (N, R, R); the top of the body is near 0
    albedo: Tensor | None  # linear RGB reflectance in [0, 1], (N, 3, R, R); `None` without colours
    body: Tensor  # 1 on an object, 0 on the background, (N, R, R)


def surfaces(seed: int, draws: Draws, resolution: int, *, coloured: bool = True) -> Surfaces:
    """Builds the patches of N contacts at `resolution` pixels a side, with colours or without."""
    axis = pixel_axis(resolution)
    x = axis[None, None, :]
    y = axis[None, :, None]
    u, v = turned(x, y, draws.shape_angle, -draws.shape_offset)
    height = torch.zeros_like(u)
    for index in draws.shape.unique().tolist():
        rows = torch.nonzero(draws.shape == index)[:, 0]
        size = draws.shape_radius[rows, None, None]
        numbers = draws.proportions[rows, :, None, None]
        height[rows] = body(list(SHAPES)[index], u[rows], v[rows], size, numbers)
    is_body = (height > DEEPEST_GROUND).float()
    height = height + draws.tilt[:, 0, None, None] * x + draws.tilt[:, 1, None, None] * y
    raised = torch.zeros(len(draws), resolution, resolution)
    albedo = None
    if coloured:
        albedo = draws.colour[:, :, None, None].expand(-1, -1, resolution, resolution).clone()
    is_drawn = draws.surface < 0
    if not is_drawn.all():
        rows = torch.nonzero(~is_drawn)[:, 0]
        raised[rows], colours = scanned_patches(draws, rows, resolution, coloured=coloured)
        if albedo is not None:
            albedo[rows] = colours
    for index in draws.material[is_drawn].unique().tolist():
        material = MATERIALS[index]
        rows = torch.nonzero(is_drawn & (draws.material == index))[:, 0]
        raised[rows], shade = relief(material.name, Fields(seed, draws, rows, resolution))
        if albedo is not None:
            albedo[rows] = shaded(material, draws.colour[rows], shade)
    level = raised.flatten(1)[:, ::7].quantile(0.9, dim=1)[:, None, None]  # of the relief, put at the body's height
    height = torch.where(is_body > 0, height + raised - level, DEEPEST_GROUND).clamp_min(DEEPEST_GROUND)
    return Surfaces(height, albedo, is_body)


def shaded(material: Material, colour: Tensor, shade: Tensor) -> Tensor:
    """(N, 3, R, R): the base colour, mixed toward the second colour (or toward black) where the shade is negative."""
    base = colour[:, :, None, None]
    shade = shade.clamp(-1.2, 1.2)[:, None]
    dark = 0.35 * base if material.second is None else torch.tensor(material.second)[:, None, None]
    weight = material.contrast * (0.5 - 0.5 * shade).clamp(0.0, 1.0)
    mixed = base * (1.0 - weight) + dark * weight
    return (mixed + 0.08 * material.contrast * shade.clamp_min(0.0)).clamp(0.0, 1.0)


def pictures(seen: Surfaces, light: Tensor, gloss: Tensor, white: Tensor, side: Tensor, resolution: int) -> Tensor:
    """sRGB-like pictures (N, 3, S, S) in [0, 1] of surfaces from straight above under one lamp and a sky.

    Args:
        seen: Coloured surfaces.
        light: Unit vectors toward the lamp, (N, 3).
        gloss: Weight of the highlight, (N,).
        white: White balance of the camera, factors on RGB, (N, 3).
        side: Of the view, about the middle of the surface, mm, (N,).
        resolution: Side S of the picture, pixels; R must be a multiple of it.
    """
    assert seen.albedo is not None  # they are coloured
    padded = F.pad(seen.height[:, None], (1, 1, 1, 1), mode="replicate")[:, 0]
    slope_x, slope_y = slopes(padded, PATCH_MM / seen.height.shape[-1])
    slope_x = slope_x[:, 1:-1, 1:-1]
    slope_y = slope_y[:, 1:-1, 1:-1]
    normal = torch.rsqrt(1.0 + slope_x**2 + slope_y**2)
    lx, ly, lz = light[:, :, None, None].unbind(1)
    lambert = ((lz - lx * slope_x - ly * slope_y) * normal).clamp_min(0.0)
    # Blinn's half vector between lamp and camera (0, 0, 1), with an exponent of 48 by repeated squaring.
    half = torch.rsqrt(2.0 + 2.0 * lz)
    facing = (((1.0 + lz) - lx * slope_x - ly * slope_y) * normal * half).clamp(0.0, 1.0)
    for _ in range(4):
        facing = facing.square()
    highlight = gloss[:, None, None] * facing**3
    lit = seen.albedo * (0.38 + 0.72 * lambert)[:, None]  # by the sky and the lamp
    lit += 0.35 * highlight[:, None]
    background = torch.tensor((0.20, 0.21, 0.24))[None, :, None, None]
    linear = torch.lerp(background, lit, seen.body[:, None]).mul_(white[..., None, None]).clamp_(0.0, 1.0)
    zoom = (side / PATCH_MM)[:, None, None] * torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    grid = F.affine_grid(zoom, list(linear.shape), align_corners=False)
    linear = F.grid_sample(linear, grid, align_corners=False)
    pooled = F.avg_pool2d(linear, linear.shape[-1] // resolution)
    return pooled.clamp_min(1e-6) ** (1 / GAMMA)
