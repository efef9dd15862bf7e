"""ObjectFolder 1.0 and 2.0 in the form of its benchmark (Gao et al., 2021, 2022).

    {vision,touch}/<object>/<point>.png  audio_examples/<object>/<point>.npy
    label.json  {object: 0 to 6}         split.json  {train, val, test: [[object, point], ...]}

Objects 1 to 100 are of version 1.0, touched by TACTO. Those above 100 are of version 2.0, touched by Taxim. The names
of the materials were never published; name them with `materials` of `open_dataset`, or they stay numbers.
"""

import json
from collections.abc import Iterator
from pathlib import Path

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.files import read_text
from unitouch_gen.training.data.records import Frame, Record, abbreviate, find_paths, frame_at

LOOKS_LIKE = ("label.json",)
CLASSES = {"material": tuple("0123456")}


def read(folder: Path) -> Iterator[Record]:
    """The points of its splits; all points, if there is no split.json."""
    labels = json.loads(read_text(folder / "label.json"))
    points = [(image.parent.name, image.stem, None) for image in find_paths(folder, "touch/*/*.png")]
    if (folder / "split.json").is_file():
        splits = json.loads(read_text(folder / "split.json"))
        points = [(str(item), str(point), split) for split, pairs in splits.items() for item, point in pairs]
    unlabelled = {item for item, _, _ in points if str(labels.get(item)) not in CLASSES["material"]}
    if unlabelled:
        names = abbreviate(sorted(unlabelled))
        raise InvalidInputError(f"label.json has no label from 0 to 6 for the objects {names}.")
    for item, point, split in points:
        sound = folder / f"audio_examples/{item}/{point}.npy"
        yield Record(
            f"{item}/{point}",
            touch=Frame(str(folder / f"touch/{item}/{point}.png")),
            picture=frame_at(folder / f"vision/{item}/{point}.png"),
            sensor="tacto" if int(item) <= 100 else "taxim",
            object=item,
            labels={"material": str(labels[item])},
            sound=str(sound) if sound.is_file() else None,
            split=split,
        )
