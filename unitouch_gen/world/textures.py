"""Scanned materials: an albedo with a height map or a normal map, read from a folder, at any place, turn and scale."""

import csv
import math
import os
import re
from collections import Counter
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor

from unitouch_gen.errors import InvalidInputError, check_integer, check_kind, first_line

GAMMA = 2.2
"""Albedos are stored as sRGB, which this power makes linear, nearly."""

KINDS: dict[str, str] = {
    "albedo": r"albedo|basecolor|base_color|color|colour|diffuse|diff|col",
    "height": r"height|displacement|disp",
    "normal": r"normalgl|normaldx|normal|nor_gl|nor_dx|nor|nrm",
}
"""How the CC0 libraries (ambientCG, Poly Haven) end the names of their maps, resolution and extension aside."""

NAMED = re.compile(
    r"(?P<item>.+?)[_-]+(?:\d+k[_-]+)?(?P<kind>" + "|".join(KINDS.values()) + r")(?:[_-]\d+k)?(?:[_-](?:png|jpg))?",
    re.IGNORECASE,
)

WORDS: dict[str, str] = {
    "natural fabric": "natural fabric|fabric|wool|cotton|denim|carpet|burlap",
    "synthetic fabric": "synthetic fabric|nylon",
    "wood": "wood|plank", "tree": "tree|bark", "brick": "brick", "concrete": "concrete|asphalt|plaster|cement",
    "tile": "tile|terrazzo", "leather": "leather", "metal": "metal|rust|diamondplate|corrugated",
    "sand": "sand|soil|ground|dirt",
    "grass": "grass|lawn", "gravel": "gravel|pebble", "plastic": "plastic", "rubber": "rubber",
    "paper": "paper|cardboard",
    "glass": "glass", "rock": "rock|stone|granite|marble|onyx",
}  # fmt: skip
"""Materials, and with which words the names of scans of them begin."""

INDEX, TOLD = "index.csv", ("source", "path", "licence")
"""The table of a folder that says where each `file` is from, and its columns that do."""

LEAST_RANGE = 8.0
"""Grey levels (of 255) that a height map has to span, or it says nothing, and the normals are integrated."""

SPLITS = ("train", "val", "test")
EVERY = 6
"""One material of so many of its class is held out for each of "val" and "test"."""


@dataclass(frozen=True, eq=False)
class Texture:
    """One scanned material, as large as it is drawn to be: both maps repeat beyond their ends.

    Attributes:
        name: `class/item`, or the item alone.
        material: The class that its file's name or folder gives, such as "wood"; empty where none does.
        albedo: Linear RGB in [0, 1], (3, S, S), float16.
        height: Heights of mean 0 and standard deviation 1, (S, S), float16.
        files: What it was read from, relative to the library's folder, and where each is from, as far as is told.
    """

    name: str
    material: str
    albedo: Tensor
    height: Tensor
    files: dict[str, str]

    @property
    def colour(self) -> Tensor:
        """Mean linear RGB, (3,)."""
        return self.albedo.float().mean(dim=(-2, -1))

    def patches(self, x: Tensor, y: Tensor, side: Tensor) -> tuple[Tensor, Tensor]:
        """Heights (N, R, R), in standard deviations, and albedos (N, 3, R, R) at positions.

        Args:
            x, y: Positions, mm, (N, R, R).
            side: Millimetres that the maps stand for along a side, (N,).
        """
        size = self.height.shape[-1]
        step = (x[:, 0, 1] - x[:, 0, 0]).hypot(y[:, 0, 1] - y[:, 0, 0])  # mm a pixel of the patch
        coarser = math.log2(max(float((step / side).mean()) * size, 1.0))
        maps = torch.cat([self.height[None], self.albedo]).float()[None]
        for _ in range(min(round(coarser), size.bit_length() - 4)):  # as a mipmap, or short waves would fold back
            maps = F.avg_pool2d(maps, 2)
        maps = F.pad(maps, (1, 1, 1, 1), mode="circular")
        inner = maps.shape[-1] - 2
        share = torch.stack([x, y], dim=-1) / side[:, None, None, None]
        place = (torch.remainder(share, 1.0) * 2.0 - 1.0) * inner / (inner + 2)
        found = F.grid_sample(maps.expand(len(x), -1, -1, -1), place, mode="bilinear", align_corners=False)
        return found[:, 0], found[:, 1:].clamp(0.0, 1.0)


class TextureLibrary:
    """Scanned materials of a folder, held apart by material.

    Args:
        textures: All of them.

    Raises:
        InvalidInputError: If there is none.
    """

    def __init__(self, textures: list[Texture]):
        if not textures:
            raise InvalidInputError("`textures` is empty; pass a folder of albedo maps with height or normal maps.")
        self.textures = sorted(textures, key=lambda texture: texture.name)
        counts: Counter[str] = Counter()
        self._places: dict[tuple[str, str], int] = {}  # within the class
        for texture in self.textures:
            self._places.setdefault((texture.material, texture.name), counts[texture.material])
            counts[texture.material] += 1

    def __len__(self) -> int:
        return len(self.textures)

    @classmethod
    def from_folder(cls, folder: str | Path, *, size: int = 512) -> "TextureLibrary":
        """Reads a folder, and folders in it, in the layout of the CC0 libraries' downloads: `NAME_Color.jpg` beside
        `NAME_Displacement.png` or `NAME_NormalGL.png`, and other words for these.

        The class of a material is told by what comes before `__` in its name, by its folder, or by the name's first
        word. An `index.csv` with the columns `file`, `source`, `path` and `licence` may say where each is from.

        Args:
            folder: Where they are.
            size: Side that all maps are brought to, pixels.

        Raises:
            InvalidInputError, InvalidTypeError: If there is none, or a picture cannot be read.
        """
        check_integer("size", size, 32, 4096)
        root = Path(check_kind("textures", folder, str, os.PathLike))
        found: dict[tuple[Path, str], dict[str, Path]] = {}
        for file in sorted(path for path in root.rglob("*") if path.suffix.lower() in (".jpg", ".jpeg", ".png")):
            if named := NAMED.fullmatch(file.stem):
                kind = next(kind for kind, words in KINDS.items() if re.fullmatch(words, named["kind"], re.IGNORECASE))
                found.setdefault((file.parent, named["item"]), {}).setdefault(kind, file)
        complete = [(item, maps) for (_, item), maps in found.items() if "albedo" in maps and len(maps) > 1]
        told = _told(root)
        read = [texture for item, maps in complete if (texture := _read(root, item, maps, size, told)) is not None]
        if not read:
            raise InvalidInputError(
                f"`textures` is {str(folder)!r}, which holds no material; each is an albedo (`NAME_Color.jpg`) beside "
                "heights (`NAME_Displacement.png`) or normals (`NAME_NormalGL.png`)."
            )
        return cls(read)

    def split_of(self, texture: Texture) -> str:
        """The split of a material: of each class every sixth is for "val" and every sixth for "test", by name."""
        place = self._places[texture.material, texture.name]
        return SPLITS[place % EVERY] if place % EVERY in (1, 2) else "train"

    @cached_property
    def by_split(self) -> dict[str, dict[str, list[int]]]:
        """By split and class, the numbers of the materials in `textures`."""
        found: dict[str, dict[str, list[int]]] = {split: {} for split in SPLITS}
        for number, texture in enumerate(self.textures):
            found[self.split_of(texture)].setdefault(texture.material, []).append(number)
        return found


def _told(root: Path) -> dict[str, str]:
    """Where files are from, as the folder's table says."""
    file = root / INDEX
    if not file.is_file():
        return {}
    try:
        with file.open(encoding="utf-8", newline="") as lines:
            rows = [row for row in csv.DictReader(lines) if row.get("file")]
    except (csv.Error, UnicodeDecodeError) as error:
        raise InvalidInputError(f"`textures` holds {str(file)!r}, which is no table: {first_line(error)}") from error
    return {row["file"]: "; ".join(row[name] for name in TOLD if row.get(name)) for row in rows}


def _read(root: Path, item: str, maps: dict[str, Path], size: int, told: dict[str, str]) -> Texture | None:
    """A material of its maps; `None` where they are flat."""
    albedo = _pixels(maps["albedo"], size)[:3] ** GAMMA
    height = None
    if "height" in maps:
        height = _pixels(maps["height"], size).mean(dim=0)
        if float(height.amax() - height.amin()) * 255 < LEAST_RANGE:
            height = None
    if height is None and "normal" in maps:
        height = integrated(_pixels(maps["normal"], size) * 2.0 - 1.0)
    if height is None or float(height.std()) == 0.0:
        return None
    height = (height - height.mean()) / height.std()
    names = [path.relative_to(root).as_posix() for path in maps.values()]
    files = {name: told.get(name, "") for name in names}
    return Texture(
        item, _material(item, maps["albedo"].parent, root), albedo.half(), height.clamp(-6.0, 6.0).half(), files
    )


def _material(item: str, folder: Path, root: Path) -> str:
    """The class that is told by what comes before `__`, or by the folder, or by a word of the name; or none."""
    told = item.split("__")[0] if "__" in item else "" if folder == root else folder.name
    for name in (told, item):
        words = name.lower().replace("_", " ")
        for material, known in WORDS.items():
            if words == material or re.match(known, words):
                return material
    return told.lower().replace("_", " ")


def _pixels(file: Path, size: int) -> Tensor:
    """(C, size, size) in [0, 1], of 8 or 16 bits."""
    try:
        with Image.open(file) as image:
            wide = image.mode.startswith("I") or image.mode == "F"
            levels = 65535.0 if wide else 255.0
            values = np.asarray(image if wide else image.convert("RGB"), dtype=np.float32) / levels
    except Exception as error:
        raise InvalidInputError(
            f"`textures` holds {str(file)!r}, which cannot be read: {first_line(error)}. Take it out, or mend it."
        ) from error
    pixels = torch.from_numpy(values if values.ndim == 3 else values[..., None]).permute(2, 0, 1)
    return F.interpolate(pixels[None], (size, size), mode="bilinear", antialias=True, align_corners=False)[0]


def integrated(normals: Tensor) -> Tensor:
    """Heights (S, S), in pixels, of normals (3, S, S), by Frankot and Chellappa (1988), which takes both to repeat.

    x points right, z out of the picture, y up (OpenGL) or down (DirectX): names tell of it seldom and wrongly, so it is
    the one with the less curl, as slopes of heights have none.
    """
    z = normals[2].clamp_min(0.05)
    size = normals.shape[-1]
    ky = 2 * math.pi * torch.fft.fftfreq(size)[:, None]
    kx = 2 * math.pi * torch.fft.rfftfreq(size)[None, :]
    along_x, along_y = torch.fft.rfft2(-normals[0] / z), torch.fft.rfft2(normals[1] / z)  # downward, as rows count
    curls = [float((ky * along_x - kx * sign * along_y).abs().square().sum()) for sign in (1.0, -1.0)]
    sign = 1.0 if curls[0] <= curls[1] else -1.0
    power = (kx**2 + ky**2).clamp_min(torch.finfo(torch.float32).tiny)
    spectrum = -1j * (kx * along_x + ky * sign * along_y) / power
    spectrum[0, 0] = 0.0
    return torch.fft.irfft2(spectrum, s=(size, size))
