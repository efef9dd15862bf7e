"""From a surface to a touch image: contact, load, creep and spread of a gel in closed form, and the light it sends."""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from unitouch_gen.errors import check_integer, check_kind
from unitouch_gen.world.grids import PATCH_MM, convolved, pixel_axis, slopes, wavenumbers
from unitouch_gen.world.sensors import Sensor


def untouched_gel(sensor: Sensor, resolution: int) -> Tensor:
    """What a sensor's camera sees of its gel where nothing touches it, without noise, (3, S, S) in [0, 1].

    Raises:
        InvalidInputError, InvalidTypeError: On a sensor or a resolution that is none.
    """
    check_kind("sensor", sensor, Sensor)
    check_integer("resolution", resolution, 1, 2**14)
    pixels, _ = gel_square(sensor, resolution)
    return gel_image(torch.zeros(1, pixels, pixels), sensor, resolution)[0]


def gel_square(sensor: Sensor, resolution: int) -> tuple[int, float]:
    """Pixels a side and side (mm) of the square of gel that is solved for a view of `resolution` pixels.

    It is half as wide again as what the camera sees, so its periodic ends stay out of view.
    """
    pixels = resolution + 2 * round(0.5 * resolution / 2)
    return pixels, sensor.field_of_view * pixels / resolution


def in_view(field: Tensor, resolution: int) -> Tensor:
    """What the camera sees, (N, S, S), of a field (N, P, P) over the square that is solved."""
    beside = (field.shape[-1] - resolution) // 2
    return field[:, beside : beside + resolution, beside : beside + resolution]


# Contact and displacement ---------------------------------------------------------------------------------------------


def gel_indentation(height: Tensor, depth: Tensor, sensor: Sensor, resolution: int) -> Tensor:
    """How far surfaces reach into a sensor's gel, mm, (N, P, P), over all the square that is solved.

    Surfaces of heights (N, R, R), mm, are pushed by depths (N,), mm, beyond their first contact.
    """
    pixels, extent = gel_square(sensor, resolution)
    return indentation_against(resample_centre(height, extent, pixels), depth, sensor, extent)


def indentation_against(height: Tensor, depth: Tensor, sensor: Sensor, extent: float) -> Tensor:
    """How far heights (N, P, P), mm, over a square of `extent` mm reach into a gel, pushed by depths (N,), mm."""
    if sensor.dome:
        axis = pixel_axis(height.shape[-1], 2 * extent / sensor.field_of_view)
        height = height - sensor.dome * (axis[None, :] ** 2 + axis[:, None] ** 2)
    return (height - height.amax(dim=(-2, -1), keepdim=True) + depth[:, None, None]).clamp_min(0.0)


def gel_displacement(indentation: Tensor, dwell: Tensor, sensor: Sensor, resolution: int) -> Tensor:
    """Displacement u (N, P, P), mm, of a sensor's gel under an indenter, after times (N,), s.

    The gel obeys relaxation du/dt = p - (u - correlation^2 laplace u) with u = 0 at contact. Every Fourier mode is one
    decaying exponential, so the solution is exact at any time: nothing is stepped. The load p saturates at the gel's
    thickness. u is at most the load but for the little that a truncated Fourier series rings beside a cliff.

    With p the indentation itself, all of a contact is spread over the correlation length. With `contact_steps`, p is
    what keeps the gel at the surface where they touch, p >= 0 and u >= indentation, and only what lies beside is drawn
    along, so that a gel of 1 mm correlation still shows threads. The camera's blur is folded into the same transform.
    """
    load = sensor.thickness * -torch.expm1(-indentation / sensor.thickness)
    ky, kx = wavenumbers(load.shape[-1], sensor.field_of_view * load.shape[-1] / resolution)
    wavenumber2 = ky**2 + kx**2
    spread = 1.0 + sensor.correlation**2 * wavenumber2
    settled = -torch.expm1(-spread * (dwell[:, None, None] / sensor.relaxation)) / spread
    response = settled * torch.exp(-0.5 * sensor.blur**2 * wavenumber2)
    spectrum = torch.fft.rfft2(load)
    if sensor.contact_steps:
        spectrum = spread * torch.fft.rfft2(following_displacement(load, spread, sensor.contact_steps))
    return torch.fft.irfft2(spectrum * response, s=load.shape[-2:])


def following_displacement(load: Tensor, spread: Tensor, steps: int) -> Tensor:
    """Displacement (N, P, P), mm, of a gel that lies against a surface where they touch.

    It solves the obstacle problem u >= load and A u >= 0, one of which is an equality everywhere, by ADMM (Boyd et al.
    2011, section 5.1), as A = 1 - correlation^2 laplace is diagonal under the Fourier transform: `spread` holds its
    eigenvalues, (P, P // 2 + 1). Twenty steps come within a percent under a ball.
    """
    size = load.shape[-2:]
    rho = 0.4 * spread.max().sqrt()  # near the fastest on balls at all resolutions
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
    """The central square of `extent` mm of a patch (N, R, R), on `pixels` a side, bilinear.

    A field finer than the new grid by more than a tenth is low-passed first, or its shortest waves would fold back:
    each pixel is averaged with those nearer than a new pixel's side, weighted by a triangle, which keeps planes.
    """
    ratio = extent / PATCH_MM * field.shape[-1] / pixels  # a new pixel's side in old ones
    if ratio > 1.1:
        reach = math.ceil(ratio) - 1
        weights = 1.0 - torch.arange(-reach, reach + 1).abs() / ratio
        field = convolved(field, weights / weights.sum())
    axis = pixel_axis(pixels, extent) / (0.5 * PATCH_MM)
    grid = torch.stack(torch.meshgrid(axis, axis, indexing="xy"), dim=-1).expand(len(field), -1, -1, -1)
    return F.grid_sample(field[:, None], grid, mode="bilinear", padding_mode="border", align_corners=False)[:, 0]


# Light ----------------------------------------------------------------------------------------------------------------


def gel_image(displacement: Tensor, sensor: Sensor, resolution: int) -> Tensor:
    """What a sensor's camera sees, (N, 3, S, S) in [0, 1], of its gel displaced by (N, P, P) mm."""
    pixel = gel_square(sensor, resolution)[1] / displacement.shape[-1]
    slope_x, slope_y = (in_view(slope, resolution) for slope in slopes(displacement, pixel))
    depth = in_view(displacement, resolution)
    images = shade_gel(slope_x, slope_y, sensor, depth)
    if sensor.marker_pitch:
        images = images * marker_mask(slope_x, slope_y, sensor, depth)
    images = images.clamp(0.0, 1.0)
    return images if sensor.gamma == 1.0 else images**sensor.gamma


def shade_gel(slope_x: Tensor, slope_y: Tensor, sensor: Sensor, depth: Tensor) -> Tensor:
    """Light that a gel of given slopes and depths (N, S, S) sends to the camera, (N, 3, S, S), not yet clipped.

    Each light adds what Lambert's cosine law changes where a facet turns from the gel's plane.
    """
    axis = pixel_axis(slope_x.shape[-1], 2.0)
    x = axis[None, :]
    y = axis[:, None]
    images = gel_background(sensor, slope_x.shape[-1]).expand(len(slope_x), -1, -1, -1).clone()
    normal = torch.rsqrt(1.0 + slope_x**2 + slope_y**2)
    gradients = sensor.gradients or ((0.0, 0.0),) * len(sensor.azimuths)
    lights = zip(sensor.azimuths, sensor.elevation, sensor.colours, gradients, strict=True)
    for azimuth, elevation, colour, (along_x, along_y) in lights:
        elevation = math.radians(elevation)
        toward_x = math.cos(math.radians(azimuth)) * math.cos(elevation)
        toward_y = math.sin(math.radians(azimuth)) * math.cos(elevation)
        lambert = (math.sin(elevation) - slope_x * toward_x - slope_y * toward_y) * normal
        strength = 1.0 + sensor.falloff * (x * toward_x + y * toward_y) + (along_x * x + along_y * y)
        change = (lambert.clamp_min(0.0) - math.sin(elevation)) * strength
        images += sensor.gain * torch.tensor(colour)[None, :, None, None] * change[:, None]
    if any(sensor.tint):
        images += torch.tensor(sensor.tint)[None, :, None, None] * depth[:, None]
    return images


def gel_background(sensor: Sensor, resolution: int) -> Tensor:
    """What the camera sees of an untouched gel, (3, S, S)."""
    coarse = torch.tensor(sensor.backdrop)[None]
    return F.interpolate(coarse, (resolution, resolution), mode="bicubic", align_corners=False)[0]


def marker_mask(slope_x: Tensor, slope_y: Tensor, sensor: Sensor, depth: Tensor) -> Tensor:
    """Transmission (N, 1, S, S) of printed dots that the gel's displacement drags along."""
    axis = pixel_axis(slope_x.shape[-1], sensor.field_of_view)
    pitch = sensor.marker_pitch
    shift = 0.8 * depth  # how far a marker moves sideways, mm, at a slope of one
    x = axis[None, None, :] + shift * slope_x
    y = axis[None, :, None] + shift * slope_y
    # Offset from the nearest dot; 512 more periods keep `frac`'s argument positive.
    nearest_x = (torch.frac(x / pitch + 512.5) - 0.5) * pitch
    nearest_y = (torch.frac(y / pitch + 512.5) - 0.5) * pitch
    inside = torch.sigmoid((sensor.marker_radius - torch.hypot(nearest_x, nearest_y)) / 0.06)  # a rim of 0.06 mm
    return (1.0 - sensor.marker_ink * inside)[:, None]
