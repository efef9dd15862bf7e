"""Touch and Go (Yang et al., 2022): a GelSight and a camera in one hand, frames with twenty materials.

    label.txt  train.txt  test.txt              20220601_182052/0000033833.jpg,3
    train_rough.txt  test_rough.txt             the same with 0 or 1
    dataset/20220601_182052/{video,gelsight}_frame/0000033833.jpg
    dataset/20220601_182052/{video.mp4,gelsight.mp4,time1.npy,time2.npy}

A recording has its frames as images, or as videos: the touch is then the GelSight's frame of that number, and the
picture the camera's nearest in time (`time1.npy` holds the camera's Unix seconds, `time2.npy` the GelSight's), or of
the same number where there are no times.
"""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.files import read_text
from unitouch_gen.training.data.records import Frame, Record, few, found

LOOKS_LIKE = ("dataset/[0-9]*_[0-9]*",)
MATERIALS = (
    "concrete", "plastic", "glass", "wood", "metal", "brick", "tile", "leather", "synthetic fabric", "natural fabric",
    "rubber", "paper", "tree", "grass", "soil", "rock", "gravel", "sand", "plants", "others",
)  # fmt: skip
SOFT = frozenset({7, 8, 9, 11, 13})
CLASSES = {"material": MATERIALS, "soft": ("hard", "soft"), "rough": ("smooth", "rough")}


def read(folder: Path) -> Iterator[Record | str]:
    """Its labelled frames, but for those whose material is inconclusive."""
    every, train, test = (read_list(folder / f"{name}.txt") for name in ("label", "train", "test"))
    rough = read_list(folder / "train_rough.txt") | read_list(folder / "test_rough.txt")
    if both := sorted(train.keys() & test.keys()):
        raise InvalidInputError(f"train.txt and test.txt both list {few(both)}.")
    labels = every | train | test
    clocks = {name: found(folder / "dataset" / name, "time[12].npy") for name in {one.split("/")[0] for one in labels}}
    times = {name: [np.load(file, allow_pickle=False) for file in files] for name, files in clocks.items()}
    for frame, material in labels.items():
        if material < 0:
            continue
        name, file = frame.split("/")
        numbers = {"material": material, "soft": int(material in SOFT), "rough": rough.get(frame, -1)}
        names = {label: CLASSES[label][number] for label, number in numbers.items() if number >= 0}
        split = "train" if frame in train else "test" if frame in test else None
        touch, picture = frames_of(folder / "dataset" / name, file, times[name])
        yield Record(frame, touch, picture, sensor="gelsight", recording=name, labels=names, split=split)
    if skipped := sum(material < 0 for material in labels.values()):
        yield f"{skipped} frames whose material is inconclusive (-1) are left out"


def frames_of(recording: Path, name: str, times: Sequence[np.ndarray]) -> tuple[Frame, Frame]:
    """The touch and the picture of a frame by its name in the lists; `times` are the camera's and the GelSight's."""
    touch, picture = recording / "gelsight_frame" / name, recording / "video_frame" / name
    if touch.parent.is_dir():
        return Frame(str(touch)), Frame(str(picture))
    number = nearest = int(touch.stem)
    if len(times) == 2:
        nearest = int(np.abs(times[0] - times[1][number]).argmin())
    return Frame(str(recording / "gelsight.mp4"), index=number), Frame(str(recording / "video.mp4"), index=nearest)


def read_list(file: Path) -> dict[str, int]:
    """The label of each frame in a list, by "recording/frame.jpg"; none where there is no file."""
    labels: dict[str, int] = {}
    for line in filter(None, map(str.strip, read_text(file).splitlines())):
        match = re.fullmatch(r"([^/,]+/[^/,]+)\s*,\s*(-?\d+)", line)
        label = int(match[2]) if match else len(MATERIALS)
        if match is None or label >= len(MATERIALS) or labels.setdefault(match[1], label) != label:
            raise InvalidInputError(
                f"{str(file)!r} has {line[:60]!r}; a line is recording/frame.jpg,label, a frame has one label, and "
                f"labels go up to {len(MATERIALS) - 1}."
            )
    return labels
