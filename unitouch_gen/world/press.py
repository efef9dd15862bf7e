"""Touches of one's own surface: a height map pressed against any sensor of the world."""

import io
import math
import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor

from unitouch_gen.errors import (
    InvalidInputError,
    InvalidTypeError,
    check_choice,
    check_file,
    check_integer,
    check_number,
    describe,
    first_line,
)
from unitouch_gen.world.draws import generator
from unitouch_gen.world.gel import gel_displacement, gel_image, gel_square, in_view, indentation_against
from unitouch_gen.world.grids import pixel_axis
from unitouch_gen.world.sensors import SENSORS, Sensor

FEWEST = 8  # pixels along a side of a height map
MOST = 8192
FLATTEST = 1e-6  # mm; less from the lowest to the highest point is no relief
DWELL = 1.0  # s between contact and exposure: gels have settled


@dataclass
class Pressed:
    """What a sensor sees of N contacts."""

    touch: Tensor  # touch images in [0, 1], (N, 3, S, S)
    depth: Tensor  # how far the gel is displaced where the camera sees it, mm, (N, S, S)
    field_of_view: float  # side of what it sees, mm


@torch.no_grad()
def press(
    height: Any,
    mm: float = 30.0,
    sensor: str | Sensor = "digit",
    depth: float | Sequence[float] = 1.0,
    *,
    relief_mm: float = 1.0,
    at: Sequence[tuple[float, float]] = ((0.0, 0.0),),
    image_size: int = 128,
    seed: int | None = 0,
) -> Pressed:
    """Presses a surface against a sensor and returns the touch images and depth maps.

    Heights point toward the sensor: what is bright touches first. Floats are millimetres. Integers of 8 or 16 bits are
    a share of their full range, which stands for `relief_mm`. Beyond its rim a map goes on at the height of the rim.

    Args:
        height: A height map: a path (8 or 16 bit image, float TIFF, .npy) or an array or tensor (H, W); or one for each
            contact, as (N, H, W) or a list.
        mm: Width of the map, mm, from 0.5 to 10,000.
        sensor: A name in `SENSORS`, or a sensor.
        depth: How far the surface is pushed beyond first contact, mm, up to 10: one, or one for each contact.
        relief_mm: Height of the full range of integers, and factor on floats, up to 1,000.
        at: Where the middle of each contact is on the map: x to the right and y down of its centre, mm.
        image_size: Side S of the images, pixels.
        seed: Of the noise of the camera; `None` for none.

    Raises:
        InvalidInputError, InvalidTypeError: On a map that is flat, in colours, too small, too large or not finite, or a
            number that is out of its range. The message says what to pass.

    Example:
        >>> x = np.linspace(-5.0, 5.0, 200)
        >>> ball = np.sqrt(np.maximum(36.0 - x[:, None] ** 2 - x[None, :] ** 2, 0.0))
        >>> press(ball, mm=10.0, sensor="gelsight", depth=[0.5, 1.0]).touch.shape
        torch.Size([2, 3, 128, 128])
    """
    # 1. Check.
    mm = check_number("mm", mm, 0.5, 10_000.0)
    relief_mm = check_relief(relief_mm)
    size = check_integer("image_size", image_size, 16, 2048)
    if seed is not None:
        check_integer("seed", seed, 0)
    used = sensor if isinstance(sensor, Sensor) else SENSORS[check_choice("sensor", sensor, SENSORS)]
    maps = height_maps(height, relief_mm)
    depths = [check_number("depth", one, 0.001, 10.0) for one in _listed("depth", depth)]
    places = [_place(one, mm, maps[0]) for one in _listed("at", at)]
    count = max(len(maps), len(depths), len(places))
    for name, given in {"height": len(maps), "depth": len(depths), "at": len(places)}.items():
        if given not in (1, count):
            raise InvalidInputError(f"`{name}` has {given} values for {count} contacts; pass one, or as many.")

    # 2. The square of surface under each contact, and what the gel makes of it.
    pixels, extent = gel_square(used, size)
    under = [
        under_gel(maps[row % len(maps)], mm, places[row % len(places)], extent=extent, pixels=pixels)
        for row in range(count)
    ]
    pushed = torch.tensor([depths[row % len(depths)] for row in range(count)])
    indentation = indentation_against(torch.stack(under), pushed, used, extent)
    displacement = gel_displacement(indentation, torch.full((count,), DWELL), used, size)
    touch = gel_image(displacement, used, size)
    if seed is not None:
        noise = [generator(seed, row).standard_normal((3, size, size), dtype=np.float32) for row in range(count)]
        touch = (touch + used.noise * torch.from_numpy(np.stack(noise))).clamp(0.0, 1.0)
    return Pressed(touch, in_view(displacement, size), used.field_of_view)


def check_relief(relief_mm: Any) -> float:
    """A factor on heights."""
    return check_number("relief_mm", relief_mm, 1e-4, 1000.0)


def _listed(name: str, values: Any) -> list[Any]:
    """One value, a list, an array or a tensor as a list of at least one."""
    values = values.tolist() if hasattr(values, "tolist") else values
    values = list(values) if isinstance(values, list | tuple) else [values]
    if not values:
        raise InvalidInputError(f"`{name}` is empty; pass one value, or one for each contact.")
    return values


def _place(place: Any, mm: float, height: Tensor) -> tuple[float, float]:
    """A place on a map, which is as tall as its pixels are square."""
    if not isinstance(place, list | tuple) or len(place) != 2:
        wanted = "pass pairs of x and y in mm from the centre, such as [(5, -3)]"
        raise InvalidInputError(f"`at` holds {describe(place)}; {wanted}.")
    rows, columns = height.shape
    x, y = (check_number("at", value) for value in place)
    half_width = 0.5 * mm
    half_height = 0.5 * mm * rows / columns
    if abs(x) > half_width or abs(y) > half_height:
        most = f"{half_width:g} mm to a side and {half_height:g} mm up and down"
        raise InvalidInputError(f"`at` is ({x:g}, {y:g}), outside the map, which reaches {most} from its centre.")
    return x, y


def under_gel(height: Tensor, mm: float, place: tuple[float, float], *, extent: float, pixels: int) -> Tensor:
    """Heights (P, P) of the square of `extent` mm about a place on a map (H, W) that is `mm` wide.

    A map finer than the new grid is averaged first, or its shortest waves would fold back.
    """
    rows, columns = height.shape
    pixel = mm / columns  # side of a pixel of the map, mm
    axis = pixel_axis(pixels, extent)
    x = 0.5 * columns + (axis + place[0]) / pixel  # in pixels
    y = 0.5 * rows + (axis + place[1]) / pixel
    low = [max(math.floor(float(one.min())) - 4, 0) for one in (x, y)]
    high = [min(math.ceil(float(one.max())) + 4, most) for one, most in ((x, columns), (y, rows))]
    crop = height[low[1] : high[1], low[0] : high[0]]
    x = x - low[0]
    y = y - low[1]
    step = math.floor(extent / pixels / pixel)
    if step > 1:
        crop = F.avg_pool2d(crop[None, None], step, ceil_mode=True, count_include_pad=False)[0, 0]
        x = x / step
        y = y / step
    across = 2.0 * x / crop.shape[1] - 1.0
    down = 2.0 * y / crop.shape[0] - 1.0
    grid = torch.stack(torch.meshgrid(across, down, indexing="xy"), dim=-1)[None]
    mode = "bicubic" if pixel > extent / pixels else "bilinear"  # between far pixels, slopes have to be smooth
    return F.grid_sample(crop[None, None], grid, mode=mode, padding_mode="border", align_corners=False)[0, 0]


# Reading height maps --------------------------------------------------------------------------------------------------


def height_maps(height: Any, relief_mm: float, name: str = "height") -> list[Tensor]:
    """Height maps of all kinds as float32 (H, W) in mm, each relative to its middle height; all of one shape."""
    if isinstance(height, list | tuple):
        if not height:
            raise InvalidInputError(f"`{name}` is an empty list; pass at least one height map.")
        named = {f"{name}[{row}]": one for row, one in enumerate(height)}
        maps = [_checked(own, _values(own, one), relief_mm) for own, one in named.items()]
    else:
        values = _values(name, height)
        if values.ndim == 3 and values.shape[-1] in (1, 3, 4):  # an image as an array
            values = _one_channel(f"`{name}`", values)
        several = values.ndim == 3 and len(values) > 0
        maps = [_checked(name, one, relief_mm) for one in (values if several else [values])]
    if len({one.shape for one in maps}) > 1:
        raise InvalidInputError(f"`{name}` holds maps of several shapes; pass maps of one shape, or one after another.")
    return maps


def _values(name: str, height: Any) -> np.ndarray:
    """Values of a path, PIL image, array or tensor."""
    subject = f"`{name}`"
    if isinstance(height, str | os.PathLike):
        check_file(name, height, "a height map")
        content = Path(height).read_bytes()
        if content.startswith(b"\x93NUMPY"):
            try:
                return np.load(io.BytesIO(content), allow_pickle=False)
            except ValueError as error:
                raise InvalidInputError(f"`{name}` names {str(height)!r}: {first_line(error)}.") from error
        subject = f"`{name}` names {str(height)!r}, which"
        height = _opened(subject, io.BytesIO(content))
    if isinstance(height, Image.Image):
        return _grey(subject, height)
    if isinstance(height, Tensor):
        return height.detach().cpu().numpy()
    if isinstance(height, np.ndarray):
        return height
    raise InvalidTypeError(f"`{name}` is {describe(height)}; pass a path, or an array of heights (H, W).")


def _opened(subject: str, content: io.BytesIO) -> Image.Image:
    """An image of a size that can be taken; the size is checked before its pixels are decoded."""
    wanted = "save it as a PNG of 8 or 16 bits, a float TIFF or a .npy file"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            image = Image.open(content)
            _check_size(subject, *image.size)
            image.load()
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        if isinstance(error, InvalidInputError):
            raise
        raise InvalidInputError(f"{subject} cannot be read as an image ({first_line(error)}); {wanted}.") from error
    return image


def _check_size(subject: str, width: int, height: int) -> None:
    if min(width, height) < FEWEST or max(width, height) > MOST:
        wanted = f"pass a map of {FEWEST} to {MOST} pixels a side, resampled if larger"
        raise InvalidInputError(f"{subject} is {width} x {height} pixels; {wanted}.")


def _grey(subject: str, image: Image.Image) -> np.ndarray:
    """Values of an image without colours; opacity is left out."""
    _check_size(subject, *image.size)
    if image.mode == "I":  # of some 16-bit files
        return np.asarray(image).astype(np.uint16)
    if image.mode == "F" or image.mode.startswith("I;16"):
        values = np.asarray(image)
        return values.astype(values.dtype.newbyteorder("="))
    if image.mode in ("1", "L"):
        return np.asarray(image.convert("L"))
    return _one_channel(subject, np.asarray(image.convert("RGB")))


def _one_channel(subject: str, pixels: np.ndarray) -> np.ndarray:
    """The channel (H, W) of an image (H, W, 1, 3 or 4) whose colours are all alike."""
    if (pixels[..., :3] != pixels[..., :1]).any():
        raise InvalidInputError(f"{subject} is in colours; pass a grey height map, where bright is high.")
    return pixels[..., 0]


def _checked(name: str, values: np.ndarray, relief_mm: float) -> Tensor:
    """A map in mm."""
    if values.ndim != 2:
        raise InvalidInputError(f"`{name}` is {describe(values)}; pass heights (H, W), or (N, H, W) for N contacts.")
    _check_size(f"`{name}`", values.shape[1], values.shape[0])
    if values.dtype in (np.uint8, np.uint16):
        heights = values.astype(np.float64) / np.iinfo(values.dtype).max
    elif np.issubdtype(values.dtype, np.floating):
        heights = values.astype(np.float64)
    else:
        wanted = "pass floats in mm, or uint8 or uint16 as shares of `relief_mm`"
        raise InvalidTypeError(f"`{name}` is {describe(values)}; {wanted}.")
    if bad := int((~np.isfinite(heights)).sum()):
        raise InvalidInputError(f"`{name}` holds {bad} of {heights.size} values that are NaN or infinite; fill them.")
    heights = relief_mm * heights
    low = heights.min()
    high = heights.max()
    if not FLATTEST < high - low < 1e5:
        what = "is flat" if high - low <= FLATTEST else f"reaches over {high - low:g} mm"
        raise InvalidInputError(f"`{name}` {what}; pass a relief in mm, of floats, or integers with `relief_mm`.")
    return torch.from_numpy((heights - 0.5 * (low + high)).astype(np.float32))
