"""SSVTP (Kerr et al., 2022) in the form of TVL (Fu et al., 2024): a DIGIT, a camera, and words.

images_rgb/image_<id>_rgb.jpg  images_tac/image_<id>_tac.jpg  text/labels_<id>.txt  train.csv  test.csv
"""

import re
from collections.abc import Iterator
from pathlib import Path

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.files import read_table, read_text
from unitouch_gen.training.data.records import Frame, Record, find_paths, frame_at, images_in

LOOKS_LIKE = ("images_tac",)


def read(folder: Path) -> Iterator[Record]:
    """A record for each tactile image."""
    splits: dict[str, str] = {}
    for file in find_paths(folder, "train.csv", "test.csv"):
        for row in read_table(file):
            name = next(iter(row.values()))  # the first column has the name of the picture
            if splits.setdefault(number_of(name), file.stem) != file.stem:
                raise InvalidInputError(f"{str(file)!r} has {name!r}, which is in another split, too.")
    for image in images_in(folder / "images_tac"):
        number = number_of(image.name)
        yield Record(
            number,
            touch=Frame(str(image)),
            picture=frame_at(folder / "images_rgb" / f"image_{number}_rgb.jpg"),
            sensor="digit",
            caption=read_text(folder / "text" / f"labels_{number}.txt").strip() or None,
            split=splits.get(number),
        )


def number_of(name: str) -> str:
    """The id in the name of an image."""
    match = re.search(r"image_(\d+)_(?:rgb|tac)", name)
    if match is None:
        raise InvalidInputError(f"{name!r} is no name of an image of SSVTP, such as images_rgb/image_12_rgb.jpg.")
    return match[1]
