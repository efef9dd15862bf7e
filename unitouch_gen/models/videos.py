"""Videos of a touch sensor and iterators of frames: the gel at rest, and the frame that shows the contact best."""

import os
from collections import deque
from collections.abc import Iterator
from operator import itemgetter
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from unitouch_gen.errors import InvalidInputError, check_file, first_line, needed
from unitouch_gen.models.images import ImageInput, load_images

VIDEOS = (".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".wmv")
LEAST_CHANGE = 2.5 / 255  # of a cell where something touches, of full scale; compression makes 1 to 2 levels of 255
QUIET = 5  # frames in a row, each like the first of them, whose median is the gel at rest


def change_of(touch: Tensor, background: Tensor) -> Tensor:
    """By how much each cell of touches (B, 3, H, W), uint8 or in [0, 1], differs from their gel at rest, (B, 8, 8)."""
    seen = [one / 255 if one.dtype == torch.uint8 else one for one in (touch, background)]
    small = [F.interpolate(one, (32, 32), mode="bilinear", antialias=True) for one in seen]
    return F.avg_pool2d((small[0] - small[1]).abs().mean(dim=1), 4)


def is_untouched(touch: Tensor, background: Tensor) -> Tensor:
    """Whether touches hardly differ from their gel at rest, bool (B,)."""
    return change_of(touch, background).amax(dim=(-2, -1)) < LEAST_CHANGE


def firmest(name: str, source: str | os.PathLike | Iterator[ImageInput]) -> Tensor:
    """The frame of firmest contact of a video file or an iterator of frames, uint8 (3, H, W).

    A recording begins before the contact: the gel at rest is the median of the first frames that are alike.

    Args:
        name: Name of the argument, for the messages.
        source: Path of a video, which takes PyAV (extra `train`), or an iterator of images.

    Raises:
        InvalidInputError, InvalidTypeError: If nothing touches the sensor, a frame is no image or of another size than
            those before, or a video cannot be read.
    """
    frames = _frames(name, source if isinstance(source, Iterator) else read_video(name, source))
    quiet = list[Tensor]()
    for pixels in frames:
        alike = not quiet or change_of(pixels[None], quiet[0][None]).max() < LEAST_CHANGE
        quiet = [*quiet, pixels] if alike else [pixels]
        if len(quiet) == QUIET:
            break
    else:
        wanted = f"no {QUIET} frames in a row are alike, which would show the gel at rest"
        raise InvalidInputError(f"`{name}` shows no contact: {wanted}; begin to record before you press.")
    rest = torch.stack(quiet).median(dim=0).values
    least = max(LEAST_CHANGE, 3.0 * change_of(torch.stack(quiet), rest[None]).max().item())  # more where they are noisy

    best, recent = (0.0, rest), deque[tuple[float, Tensor]](maxlen=3)
    for pixels in frames:
        change = change_of(pixels[None], rest[None])
        if change.max() < least:
            recent.clear()
            continue
        recent.append((change.mean().item(), pixels))
        middle = sorted(recent, key=itemgetter(0))[len(recent) // 2]  # a broken frame is never it
        if len(recent) == 3 and middle[0] > best[0]:
            best = middle
    if best[0] == 0.0:
        wanted = "no 3 frames in a row differ from the gel at rest; press while it records"
        raise InvalidInputError(f"`{name}` shows no contact: {wanted}.")
    return best[1]


def _frames(name: str, frames: Iterator[ImageInput]) -> Iterator[Tensor]:
    """Frames of one size as RGB, uint8 (3, H, W)."""
    size = None
    for index, frame in enumerate(frames):
        pixels = load_images(f"{name}[{index}]", frame)[0]
        pixels = pixels.clone() if pixels.dtype == torch.uint8 else (255.0 * pixels).round().byte()
        size = size or pixels.shape
        if pixels.shape != size:
            sizes = f"{tuple(pixels.shape[1:])} pixels and those before {tuple(size[1:])}"
            raise InvalidInputError(f"`{name}[{index}]` is {sizes}; pass frames of one size.")
        yield pixels


def read_video(name: str, place: str | os.PathLike) -> Iterator[np.ndarray]:
    """Frames of a video file as players show them, square pixels and upright, uint8 RGB (H, W, 3).

    Those that cannot be decoded are left out. Raises `InvalidInputError` if it cannot be read, or PyAV is missing.
    """
    av: Any = needed("av")
    undecodable = av.FFmpegError  # which the module has no more when Python ends amid frames
    check_file(name, place, "a video")
    options = {"protocol_whitelist": "file"}  # a list of other places is no video
    try:
        with av.open(os.path.abspath(place), options=options) as container:  # 10:30.mp4 would be of a protocol
            for packet in container.demux(video=0):
                try:
                    decoded = packet.decode()
                except undecodable:
                    continue
                aspect = float(container.streams.video[0].sample_aspect_ratio or 1)
                for frame in decoded:
                    pixels = frame.to_ndarray(format="rgb24", width=round(frame.width * aspect))
                    yield np.ascontiguousarray(np.rot90(pixels, round(frame.rotation / 90)))
    except (undecodable, OSError, ValueError, IndexError) as error:  # the last of a file without a video
        raise InvalidInputError(f"`{name}` is {str(place)!r}, which is no video ({first_line(error)}).") from error
