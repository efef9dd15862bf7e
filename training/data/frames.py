"""Images that are read from a file when they are asked for: small values, which may be sent to other threads."""

import os
import threading
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from unitouch_gen.errors import InvalidInputError, first_line, needed
from unitouch_gen.models.images import load_images


@dataclass(frozen=True, slots=True)
class Frame:
    """An image file.

    Attributes:
        path: The file's.
        bgr: Whether it is stored with blue in the place of red, as OpenCV has images in memory.
    """

    path: str
    bgr: bool = field(default=False, kw_only=True)

    def read(self) -> Tensor:
        """Pixels (3, H, W): uint8, or float32 in [0, 1].

        Raises:
            InvalidInputError: If they cannot be read; the message names the file.
        """
        try:
            pixels = load_images("image", self._source())[0]
        except InvalidInputError:
            raise
        except (OSError, KeyError, ValueError) as error:  # PyAV's and h5py's are among these
            raise InvalidInputError(f"`image` is {self}, which cannot be read: {first_line(error)}") from error
        return pixels.flip(0) if self.bgr else pixels

    def _source(self) -> Any:
        return self.path


@dataclass(frozen=True, slots=True)
class VideoFrame(Frame):
    """A frame of a video by its number, from 0 in the order in which they are shown."""

    index: int

    def _source(self) -> np.ndarray:
        videos: dict[str, _Video] = vars(_OPEN).setdefault(str(os.getpid()), {})
        if self.path not in videos:
            while len(videos) > 1:  # a recording has two
                videos.pop(next(iter(videos)))
            videos[self.path] = _Video(self.path)
        return videos[self.path].frame(self.index)


@dataclass(frozen=True, slots=True)
class HDF5Image(Frame):
    """An array (H, W, 3) in an HDF5 file."""

    key: str

    def _source(self) -> np.ndarray:
        with needed("h5py").File(self.path) as file:
            return file[self.key][()]


_OPEN = threading.local()
"""The videos of a thread, by process: one that is forked can neither read on in its parent's nor close them."""


class _Video:
    """An open video that is read forwards; it seeks where there is a key frame on the way."""

    def __init__(self, path: str):
        self.container = needed("av").open(path)
        self.stream = self.container.streams.video[0]
        packets = [packet for packet in self.container.demux(self.stream) if packet.pts is not None]
        self.times = sorted(packet.pts for packet in packets)
        self.keys = sorted(packet.pts for packet in packets if packet.is_keyframe)
        self.frames: Iterator[Any] = iter(())
        self.time = self.times[-1] if self.times else 0  # of the frame read last

    def frame(self, index: int) -> np.ndarray:
        if not 0 <= index < len(self.times):
            raise ValueError(f"the video has {len(self.times)} frames, numbered from 0")
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


def frames_of(video: Path) -> list[VideoFrame]:
    """All frames of a video; none where there is no file."""
    try:
        return (
            [VideoFrame(str(video), index) for index in range(len(_Video(str(video)).times))] if video.is_file() else []
        )
    except (OSError, ValueError, IndexError) as error:
        raise InvalidInputError(f"{str(video)!r} cannot be read as a video: {first_line(error)}.") from error
