"""Records, each a touch with all that is known of it; and what layouts of data sets find and read them with."""

import threading
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
from unitouch_gen.models.videos import read_video

IMAGES = frozenset(Image.registered_extensions()) - {".pdf", ".mpg", ".mpeg", ".h5", ".hdf"}  # suffixes


@dataclass(frozen=True, slots=True)
class Frame:
    """An image in a file."""

    path: str
    index: int | None = None  # in a video, the number of the frame, from 0 in the order in which frames are shown
    key: str | None = None  # in an HDF5 file, the name of the array (H, W, 3)

    def read(self) -> Tensor:
        """Pixels (3, H, W): uint8, or float32 in [0, 1]; raises an `InvalidInputError` if they cannot be read."""
        source: Any = self.path
        try:
            if self.index is not None:
                source = open_video(self.path, threading.get_ident()).frame(self.index)
            elif self.key is not None:
                with needed("h5py").File(self.path) as file:
                    source = file[self.key][()]
        except (OSError, LookupError, ValueError) as error:  # PyAV's and h5py's are among these
            raise InvalidInputError(f"{self.path!r} cannot be read: {first_line(error)}.") from error
        return load_images("image", source)[0]


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
    """The image in a file, if it is there."""
    return Frame(str(file)) if file.is_file() else None


def column_of(file: Path, columns: Iterable[str], known: Sequence[str]) -> str:
    """The first of `known` that is a column of a table."""
    for name in known:
        if name in columns:
            return name
    raise InvalidInputError(f"{str(file)!r} has the columns {list(columns)}, and none of {', '.join(known)}.")


@lru_cache(maxsize=64)  # two for each thread, as a recording has two
def open_video(path: str, thread: int) -> "Video":
    """A video that is read in one thread alone."""
    return Video(path)


class Video:
    """A video that is read forwards, and from its beginning for a frame that is behind."""

    def __init__(self, path: str):
        self.path, self.place = path, -1  # number of the frame that was read last
        self.frames: Iterator[np.ndarray] = iter(())

    def frame(self, index: int) -> np.ndarray:
        """Pixels (H, W, 3) of a frame by its number."""
        if self.place < 0 or index <= self.place:
            self.frames, self.place = read_video("video", self.path), -1
        for pixels in self.frames:
            self.place += 1
            if self.place == index:
                return pixels
        raise ValueError(f"the video has {self.place + 1} frames, but not number {index}")


def frames_in(path: str) -> int:
    """Number of a video's frames."""
    with needed("av").open(path) as container:
        return sum(packet.pts is not None for packet in container.demux(video=0))
