"""What the other samples draw with: pictures as tiles of one size, in rows and columns with names."""

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

GAP = 6
MARGIN = 12
INK = "black"
PAPER = "white"


def to_tile(picture: Image.Image | Tensor, side: int) -> Image.Image:
    """A PIL image, or pixels (3, H, W) in [0, 1], as a square of `side` pixels; small ones keep their pixels sharp."""
    if isinstance(picture, Tensor):
        picture = Image.fromarray((picture.clamp(0, 1).permute(1, 2, 0) * 255).round().byte().numpy())
    whole = side % picture.width == 0 and side % picture.height == 0
    scaling = Image.Resampling.NEAREST if whole else Image.Resampling.BICUBIC
    return ImageOps.fit(picture.convert("RGB"), (side, side), scaling)


@cache
def font(size: int) -> ImageFont.FreeTypeFont:
    return ImageFont.truetype(findfont("DejaVu Sans"), size)


def written(text: str, size: int, room: int) -> Image.Image:
    """Centred text in lines of about `room` pixels, as a picture whose height depends on their number alone.

    Lines end at spaces, and after underscores.
    """
    broken = wrap(text.replace("_", "_ "), round(room / (0.58 * size))) or [""]
    lines = [line.replace("_ ", "_") for line in broken]
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
        blocks: Rows are divided among so many blocks side by side, which keeps a long grid short enough for a page.
    """
    columns = len(titles)
    height = -(-len(rows) // blocks)
    upwards = [written(label, size, side).rotate(90, expand=True) for label in labels]
    above = [written(title, size, side) for title in titles]
    left = max(label.width for label in upwards) + 2 * GAP
    top = max(title.height for title in above) + 2 * GAP
    pitch = side + GAP
    block = left + columns * (side + GAP) + MARGIN
    canvas = Image.new("RGB", (MARGIN + blocks * block - GAP, MARGIN + top + height * pitch - GAP + MARGIN), PAPER)
    for number, (row, label) in enumerate(zip(rows, upwards, strict=True)):
        x = MARGIN + number // height * block
        y = MARGIN + top + number % height * pitch
        canvas.paste(label, (x + left - 2 * GAP - label.width, y + (side - label.height) // 2))
        for column, (tile, title) in enumerate(zip(row, above, strict=True)):
            start = x + left + column * pitch
            if tile is not None:
                canvas.paste(to_tile(tile, side), (start, y))
            if number % height == 0:
                canvas.paste(title, (start + (side - title.width) // 2, y - GAP - title.height))
    return canvas


def save(picture: Image.Image, output: Path) -> None:
    """Writes a picture and says where it is."""
    output.parent.mkdir(parents=True, exist_ok=True)
    picture.save(output, quality=88)
    print(output)


def flat_contacts(world: World, number: int = 0) -> tuple[list[int], list[int], list[int]]:
    """Material, object and contact of one firm contact of each material with a flat face of it, of objects that nothing
    was trained on; other numbers pick others.

    Of a world of drawn and scanned objects, every second material is scanned, as far as there are scans.
    """
    first = FIRST_OBJECT["test"]
    chosen = []
    objects = torch.arange(first, first + 40 + 20 * number)
    for material in range(len(MATERIAL_NAMES)):
        draws = world.draw(torch.full_like(objects, material), objects, torch.zeros_like(objects))
        flat = draws.shape == list(SHAPES).index("flat")
        scanned = draws.surface >= 0
        wanted = scanned if bool(scanned.all()) or (material % 2 == 0 and bool(scanned.any())) else ~scanned
        chosen.append(int(objects[flat & wanted & (draws.indentation_depth > 0.5)][number]))
    return list(range(len(MATERIAL_NAMES))), chosen, [0] * len(chosen)


def labels_of(scene: Scene) -> list[str]:
    """Names of the materials of a scene, and which of them are scanned."""
    return [
        name if surface is None else f"{name}, scanned"
        for name, surface in zip(MATERIAL_NAMES, scene.surface, strict=True)
    ]
