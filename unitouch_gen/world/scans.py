"""Scanned surfaces: photographed colours and measured heights of real surfaces, in place of a drawn relief.

`collection/index.csv` names each with its source, author and licence. No source tells a physical scale, so the side and
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
HEIGHT_RANGE = 3.2  # heights are stored in units of their deviation, from minus to plus this
GAMMA = 1.8  # of photographs, as of the world's pictures

MEASURED_WEIGHT = 3  # how often a measured surface is drawn for each time that one with computed heights is
LARGEST_SHARE = 0.1  # of a material's objects to train on that show one surface: of few surfaces, few objects
LOWEST_RELIEF = 0.03  # RMS, mm
HIGHEST_RELIEF = 0.6  # RMS, mm
CLEAR_GRAIN = 0.35  # coherence of slopes above which a surface has a direction


@dataclass(frozen=True)
class ScannedSurface:
    """One surface of the collection."""

    name: str
    material: str
    heights: str  # "measured"; "computed" from a photograph's brightness; or "none" where colours alone are known
    split: str  # "train", "val" or "test"
    group: str  # of surfaces that may be of one asset, which are on one side of the split
    source: str
    author: str
    licence: str

    @property
    def weight(self) -> int:
        """How often it is drawn."""
        return MEASURED_WEIGHT if self.heights == "measured" else 1

    @cached_property
    def colours(self) -> Tensor:
        """Photographed colours, sRGB, uint8 (3, S, S)."""
        image = Image.open(COLLECTION / "surfaces" / f"{self.name}{COLOURS}").convert("RGB")
        return torch.from_numpy(np.array(image)).permute(2, 0, 1).contiguous()

    @cached_property
    def mean_colour(self) -> Tensor:
        """Linear RGB, (3,)."""
        return linear_levels()[self.colours.long()].mean(dim=(1, 2))

    @cached_property
    def relief(self) -> Tensor:
        """Heights in 256 levels, uint8 (S, S); level where none are known."""
        if self.heights == "none":
            return torch.full((8, 8), 128, dtype=torch.uint8)
        image = Image.open(COLLECTION / "surfaces" / f"{self.name}{HEIGHTS}").convert("L")
        return torch.from_numpy(np.array(image))

    @cached_property
    def grain(self) -> tuple[float, float]:
        """Direction along which it changes least, radians in the scan's frame, and how clear that is, [0, 1].

        Both are of the structure tensor, the mean outer product of its slopes.
        """
        along_y, along_x = torch.gradient(self.relief.float())
        xx = (along_x**2).mean().item()
        yy = (along_y**2).mean().item()
        xy = (along_x * along_y).mean().item()
        steepest = 0.5 * math.atan2(2 * xy, xx - yy)
        return steepest + 0.5 * math.pi, math.hypot(xx - yy, 2 * xy) / max(xx + yy, 1e-9)


@cache
def linear_levels() -> Tensor:
    """Linear reflectance of each of 256 levels of a photograph."""
    return (torch.arange(256) / 255.0) ** GAMMA


@cache
def scanned_surfaces() -> tuple[ScannedSurface, ...]:
    """All surfaces of the collection."""
    with (COLLECTION / "index.csv").open(encoding="utf-8", newline="") as stream:
        rows = [row for row in csv.DictReader(stream) if row["kind"] == "surface"]
    return tuple(ScannedSurface(**{name: row[name] for name in ScannedSurface.__annotations__}) for row in rows)


# Which objects are scanned --------------------------------------------------------------------------------------------


def split_of(object_: int) -> str:
    """The split that an object's number is in; "beyond" shows the surfaces of "test", in other sizes."""
    place = object_ % 1000
    return [name for name, first in FIRST_OBJECT.items() if first <= place][-1]


@cache
def surfaces_of(material: int, split: str, colours_alone: bool = False) -> tuple[int, ...]:
    """Numbers of the surfaces of a material and a split."""
    kept = "test" if split == "beyond" else split
    return tuple(
        number
        for number, one in enumerate(scanned_surfaces())
        if one.material == MATERIALS[material].name and one.split == kept and (one.heights != "none" or colours_alone)
    )


def surface_of(seed: int, material: int, object_: int, share: float, colours_alone: bool = False) -> int:
    """Number of the surface that an object of a world shows, or -1 for a drawn one.

    Scanned objects are spread evenly over the numbers of a split. They take its surfaces in turn, in an order that is
    drawn for each round, so all of them are seen.
    """
    split = split_of(object_)
    found = surfaces_of(material, split, colours_alone)
    if split == "train" and share < 1.0:
        share = min(share, LARGEST_SHARE * len(found))
    place = object_ % 1000 - FIRST_OBJECT[split]
    before = math.floor(place * share)
    if not found or math.floor((place + 1) * share) == before:
        return -1
    weighted = [number for number in found for _ in range(scanned_surfaces()[number].weight if split == "train" else 1)]
    turn, position = divmod(before, len(weighted))
    rng = generator(seed, SCAN_STREAM, material, object_ // 1000, list(FIRST_OBJECT).index(split), turn)
    return weighted[rng.permutation(len(weighted))[position]]


def with_scans(seed: int, draws: Draws, share: float, colours_alone: bool = False) -> Draws:
    """The same contacts, of which a share of objects is scanned.

    Scanned rows have further numbers: `scan_side` of the scan (mm), `scan_turn` in the picture (radians; `angle` is
    then the direction of its own grain), `scan_mirrored` (1 or -1), `scan_place` of the contact (mm), `scan_tint`
    (factors on RGB), `scan_contrast` (exponent on colours around their mean) and whether the surface is `grained`.
    """
    names = draws.names()
    numbers = [surface_of(seed, material, object_, share, colours_alone) for material, object_, _ in names]
    surface = torch.tensor(numbers, dtype=torch.int64)
    rows = torch.nonzero(surface >= 0)[:, 0].tolist()
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
    for row in rows:
        scan = scanned_surfaces()[numbers[row]]
        material, object_, contact = names[row]
        of_object, of_contact = (
            generator(seed, SCAN_STREAM, *name) for name in ((material, object_), (material, object_, contact))
        )
        mirrored = 1.0 if of_contact.uniform() < 0.5 else -1.0
        direction, clear = scan.grain
        relief = MATERIALS[material].roughness * float(draws.amplitude[row])
        relief = min(max(relief, LOWEST_RELIEF), HIGHEST_RELIEF)
        tint = contrast = torch.ones(())
        if split_of(object_) == "train":
            tint = torch.from_numpy(np.exp(of_object.normal(0.0, 0.2) + of_object.normal(0.0, 0.06, 3))).float()
            contrast = torch.tensor(of_object.uniform(0.6, 1.3))
            # Where heights were computed from brightness, dark would always be deep.
            if scan.heights == "computed" and of_object.uniform() < 0.35:
                contrast = -contrast
        # The patch lies on the scan, as far as it fits.
        side = float(columns["scan_side"][row])
        turn = float(columns["scan_turn"][row])
        free = max(side - PATCH_MM * (abs(math.cos(turn)) + abs(math.sin(turn))), 0.1 * side)
        place = 0.5 * side + free * of_contact.uniform(-0.5, 0.5, 2)
        columns["scan_place"][row] = torch.from_numpy(place).float()
        columns["scan_mirrored"][row] = mirrored
        columns["scan_tint"][row] = tint
        columns["scan_contrast"][row] = contrast
        columns["grained"][row] = clear > CLEAR_GRAIN
        columns["angle"][row] += mirrored * direction
        columns["colour"][row] = (scan.mean_colour * tint).clamp(0.02, 0.98)
        columns["amplitude"][row] = relief / MATERIALS[material].roughness
    return draws.but(surface=surface, **columns)


# What they look and feel like -----------------------------------------------------------------------------------------


def scanned_patches(draws: Draws, rows: Tensor, resolution: int, *, coloured: bool) -> tuple[Tensor, Tensor | None]:
    """Heights (n, R, R), mm, and linear colours (n, 3, R, R) of the scanned contacts in some rows of draws."""
    axis = pixel_axis(resolution)
    heights = []
    colours = []
    for row in rows.tolist():
        scan = scanned_surfaces()[int(draws.surface[row])]
        side = float(draws.scan_side[row])
        turn = float(draws.scan_turn[row])
        x = axis[None, :]
        y = axis[:, None]
        u = (math.cos(turn) * x + math.sin(turn) * y) * float(draws.scan_mirrored[row])
        v = math.cos(turn) * y - math.sin(turn) * x
        place = torch.stack([u, v], dim=-1) + draws.scan_place[row]
        levels = (2.0 * HEIGHT_RANGE / 255.0) * (torch.arange(256) - 127.5)
        relief = MATERIALS[int(draws.material[row])].roughness * float(draws.amplitude[row])
        if scan.heights == "none":
            heights.append(torch.zeros(resolution, resolution))
        else:
            heights.append(relief * sampled(scan.relief[None], levels[None], place / side, "bicubic")[0])
        if coloured:
            mean = scan.mean_colour[:, None]
            tint = draws.scan_tint[row, :, None]
            shades = mean * (linear_levels() / mean.clamp_min(0.01)).clamp(0.15, 6.0) ** draws.scan_contrast[row] * tint
            colours.append(sampled(scan.colours, shades.clamp(0.0, 1.0), place / side, "bilinear"))
    return torch.stack(heights), torch.stack(colours) if coloured else None


def sampled(image: Tensor, values: Tensor, place: Tensor, mode: str) -> Tensor:
    """What an image shows at places (R, R, 2), in sides of it, (C, R, R); beyond its rim it is mirrored.

    Args:
        image: Levels, uint8 (C, S, S).
        values: What each level stands for, (C, 256).
        place: x and y of each point.
        mode: Of interpolation, "bilinear" or "bicubic".
    """
    size = image.shape[-1]
    pixels = place * size
    corners = pixels[[0, 0, -1, -1], [0, -1, 0, -1]]
    low = corners.amin(dim=0).floor().long() - 2
    high = corners.amax(dim=0).ceil().long() + 2
    columns, rows = (mirrored_index(int(first), int(last), size) for first, last in zip(low, high, strict=True))
    crop = image[:, rows][:, :, columns].long()
    found = torch.stack([levels[channel] for levels, channel in zip(values, crop, strict=True)])[None]
    pixels = pixels - low
    # Where pixels of the image are finer than those of the patch, several are averaged, or they would fold back.
    step = max(round(float(torch.linalg.vector_norm(pixels[0, 1] - pixels[0, 0]))), 1)
    if step > 1:
        found = F.avg_pool2d(found, step, ceil_mode=True, count_include_pad=False)
        pixels = pixels / step
    grid = 2.0 * pixels / torch.tensor([found.shape[-1], found.shape[-2]]) - 1.0
    return F.grid_sample(found, grid[None], mode=mode, padding_mode="border", align_corners=False)[0]


def mirrored_index(first: int, last: int, size: int) -> Tensor:
    """Indices of pixels `first` to `last` of a row of `size` that goes on mirrored at both ends."""
    index = torch.arange(first, last + 1) % (2 * size)
    return torch.minimum(index, 2 * size - 1 - index)
