"""Scanned materials: an albedo with a height map, read from a folder, at any place, turn and scale."""

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
from unitouch_gen.world.materials import MATERIALS

GAMMA = 2.2  # albedos are stored as sRGB, which this power makes linear, nearly

NAMED = re.compile(
    r"""(?P<item>.+?)[_-]+(?:\d+k[_-]+)?(?:
        (?P<albedo>albedo|basecolor|base_color|color|colour|diffuse|diff|col)|
        (?P<height>height|displacement|disp)
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
    files: list[str]  # what it was read from, relative to the library's folder

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
            raise InvalidInputError("`textures` is empty; pass a folder of albedo maps with height maps.")
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
        `NAME_Displacement.png`, and other words for these. Maps are brought to `size` pixels.

        The class of a material is told by what comes before `__` in its name, by its folder, or by the name's first
        word.

        Raises:
            InvalidInputError, InvalidTypeError: If there is none, or a picture cannot be read.
        """
        root = Path(check_kind("textures", folder, str, os.PathLike))
        found: dict[tuple[Path, str], dict[str, Path]] = {}  # maps by folder and item
        for file in sorted(path for path in root.rglob("*") if path.suffix.lower() in (".jpg", ".jpeg", ".png")):
            if named := NAMED.fullmatch(file.stem):
                kind = "albedo" if named["albedo"] else "height"
                found.setdefault((file.parent, named["item"]), {}).setdefault(kind, file)
        whole = [(item, maps) for (_, item), maps in found.items() if len(maps) == 2]
        textures = [texture for item, maps in whole if (texture := _read(root, item, maps, size))]
        if not textures:
            raise InvalidInputError(
                f"`textures` is {str(folder)!r}, which holds no material; each is an albedo (`NAME_Color.jpg`) beside "
                "heights that are not flat (`NAME_Displacement.png`)."
            )
        return cls(textures)


def _read(root: Path, item: str, maps: dict[str, Path], size: int) -> Texture | None:
    """A material of its maps; `None` where the heights are flat, which some libraries ship."""
    albedo, height = _pixels(maps["albedo"], size)[:3] ** GAMMA, _pixels(maps["height"], size).mean(dim=0)
    if float(height.amax() - height.amin()) * 255 < 8.0:  # grey levels
        return None
    height = ((height - height.mean()) / height.std()).clamp(-6.0, 6.0)
    files = [path.relative_to(root).as_posix() for path in maps.values()]
    return Texture(item, _material(item, maps["albedo"].parent, root), albedo.half(), height.half(), files)


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
