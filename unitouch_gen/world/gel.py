"""Touch images of surfaces: contact, load, creep and spread of a gel in closed form, and its shading."""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from unitouch_gen.errors import check_integer, check_kind
from unitouch_gen.world.grids import PATCH_MM, convolved, pixel_axis, slopes, wavenumbers
from unitouch_gen.world.sensors import Sensor


def untouched_gel(sensor: Sensor, resolution: int) -> Tensor:
    """The image of an untouched gel, without noise, (3, S, S) in [0, 1].

    Raises:
        InvalidInputError, InvalidTypeError: If `sensor` is no `Sensor`, or `resolution` is out of range.
    """
    check_kind("sensor", sensor, Sensor)
    check_integer("resolution", resolution, 1, 2**14)
    pixels, _ = gel_square(sensor, resolution)
    return gel_image(torch.zeros(1, pixels, pixels), sensor, resolution)[0]


def gel_square(sensor: Sensor, resolution: int) -> tuple[int, float]:
    """Pixels along a side, and side in mm, of the square of gel that is solved for a view of `resolution` pixels.

    It is half as wide again as the view, so its periodic borders stay out of view.
    """
    pixels = resolution + 2 * round(0.5 * resolution / 2)
    return pixels, sensor.field_of_view * pixels / resolution


def in_view(field: Tensor, resolution: int) -> Tensor:
    """The camera's view, (N, S, S), of a field (N, P, P) over the square that is solved."""
    start = (field.shape[-1] - resolution) // 2
    return field[:, start : start + resolution, start : start + resolution]


# Contact and displacement ---------------------------------------------------------------------------------------------


def gel_indentation(height: Tensor, depth: Tensor, sensor: Sensor, resolution: int) -> Tensor:
    """Depth of surfaces in a sensor's gel, mm, (N, P, P), over all of the square that is solved.

    Surfaces of heights (N, R, R), mm, are pushed by depths (N,), mm, beyond their first contact.
    """
    pixels, extent = gel_square(sensor, resolution)
    return indentation_against(resample_centre(height, extent, pixels), depth, sensor, extent)


def indentation_against(height: Tensor, depth: Tensor, sensor: Sensor, extent: float) -> Tensor:
    """Depth in a gel of surfaces of heights (N, P, P), mm, over a square of `extent` mm, pushed by depths (N,), mm."""
    if sensor.dome:
        axis = pixel_axis(height.shape[-1], 2 * extent / sensor.field_of_view)
        height = height - sensor.dome * (axis[None, :] ** 2 + axis[:, None] ** 2)
    top = height.amax(dim=(-2, -1), keepdim=True)
    return (height - top + depth[:, None, None]).clamp_min(0.0)


def gel_displacement(indentation: Tensor, dwell: Tensor, sensor: Sensor, resolution: int) -> Tensor:
    """Displacement u (N, P, P), mm, of a sensor's gel under an indenter, after times (N,), s.

    The gel obeys relaxation du/dt = p - (u - correlation^2 laplace u) with u = 0 at contact. Every Fourier mode is one
    decaying exponential, so the solution is exact at any time: nothing is stepped. The load p saturates at the gel's
    thickness. u exceeds the load only by the ringing of a truncated Fourier series beside a cliff.

    Without `contact_steps`, p is the indentation, and all of a contact is spread over the correlation length. With
    them, p >= 0 keeps the gel at the surface where they touch, u >= indentation, and only the gel beside the contact is
    drawn along. So a gel of 1 mm correlation still shows threads. The camera's blur is part of the same transform.
    """
    load = sensor.thickness * -torch.expm1(-indentation / sensor.thickness)
    ky, kx = wavenumbers(load.shape[-1], sensor.field_of_view * load.shape[-1] / resolution)
    wavenumber2 = ky**2 + kx**2
    spread = 1.0 + sensor.correlation**2 * wavenumber2
    creep = -torch.expm1(-spread * (dwell[:, None, None] / sensor.relaxation)) / spread
    response = creep * torch.exp(-0.5 * sensor.blur**2 * wavenumber2)
    if sensor.contact_steps:
        following = following_displacement(load, spread, sensor.contact_steps)
        spectrum = spread * torch.fft.rfft2(following)
    else:
        spectrum = torch.fft.rfft2(load)
    return torch.fft.irfft2(spectrum * response, s=load.shape[-2:])


def following_displacement(load: Tensor, spread: Tensor, steps: int) -> Tensor:
    """Displacement (N, P, P), mm, of a gel that lies against a surface where they touch.

    It solves the obstacle problem u >= load and A u >= 0, one of which is an equality everywhere, by ADMM (Boyd et al.
    2011, section 5.1). A = 1 - correlation^2 laplace is diagonal under the Fourier transform, with the eigenvalues
    `spread`, (P, P // 2 + 1). Under a ball, twenty steps come within a percent.
    """
    size = load.shape[-2:]
    rho = 0.4 * spread.max().sqrt()  # near the fastest for balls at all resolutions
    displacement = load
    multiplier = torch.zeros_like(load)
    denominator = spread + rho
    for _ in range(steps):
        spectrum = torch.fft.rfft2((displacement - multiplier).mul_(rho)).div_(denominator)
        multiplier += torch.fft.irfft2(spectrum, s=size)
        displacement = torch.maximum(load, multiplier)
        multiplier -= displacement
    return displacement


def resample_centre(field: Tensor, extent: float, pixels: int) -> Tensor:
    """The central square of `extent` mm of a patch (N, R, R), bilinearly on `pixels` a side.

    A field finer than the new grid by more than a tenth is low-passed first, to avoid aliasing. Each pixel is averaged
    with those nearer than a new pixel's side, weighted by a triangle, which keeps planes.
    """
    ratio = extent / PATCH_MM * field.shape[-1] / pixels  # side of a new pixel in old ones
    if ratio > 1.1:
        reach = math.ceil(ratio) - 1
        weights = 1.0 - torch.arange(-reach, reach + 1).abs() / ratio
        field = convolved(field, weights / weights.sum())
    axis = pixel_axis(pixels, extent) / (0.5 * PATCH_MM)
    grid = torch.stack(torch.meshgrid(axis, axis, indexing="xy"), dim=-1).expand(len(field), -1, -1, -1)
    return F.grid_sample(field[:, None], grid, mode="bilinear", padding_mode="border", align_corners=False)[:, 0]


# Light ----------------------------------------------------------------------------------------------------------------


def gel_image(displacement: Tensor, sensor: Sensor, resolution: int) -> Tensor:
    """Touch images (N, 3, S, S) in [0, 1] of a sensor, whose gel is displaced by (N, P, P) mm."""
    _, extent = gel_square(sensor, resolution)
    slope_x, slope_y = slopes(displacement, extent / displacement.shape[-1])
    slope_x = in_view(slope_x, resolution)
    slope_y = in_view(slope_y, resolution)
    depth = in_view(displacement, resolution)
    images = shade_gel(slope_x, slope_y, sensor, depth)
    if sensor.marker_pitch:
        images = images * marker_mask(slope_x, slope_y, sensor, depth)
    images = images.clamp(0.0, 1.0)
    return images if sensor.gamma == 1.0 else images**sensor.gamma


def shade_gel(slope_x: Tensor, slope_y: Tensor, sensor: Sensor, depth: Tensor) -> Tensor:
    """Light from a gel of slopes and depths (N, S, S) to the camera, (N, 3, S, S), not yet clipped.

    By Lambert's cosine law, each light changes the brightness where a facet is turned from the gel's plane.
    """
    axis = pixel_axis(slope_x.shape[-1], 2.0)
    x = axis[None, :]
    y = axis[:, None]
    images = gel_background(sensor, slope_x.shape[-1]).expand(len(slope_x), -1, -1, -1).clone()
    normal = torch.rsqrt(1.0 + slope_x**2 + slope_y**2)
    gradients = sensor.gradients or ((0.0, 0.0),) * len(sensor.azimuths)
    lights = zip(sensor.azimuths, sensor.elevation, sensor.colours, gradients, strict=True)
    for azimuth, elevation, colour, (gradient_x, gradient_y) in lights:
        elevation = math.radians(elevation)
        toward_x = math.cos(math.radians(azimuth)) * math.cos(elevation)
        toward_y = math.sin(math.radians(azimuth)) * math.cos(elevation)
        lambert = (math.sin(elevation) - slope_x * toward_x - slope_y * toward_y) * normal
        strength = 1.0 + sensor.falloff * (x * toward_x + y * toward_y) + (gradient_x * x + gradient_y * y)
        change = (lambert.clamp_min(0.0) - math.sin(elevation)) * strength
        images += sensor.gain * torch.tensor(colour)[None, :, None, None] * change[:, None]
    if any(sensor.tint):
        images += torch.tensor(sensor.tint)[None, :, None, None] * depth[:, None]
    return images


def gel_background(sensor: Sensor, resolution: int) -> Tensor:
    """The backdrop of an untouched gel at a resolution, (3, S, S)."""
    coarse = torch.tensor(sensor.backdrop)[None]
    return F.interpolate(coarse, (resolution, resolution), mode="bicubic", align_corners=False)[0]


def marker_mask(slope_x: Tensor, slope_y: Tensor, sensor: Sensor, depth: Tensor) -> Tensor:
    """Transmission (N, 1, S, S) of printed dots that the gel's displacement drags along."""
    axis = pixel_axis(slope_x.shape[-1], sensor.field_of_view)
    pitch = sensor.marker_pitch
    shift = 0.8 * depth  # sideways movement of a marker at a slope of one, mm
    x = axis[None, None, :] + shift * slope_x
    y = axis[None, :, None] + shift * slope_y
    # Offset from the nearest dot; 512 more periods keep `frac`'s argument positive.
    nearest_x = (torch.frac(x / pitch + 512.5) - 0.5) * pitch
    nearest_y = (torch.frac(y / pitch + 512.5) - 0.5) * pitch
    inside = torch.sigmoid((sensor.marker_radius - torch.hypot(nearest_x, nearest_y)) / 0.06)  # a rim of 0.06 mm
    return (1.0 - sensor.marker_ink * inside)[:, None]
