"""Touch and Go (Yang et al., 2022): a GelSight and a camera in one hand, frames with twenty materials.

    label.txt  train.txt  test.txt              20220601_182052/0000033833.jpg,3
    train_rough.txt  test_rough.txt             the same with 0 or 1
    dataset/20220601_182052/{video,gelsight}_frame/0000033833.jpg

Frames are images, as the authors' `extract_frame.py` makes them of each recording's `video.mp4` and `gelsight.mp4`.
"""

import re
from collections.abc import Iterator
from pathlib import Path

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.files import read_text
from unitouch_gen.training.data.records import Frame, Record, abbreviate, find_paths

LOOKS_LIKE = ("dataset/[0-9]*_[0-9]*",)
MATERIALS = (
    "concrete",
    "plastic",
    "glass",
    "wood",
    "metal",
    "brick",
    "tile",
    "leather",
    "synthetic fabric",
    "natural fabric",
    "rubber",
    "paper",
    "tree",
    "grass",
    "soil",
    "rock",
    "gravel",
    "sand",
    "plants",
    "others",
)
SOFT = frozenset({7, 8, 9, 11, 13})  # numbers of materials
CLASSES = {"material": MATERIALS, "soft": ("hard", "soft"), "rough": ("smooth", "rough")}


def read(folder: Path) -> Iterator[Record | str]:
    """Its labelled frames, without those whose material is inconclusive (-1)."""
    every = read_list(folder / "label.txt")
    train = read_list(folder / "train.txt")
    test = read_list(folder / "test.txt")
    rough = read_list(folder / "train_rough.txt") | read_list(folder / "test_rough.txt")
    in_both = train.keys() & test.keys()
    if in_both:
        raise InvalidInputError(f"train.txt and test.txt both list {abbreviate(sorted(in_both))}.")
    labels = every | train | test
    if labels and not find_paths(folder, "dataset/*/gelsight_frame"):
        raise InvalidInputError("there are videos alone; run the data set's own `python extract_frame.py` first.")
    for frame, material in labels.items():
        if material < 0:
            continue
        recording, file = frame.split("/")
        recording_folder = folder / "dataset" / recording
        numbers = {"material": material, "soft": int(material in SOFT), "rough": rough.get(frame, -1)}
        split = None
        if frame in train:
            split = "train"
        elif frame in test:
            split = "test"
        yield Record(
            frame,
            touch=Frame(str(recording_folder / "gelsight_frame" / file)),
            picture=Frame(str(recording_folder / "video_frame" / file)),
            sensor="gelsight",
            recording=recording,
            labels={label: CLASSES[label][number] for label, number in numbers.items() if number >= 0},
            split=split,
        )
    skipped = sum(material < 0 for material in labels.values())
    if skipped:
        yield f"{skipped} frames whose material is inconclusive (-1) are left out"


def read_list(file: Path) -> dict[str, int]:
    """The label of each frame in a list, by "recording/frame.jpg"; empty if there is no file."""
    labels: dict[str, int] = {}
    for line in filter(None, map(str.strip, read_text(file).splitlines())):
        match = re.fullmatch(r"(?P<frame>[^/,]+/[^/,]+)\s*,\s*(?P<label>-?\d+)", line)
        label = int(match["label"]) if match else None
        if match is None or label is None or label >= len(MATERIALS) or labels.get(match["frame"], label) != label:
            raise InvalidInputError(
                f"{str(file)!r} has {line[:60]!r}; a line is recording/frame.jpg,label, a frame has one label, and "
                f"labels go up to {len(MATERIALS) - 1}."
            )
        labels[match["frame"]] = label
    return labels
