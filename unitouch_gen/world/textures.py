"""Scanned materials: an albedo with a height map or a normal map, read from a folder, at any place, turn and scale."""

import csv
import math
import os
import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor

from unitouch_gen.errors import InvalidInputError, check_kind, first_line
from unitouch_gen.world.grids import wavenumbers
from unitouch_gen.world.materials import MATERIALS

GAMMA = 2.2  # albedos are stored as sRGB, which this power makes linear, nearly

NAMED = re.compile(
    r"""(?P<item>.+?)[_-]+(?:\d+k[_-]+)?(?:
        (?P<albedo>albedo|basecolor|base_color|color|colour|diffuse|diff|col)|
        (?P<height>height|displacement|disp)|
        (?P<normal>normalgl|normaldx|normal|nor_gl|nor_dx|nor|nrm)
    )(?:[_-]\d+k)?(?:[_-](?:png|jpg))?""",
    re.IGNORECASE | re.VERBOSE,
)
"""How the CC0 libraries (ambientCG, Poly Haven) name maps, extensions aside."""


@dataclass(frozen=True, eq=False)
class Texture:
    """One scanned material, as large as it is drawn to be: both maps repeat beyond their ends."""

    name: str  # `class/item`, or the item alone
    material: str  # the class that its file's name or folder gives, such as "wood"; empty where none does
    albedo: Tensor  # linear RGB in [0, 1], (3, S, S), float16
    height: Tensor  # heights of mean 0 and standard deviation 1, (S, S), float16
    files: dict[str, str]  # what it was read from, relative to the library's folder, and where each is from

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
    """Scanned materials, held apart by material: of each class every sixth, by name, is for "val" and one for "test".

    Attributes:
        textures: All of them, by name.
        by_split: By split and class, their numbers in `textures`.

    Raises:
        InvalidInputError: If there is none.
    """

    def __init__(self, textures: list[Texture]):
        if not textures:
            raise InvalidInputError("`textures` is empty; pass a folder of albedo maps with height or normal maps.")
        self.textures = sorted(textures, key=lambda texture: texture.name)
        self.by_split: dict[str, dict[str, list[int]]] = {"train": {}, "val": {}, "test": {}}
        counts = Counter[str]()  # within the class
        for number, texture in enumerate(self.textures):
            split = {1: "val", 2: "test"}.get(counts[texture.material] % 6, "train")
            counts[texture.material] += 1
            self.by_split[split].setdefault(texture.material, []).append(number)

    @classmethod
    def from_folder(cls, folder: str | Path, *, size: int = 512) -> "TextureLibrary":
        """Reads a folder, and folders in it, in the layout of the CC0 libraries' downloads: `NAME_Color.jpg` beside
        `NAME_Displacement.png` or `NAME_NormalGL.png`, and other words for these. Maps are brought to `size` pixels.

        The class of a material is told by what comes before `__` in its name, by its folder, or by the name's first
        word. An `index.csv` with the columns `file`, `source`, `path` and `licence` may say where each is from.

        Raises:
            InvalidInputError, InvalidTypeError: If there is none, or a picture cannot be read.
        """
        root = Path(check_kind("textures", folder, str, os.PathLike))
        found: dict[tuple[Path, str], dict[str, Path]] = {}
        for file in sorted(path for path in root.rglob("*") if path.suffix.lower() in (".jpg", ".jpeg", ".png")):
            if named := NAMED.fullmatch(file.stem):
                kind = next(kind for kind in ("albedo", "height", "normal") if named[kind])
                found.setdefault((file.parent, named["item"]), {}).setdefault(kind, file)
        origins, whole = _origins(root), [(item, maps) for (_, item), maps in found.items() if "albedo" in maps]
        textures = [texture for item, maps in whole if (texture := _read(root, item, maps, size, origins))]
        if not textures:
            raise InvalidInputError(
                f"`textures` is {str(folder)!r}, which holds no material; each is an albedo (`NAME_Color.jpg`) beside "
                "heights (`NAME_Displacement.png`) or normals (`NAME_NormalGL.png`)."
            )
        return cls(textures)


def _origins(root: Path) -> dict[str, str]:
    """Where files are from, as the folder's table says."""
    file = root / "index.csv"
    if not file.is_file():
        return {}
    try:
        with file.open(encoding="utf-8", newline="") as lines:
            rows = [row for row in csv.DictReader(lines) if row.get("file")]
    except (csv.Error, UnicodeDecodeError) as error:
        raise InvalidInputError(f"`textures` holds {str(file)!r}, which is no table: {first_line(error)}") from error
    told = ("source", "path", "licence")
    return {row["file"]: "; ".join(row[name] for name in told if row.get(name)) for row in rows}


def _read(root: Path, item: str, maps: dict[str, Path], size: int, origins: dict[str, str]) -> Texture | None:
    """A material of its maps; `None` where none shows a relief."""
    height = _pixels(maps["height"], size).mean(dim=0) if "height" in maps else torch.zeros(size, size)
    if float(height.amax() - height.amin()) * 255 < 8.0:  # grey levels, which say nothing
        height = integrated(_pixels(maps["normal"], size) * 2.0 - 1.0) if "normal" in maps else 0.0 * height
    if float(height.std()) == 0.0:
        return None
    height = ((height - height.mean()) / height.std()).clamp(-6.0, 6.0)
    names = [path.relative_to(root).as_posix() for path in maps.values()]
    material, albedo = _material(item, maps["albedo"].parent, root), _pixels(maps["albedo"], size)[:3] ** GAMMA
    return Texture(item, material, albedo.half(), height.half(), {name: origins.get(name, "") for name in names})


def _material(item: str, folder: Path, root: Path) -> str:
    """The class that is told by what comes before `__`, or by the folder, or by a word of the name; or none."""
    told = (item.split("__")[0] if "__" in item else "" if folder == root else folder.name).lower().replace("_", " ")
    for name in (told, item.lower().replace("_", " ")):
        if found := [material.name for material in MATERIALS if name.startswith(tuple(material.scans))]:
            return found[0]
    return told


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
    ky, kx = wavenumbers(size, size)
    along_x, along_y = torch.fft.rfft2(-normals[0] / z), torch.fft.rfft2(normals[1] / z)  # downward, as rows count
    curls = [float((ky * along_x - kx * sign * along_y).abs().square().sum()) for sign in (1.0, -1.0)]
    sign = 1.0 if curls[0] <= curls[1] else -1.0
    power = (kx**2 + ky**2).clamp_min(torch.finfo(torch.float32).tiny)
    spectrum = -1j * (kx * along_x + ky * sign * along_y) / power
    spectrum[0, 0] = 0.0
    return torch.fft.irfft2(spectrum, s=(size, size))
