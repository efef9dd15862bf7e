"""Touch images of a height map that is pressed against any sensor of the world."""

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
    check_finite,
    check_integer,
    check_not_empty,
    check_number,
    describe,
    explain_errors,
    one_each,
)
from unitouch_gen.world.draws import generator
from unitouch_gen.world.gel import gel_displacement, gel_image, gel_square, in_view, indentation_against
from unitouch_gen.world.grids import pixel_axis
from unitouch_gen.world.sensors import SENSORS, Sensor

FEWEST = 8  # pixels along a side of a height map
MOST = 8192  # pixels along a side of a height map
FLATTEST = 1e-6  # smallest difference of heights, mm
DWELL = 1.0  # time between contact and exposure, after which gels have settled, s


@dataclass
class Pressed:
    """Touch images and depth maps of N contacts."""

    touch: Tensor  # touch images in [0, 1], (N, 3, S, S)
    depth: Tensor  # displacement of the gel in the camera's view, mm, (N, S, S)
    field_of_view: float  # side of the view, mm


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

    Heights point toward the sensor, so bright places touch first. Floats are millimetres. The full range of integers of
    8 or 16 bits stands for `relief_mm`. Beyond its border a map continues at the height of the border.

    Args:
        height: A height map: a path (8 or 16 bit image, float TIFF, .npy) or an array or tensor (H, W); or one for each
            contact, as (N, H, W) or a list of any shapes.
        mm: Width of the map, mm, from 0.5 to 10,000.
        sensor: A name in `SENSORS`, or a sensor.
        depth: Depth of the surface beyond first contact, mm, up to 10: one, or one for each contact.
        relief_mm: Height of the full range of integers, and factor on floats, up to 1,000.
        at: Middle of each contact on the map: x to the right and y down of its centre, mm.
        image_size: Side S of the images, pixels.
        seed: Of the noise of the camera; `None` for no noise.

    Raises:
        InvalidInputError, InvalidTypeError: If a map is flat, in colours, too small, too large or not finite, or a
            number is out of its range. The message says what to pass.

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
    if not isinstance(sensor, Sensor):
        sensor = SENSORS[check_choice("sensor", sensor, SENSORS)]
    maps = height_maps(height, relief_mm)
    depths = [check_number("depth", value, 0.001, 10.0) for value in _listed("depth", depth)]
    points = _listed("at", at)
    count = max(len(maps), len(depths), len(points))
    maps = one_each("height", maps, count)
    depths = one_each("depth", depths, count)
    points = one_each("at", points, count)
    places = [_place(point, mm, height_map) for point, height_map in zip(points, maps, strict=True)]

    # 2. The square of surface under each contact.
    pixels, extent = gel_square(sensor, size)
    heights = list[Tensor]()
    for height_map, place in zip(maps, places, strict=True):
        heights.append(under_gel(height_map, mm, place, extent=extent, pixels=pixels))

    # 3. The gel, and its image.
    indentation = indentation_against(torch.stack(heights), torch.tensor(depths), sensor, extent)
    displacement = gel_displacement(indentation, torch.full((count,), DWELL), sensor, size)
    touch = gel_image(displacement, sensor, size)
    if seed is not None:
        noise = [generator(seed, row).standard_normal((3, size, size), dtype=np.float32) for row in range(count)]
        touch = (touch + sensor.noise * torch.from_numpy(np.stack(noise))).clamp(0.0, 1.0)
    return Pressed(touch, in_view(displacement, size), sensor.field_of_view)


def check_relief(relief_mm: Any) -> float:
    """Checks a factor on heights."""
    return check_number("relief_mm", relief_mm, 1e-4, 1000.0)


def _listed(name: str, values: Any) -> list[Any]:
    """One value, a list, an array or a tensor as a list of at least one."""
    if hasattr(values, "tolist"):
        values = values.tolist()
    listed = list(values) if isinstance(values, list | tuple) else [values]
    check_not_empty(name, listed)
    return listed


def _place(place: Any, mm: float, height: Tensor) -> tuple[float, float]:
    """A checked place on a map, in mm; the map's pixels are square."""
    if not isinstance(place, list | tuple) or len(place) != 2:
        wanted = "pass pairs of x and y in mm from the centre, such as [(5, -3)]"
        raise InvalidInputError(f"`at` holds {describe(place)}; {wanted}.")
    rows, columns = height.shape
    half_width = 0.5 * mm
    half_height = 0.5 * mm * rows / columns
    x = check_number("at", place[0], -half_width, half_width)  # beyond them there is no map
    y = check_number("at", place[1], -half_height, half_height)
    return x, y


def under_gel(height: Tensor, mm: float, place: tuple[float, float], *, extent: float, pixels: int) -> Tensor:
    """Heights (P, P) of the square of `extent` mm about a place on a map (H, W) that is `mm` wide.

    A map finer than the new grid is averaged first, to avoid aliasing.
    """
    rows, columns = height.shape
    pixel = mm / columns  # side of a pixel of the map, mm
    axis = pixel_axis(pixels, extent)
    x = 0.5 * columns + (axis + place[0]) / pixel  # in pixels of the map
    y = 0.5 * rows + (axis + place[1]) / pixel
    left, right = _range_of(x, columns)
    top, bottom = _range_of(y, rows)
    crop = height[top:bottom, left:right]
    x = x - left
    y = y - top
    step = math.floor(extent / pixels / pixel)
    if step > 1:
        crop = F.avg_pool2d(crop[None, None], step, ceil_mode=True, count_include_pad=False)[0, 0]
        x = x / step
        y = y / step
    grid_x = 2.0 * x / crop.shape[1] - 1.0
    grid_y = 2.0 * y / crop.shape[0] - 1.0
    grid = torch.stack(torch.meshgrid(grid_x, grid_y, indexing="xy"), dim=-1)[None]
    mode = "bicubic" if pixel > extent / pixels else "bilinear"  # large pixels need smooth slopes between them
    return F.grid_sample(crop[None, None], grid, mode=mode, padding_mode="border", align_corners=False)[0, 0]


def _range_of(positions: Tensor, size: int) -> tuple[int, int]:
    """First pixel, and the one after the last, of a row of `size` that positions and a margin of 4 pixels need."""
    first = max(math.floor(float(positions.min())) - 4, 0)
    end = min(math.ceil(float(positions.max())) + 4, size)
    return first, end


# Reading height maps --------------------------------------------------------------------------------------------------


def height_maps(height: Any, relief_mm: float, name: str = "height") -> list[Tensor]:
    """Height maps of all kinds as float32 (H, W) in mm, each relative to its middle height."""
    maps = list[Tensor]()
    if isinstance(height, list | tuple):
        check_not_empty(name, height)
        for row, item in enumerate(height):
            item_name = f"{name}[{row}]"
            maps.append(_checked(item_name, _values(item_name, item), relief_mm))
    else:
        values = _values(name, height)
        if values.ndim == 3 and values.shape[-1] in (1, 3, 4):  # an image as an array
            values = _one_channel(f"`{name}`", values)
        is_stack = values.ndim == 3 and len(values) > 0
        for single in values if is_stack else [values]:
            maps.append(_checked(name, single, relief_mm))
    return maps


def _values(name: str, height: Any) -> np.ndarray:
    """The values of a path, PIL image, array or tensor."""
    subject = f"`{name}`"
    if isinstance(height, str | os.PathLike):
        check_file(name, height, "a height map")
        subject = f"`{name}` names {str(height)!r}, which"
        height = _read(subject, Path(height).read_bytes())
    if isinstance(height, Image.Image):
        return _grey(subject, height)
    if isinstance(height, Tensor):
        height = height.detach().cpu().numpy()
    if isinstance(height, np.ndarray) and (height.dtype in (np.uint8, np.uint16) or height.dtype.kind == "f"):
        return height
    wanted = "pass a path, or an array (H, W): floats in mm, or uint8 or uint16 as shares of `relief_mm`"
    raise InvalidTypeError(f"{subject} is {describe(height)}; {wanted}.")


def _read(subject: str, content: bytes) -> Image.Image | np.ndarray:
    """The image or array in a file. The size of an image is checked before its pixels are decoded."""
    wanted = "save it as a PNG of 8 or 16 bits, a float TIFF or a .npy file"
    kinds = (OSError, SyntaxError, ValueError, Image.DecompressionBombError)
    with explain_errors(f"{subject} cannot be read as an image", wanted, *kinds), warnings.catch_warnings():
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        if content.startswith(b"\x93NUMPY"):
            return np.load(io.BytesIO(content), allow_pickle=False)
        image = Image.open(io.BytesIO(content))
        _check_size(subject, *image.size)
        image.load()
        return image


def _check_size(subject: str, width: int, height: int) -> None:
    if min(width, height) < FEWEST or max(width, height) > MOST:
        wanted = f"pass a map of {FEWEST} to {MOST} pixels a side, resampled if larger"
        raise InvalidInputError(f"{subject} is {width} x {height} pixels; {wanted}.")


def _grey(subject: str, image: Image.Image) -> np.ndarray:
    """The values of a grey image; opacity is ignored."""
    _check_size(subject, *image.size)
    if image.mode == "I":  # some files of 16 bits
        return np.asarray(image).astype(np.uint16)
    if image.mode == "F" or image.mode.startswith("I;16"):
        values = np.asarray(image)
        return values.astype(values.dtype.newbyteorder("="))
    if image.mode in ("1", "L"):
        return np.asarray(image.convert("L"))
    return _one_channel(subject, np.asarray(image.convert("RGB")))


def _one_channel(subject: str, pixels: np.ndarray) -> np.ndarray:
    """The channel (H, W) of a grey image (H, W, 1, 3 or 4)."""
    if (pixels[..., :3] != pixels[..., :1]).any():
        raise InvalidInputError(f"{subject} is in colours; pass a grey height map, where bright is high.")
    return pixels[..., 0]


def _checked(name: str, values: np.ndarray, relief_mm: float) -> Tensor:
    """A checked map in mm, relative to its middle height."""
    if values.ndim != 2:
        raise InvalidInputError(f"`{name}` is {describe(values)}; pass heights (H, W), or (N, H, W) for N contacts.")
    _check_size(f"`{name}`", values.shape[1], values.shape[0])
    full_scale = 1.0 if values.dtype.kind == "f" else np.iinfo(values.dtype).max
    heights = values.astype(np.float64) / full_scale
    heights = relief_mm * check_finite(name, torch.from_numpy(heights)).numpy()
    low = heights.min()
    high = heights.max()
    if not FLATTEST < high - low < 1e5:
        what = "is flat" if high - low <= FLATTEST else f"reaches over {high - low:g} mm"
        raise InvalidInputError(f"`{name}` {what}; pass a relief in mm, of floats, or integers with `relief_mm`.")
    return torch.from_numpy((heights - 0.5 * (low + high)).astype(np.float32))
