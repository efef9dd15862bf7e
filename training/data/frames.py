"""Frames: an image file, a frame of a video, or an array in an HDF5 file, read when it is asked for."""

import threading
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from unitouch_gen.errors import InvalidInputError, first_line, needed
from unitouch_gen.models.images import load_images


@dataclass(frozen=True, slots=True)
class Frame:
    """An image in a file.

    Attributes:
        path: The file.
        index: In a video, the number of the frame, from 0 in the order in which frames are shown.
        key: In an HDF5 file, the name of the array (H, W, 3).
        bgr: Whether blue is stored in the place of red, as OpenCV has images in memory.
    """

    path: str
    index: int | None = None
    key: str | None = None
    bgr: bool = False

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


def frame_at(file: Path) -> Frame | None:
    """An image file, if it is there."""
    return Frame(str(file)) if file.is_file() else None


_OPEN = threading.local()


def open_video(path: str) -> "Video":
    """A video among the two that a thread holds open, as a recording has two."""
    videos: dict[str, Video] = vars(_OPEN)
    if path not in videos:
        while len(videos) > 1:
            videos.pop(next(iter(videos)))
        videos[path] = Video(path)
    return videos[path]


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
                return frame.to_ndarray(format="rgb24")
        self.time = self.times[-1]
        raise ValueError("the video ends before that frame")
