"""Videos and streams of frames of a touch sensor: its gel at rest, contacts, and the frame that shows one best."""

import os
import re
import warnings
from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image, ImageSequence
from torch import Tensor

from unitouch_gen.errors import InvalidInputError, InvalidTypeError, check_choice, describe, first_line, needed
from unitouch_gen.files import check_file
from unitouch_gen.models.images import ImageInput, load_images

VIDEOS = frozenset({".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".wmv"})  # suffixes of files
CONTENTS = rb"....ftyp(?!hei|mif|avi)|\x1aE\xdf\xa3|RIFF....AVI |\0\0\x01[\xb3\xba]|0&\xb2u"  # how these begin; no HEIC
LEAST_CHANGE = 2.5 / 255  # of a cell where something touches, of full scale; compression makes 1 to 2 levels of 255
QUIET = 5  # frames in a row, each like the first of them, whose median is the gel at rest
SETTLED = 5  # frames without a firmer one after which a contact is as firm as it gets


def change_of(touch: Tensor, background: Tensor) -> Tensor:
    """By how much each cell of touches (B, 3, H, W), uint8 or in [0, 1], differs from their gel at rest, (B, 8, 8)."""
    seen = [one / 255 if one.dtype == torch.uint8 else one for one in (touch, background)]
    small = [F.interpolate(one, (32, 32), mode="bilinear", antialias=True) for one in seen]
    return F.avg_pool2d((small[0] - small[1]).abs().mean(dim=1), 4)


def is_untouched(touch: Tensor, background: Tensor) -> Tensor:
    """Whether touches hardly differ from their gel at rest, bool (B,)."""
    return change_of(touch, background).amax(dim=(-2, -1)) < LEAST_CHANGE


@dataclass(frozen=True)
class Contact:
    """The firmest frame of a contact and the gel at rest, RGB, uint8 (H, W, 3); the index of that frame; and its mean
    difference from the gel at rest, of full scale."""

    frame: np.ndarray
    background: np.ndarray
    index: int
    firmness: float


def contacts(
    frames: Iterable[ImageInput] | str | os.PathLike, color: str = "rgb", *, name: str = "frames"
) -> Iterator[Contact]:
    """Contacts of a stream of frames, each when it is as firm as it gets; and again if it gets firmer by a twentieth.

    Each goes into a pipeline with its background: `pipe(contact.frame, background=contact.background)`.

    Args:
        frames: Path of a video, which takes PyAV (`unitouch_gen[train]`), or an iterable of images. It begins before
            the first contact: the gel at rest is the median of the first frames that are alike.
        color: Order of the channels of arrays and tensors, "rgb" or "bgr", which is OpenCV's.
        name: Name of the argument, for the messages.

    Raises:
        InvalidInputError, InvalidTypeError: If nothing touches the sensor, a frame is no image or of another size than
            those before, or a video cannot be read.

    Example:
        >>> rest = np.full((48, 64, 3), 100, np.uint8)
        >>> pressed = rest.copy()
        >>> pressed[16:32, 24:40] += 50
        >>> [contact.index for contact in contacts([rest] * 6 + [pressed] * 3)]
        [7]
    """
    images, quiet = enumerate(_frames(name, frames, color)), list[Tensor]()
    for _, pixels in images:
        alike = not quiet or change_of(pixels[None], quiet[0][None]).max() < LEAST_CHANGE
        quiet = [*quiet, pixels] if alike else [pixels]
        if len(quiet) == QUIET:
            break
    else:
        wanted = f"no {QUIET} frames in a row are alike, which would show the gel at rest"
        raise InvalidInputError(f"`{name}` shows no contact: {wanted}; begin to record before you press.")
    rest = torch.stack(quiet).median(dim=0).values
    least = max(LEAST_CHANGE, 3.0 * change_of(torch.stack(quiet), rest[None]).max().item())  # more where they are noisy

    recent = deque[Contact](maxlen=3)
    best, due, age, found = None, False, 0, 0  # due: yet to be yielded; age: frames since it was as firm
    for index, pixels in images:
        change = change_of(pixels[None], rest[None])
        let_go = change.max().item() < least
        if not let_go:
            shown, behind = (one.permute(1, 2, 0).numpy() for one in (pixels, rest))
            recent.append(Contact(shown, behind, index, change.mean().item()))
            middle = sorted(recent, key=lambda one: one.firmness)[len(recent) // 2]  # a broken frame is never it
            age += 1
            if len(recent) == 3 and (best is None or middle.firmness > (1.0 if due else 1.05) * best.firmness):
                best, due, age = middle, True, 0
        if due and best is not None and (let_go or age >= SETTLED):
            yield best
            due, found = False, found + 1
        if let_go:
            best = None
            recent.clear()
    if due and best is not None:
        yield best
    elif not found:
        wanted = "no 3 frames in a row differ from the gel at rest; press while it records"
        raise InvalidInputError(f"`{name}` shows no contact: {wanted}.")


def _frames(name: str, frames: Iterable[ImageInput] | str | os.PathLike, color: str) -> Iterator[Tensor]:
    """Frames of one size as RGB, uint8 (3, H, W)."""
    check_choice("color", color, ("rgb", "bgr"))
    frames = read_video(name, frames) if isinstance(frames, str | os.PathLike) else frames
    if not isinstance(frames, Iterable) or isinstance(frames, bytes | dict) or getattr(frames, "ndim", 4) != 4:
        raise InvalidTypeError(f"`{name}` is {describe(frames)}; pass the path of a video, or an iterable of frames.")
    size = None
    for index, frame in enumerate(frames):
        pixels = load_images(f"{name}[{index}]", frame)[0]
        pixels = pixels.clone() if pixels.dtype == torch.uint8 else (255.0 * pixels).round().byte()
        size = size or pixels.shape
        if pixels.shape != size:
            sizes = f"{tuple(pixels.shape[1:])} pixels and those before {tuple(size[1:])}"
            raise InvalidInputError(f"`{name}[{index}]` is {sizes}; pass frames of one size.")
        yield pixels.flip(0) if color == "bgr" and not isinstance(frame, str | os.PathLike) else pixels


def firmest(name: str, source: Any) -> Any:
    """The firmest contact of a video, an animated image or an iterator of frames; any other input as it is."""
    frames = source if isinstance(source, Iterator) else moving(source)
    if frames is None:
        return source
    best = max(contacts(frames, name=name), key=lambda contact: contact.firmness)
    if isinstance(frames, list):
        warnings.warn(f"`{name}` is an animation; its firmest contact is used, frame {best.index}.", stacklevel=2)
    return best.frame


def moving(source: Any) -> Any:
    """The path of a video, or frames of an animated image (GIF, APNG, TIFF) if enough for a contact; or `None`."""
    is_file = isinstance(source, str | os.PathLike) and os.path.isfile(source)
    with open(source, "rb") if is_file else nullcontext(source) as opened:
        if is_file and (Path(source).suffix.lower() in VIDEOS or re.match(CONTENTS, opened.read(16), re.DOTALL)):
            return source
        try:
            image = Image.open(opened) if is_file else opened
            if getattr(image, "n_frames", 1) < 2 or image.tell() > 0:  # a frame that the user has chosen
                return None
            stored = [(frame.copy(), frame.info.get("duration", 0)) for frame in ImageSequence.Iterator(image)]  # type: ignore[arg-type]
            image.seek(0)
        except Exception:  # of as many kinds as there are formats; `load_images` tells them
            return None
    unit = min((duration for _, duration in stored if duration), default=1)  # equal frames are stored as a longer one
    frames = [frame for frame, duration in stored for _ in range(min(max(round(duration / unit), 1), 100))]
    return frames if len(frames) >= QUIET + 3 and len({frame.size for frame in frames}) == 1 else None


def read_video(name: str, place: str | os.PathLike, *, form: str | None = None) -> Iterator[np.ndarray]:
    """Frames (H, W, 3) of a video file, or of a camera by PyAV's name and format of it ("v4l2"), uint8 RGB, as shown.

    Those that cannot be decoded are left out. Raises `InvalidInputError` if it cannot be read, or PyAV is missing.
    """
    av: Any = needed("av")
    undecodable = av.FFmpegError  # which the module has no more when Python ends amid frames
    if form is None:
        check_file(name, place, "a video")
    options = {"protocol_whitelist": "file"} if form is None else {}  # a list of other places is no video
    try:
        # a name such as 10:30.mp4 would be of a protocol
        with av.open(os.path.abspath(place) if form is None else str(place), format=form, options=options) as container:
            for packet in container.demux(video=0):
                try:
                    decoded = packet.decode()
                except undecodable:
                    continue
                yield from (shown(frame, container.streams.video[0]) for frame in decoded)
    except (undecodable, OSError, ValueError, IndexError) as error:  # the last of a file without a video
        raise InvalidInputError(f"`{name}` is {str(place)!r}, which is no video ({first_line(error)}).") from error


def shown(frame: Any, stream: Any) -> np.ndarray:
    """Pixels (H, W, 3) of a decoded frame as players show it, uint8 RGB: square, and turned by its display matrix."""
    width = round(frame.width * float(stream.sample_aspect_ratio or 1))
    pixels = frame.to_ndarray(format="rgb24", width=width)
    matrix = frame.side_data.get("DISPLAYMATRIX")
    if matrix is None:
        return pixels
    a, b, _, c, d = np.frombuffer(matrix, np.int32)[:5]  # (column, row) goes to (a column + c row, b column + d row)
    if abs(b) > abs(a):
        pixels, a, d = pixels.transpose(1, 0, 2), c, b
    return np.ascontiguousarray(pixels[:: -1 if d < 0 else 1, :: -1 if a < 0 else 1])
