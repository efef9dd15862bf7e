"""Videos and streams of frames of a touch sensor: its gel at rest, contacts, and the frame that shows one best."""

import os
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from unitouch_gen.errors import InvalidInputError, InvalidTypeError, check_choice, describe, first_line, needed
from unitouch_gen.files import check_file
from unitouch_gen.models.images import ImageInput, load_images
from unitouch_gen.models.out_of_distribution import LEAST_CHANGE, change_of

VIDEOS = frozenset({".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".wmv"})
"""Suffixes of files that are taken for videos."""

QUIET = 5  # frames in a row, each like the first of them, whose median is the gel at rest
IN_A_ROW = 3  # of so many the middle one by firmness counts, so that a broken frame is never the firmest
SETTLED = 5  # frames without a firmer one after which a contact is as firm as it gets


@dataclass(frozen=True)
class Contact:
    """The firmest frame of a contact and the gel at rest, RGB, uint8 or float32 in [0, 1], (H, W, 3); the index of that
    frame; and its mean difference from the gel at rest, of full scale."""

    frame: np.ndarray
    background: np.ndarray
    index: int
    firmness: float


class ContactTracker:
    """Follows a stream of frames: the gel at rest from the first quiet ones, contacts, and their firmest frames.

    Args:
        color: Order of the channels of arrays and tensors, "rgb" or "bgr", which is OpenCV's.
        background: The gel at rest, where it is known: an image as of `load_images`.
        name: Name of the frames in messages.

    Attributes:
        count: How many frames came.
        background: The gel at rest, (3, H, W); `None` until it is known.
        touched, firmness: Whether something touches the gel, and the mean difference from it at rest, of full scale.
        contact: The running contact or the last one, at its firmest; `None` before the first.
        settled: Whether that contact has just become as firm as it gets; once for each.
    """

    def __init__(self, color: str = "rgb", background: ImageInput = None, name: str = "frames"):
        self.color, self.name, self.count = check_choice("color", color, ("rgb", "bgr")), name, 0
        self.background = None if background is None else load_images("background", background)[0]
        self.touched, self.firmness, self.settled = False, 0.0, False
        self.contact: Contact | None = None
        self.least = LEAST_CHANGE  # more where the quiet frames are noisy
        self._quiet: deque[Tensor] = deque(maxlen=QUIET)
        self._last: deque[tuple[float, int, Tensor]] = deque(maxlen=IN_A_ROW)
        self._firmest_at, self._told = -1, False

    def update(self, frame: ImageInput) -> None:
        """Takes the next frame; raises as `load_images`, and if it is of another size than those before."""
        name, self.count, self.settled = f"{self.name}[{self.count}]", self.count + 1, False
        pixels = load_images(name, frame)[0].clone()  # cameras write into one array again and again
        if self.color == "bgr" and not isinstance(frame, str | os.PathLike):  # files say themselves
            pixels = pixels.flip(0)
        before = self.background if self.background is not None else self._quiet[0] if self._quiet else pixels
        if pixels.shape != before.shape:
            sizes = f"{tuple(pixels.shape[1:])} pixels and those before {tuple(before.shape[1:])}"
            raise InvalidInputError(f"`{name}` is {sizes}; pass frames of one size.")
        change = _change(pixels, before)
        if self.background is not None:
            self._follow(pixels, change)
        else:
            self._look_for_rest(pixels, change)

    def _look_for_rest(self, pixels: Tensor, change: Tensor) -> None:
        """Keeps the frames that are like the first one kept, and takes enough of them for the gel at rest."""
        if change.max() >= LEAST_CHANGE:
            self._quiet.clear()
        self._quiet.append(pixels)
        if len(self._quiet) == QUIET:
            self.background = torch.stack(list(self._quiet)).median(dim=0).values
            noise = max(float(_change(one, self.background).max()) for one in self._quiet)
            self.least = max(LEAST_CHANGE, 3.0 * noise)

    def _follow(self, pixels: Tensor, change: Tensor) -> None:
        """Finds out whether a frame after the quiet ones is firmer than those of its contact before it."""
        running, index = self.touched, self.count - 1
        self.touched, self.firmness = float(change.max()) >= self.least, float(change.mean())
        if self.touched and not running:
            self.contact, self._told = None, False
            self._last.clear()
        if self.touched:
            self._last.append((self.firmness, index, pixels))
            firmness, at, middle = sorted(self._last, key=lambda one: one[0])[len(self._last) // 2]
            if len(self._last) == IN_A_ROW and (self.contact is None or firmness > self.contact.firmness):
                frame, behind = (one.permute(1, 2, 0).numpy() for one in (middle, self.background))  # type: ignore[union-attr]
                self.contact, self._firmest_at = Contact(frame, behind, at, firmness), index
        over = index - self._firmest_at >= SETTLED if self.touched else running
        self.settled = over and self.contact is not None and not self._told
        self._told = self._told or self.settled


def _change(pixels: Tensor, background: Tensor) -> Tensor:
    """`change_of` of uint8 or float images (3, H, W), (8, 8)."""
    scale = 255.0 if pixels.dtype == torch.uint8 else 1.0
    return change_of(pixels[None].float() / scale, background[None].float() / scale)[0]


def firmest_contact(
    frames: Iterable[ImageInput] | str | os.PathLike, color: str = "rgb", background: ImageInput = None, *,
    name: str = "frames",
) -> Contact:  # fmt: skip
    """The frame of firmest contact of a recording that begins before the contact.

    It goes into a pipeline with its background: `pipe(contact.frame, background=contact.background)`.

    Args:
        frames: Path of a video, which takes PyAV (`unitouch_gen[train]`), or an iterable of images.
        color: Order of the channels of arrays and tensors, "rgb" or "bgr".
        background: What the sensor sees untouched; the median of the first quiet frames when left out.
        name: Name of the argument, for the messages.

    Raises:
        InvalidInputError, InvalidTypeError: If no frames are quiet, nothing touches the sensor, a frame is no image, or
            a video cannot be read.

    Example:
        >>> rest = np.full((48, 64, 3), 100, np.uint8)
        >>> pressed = rest.copy()
        >>> pressed[16:32, 24:40] += 50
        >>> firmest_contact([rest] * 6 + [pressed] * 3).index
        7
    """
    tracker, best = ContactTracker(color, background, name), None
    if isinstance(frames, str | os.PathLike):
        frames = read_video(name, frames)
    if not isinstance(frames, Iterable) or isinstance(frames, bytes | dict) or getattr(frames, "ndim", 4) != 4:
        raise InvalidTypeError(f"`{name}` is {describe(frames)}; pass the path of a video, or an iterable of frames.")
    for frame in frames:
        tracker.update(frame)
        if best is None or (tracker.contact is not None and tracker.contact.firmness > best.firmness):
            best = tracker.contact
    if best is None:
        why = f"differ from the gel at rest by {tracker.least:.2g} of full scale anywhere; press while it records"
        if tracker.background is None:
            why = "are alike, which would show the gel at rest; begin to record before you press, or pass `background`"
        raise InvalidInputError(f"`{name}` shows no contact: too few in a row of {tracker.count} frames {why}.")
    return best


def still(name: str, touch: Any) -> Any:
    """A touch of any kind, where a video or an iterator of frames is its frame of firmest contact."""
    if isinstance(touch, list | tuple):
        return [still(f"{name}[{row}]", one) for row, one in enumerate(touch)]
    video = isinstance(touch, str | os.PathLike) and Path(touch).suffix.lower() in VIDEOS
    return firmest_contact(touch, name=name).frame if video or isinstance(touch, Iterator) else touch


def read_video(name: str, place: str | os.PathLike, *, form: str | None = None) -> Iterator[np.ndarray]:
    """Frames (H, W, 3) of a video file, or of a camera by PyAV's name and format of it ("v4l2"), uint8 RGB.

    Those that cannot be decoded are left out.

    Raises:
        InvalidInputError: If PyAV is not installed, or it cannot be read.
    """
    av = needed("av")
    if form is None:
        check_file(name, place, "a video")
    options = {"protocol_whitelist": "file"} if form is None else {}  # a list of other places is no video
    try:
        with av.open(str(place), format=form, options=options) as container:
            for packet in container.demux(video=0):
                try:
                    decoded = packet.decode()
                except av.FFmpegError:
                    continue
                yield from (frame.to_ndarray(format="rgb24") for frame in decoded)
    except (av.FFmpegError, OSError, ValueError, IndexError) as error:  # the last of a file without a video
        raise InvalidInputError(
            f"`{name}` is {str(place)!r}, which cannot be read as a video ({first_line(error)})."
        ) from error
