"""Files of small data sets, in the formats that real ones come in, and the colours that they were written with."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from PIL import Image

from unitouch_gen.world import MATERIAL_NAMES

Colour = tuple[int, int, int]

RED = (200, 40, 30)
BLUE = (40, 50, 210)


def shade(number: int) -> Colour:
    """A colour for each number up to 64, far enough from the others to be told apart in a video."""
    return (30 + 60 * (number % 4), 30 + 60 * (number // 4 % 4), 30 + 60 * (number // 16 % 4))


def write_image(file: Path, colour: Colour, size: tuple[int, int] = (40, 32)) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", size, colour).save(file)
    return file


def write_attempts(file: Path, attempts: Sequence[dict[str, Any]]) -> Path:
    """A list of dictionaries as deepdish writes it: scalars are attributes of groups, arrays are in them."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(file, "w") as opened:
        group = opened.create_group("data")
        group.attrs["TITLE"] = np.bytes_(f"list:{len(attempts)}")
        for number, attempt in enumerate(attempts):
            entry = group.create_group(f"i{number}")
            for name, value in attempt.items():
                if isinstance(value, np.ndarray):
                    entry.create_dataset(name, data=value, compression="gzip", shuffle=True)
                else:
                    entry.attrs[name] = value
    return file


def painted(colour: Colour, size: tuple[int, int] = (32, 40)) -> np.ndarray:
    """An image (H, W, 3) of one colour."""
    return np.broadcast_to(np.array(colour, np.uint8), (*size, 3)).copy()


def pictured_labels() -> list[tuple[int, int, int]]:
    """Materials, objects and contacts of `write_pictured`: four, six of each, two of each."""
    return [(material, thing, contact) for material in range(4) for thing in range(6) for contact in range(2)]


def write_pictured(folder: Path) -> None:
    """The list of a data set of touches with pictures, by `gelsight`, in splits by objects; its images are none yet."""
    rows = ["touch,picture,object,material,split,sensor"]
    for number, (material, thing, _) in enumerate(pictured_labels()):
        split = ("train", "train", "train", "val", "test", "test")[thing]
        name = MATERIAL_NAMES[material]
        rows.append(f"touch/{number}.png,picture/{number}.png,{name}{thing},{name},{split},gelsight")
        for kind in ("touch", "picture"):
            (folder / kind).mkdir(parents=True, exist_ok=True)
            (folder / kind / f"{number}.png").write_bytes(b"no image")
    (folder / "labels.csv").write_text("\n".join(rows))
