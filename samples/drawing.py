"""Drawing for the other samples: grids of pictures as tiles of one size, with labels and titles."""

import math
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from textwrap import wrap

import torch
from matplotlib.font_manager import findfont
from PIL import Image, ImageDraw, ImageFont, ImageOps
from torch import Tensor

from unitouch_gen.world import FIRST_OBJECT, MATERIAL_NAMES, Scene, World
from unitouch_gen.world.draws import SHAPES

Tile = Image.Image | Tensor | None

GAP = 6  # pixels between tiles
MARGIN = 12  # pixels around the grid
INK = "black"
PAPER = "white"


def to_tile(picture: Image.Image | Tensor, side: int) -> Image.Image:
    """A PIL image, or pixels (3, H, W) in [0, 1], as a square of `side` pixels; integer factors keep pixels sharp."""
    if isinstance(picture, Tensor):
        picture = Image.fromarray((picture.clamp(0, 1).permute(1, 2, 0) * 255).round().byte().numpy())
    has_integer_factor = side % picture.width == 0 and side % picture.height == 0
    scaling = Image.Resampling.NEAREST if has_integer_factor else Image.Resampling.BICUBIC
    return ImageOps.fit(picture.convert("RGB"), (side, side), scaling)


@cache
def font(size: int) -> ImageFont.FreeTypeFont:
    return ImageFont.truetype(findfont("DejaVu Sans"), size)


def written(text: str, size: int, room: int) -> Image.Image:
    """A picture of centred text in lines of about `room` pixels, with a height that depends only on their number.

    Lines end at spaces, and after underscores.
    """
    wrapped = wrap(text.replace("_", "_ "), round(room / (0.58 * size))) or [""]
    lines = [line.replace("_ ", "_") for line in wrapped]
    pitch = sum(font(size).getmetrics())
    width = max(round(font(size).getlength(line)) for line in lines)
    picture = Image.new("RGB", (max(width, 1), pitch * len(lines)), PAPER)
    for number, line in enumerate(lines):
        ImageDraw.Draw(picture).text((width / 2, number * pitch), line, INK, font(size), anchor="ma")
    return picture


def draw_grid(
    rows: Sequence[Sequence[Tile]],
    *,
    labels: Sequence[str],
    titles: Sequence[str],
    side: int = 128,
    size: int = 20,
    blocks: int = 1,
) -> Image.Image:
    """Rows of tiles, with a label beside each row and a title above each column.

    Args:
        rows: Pictures; `None` leaves a place empty.
        labels: Of the rows, written upwards.
        titles: Of the columns; both are broken into lines as long as a tile.
        side: Of a tile, pixels.
        size: Of the text, pixels.
        blocks: Number of blocks side by side that rows are divided among, which keeps a long grid short.
    """
    rows_per_block = math.ceil(len(rows) / blocks)
    label_pictures = [written(label, size, side).rotate(90, expand=True) for label in labels]
    title_pictures = [written(title, size, side) for title in titles]
    left = max(label.width for label in label_pictures) + 2 * GAP
    top = max(title.height for title in title_pictures) + 2 * GAP
    pitch = side + GAP
    block_width = left + len(titles) * pitch + MARGIN
    width = MARGIN + blocks * block_width - GAP
    height = MARGIN + top + rows_per_block * pitch - GAP + MARGIN
    canvas = Image.new("RGB", (width, height), PAPER)
    for number, (row, label) in enumerate(zip(rows, label_pictures, strict=True)):
        block, place = divmod(number, rows_per_block)
        x = MARGIN + block * block_width
        y = MARGIN + top + place * pitch
        canvas.paste(label, (x + left - 2 * GAP - label.width, y + (side - label.height) // 2))
        for column, (tile, title) in enumerate(zip(row, title_pictures, strict=True)):
            start = x + left + column * pitch
            if tile is not None:
                canvas.paste(to_tile(tile, side), (start, y))
            if place == 0:
                canvas.paste(title, (start + (side - title.width) // 2, y - GAP - title.height))
    return canvas


def save(picture: Image.Image, output: Path) -> None:
    """Writes a picture and prints its path."""
    output.parent.mkdir(parents=True, exist_ok=True)
    picture.save(output, quality=88)
    print(output)


def flat_contacts(world: World, number: int = 0) -> tuple[list[int], list[int], list[int]]:
    """Material, object and contact of a firm contact with a flat face of a held-out object, for each material.

    Other numbers choose other objects. In a world of drawn and scanned objects, every second material is scanned, as
    far as there are scans.
    """
    first = FIRST_OBJECT["test"]
    chosen = []
    objects = torch.arange(first, first + 40 + 20 * number)
    for material in range(len(MATERIAL_NAMES)):
        draws = world.draw(torch.full_like(objects, material), objects, torch.zeros_like(objects))
        is_flat = draws.shape == list(SHAPES).index("flat")
        is_firm = draws.indentation_depth > 0.5
        is_scanned = draws.surface >= 0
        takes_scan = bool(is_scanned.all()) or (material % 2 == 0 and bool(is_scanned.any()))
        wanted = is_scanned if takes_scan else ~is_scanned
        chosen.append(int(objects[is_flat & is_firm & wanted][number]))
    return list(range(len(MATERIAL_NAMES))), chosen, [0] * len(chosen)


def labels_of(scene: Scene) -> list[str]:
    """Names of the materials of a scene, and which of them are scanned."""
    return [
        name if surface is None else f"{name}, scanned"
        for name, surface in zip(MATERIAL_NAMES, scene.surface, strict=True)
    ]
