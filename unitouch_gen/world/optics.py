"""From a surface to what a camera sees: through a gel (touch images) and through air (pictures)."""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from unitouch_gen.world.fields import PATCH_MM, pixel_axis, wavenumbers
from unitouch_gen.world.gel import DEFAULT_GRID, GelGrid, check_heights, gel_displacement, gel_indentation
from unitouch_gen.world.sensors import Sensor

PRINTED_PITCH, PRINTED_RADIUS = 3.6, 0.26
"""Of markers that a style prints on a plain gel, mm: sparser and smaller than GelSlim's own, so the two differ."""

MARKER_DRAG = 0.8
"""How far a marker moves sideways, mm, for each mm of depth at a slope of one."""

MARKER_INK = 0.6
"""Share of the light that a marker takes."""

MARKER_RIM = 0.06
"""Length over which a marker's rim fades, mm."""

SKY, LAMP = 0.38, 0.72
"""Light on a surface from all around, and from the lamp where the surface faces it."""

HIGHLIGHT, SHININESS = 0.35, 48
"""Brightness and exponent (Blinn) of the highlight on a surface of full gloss."""

BEHIND = (0.20, 0.21, 0.24)
"""Linear RGB of what shows behind an object."""

GAMMA = 1.8
"""Of the pictures. Like the numbers above it is chosen for materials to look apart, not measured."""


def touch_images(
    height: Tensor,
    indentation_depth: Tensor,
    dwell: Tensor,
    compliance: Tensor,
    sensor: Sensor,
    resolution: int,
    *,
    cast: Tensor | None = None,
    markers: bool = False,
    grid: GelGrid = DEFAULT_GRID,
) -> Tensor:
    """Noise-free touch images of N surfaces under one sensor.

    Args:
        height: Heights over the whole patch, mm, (N, R, R).
        indentation_depth, dwell, compliance: Depth (mm), time (s) and softness of each contact, (N,).
        sensor: Whose gel, lights and camera.
        resolution: Side of the image, pixels.
        cast: Factor on each colour channel, (3,).
        markers: Prints a grid of dots even on a sensor that has none.
        grid: On which the gel is solved. Refining it alone shows the facets of a coarse surface more sharply, and
            refining the surface alone only blurs it to the gel's grid: the error falls when both are refined.

    Returns:
        Images (N, 3, resolution, resolution) in [0, 1]. A depth of 0 or less touches nothing: the background.

    Raises:
        ValueError: On heights, depths or times that are not finite, or a sensor whose gel cannot be.
    """
    _, extent, _ = grid.layout(sensor.field_of_view, resolution)
    indentation, seen = gel_indentation(height, indentation_depth, compliance, sensor, resolution, grid)
    u = gel_displacement(
        indentation,
        dwell,
        extent=extent,
        thickness=sensor.thickness,
        correlation=sensor.correlation,
        relaxation=sensor.relaxation,
        blur=sensor.blur,
    )
    if grid.slopes == "spectral":
        slope_x, slope_y = spectral_slopes(u, extent)
    else:
        slope_x, slope_y = slopes(u, extent / u.shape[-1])
    slope_x, slope_y, depth = slope_x[:, seen, seen], slope_y[:, seen, seen], u[:, seen, seen]
    images = shade_gel(slope_x, slope_y, sensor)
    pitch, radius = sensor.marker_pitch, sensor.marker_radius
    if markers and not pitch:
        pitch, radius = PRINTED_PITCH, PRINTED_RADIUS
    if pitch:
        images = images * marker_mask(slope_x, slope_y, depth, sensor.field_of_view, pitch, radius)
    if cast is not None:
        images = images * cast[None, :, None, None]
    images = images.clamp(0.0, 1.0)
    return images if grid.refinement == 1 else F.avg_pool2d(images, grid.refinement)


def slopes(height: Tensor, pixel: float) -> tuple[Tensor, Tensor]:
    """Central differences along x and y of a periodic field (N, R, R) with pixels of `pixel` mm."""
    along_x = (height.roll(-1, dims=-1) - height.roll(1, dims=-1)) / (2 * pixel)
    along_y = (height.roll(-1, dims=-2) - height.roll(1, dims=-2)) / (2 * pixel)
    return along_x, along_y


def spectral_slopes(height: Tensor, extent: float) -> tuple[Tensor, Tensor]:
    """Derivatives along x and y of the trigonometric interpolant of a periodic field (N, R, R) over `extent` mm."""
    resolution = height.shape[-1]
    ky, kx = (wave.clone() for wave in wavenumbers(resolution, extent))
    if resolution % 2 == 0:
        ky[resolution // 2], kx[:, -1] = 0.0, 0.0  # an odd derivative has no real part at the Nyquist limit
    spectrum = torch.fft.rfft2(height)
    along_x, along_y = (torch.fft.irfft2(1j * k * spectrum, s=(resolution, resolution)) for k in (kx, ky))
    return along_x, along_y


def shade_gel(slope_x: Tensor, slope_y: Tensor, sensor: Sensor) -> Tensor:
    """Light that a gel of given slopes (N, R, R) sends to the camera above it, (N, 3, R, R), not yet clipped."""
    axis = pixel_axis(slope_x.shape[-1], 2.0)
    x, y = axis[None, :], axis[:, None]
    images = gel_background(sensor, slope_x.shape[-1]).expand(len(slope_x), -1, -1, -1).clone()
    normal = torch.rsqrt(1.0 + slope_x**2 + slope_y**2)
    elevation = math.radians(sensor.elevation)
    for azimuth, colour in zip(sensor.azimuths, sensor.colours, strict=True):
        toward_x = math.cos(math.radians(azimuth)) * math.cos(elevation)
        toward_y = math.sin(math.radians(azimuth)) * math.cos(elevation)
        lambert = (math.sin(elevation) - slope_x * toward_x - slope_y * toward_y) * normal
        gained = (lambert.clamp_min(0.0) - math.sin(elevation)) * (1.0 + sensor.falloff * (x * toward_x + y * toward_y))
        images += sensor.gain * torch.tensor(colour)[None, :, None, None] * gained[:, None]
    return images


def gel_background(sensor: Sensor, resolution: int) -> Tensor:
    """What the camera sees of an untouched gel, (3, R, R)."""
    axis = pixel_axis(resolution, 2.0)
    x, y = axis[None, :], axis[:, None]
    basis = torch.stack([torch.ones(resolution, resolution), x.expand(resolution, -1), y.expand(-1, resolution),
                         x**2 + y**2, x * y])  # fmt: skip
    return torch.einsum("cb,bhw->chw", torch.tensor(sensor.background), basis)


def marker_mask(slope_x: Tensor, slope_y: Tensor, depth: Tensor, view: float, pitch: float, radius: float) -> Tensor:
    """Transmission (N, 1, R, R) of printed dots that the gel's displacement drags along."""
    axis = pixel_axis(slope_x.shape[-1], view)
    shift = MARKER_DRAG * depth
    x, y = axis[None, None, :] + shift * slope_x, axis[None, :, None] + shift * slope_y
    # Offset from the nearest dot; 512 more periods keep `frac`'s argument positive.
    nearest_x = (torch.frac(x / pitch + 512.5) - 0.5) * pitch
    nearest_y = (torch.frac(y / pitch + 512.5) - 0.5) * pitch
    inside = torch.sigmoid((radius - torch.hypot(nearest_x, nearest_y)) / MARKER_RIM)
    return (1.0 - MARKER_INK * inside)[:, None]


def pictures(
    height: Tensor, albedo: Tensor, body: Tensor, light: Tensor, gloss: Tensor, resolution: int, white: Tensor
) -> Tensor:
    """Pictures of N surfaces from straight above under one lamp and a sky.

    Args:
        height: mm, (N, R, R).
        albedo: Linear RGB, (N, 3, R, R).
        body: 1 on the object, 0 on what lies behind it, (N, R, R).
        light: Unit vectors toward the lamp, (N, 3).
        gloss: Weight of the highlight, (N,).
        resolution: Side of the picture, pixels; R must be a multiple of it.
        white: White balance of the camera, factors on RGB, (3,).

    Returns:
        sRGB-like pictures in [0, 1], (N, 3, resolution, resolution).

    Raises:
        ValueError: On heights that are not finite.
    """
    check_heights(height)
    padded = F.pad(height[:, None], (1, 1, 1, 1), mode="replicate")[:, 0]
    slope_x, slope_y = (field[:, 1:-1, 1:-1] for field in slopes(padded, PATCH_MM / height.shape[-1]))
    normal = torch.rsqrt(1.0 + slope_x**2 + slope_y**2)
    lx, ly, lz = (component[:, None, None] for component in light.unbind(1))
    lambert = ((lz - lx * slope_x - ly * slope_y) * normal).clamp_min(0.0)
    # Blinn's half vector between lamp and camera (0, 0, 1).
    half = torch.rsqrt(2.0 + 2.0 * lz)
    facing = (((1.0 + lz) - lx * slope_x - ly * slope_y) * normal * half).clamp(0.0, 1.0)
    highlight = gloss[:, None, None] * facing**SHININESS
    lit = albedo * (SKY + LAMP * lambert)[:, None] + HIGHLIGHT * highlight[:, None]
    behind = torch.tensor(BEHIND)[None, :, None, None]
    linear = torch.lerp(behind.expand_as(lit), lit, body[:, None]) * white[None, :, None, None]
    return F.avg_pool2d(linear.clamp(0.0, 1.0), height.shape[-1] // resolution).clamp_min(1e-6) ** (1 / GAMMA)
