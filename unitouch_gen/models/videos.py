"""Videos and streams of frames of a touch sensor: its gel at rest, contacts, and the frame that shows one best."""

import os
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from unitouch_gen.errors import InvalidInputError, InvalidTypeError, check_choice, describe, first_line, needed
from unitouch_gen.files import check_file
from unitouch_gen.models.images import ImageInput, load_images

VIDEOS = frozenset({".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".wmv"})
"""Suffixes of files that are taken for videos."""

LEAST_CHANGE = 2.5 / 255
"""Change of a cell where something touches the gel, of full scale. Compression alone makes 1 to 2 levels of 255."""

QUIET = 5  # frames in a row, each like the first of them, whose median is the gel at rest
IN_A_ROW = 3  # of so many the middle one by firmness counts, so that a broken frame is never the firmest
SETTLED = 5  # frames without a firmer one after which a contact is as firm as it gets


def change_of(touch: Tensor, background: Tensor) -> Tensor:
    """By how much each cell of touches (B, 3, S, S) in [0, 1] differs from their gel at rest, (B, 8, 8)."""
    small = [F.interpolate(one, (32, 32), mode="bilinear", antialias=True) for one in (touch, background)]
    return F.avg_pool2d((small[0] - small[1]).abs().mean(dim=1), 4)


def is_untouched(touch: Tensor, background: Tensor) -> Tensor:
    """Whether touches hardly differ from their gel at rest, bool (B,); see `change_of`."""
    return change_of(touch, background).amax(dim=(-2, -1)) < LEAST_CHANGE


@dataclass(frozen=True)
class Contact:
    """The firmest frame of a contact and the gel at rest, RGB, uint8 or float32 in [0, 1], (H, W, 3); the index of that
    frame; and its mean difference from the gel at rest, of full scale."""

    frame: np.ndarray
    background: np.ndarray
    index: int
    firmness: float


def contacts(
    frames: Iterable[ImageInput] | str | os.PathLike,
    color: str = "rgb",
    background: ImageInput = None,
    *,
    name: str = "frames",
) -> Iterator[Contact]:
    """Contacts of a stream of frames, each when it is as firm as it gets; and again if it gets firmer by a twentieth.

    Args:
        frames: Path of a video, which takes PyAV (`unitouch_gen[train]`), or an iterable of images.
        color: Order of the channels of arrays and tensors, "rgb" or "bgr", which is OpenCV's.
        background: What the sensor sees untouched; the median of the first quiet frames when left out.
        name: Name of the argument, for the messages.

    Raises:
        InvalidInputError, InvalidTypeError: If no frames are quiet, a frame is no image or of another size than those
            before, or a video cannot be read.
    """
    check_choice("color", color, ("rgb", "bgr"))
    frames = read_video(name, frames) if isinstance(frames, str | os.PathLike) else frames
    if not isinstance(frames, Iterable) or isinstance(frames, bytes | dict) or getattr(frames, "ndim", 4) != 4:
        raise InvalidTypeError(f"`{name}` is {describe(frames)}; pass the path of a video, or an iterable of frames.")
    rest = None if background is None else load_images("background", background)[0]
    least = LEAST_CHANGE  # more where the quiet frames are noisy
    quiet, last = deque[Tensor](maxlen=QUIET), deque[tuple[float, int, Tensor]](maxlen=IN_A_ROW)
    best: Contact | None = None  # of the running contact
    new, age = False, 0  # whether it has yet to be yielded, and frames since it was the firmest
    for index, frame in enumerate(frames):
        pixels = load_images(f"{name}[{index}]", frame)[0].clone()  # cameras write into one array again and again
        if color == "bgr" and not isinstance(frame, str | os.PathLike):  # files say themselves
            pixels = pixels.flip(0)
        before = rest if rest is not None else quiet[0] if quiet else pixels
        if pixels.shape != before.shape:
            sizes = f"{tuple(pixels.shape[1:])} pixels and those before {tuple(before.shape[1:])}"
            raise InvalidInputError(f"`{name}[{index}]` is {sizes}; pass frames of one size.")
        change = _change(pixels, before)
        if rest is None:
            if change.max() >= LEAST_CHANGE:
                quiet.clear()
            quiet.append(pixels)
            if len(quiet) == QUIET:
                rest = torch.stack(list(quiet)).median(dim=0).values
                least = max(LEAST_CHANGE, 3.0 * max(float(_change(one, rest).max()) for one in quiet))
        elif change.max() < least:
            if best is not None and new:
                yield best
            best, new = None, False
            last.clear()
        else:
            last.append((float(change.mean()), index, pixels))
            firmness, at, middle = sorted(last, key=lambda one: one[0])[len(last) // 2]
            age += 1
            if len(last) == IN_A_ROW and (best is None or firmness > (1.0 if new else 1.05) * best.firmness):
                shown, behind = (one.permute(1, 2, 0).numpy() for one in (middle, rest))
                best, new, age = Contact(shown, behind, at, firmness), True, 0
            elif best is not None and new and age >= SETTLED:
                yield best
                new = False
    if best is not None and new:
        yield best
    if rest is None:
        raise InvalidInputError(
            f"`{name}` shows no contact: too few frames in a row are alike, which would show the gel at rest; begin to "
            "record before you press, or pass `background`."
        )


def _change(pixels: Tensor, background: Tensor) -> Tensor:
    """`change_of` of uint8 or float images (3, H, W), (8, 8)."""
    scale = 255.0 if pixels.dtype == torch.uint8 else 1.0
    return change_of(pixels[None].float() / scale, background[None].float() / scale)[0]


def firmest_contact(
    frames: Iterable[ImageInput] | str | os.PathLike, color: str = "rgb", background: ImageInput = None, *,
    name: str = "frames",
) -> Contact:  # fmt: skip
    """The firmest of the `contacts` of a recording that begins before the contact, with the same arguments and errors.

    It goes into a pipeline with its background: `pipe(contact.frame, background=contact.background)`.

    Raises:
        InvalidInputError: If nothing touches the sensor.

    Example:
        >>> rest = np.full((48, 64, 3), 100, np.uint8)
        >>> pressed = rest.copy()
        >>> pressed[16:32, 24:40] += 50
        >>> firmest_contact([rest] * 6 + [pressed] * 3).index
        7
    """
    found = max(contacts(frames, color, background, name=name), key=lambda one: one.firmness, default=None)
    if found is None:
        wanted = f"no {IN_A_ROW} frames in a row differ from the gel at rest; press while it records"
        raise InvalidInputError(f"`{name}` shows no contact: {wanted}.")
    return found


def read_video(name: str, place: str | os.PathLike, *, form: str | None = None) -> Iterator[np.ndarray]:
    """Frames (H, W, 3) of a video file, or of a camera by PyAV's name and format of it ("v4l2"), uint8 RGB.

    Those that cannot be decoded are left out. Raises `InvalidInputError` if it cannot be read, or PyAV is missing.
    """
    av: Any = needed("av")
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
