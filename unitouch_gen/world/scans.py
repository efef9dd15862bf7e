"""Scanned surfaces: photographed colours and measured heights of real surfaces, in place of a drawn relief.

`collection/index.csv` names each with its source, author and licence. No source has a physical scale, so the side and
the relief of each object's surface are drawn by material.
"""

import csv
import math
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor

from unitouch_gen.world.draws import FIRST_OBJECT, SCAN_STREAM, Draws, generator
from unitouch_gen.world.grids import PATCH_MM, pixel_axis
from unitouch_gen.world.materials import MATERIALS

COLLECTION = Path(__file__).with_name("collection")
COLOURS = ".colour.webp"  # suffixes of files
HEIGHTS = ".height.webp"
HEIGHT_RANGE = 3.2  # heights are stored in units of their deviation, from minus to plus this number
GAMMA = 1.8  # of photographs, as of the world's pictures

MEASURED_WEIGHT = 3  # frequency of a measured surface, relative to one with computed heights
LARGEST_SHARE = 0.1  # largest share of a material's training objects with the same surface
LOWEST_RELIEF = 0.03  # RMS, mm
HIGHEST_RELIEF = 0.6  # RMS, mm
CLEAR_GRAIN = 0.35  # coherence of slopes above which a surface has a direction


@dataclass(frozen=True)
class ScannedSurface:
    """One surface of the collection."""

    name: str
    material: str
    heights: str  # "measured", "computed" from a photograph's brightness, or "none" if only colours are known
    split: str  # "train", "val" or "test"
    group: str  # surfaces that may be of one asset; all of them are in one split
    source: str
    author: str
    licence: str

    @property
    def weight(self) -> int:
        """Relative frequency."""
        return MEASURED_WEIGHT if self.heights == "measured" else 1

    @cached_property
    def colours(self) -> Tensor:
        """Photographed colours, sRGB, uint8 (3, S, S)."""
        image = Image.open(COLLECTION / "surfaces" / f"{self.name}{COLOURS}").convert("RGB")
        return torch.from_numpy(np.array(image)).permute(2, 0, 1).contiguous()

    @cached_property
    def mean_colour(self) -> Tensor:
        """Mean linear RGB, (3,)."""
        return linear_levels()[self.colours.long()].mean(dim=(1, 2))

    @cached_property
    def relief(self) -> Tensor:
        """Heights in 256 levels, uint8 (S, S); a flat field if none are known."""
        if self.heights == "none":
            return torch.full((8, 8), 128, dtype=torch.uint8)
        image = Image.open(COLLECTION / "surfaces" / f"{self.name}{HEIGHTS}").convert("L")
        return torch.from_numpy(np.array(image))

    @cached_property
    def grain(self) -> tuple[float, float]:
        """Direction of the grain, radians in the scan's frame, and its coherence, [0, 1], by the structure tensor."""
        slope_y, slope_x = torch.gradient(self.relief.float())
        xx = (slope_x**2).mean().item()
        yy = (slope_y**2).mean().item()
        xy = (slope_x * slope_y).mean().item()
        steepest = 0.5 * math.atan2(2 * xy, xx - yy)
        coherence = math.hypot(xx - yy, 2 * xy) / max(xx + yy, 1e-9)
        return steepest + 0.5 * math.pi, coherence


@cache
def linear_levels() -> Tensor:
    """Linear reflectance of each of the 256 levels of a photograph."""
    return (torch.arange(256) / 255.0) ** GAMMA


@cache
def scanned_surfaces() -> tuple[ScannedSurface, ...]:
    """All surfaces of the collection."""
    with (COLLECTION / "index.csv").open(encoding="utf-8", newline="") as stream:
        rows = [row for row in csv.DictReader(stream) if row["kind"] == "surface"]
    return tuple(ScannedSurface(**{name: row[name] for name in ScannedSurface.__annotations__}) for row in rows)


# Which objects are scanned --------------------------------------------------------------------------------------------


def split_of(object_: int) -> str:
    """The split of an object, by its number."""
    number = object_ % 1000
    return [name for name, first in FIRST_OBJECT.items() if first <= number][-1]


@cache
def surfaces_of(material: int, split: str, colours_alone: bool = False) -> tuple[int, ...]:
    """Numbers of the surfaces of a material and a split; "beyond" has those of "test"."""
    name = MATERIALS[material].name
    own_split = "test" if split == "beyond" else split
    numbers = list[int]()
    for number, surface in enumerate(scanned_surfaces()):
        is_usable = surface.heights != "none" or colours_alone
        if surface.material == name and surface.split == own_split and is_usable:
            numbers.append(number)
    return tuple(numbers)


def surface_of(seed: int, material: int, object_: int, share: float, colours_alone: bool = False) -> int:
    """Number of the surface of an object in a world, or -1 for a drawn one.

    Scanned objects are spread evenly over the numbers of a split. They take the surfaces in turn, in a random order for
    each round, so that all are used.
    """
    split = split_of(object_)
    candidates = surfaces_of(material, split, colours_alone)
    if split == "train" and share < 1.0:
        share = min(share, LARGEST_SHARE * len(candidates))
    position = object_ % 1000 - FIRST_OBJECT[split]
    scanned_before = math.floor(position * share)
    is_scanned = math.floor((position + 1) * share) > scanned_before
    if not candidates or not is_scanned:
        return -1
    weighted = list[int]()
    for number in candidates:
        repeats = scanned_surfaces()[number].weight if split == "train" else 1
        weighted += [number] * repeats
    turn, place = divmod(scanned_before, len(weighted))
    rng = generator(seed, SCAN_STREAM, material, object_ // 1000, list(FIRST_OBJECT).index(split), turn)
    return weighted[rng.permutation(len(weighted))[place]]


def with_scans(seed: int, draws: Draws, share: float, colours_alone: bool = False) -> Draws:
    """The same contacts, a share of their objects scanned.

    They have further numbers: `scan_side` of the scan (mm), `scan_turn` in the picture (radians), `scan_mirrored` (1 or
    -1), `scan_place` of the contact (mm), `scan_tint` (factors on RGB), `scan_contrast` (exponent on colours around
    their mean), and whether the surface is `grained`. `angle` of scanned rows is the direction of the scan's own grain.
    """
    names = draws.names()
    numbers = [surface_of(seed, material, object_, share, colours_alone) for material, object_, _ in names]
    columns = {
        "scan_side": draws.of_material("field") * draws.scale,
        "scan_turn": draws.angle.clone(),
        "scan_mirrored": torch.ones(len(draws)),
        "scan_place": torch.zeros(len(draws), 2),
        "scan_tint": torch.ones(len(draws), 3),
        "scan_contrast": torch.ones(len(draws)),
        "grained": torch.zeros(len(draws), dtype=torch.bool),
        "angle": draws.angle.clone(),
        "colour": draws.colour.clone(),
        "amplitude": draws.amplitude.clone(),
    }
    for row, number in enumerate(numbers):
        if number < 0:
            continue
        scan = scanned_surfaces()[number]
        spec = MATERIALS[names[row][0]]
        of_contact = generator(seed, SCAN_STREAM, *names[row])
        mirrored = 1.0 if of_contact.uniform() < 0.5 else -1.0
        direction, coherence = scan.grain
        relief = spec.roughness * float(draws.amplitude[row])
        relief = min(max(relief, LOWEST_RELIEF), HIGHEST_RELIEF)
        tint, contrast = draw_colours(seed, names[row], scan)
        # The patch lies within the scan, as far as it fits.
        side = float(columns["scan_side"][row])
        turn = float(columns["scan_turn"][row])
        extent = PATCH_MM * (abs(math.cos(turn)) + abs(math.sin(turn)))  # of the turned patch, mm
        free = max(side - extent, 0.1 * side)
        place = 0.5 * side + free * of_contact.uniform(-0.5, 0.5, 2)
        columns["scan_place"][row] = torch.from_numpy(place).float()
        columns["scan_mirrored"][row] = mirrored
        columns["scan_tint"][row] = tint
        columns["scan_contrast"][row] = contrast
        columns["grained"][row] = coherence > CLEAR_GRAIN
        columns["angle"][row] += mirrored * direction
        columns["colour"][row] = (scan.mean_colour * tint).clamp(0.02, 0.98)
        columns["amplitude"][row] = relief / spec.roughness
    surface = torch.tensor(numbers, dtype=torch.int64)
    return draws.but(surface=surface, **columns)


def draw_colours(seed: int, name: tuple[int, int, int], scan: ScannedSurface) -> tuple[Tensor, Tensor]:
    """Tint, factors on RGB, and contrast, an exponent on colours, of an object; training objects vary."""
    material, object_, _ = name
    if split_of(object_) != "train":
        return torch.ones(()), torch.ones(())
    of_object = generator(seed, SCAN_STREAM, material, object_)
    tint = torch.from_numpy(np.exp(of_object.normal(0.0, 0.2) + of_object.normal(0.0, 0.06, 3))).float()
    contrast = torch.tensor(of_object.uniform(0.6, 1.3))
    # Heights computed from brightness would always make dark places deep.
    if scan.heights == "computed" and of_object.uniform() < 0.35:
        contrast = -contrast
    return tint, contrast


# Colours and heights --------------------------------------------------------------------------------------------------


def scanned_patches(draws: Draws, rows: Tensor, resolution: int, *, coloured: bool) -> tuple[Tensor, Tensor | None]:
    """Heights (n, R, R), mm, and with `coloured` linear colours (n, 3, R, R), of the scanned contacts in `rows`."""
    axis = pixel_axis(resolution)
    heights = list[Tensor]()
    colours = list[Tensor]()
    for row in rows.tolist():
        scan = scanned_surfaces()[int(draws.surface[row])]
        side = float(draws.scan_side[row])
        turn = float(draws.scan_turn[row])
        x = axis[None, :]
        y = axis[:, None]
        u = (math.cos(turn) * x + math.sin(turn) * y) * float(draws.scan_mirrored[row])
        v = math.cos(turn) * y - math.sin(turn) * x
        place = (torch.stack([u, v], dim=-1) + draws.scan_place[row]) / side
        if scan.heights == "none":
            heights.append(torch.zeros(resolution, resolution))
        else:
            relief = MATERIALS[int(draws.material[row])].roughness * float(draws.amplitude[row])
            levels = (2.0 * HEIGHT_RANGE / 255.0) * (torch.arange(256) - 127.5)
            heights.append(relief * sampled(scan.relief[None], levels[None], place, mode="bicubic")[0])
        if coloured:
            mean = scan.mean_colour[:, None]
            contrasts = (linear_levels() / mean.clamp_min(0.01)).clamp(0.15, 6.0)
            shades = mean * contrasts ** draws.scan_contrast[row] * draws.scan_tint[row, :, None]
            colours.append(sampled(scan.colours, shades.clamp(0.0, 1.0), place, mode="bilinear"))
    return torch.stack(heights), torch.stack(colours) if coloured else None


def sampled(image: Tensor, values: Tensor, place: Tensor, mode: str) -> Tensor:
    """An image interpolated at places (R, R, 2), (C, R, R); beyond its border it is mirrored.

    Args:
        image: Levels, uint8 (C, S, S).
        values: The value of each level, (C, 256).
        place: x and y of each point, in sides of the image.
        mode: Of interpolation, "bilinear" or "bicubic".
    """
    size = image.shape[-1]
    pixels = place * size
    corners = pixels[[0, 0, -1, -1], [0, -1, 0, -1]]
    low = corners.amin(dim=0).floor().long() - 2
    high = corners.amax(dim=0).ceil().long() + 2
    columns = mirrored_index(int(low[0]), int(high[0]), size)
    rows = mirrored_index(int(low[1]), int(high[1]), size)
    levels = image[:, rows][:, :, columns].long()
    crop = torch.stack([channel_values[channel] for channel_values, channel in zip(values, levels, strict=True)])[None]
    pixels = pixels - low
    # An image finer than the patch is averaged first, to avoid aliasing.
    step = max(round(float(torch.linalg.vector_norm(pixels[0, 1] - pixels[0, 0]))), 1)
    if step > 1:
        crop = F.avg_pool2d(crop, step, ceil_mode=True, count_include_pad=False)
        pixels = pixels / step
    grid = 2.0 * pixels / torch.tensor([crop.shape[-1], crop.shape[-2]]) - 1.0
    return F.grid_sample(crop, grid[None], mode=mode, padding_mode="border", align_corners=False)[0]


def mirrored_index(first: int, last: int, size: int) -> Tensor:
    """Indices of pixels `first` to `last` of a row of `size` that is mirrored at both ends."""
    index = torch.arange(first, last + 1) % (2 * size)
    return torch.minimum(index, 2 * size - 1 - index)
