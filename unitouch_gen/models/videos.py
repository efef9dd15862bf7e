"""Videos and streams of frames of a touch sensor: its gel at rest, contacts, and the frame that shows one best.

Camera-based sensors are cameras: what their makers' software yields frame by frame, or a video of it, goes in here.
"""

import os
import statistics
import warnings
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from unitouch_gen.errors import (
    DroppedFramesWarning,
    InvalidInputError,
    InvalidTypeError,
    check_choice,
    describe,
    first_line,
    needed,
)
from unitouch_gen.files import check_file
from unitouch_gen.models.images import ImageInput, load_images
from unitouch_gen.models.out_of_distribution import LEAST_CHANGE, SIDE, change_of

VIDEOS = frozenset({".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".wmv"})
"""Suffixes of files that are taken for videos."""

COLORS = ("rgb", "bgr")
"""Orders of channels; OpenCV's is the second."""

QUIET = 5
"""Frames in a row, each like the first of them, whose median is the gel at rest."""

NOISE = 3.0
"""How many times what the quiet frames differ from each other is no contact yet."""

IN_A_ROW = 3
"""Frames that a contact lasts at least, and of which the middle one counts: a single broken frame is none."""

SETTLED = 5
"""Frames without a firmer one after which a contact is as firm as it gets."""

LONGEST_GAP = 1000
"""Frames that a gap between two timestamps counts for at most."""


@dataclass(frozen=True)
class Contact:
    """A contact in a stream of frames.

    Attributes:
        frame: The one of firmest contact, RGB, uint8 or float32 in [0, 1], (H, W, 3).
        background: The gel at rest, of the same kind.
        index: Of that frame, from 0; dropped ones count.
        firmness: By how much it differs from the background on average, of full scale.
        frames: How many frames there were.
        dropped: How many of them are missing.
    """

    frame: np.ndarray
    background: np.ndarray
    index: int
    firmness: float
    frames: int
    dropped: int


@dataclass(frozen=True)
class Seen:
    """What a tracker knows after a frame.

    Attributes:
        index: Of the frame, from 0.
        ready: Whether the gel at rest is known.
        touched: Whether something touches it.
        firmness: By how much it differs from the gel at rest on average, of full scale.
        contact: The running contact or the last one, at its firmest; `None` before the first.
        settled: Whether that contact has just become as firm as it gets; once for each.
    """

    index: int
    ready: bool = False
    touched: bool = False
    firmness: float = 0.0
    contact: Contact | None = None
    settled: bool = False


class ContactTracker:
    """Follows a stream of frames: the gel at rest from the first quiet ones, contacts, and their firmest frames.

    Of each three frames in a row the middle one by firmness counts, so that a single broken frame is never the firmest.

    Args:
        color: Order of the channels of arrays and tensors, "rgb" or "bgr".
        background: The gel at rest, where it is known: an image as of `load_images`.
        name: What messages call the frames.

    Raises:
        InvalidInputError, InvalidTypeError: If there is no such order, or the background is no image.
    """

    def __init__(self, color: str = "rgb", background: ImageInput = None, name: str = "frames"):
        self.color, self.name = check_choice("color", color, COLORS), name
        self.count = self.dropped = 0
        self.background: Tensor | None = None
        self.least = LEAST_CHANGE
        self._rest: Tensor | None = None  # the background, small
        self._quiet: deque[tuple[Tensor, Tensor]] = deque(maxlen=QUIET)
        self._last: deque[tuple[float, int, Tensor]] = deque(maxlen=IN_A_ROW)
        self._seen, self._firmest_at, self._told = Seen(-1), -1, False
        if background is not None:
            self._set_background(load_images("background", background)[0])

    def update(self, frame: ImageInput) -> Seen:
        """Takes the next frame; `None` stands for one that was dropped.

        Raises:
            InvalidInputError, InvalidTypeError: If it is no image, or of another size than those before.
        """
        index, self.count = self.count, self.count + 1
        if frame is None:
            self.dropped += 1
            self._seen = replace(self._seen, index=index, settled=False)
            return self._seen
        pixels = load_images(f"{self.name}[{index}]", frame)[0].clone()  # cameras write into one array again and again
        if self.color == "bgr" and not isinstance(frame, str | os.PathLike):  # files say themselves
            pixels = pixels.flip(0)
        before = self.background if self.background is not None else self._quiet[-1][0] if self._quiet else pixels
        if pixels.shape != before.shape:
            raise InvalidInputError(
                f"`{self.name}[{index}]` is {pixels.shape[2]} x {pixels.shape[1]} pixels, where those before are "
                f"{before.shape[2]} x {before.shape[1]}; pass frames of one size."
            )
        small = _small(pixels)
        if self._rest is None:
            self._look_for_rest(pixels, small)
            self._seen = Seen(index, ready=self._rest is not None)
            return self._seen
        self._seen = self._follow(index, pixels, small)
        return self._seen

    def _look_for_rest(self, pixels: Tensor, small: Tensor) -> None:
        """Keeps the frames that are like the first one kept, and takes enough of them for the gel at rest."""
        if self._quiet and float(change_of(small, self._quiet[0][1]).max()) >= LEAST_CHANGE:
            self._quiet.clear()
        self._quiet.append((pixels, small))
        if len(self._quiet) == QUIET:
            self._set_background(torch.stack([one for one, _ in self._quiet]).median(dim=0).values)
            noise = max(float(change_of(one, self._rest).max()) for _, one in self._quiet)  # type: ignore[arg-type]
            self.least = max(LEAST_CHANGE, NOISE * noise)

    def _set_background(self, pixels: Tensor) -> None:
        self.background, self._rest = pixels, _small(pixels)

    def _follow(self, index: int, pixels: Tensor, small: Tensor) -> Seen:
        """What a frame after the quiet ones shows."""
        assert self._rest is not None
        change = change_of(small, self._rest)
        touched, firmness = float(change.max()) >= self.least, float(change.mean())
        contact, running = self._seen.contact, self._seen.touched
        if touched and not running:
            contact, self._told = None, False
            self._last.clear()
        if touched:
            self._last.append((firmness, index, pixels))
            middle = sorted(self._last, key=lambda one: one[0])[len(self._last) // 2]
            if len(self._last) == IN_A_ROW and (contact is None or middle[0] > contact.firmness):
                contact, self._firmest_at = self._contact(*middle), index
        lasted = touched and index - self._firmest_at >= SETTLED
        settled = contact is not None and not self._told and (lasted or (running and not touched))
        self._told = self._told or settled
        return Seen(index, True, touched, firmness, contact, settled)

    def _contact(self, firmness: float, index: int, pixels: Tensor) -> Contact:
        assert self.background is not None
        frame, behind = (one.permute(1, 2, 0).numpy() for one in (pixels, self.background))
        return Contact(frame, behind, index, firmness, self.count, self.dropped)


def firmest_contact(
    frames: Iterable[ImageInput] | str | os.PathLike, color: str = "rgb", background: ImageInput = None, *,
    name: str = "frames",
) -> Contact:  # fmt: skip
    """The frame of firmest contact of a recording that begins before the contact.

    Args:
        frames: Path of a video, which takes PyAV (`unitouch_gen[train]`), or an iterable of frames: arrays (H, W, 3) or
            whatever else an image may be, and `None` for each that was dropped.
        color: Order of the channels of arrays and tensors, "rgb" or "bgr". Of a video it is that of the file's making.
        background: What the sensor sees untouched; the median of the first quiet frames when left out.
        name: Name of the argument, for the messages.

    Returns:
        The frame and its background: `pipe(contact.frame, background=contact.background)`.

    Raises:
        InvalidInputError, InvalidTypeError: If there are no frames, none are quiet, nothing touches the sensor, a frame
            is no image, or a video cannot be read.

    Warns:
        DroppedFramesWarning: Of frames that are missing.

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
    batch = not isinstance(frames, np.ndarray | Tensor) or frames.ndim == 4
    if not isinstance(frames, Iterable) or isinstance(frames, bytes | dict) or not batch:
        raise InvalidTypeError(f"`{name}` is {describe(frames)}; pass the path of a video, or an iterable of frames.")
    for frame in frames:
        contact = tracker.update(frame).contact
        if contact is not None and (best is None or contact.firmness > best.firmness):
            best = contact
    if best is None:
        raise InvalidInputError(f"`{name}` {_what_is_missing(tracker)}")
    if tracker.dropped:
        warnings.warn(
            f"`{name}`: {tracker.dropped} of {tracker.count} frames are missing, and the firmest may be among them.",
            DroppedFramesWarning,
            stacklevel=2,
        )
    return replace(best, frames=tracker.count, dropped=tracker.dropped)


def _what_is_missing(tracker: ContactTracker) -> str:
    """Why no contact was found."""
    if tracker.count == tracker.dropped:
        return "holds no frames; record anew."
    if tracker.background is None:
        return (
            f"holds no {QUIET} frames in a row that are alike, which would show the gel at rest, in {tracker.count}; "
            "begin to record before you press, or pass `background`."
        )
    return (
        f"shows no contact: no {IN_A_ROW} in a row of {tracker.count} frames differ from the gel at rest by "
        f"{tracker.least:.2g} of full scale anywhere; press while it records, or pass a single image."
    )


def _small(pixels: Tensor) -> Tensor:
    """(3, H, W) -> (1, 3, 32, 32) in [0, 1], in which changes are measured."""
    values = pixels.float() / 255.0 if pixels.dtype == torch.uint8 else pixels
    return F.interpolate(values[None], (SIDE, SIDE), mode="bilinear", antialias=True)


def still(name: str, touch: Any) -> Any:
    """A touch of any kind, where a video or an iterator of frames is its frame of firmest contact.

    Raises:
        InvalidInputError, InvalidTypeError: See `firmest_contact`.
    """
    if isinstance(touch, list | tuple):
        return [still(f"{name}[{row}]", one) for row, one in enumerate(touch)]
    video = isinstance(touch, str | os.PathLike) and Path(touch).suffix.lower() in VIDEOS
    return firmest_contact(touch, name=name).frame if video or isinstance(touch, Iterator) else touch


# Reading --------------------------------------------------------------------------------------------------------------


def read_video(
    name: str, place: str | os.PathLike, *, form: str | None = None, loop: bool = False
) -> Iterator[np.ndarray | None]:
    """Frames (H, W, 3) of a video file or a camera, uint8 RGB, and `None` for each that its timestamps leave out.

    Args:
        name: Name of the argument, for the messages.
        place: Path of the file, or what PyAV calls a camera.
        form: PyAV's format of a camera, such as "v4l2"; `None` for a file.
        loop: Whether to begin anew where a file ends.

    Raises:
        InvalidInputError: If PyAV is not installed, or it cannot be read.
    """
    av = needed("av")
    if form is None:
        check_file(name, place, "a video")
    while True:
        try:
            options = {"protocol_whitelist": "file"} if form is None else {}  # a list of other places is no video
            with av.open(str(place), format=form, options=options) as container:
                if not container.streams.video:
                    raise InvalidInputError(f"`{name}` is {str(place)!r}, which holds no video; pass one.")
                yield from _frames(av, container)
        except (av.FFmpegError, OSError, ValueError) as error:
            if isinstance(error, InvalidInputError):
                raise
            raise InvalidInputError(
                f"`{name}` is {str(place)!r}, which cannot be read as a video ({first_line(error)})."
            ) from error
        if not loop:
            return


def _frames(av: Any, container: Any) -> Iterator[np.ndarray | None]:
    """Frames of an open container, and `None` for each that cannot be decoded or that its timestamps leave out."""
    stream, before, steps = container.streams.video[0], None, deque[int](maxlen=15)
    stream.thread_type = "AUTO"
    for packet in container.demux(stream):
        try:
            decoded = packet.decode()
        except av.FFmpegError:  # a damaged one leaves a gap between the timestamps of its neighbours
            continue
        for frame in decoded:
            if frame.pts is not None and before is not None and frame.pts > before:
                step = frame.pts - before
                usual = statistics.median(steps) if steps else step
                yield from [None] * min(round(step / usual) - 1, LONGEST_GAP)
                if step < 1.5 * usual:
                    steps.append(step)
            before = frame.pts
            yield frame.to_ndarray(format="rgb24")
