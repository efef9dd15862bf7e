"""Touch and Go (Yang et al., 2022): a GelSight and a camera in one hand, frames with twenty materials.

    label.txt  train.txt  test.txt              20220601_182052/0000033833.jpg,3
    train_rough.txt  test_rough.txt             the same with 0 or 1
    category_reference.txt                      concrete: 0
    dataset/20220601_182052/{video,gelsight}_frame/0000033833.jpg
    dataset/20220601_182052/{video.mp4,gelsight.mp4,time1.npy,time2.npy}

A recording has its frames as images, or as videos: the touch is then the GelSight's frame of that number, and the
picture the camera's nearest in time (`time1.npy` holds the camera's Unix seconds, `time2.npy` the GelSight's), or of
the same number where there are no times.
"""

import re
from pathlib import Path

import numpy as np

from unitouch_gen.errors import InvalidInputError, first_line, first_of
from unitouch_gen.training.data.frames import Frame, VideoFrame
from unitouch_gen.training.data.reading import integer, read_text
from unitouch_gen.training.data.records import MATERIAL, Record, RecordSet

LOOKS_LIKE = ("dataset/[0-9]*_[0-9]*",)
MATERIALS = (
    "concrete", "plastic", "glass", "wood", "metal", "brick", "tile", "leather", "synthetic fabric", "natural fabric",
    "rubber", "paper", "tree", "grass", "soil", "rock", "gravel", "sand", "plants", "others",
)  # fmt: skip
SOFT = frozenset({7, 8, 9, 11, 13})
UNKNOWN = -1


def read(folder: Path) -> RecordSet:
    """Its labelled frames."""
    every, train, test = (read_list(folder / f"{name}.txt") for name in ("label", "train", "test"))
    rough = read_list(folder / "train_rough.txt") | read_list(folder / "test_rough.txt")
    labels = every | train | test
    differ = [frame for part in (every, train, test) for frame in part if part[frame] != labels[frame]]
    if differ or train.keys() & test.keys():
        two = "labels" if differ else "splits"
        raise InvalidInputError(
            f"The lists have two {two} of {first_of(differ or sorted(train.keys() & test.keys()))}."
        )
    recordings = {name: Recording(folder / "dataset" / name) for name in {frame.split("/")[0] for frame in labels}}
    records = []
    for frame, material in labels.items():
        if material == UNKNOWN:
            continue
        name, file = frame.split("/")
        touch, picture = recordings[name].frames(file)
        known = {MATERIAL: material, "soft": int(material in SOFT), "rough": rough.get(frame, UNKNOWN)}
        records.append(
            Record(
                id=frame,
                touch=touch,
                picture=picture,
                sensor="gelsight",
                recording=name,
                labels={label: number for label, number in known.items() if number != UNKNOWN},
                split="train" if frame in train else "test" if frame in test else None,
            )
        )
    skipped = len(labels) - len(records)
    notes = (f"{skipped} frames whose material is inconclusive (-1) are left out",) if skipped else ()
    classes = {MATERIAL: material_names(folder), "soft": ("hard", "soft"), "rough": ("smooth", "rough")}
    return RecordSet(folder.name, "touch_and_go", tuple(records), classes, apart="recording", notes=notes)


class Recording:
    """Where the frames of one recording are."""

    def __init__(self, folder: Path):
        self.folder, self.images = folder, (folder / "gelsight_frame").is_dir()
        if not self.images and not (folder / "gelsight.mp4").is_file():
            raise InvalidInputError(
                f"The recording {str(folder)!r} is listed, but has no gelsight_frame or gelsight.mp4."
            )
        self.camera, self.gel = (None if self.images else read_times(folder / f"time{of}.npy") for of in (1, 2))

    def frames(self, name: str) -> tuple[Frame, Frame]:
        """The touch and the picture of a frame by its name in the lists."""
        if self.images:
            return Frame(str(self.folder / "gelsight_frame" / name)), Frame(str(self.folder / "video_frame" / name))
        number = seen = integer(Path(name).stem, f"A frame of {self.folder.name!r}")
        if self.camera is not None and self.gel is not None:
            if number >= len(self.gel):
                raise InvalidInputError(f"{str(self.folder)!r} has {len(self.gel)} times, but a label for {number}.")
            seen = int(np.abs(self.camera - self.gel[number]).argmin())
        gel, camera = self.folder / "gelsight.mp4", self.folder / "video.mp4"
        return VideoFrame(str(gel), number), VideoFrame(str(camera), seen)


def read_times(file: Path) -> np.ndarray | None:
    """Seconds of each frame; `None` where there is no file."""
    if not file.is_file():
        return None
    try:
        times = np.load(file, allow_pickle=False)
        if times.ndim != 1 or len(times) == 0 or times.dtype.kind != "f" or not np.isfinite(times).all():
            raise ValueError("it has to hold seconds, one a frame")
    except (OSError, ValueError) as error:
        raise InvalidInputError(f"{str(file)!r} cannot be used: {first_line(error)}.") from error
    return times


def read_list(file: Path) -> dict[str, int]:
    """The label of each frame in a list, by "recording/frame.jpg"; none where there is no file."""
    labels: dict[str, int] = {}
    for number, line in enumerate(read_text(file).splitlines() if file.is_file() else (), start=1):
        match = re.fullmatch(r"([^/,]+/[^/,]+)\s*,\s*(-?\d+)", line.strip())
        if line.strip() and (match is None or labels.setdefault(match[1], int(match[2])) != int(match[2])):
            raise InvalidInputError(
                f"{str(file)!r} has {line[:60]!r} in line {number}; a line is recording/frame.jpg,label, and a "
                "frame has one label."
            )
    return labels


def material_names(folder: Path) -> tuple[str, ...]:
    """Those of `category_reference.txt`, which may quote a name and explain it in brackets; else the published ones."""
    file = folder / "category_reference.txt"
    lines = re.findall(r"^\s*[\"']?([^\"':\n]+?)[\"']?\s*:\s*(\d+)\b", read_text(file) if file.is_file() else "", re.M)
    names = {int(number): name.lower() for name, number in lines}
    if sorted(names) != list(range(len(names))):
        raise InvalidInputError(f"{str(file)!r} numbers the materials {sorted(names)}; they have to go up from 0.")
    return tuple(names[number] for number in range(len(names))) or MATERIALS
