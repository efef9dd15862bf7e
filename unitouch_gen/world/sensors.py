"""Camera-based tactile sensors, and the images that they take of a surface.

Those of `SENSORS` are real ones, as far as published measurements of them tell. Lights and backgrounds are fitted to
calibration tables and frames by `python -m tests.benchmarks.calibration`. For each `calibrated_sensors.json` names
sources and licences, and parts its values by where they are from: `published` by a source, `measured` on its frames,
`fitted` to them, or `guessed`, where no source tells. `settings` are of rendering.
"""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from unitouch_gen.errors import check_integer, check_kind, check_tensor
from unitouch_gen.world.gel import (
    DEFAULT_GRID,
    LARGEST_GRID,
    GelGrid,
    contact_indentation,
    gel_displacement,
    resample_centre,
)
from unitouch_gen.world.surfaces import check_heights, pixel_axis, slopes, spectral_slopes

Colour = tuple[float, float, float]
Backdrop = tuple[tuple[tuple[float, ...], ...], ...]


@dataclass(frozen=True)
class Sensor:
    """Gel, lights and camera of one sensor.

    Attributes:
        name: Lower case, as users type it.
        field_of_view: Side of the square of gel that the camera sees, mm.
        thickness: Thickness of the gel, mm; no contact can displace it further.
        correlation: Length over which the gel spreads a displacement, mm.
        relaxation: Time constant of the gel's creep, s.
        azimuths: Directions of the lights around the gel, degrees.
        elevation: Angle of the lights above the gel's plane, degrees: one for all, or one for each.
        colours: Linear RGB of each light.
        falloff: How much nearer pixels get more of a light, relative, [0, 1].
        gain: Brightness change by a facet that turns fully toward a light.
        background: Per RGB channel: value at the centre and slopes along x, y, x^2 + y^2 and x y over [-1, 1].
        blur: Standard deviation of the camera's blur, mm.
        noise: Standard deviation of the camera's noise, in units of full scale.
        marker_pitch, marker_radius: Spacing and radius of printed markers, mm; 0 for a plain gel.
        marker_ink: Share of the light that a marker takes.
        backdrop: The untouched gel on a coarse grid, (3, h, w) values, interpolated in place of `background`.
        gradients: How much more of each light falls on the rim of the view than on its middle, relative, along x and
            along y; none for lights that differ by `falloff` alone.
        tint: How much each channel gains where the gel is displaced, for each mm.
        contact_steps: Steps in which the gel comes to lie against what touches it; 0 for one that spreads all contact.
        gamma: Power that the camera raises its values to.
        dome: How far the gel bulges, in its middle over the rim of what the camera sees, mm.
    """

    name: str
    field_of_view: float
    thickness: float
    correlation: float
    relaxation: float
    azimuths: tuple[float, ...]
    elevation: float | tuple[float, ...]
    colours: tuple[Colour, ...]
    falloff: float
    gain: float
    background: tuple[tuple[float, float, float, float, float], ...]
    blur: float
    noise: float
    marker_pitch: float = 0.0
    marker_radius: float = 0.0
    marker_ink: float = 0.6
    backdrop: Backdrop | None = None
    gradients: tuple[tuple[float, float], ...] = ()
    tint: Colour = (0.0, 0.0, 0.0)
    contact_steps: int = 0
    gamma: float = 1.0
    dome: float = 0.0


NUMBERS = Path(__file__).with_name("calibrated_sensors.json")

KINDS = ("published", "measured", "fitted", "guessed", "settings")


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def sensor_from(name: str, entry: dict[str, Any]) -> Sensor:
    """Sensor of one entry of the file."""
    values = {field: _tuples(value) for kind in KINDS for field, value in entry[kind].items()}
    return Sensor(name, **values)


SENSORS: dict[str, Sensor] = {
    name: sensor_from(name, entry) for name, entry in json.loads(NUMBERS.read_text(encoding="utf-8")).items()
}
"""By name: a GelSight and a DIGIT as Taxim measured them, a GelSight R1.5, and ObjectFolder's GelSight."""

MARKER_DRAG = 0.8
"""How far a marker moves sideways, mm, for each mm of depth at a slope of one."""

MARKER_RIM = 0.06
"""Length over which a marker's rim fades, mm."""


def touch_images(
    height: Tensor,
    indentation_depth: Tensor,
    dwell: Tensor,
    compliance: Tensor,
    sensor: Sensor,
    resolution: int,
    grid: GelGrid = DEFAULT_GRID,
) -> Tensor:
    """Noise-free touch images of N surfaces under one sensor.

    Args:
        height: Heights over the whole patch, mm, (N, R, R).
        indentation_depth, dwell, compliance: Depth (mm), time (s) and softness of each contact, (N,).
        sensor: Gel, lights and camera.
        resolution: Side of the image, pixels.
        grid: Grid on which the gel is solved. Refining it alone shows the facets of a coarse surface more sharply, and
            refining the surface alone only blurs it to the gel's grid: the error falls when both are refined.

    Returns:
        Images (N, 3, resolution, resolution) in [0, 1]. A depth of 0 or less touches nothing: the background.

    Raises:
        InvalidInputError, InvalidTypeError: On heights, depths or times that are no tensors, or not finite, or a sensor
            whose gel cannot be.
    """
    indentation, _ = gel_indentation(height, indentation_depth, compliance, sensor, resolution, grid)
    gel = pressed_gel(indentation, dwell, sensor, resolution, grid)
    return images_of_gel(gel, sensor, grid)


@dataclass(frozen=True)
class PressedGel:
    """A gel that N surfaces were pressed into.

    Attributes:
        displacement: How far it is displaced, mm, over all of the square that was solved, (N, P, P).
        extent: Side of that square, mm.
        seen: Rows and columns that the camera sees.
    """

    displacement: Tensor
    extent: float
    seen: slice

    @property
    def depth(self) -> Tensor:
        """What the camera sees of the displacement, mm, (N, S, S)."""
        return self.displacement[:, self.seen, self.seen]


def pressed_gel(
    indentation: Tensor, dwell: Tensor, sensor: Sensor, resolution: int, grid: GelGrid = DEFAULT_GRID
) -> PressedGel:
    """A sensor's gel under N surfaces that reach into it as `gel_indentation` says; see `touch_images`."""
    check_tensor("dwell", dwell, len(indentation), finite=False)
    _, extent, seen = grid.layout(sensor.field_of_view, resolution)
    displacement = gel_displacement(
        indentation,
        dwell,
        extent=extent,
        thickness=sensor.thickness,
        correlation=sensor.correlation,
        relaxation=sensor.relaxation,
        blur=sensor.blur,
        contact_steps=sensor.contact_steps,
    )
    return PressedGel(displacement, extent, seen)


def images_of_gel(gel: PressedGel, sensor: Sensor, grid: GelGrid = DEFAULT_GRID) -> Tensor:
    """What a sensor's camera sees of its pressed gel, (N, 3, S, S); arguments as for `touch_images`."""
    seen = gel.seen
    if grid.slopes == "spectral":
        slope_x, slope_y = spectral_slopes(gel.displacement, gel.extent)
    else:
        slope_x, slope_y = slopes(gel.displacement, gel.extent / gel.displacement.shape[-1])
    slope_x, slope_y, depth = slope_x[:, seen, seen], slope_y[:, seen, seen], gel.depth
    images = shade_gel(slope_x, slope_y, sensor, depth)
    if sensor.marker_pitch:
        dots = (sensor.marker_pitch, sensor.marker_radius, sensor.marker_ink)
        images = images * marker_mask(slope_x, slope_y, depth, sensor.field_of_view, *dots)
    images = images.clamp(0.0, 1.0)
    if sensor.gamma != 1.0:
        images = images**sensor.gamma
    return images if grid.refinement == 1 else F.avg_pool2d(images, grid.refinement)


def untouched_gel(sensor: Sensor, resolution: int) -> Tensor:
    """What a sensor's camera sees of its gel where nothing touches it, without noise, (3, S, S) in [0, 1].

    Raises:
        InvalidInputError, InvalidTypeError: On a resolution or sensor that is none.
    """
    check_kind("sensor", sensor, Sensor)
    check_integer("resolution", resolution, 1, LARGEST_GRID)
    pixels, extent, seen = DEFAULT_GRID.layout(sensor.field_of_view, resolution)
    return images_of_gel(PressedGel(torch.zeros(1, pixels, pixels), extent, seen), sensor)[0]


def contact_share(
    height: Tensor,
    indentation_depth: Tensor,
    compliance: Tensor,
    sensor: Sensor,
    resolution: int,
    grid: GelGrid = DEFAULT_GRID,
) -> Tensor:
    """Share of the camera's view in which a surface touches the gel, (N,); arguments as for `touch_images`."""
    indentation, seen = gel_indentation(height, indentation_depth, compliance, sensor, resolution, grid)
    return (indentation[:, seen, seen] > 0).float().mean(dim=(-2, -1))


def gel_indentation(
    height: Tensor,
    indentation_depth: Tensor,
    compliance: Tensor,
    sensor: Sensor,
    resolution: int,
    grid: GelGrid = DEFAULT_GRID,
) -> tuple[Tensor, slice]:
    """Indentation (N, P, P) in mm over all the gel that is solved, and which rows and columns of it the camera sees."""
    check_tensor("height", height, "N", "R", "R", finite=False)
    check_heights(height)
    for label, values in (("indentation_depth", indentation_depth), ("compliance", compliance)):
        check_tensor(label, values, len(height))
    check_kind("sensor", sensor, Sensor), check_kind("grid", grid, GelGrid)
    check_integer("resolution", resolution, 1, LARGEST_GRID)
    pixels, extent, seen = grid.layout(sensor.field_of_view, resolution)
    height = resample_centre(height, extent, pixels)
    if sensor.dome:
        axis = pixel_axis(pixels, 2 * extent / sensor.field_of_view)
        height = height - sensor.dome * (axis[None, :] ** 2 + axis[:, None] ** 2)
    return contact_indentation(height, indentation_depth, compliance), seen


def shade_gel(slope_x: Tensor, slope_y: Tensor, sensor: Sensor, depth: Tensor | None = None) -> Tensor:
    """Light that a gel of given slopes and depths (N, R, R) sends to the camera, (N, 3, R, R), not yet clipped."""
    axis = pixel_axis(slope_x.shape[-1], 2.0)
    x, y = axis[None, :], axis[:, None]
    images = gel_background(sensor, slope_x.shape[-1]).expand(len(slope_x), -1, -1, -1).clone()
    normal = torch.rsqrt(1.0 + slope_x**2 + slope_y**2)
    count = len(sensor.azimuths)
    elevations = sensor.elevation if isinstance(sensor.elevation, tuple) else (sensor.elevation,) * count
    lights = zip(sensor.azimuths, elevations, sensor.colours, sensor.gradients or ((0.0, 0.0),) * count, strict=True)
    for azimuth, elevation, colour, (along_x, along_y) in lights:
        elevation = math.radians(elevation)
        toward_x = math.cos(math.radians(azimuth)) * math.cos(elevation)
        toward_y = math.sin(math.radians(azimuth)) * math.cos(elevation)
        lambert = (math.sin(elevation) - slope_x * toward_x - slope_y * toward_y) * normal
        strength = 1.0 + sensor.falloff * (x * toward_x + y * toward_y) + (along_x * x + along_y * y)
        change = (lambert.clamp_min(0.0) - math.sin(elevation)) * strength
        images += sensor.gain * torch.tensor(colour)[None, :, None, None] * change[:, None]
    if depth is not None and any(sensor.tint):
        images += torch.tensor(sensor.tint)[None, :, None, None] * depth[:, None]
    return images


def gel_background(sensor: Sensor, resolution: int) -> Tensor:
    """What the camera sees of an untouched gel, (3, R, R)."""
    if sensor.backdrop is not None:
        coarse = torch.tensor(sensor.backdrop)[None]
        return F.interpolate(coarse, (resolution, resolution), mode="bicubic", align_corners=False)[0]
    axis = pixel_axis(resolution, 2.0)
    x, y = axis[None, :], axis[:, None]
    basis = torch.stack([torch.ones(resolution, resolution), x.expand(resolution, -1), y.expand(-1, resolution),
                         x**2 + y**2, x * y])  # fmt: skip
    return torch.einsum("cb,bhw->chw", torch.tensor(sensor.background), basis)


def marker_mask(
    slope_x: Tensor, slope_y: Tensor, depth: Tensor, view: float, pitch: float, radius: float, ink: float
) -> Tensor:
    """Transmission (N, 1, R, R) of printed dots that the gel's displacement drags along."""
    axis = pixel_axis(slope_x.shape[-1], view)
    shift = MARKER_DRAG * depth
    x, y = axis[None, None, :] + shift * slope_x, axis[None, :, None] + shift * slope_y
    # Offset from the nearest dot; 512 more periods keep `frac`'s argument positive.
    nearest_x = (torch.frac(x / pitch + 512.5) - 0.5) * pitch
    nearest_y = (torch.frac(y / pitch + 512.5) - 0.5) * pitch
    inside = torch.sigmoid((radius - torch.hypot(nearest_x, nearest_y)) / MARKER_RIM)
    return (1.0 - ink * inside)[:, None]
