"""Records, each a touch with all that is known of it; and what layouts of data sets find and read them with."""

import threading
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from torch import Tensor

from unitouch_gen.errors import InvalidInputError, first_line, needed
from unitouch_gen.files import files_below, is_hidden, natural
from unitouch_gen.models.images import load_images
from unitouch_gen.models.videos import shown

IMAGES = frozenset(Image.registered_extensions()) - {".pdf", ".mpg", ".mpeg", ".h5", ".hdf"}
"""Suffixes of files that Pillow reads as images."""


@dataclass(frozen=True, slots=True)
class Frame:
    """An image in a file."""

    path: str
    index: int | None = None  # in a video, the number of the frame, from 0 in the order in which frames are shown
    key: str | None = None  # in an HDF5 file, the name of the array (H, W, 3)
    bgr: bool = False  # whether blue is stored in the place of red, as OpenCV has images in memory

    def read(self) -> Tensor:
        """Pixels (3, H, W): uint8, or float32 in [0, 1]; raises an `InvalidInputError` if they cannot be read."""
        source: Any = self.path
        try:
            if self.index is not None:
                source = open_video(self.path).frame(self.index)
            elif self.key is not None:
                with needed("h5py").File(self.path) as file:
                    source = file[self.key][()]
        except (OSError, LookupError, ValueError) as error:  # PyAV's and h5py's are among these
            raise InvalidInputError(f"{self.path!r} cannot be read: {first_line(error)}.") from error
        pixels = load_images("image", source)[0]
        return pixels.flip(0) if self.bgr else pixels


@dataclass(frozen=True, slots=True)
class Record:
    """One touch with all that is known of it."""

    id: str  # unique in its data set
    touch: Frame
    picture: Frame | None = None
    background: Frame | None = None  # the gel before the contact
    sensor: str | None = None  # what took the touch
    object: str | None = None  # which records of several splits may not share
    recording: str | None = None  # nor this, where there are no objects
    labels: Mapping[str, Any] = field(default_factory=dict)  # classes: layouts name them, `open_dataset` numbers them
    caption: str | None = None
    sound: str | None = None  # a sound file, or a .npy file of samples
    split: str | None = None  # "train", "val" or "test", where the data set says

    @property
    def files(self) -> set[str]:
        """Paths of all its files."""
        frames = (self.touch, self.picture, self.background)
        return {frame.path for frame in frames if frame} | ({self.sound} if self.sound else set())


def few(names: Sequence[str]) -> str:
    """The first five of many, and how many more there are."""
    return "; ".join([*names[:5], f"and {len(names) - 5} more"] if len(names) > 5 else names)


def found(folder: Path, *patterns: str) -> list[Path]:
    """What patterns find in a folder, in natural order, without hidden files and those in hidden folders."""
    paths = {path for one in patterns for path in (files_below(folder) if one == "**/*" else folder.glob(one))}
    return sorted((path for path in paths if not is_hidden(path.relative_to(folder))), key=natural)


def images_in(folder: Path, pattern: str = "*") -> list[Path]:
    """The images in a folder, in natural order; none where there is no folder."""
    return [file for file in found(folder, pattern) if file.suffix.lower() in IMAGES]


def frame_at(file: Path) -> Frame | None:
    """An image file, if it is there."""
    return Frame(str(file)) if file.is_file() else None


def column_of(file: Path, columns: Iterable[str], known: Sequence[str]) -> str:
    """The first of `known` that is a column of a table."""
    for name in known:
        if name in columns:
            return name
    raise InvalidInputError(f"{str(file)!r} has the columns {list(columns)}, and none of {', '.join(known)}.")


@lru_cache(maxsize=64)  # two for each thread, as a recording has two
def _opened(path: str, thread: int) -> "Video":
    return Video(path)


def open_video(path: str) -> "Video":
    """An open video that no other thread reads."""
    return _opened(path, threading.get_ident())


class Video:
    """An open video that is read forwards, and seeks where there is a key frame on the way."""

    def __init__(self, path: str):
        self.container = needed("av").open(path)
        self.stream = self.container.streams.video[0]
        packets = [packet for packet in self.container.demux(self.stream) if packet.pts is not None]
        self.times = sorted(packet.pts for packet in packets)
        self.keys = sorted(packet.pts for packet in packets if packet.is_keyframe)
        self.frames: Iterator[Any] = iter(())
        self.time = max(self.times, default=0)  # of the frame read last

    def frame(self, index: int) -> np.ndarray:
        """Pixels (H, W, 3) of a frame by its number."""
        if not 0 <= index < len(self.times):
            raise ValueError(f"the video has {len(self.times)} frames, but not number {index}")
        wanted = self.times[index]
        key = self.keys[max(bisect_right(self.keys, wanted) - 1, 0)]
        if not key <= self.time < wanted:
            self.container.seek(key, stream=self.stream)
            self.frames = self.container.decode(self.stream)
        for frame in self.frames:
            if frame.pts is not None and frame.pts >= wanted:
                self.time = frame.pts
                return shown(frame, self.stream)
        self.time = self.times[-1]
        raise ValueError("the video ends before that frame")
