"""Videos of a touch sensor and iterators of frames: the gel at rest, and the frame that shows the contact best."""

import os
import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from unitouch_gen.errors import InvalidInputError, UnfamiliarInputWarning, check_file, explain_errors, import_optional
from unitouch_gen.models.images import ImageInput, load_images

VIDEOS = (".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".wmv")
LEAST_CHANGE = 2.5 / 255  # of a touched cell, as a share of full scale; compression changes 1 to 2 of 255 levels
QUIET = 5  # similar frames in a row that show the gel at rest or a contact that is held
CLEARLY = 1.1  # factor of structure between a press and the gel at rest; none of 240 presses on a GelSight has less
MOST_FRAMES = 64  # frames of a recording that are held in memory
MOST_BYTES = 2**28  # memory for these frames


def thumbnails(images: Tensor) -> Tensor:
    """Images (B, 3, H, W), uint8 or in [0, 1], as float (B, 3, 32, 32)."""
    scaled = images / 255 if images.dtype == torch.uint8 else images
    return F.interpolate(scaled, (32, 32), mode="bilinear", antialias=True)


def change_of(touch: Tensor, background: Tensor) -> Tensor:
    """Mean absolute difference of touches (B, 3, H, W), uint8 or in [0, 1], from their gel at rest, (B, 8, 8) cells."""
    difference = (thumbnails(touch) - thumbnails(background)).abs().mean(dim=1)
    return F.avg_pool2d(difference, 4)


def is_untouched(touch: Tensor, background: Tensor) -> Tensor:
    """Whether touches hardly differ from their gel at rest, bool (B,)."""
    return change_of(touch, background).amax(dim=(-2, -1)) < LEAST_CHANGE


def structure_of(images: Tensor) -> float:
    """Mean absolute second difference of thumbnails of images (B, 3, H, W); a contact has more than the gel at rest."""
    small = thumbnails(images)
    return sum(small.diff(n=2, dim=dim).abs().mean().item() for dim in (-2, -1))


def is_blank(images: Tensor) -> bool:
    """Whether images (B, 3, H, W) are black, or more than an eighth of them is the green of a decoder without data.

    Cameras give such frames when they start or are unplugged. The green is Y = U = V = 0.
    """
    red, green, blue = thumbnails(images).unbind(dim=1)
    no_data = (red < 0.06) & (blue < 0.06) & (green > 0.4) & (green < 0.7)
    black = torch.stack([red, green, blue]).max() < 0.08
    return bool(black or no_data.float().mean() > 1 / 8)


# Recordings -----------------------------------------------------------------------------------------------------------


@dataclass(eq=False)
class Frame:
    """A frame of a recording, uint8 (3, H, W), and its thumbnail (1, 3, 32, 32)."""

    index: int
    pixels: Tensor
    small: Tensor
    repeats: int = 0  # frames after it that equal it
    isolated: bool = False  # unlike the frames before and after it, as broken frames are


@dataclass(eq=False)
class Still:
    """Similar frames in a row: the gel at rest, a contact that is held, or a moment of a movement."""

    first: Tensor  # thumbnail of the first frame, (1, 3, 32, 32)
    small: Tensor  # mean of the first `QUIET` thumbnails
    frames: int
    distinct: int = 1  # frames without repeats
    noise: float = 0.0  # mean change of the cell that changes most
    visits: int = 1  # how often the recording looked like this


def firmest(name: str, source: str | os.PathLike | Iterator[ImageInput]) -> Tensor:
    """The frame of firmest contact of a video file or an iterator of frames, uint8 (3, H, W).

    It is the frame that differs most from the gel at rest, which is searched over the whole recording. Frames that are
    black, green or unlike both of their neighbours are left out. Frames that repeat the one before count once, unless
    all do, as in simulations. At most `MOST_FRAMES` frames are held in memory.

    Args:
        name: Name of the argument, for the messages.
        source: Path of a video, which is read by PyAV (extra `train`), or an iterator of images.

    Warns:
        UnfamiliarInputWarning: If the gel at rest cannot be told from a contact that is held.

    Raises:
        InvalidInputError, InvalidTypeError: If nothing touches the sensor, a frame is no image or of another size than
            those before, or a video cannot be read.
    """
    images = source if isinstance(source, Iterator) else read_video(name, source)
    kept, stills, blank = _gather(_frames(name, images))
    noisy = any(still.distinct >= QUIET for still in stills)  # a camera, so frames that repeat are dropouts
    contacts = [frame for frame in kept if not (noisy and frame.isolated)]
    # In differences of images, the gel at rest is black.
    candidates = _at_rest(stills, noisy) or _at_rest(blank, noisy=False)
    furthest = [_most_changed(contacts, rest) for rest in candidates]
    firmest_of_each = [frame for frame in furthest if frame is not None]
    if not firmest_of_each:
        why = "no frames differ from the gel at rest; press while it records"
        if not candidates:
            alike = f"no {QUIET} frames in a row are alike, which would show the gel at rest"
            why = f"{alike}; begin to record before you press"
        raise InvalidInputError(f"`{name}` shows no contact: {why}.")

    best = firmest_of_each[0]
    rest_has_more = CLEARLY * structure_of(best.small) < structure_of(candidates[0].small)
    if rest_has_more or not all(_alike(frame.small, best.small) for frame in firmest_of_each):
        doubt = f"does not show which of its frames are the gel at rest, so frame {best.index}, which is taken,"
        what_to_do = "Record the gel at rest before and after you press, or pass the frame itself."
        message = f"`{name}` {doubt} may not be the firmest contact. {what_to_do}"
        warnings.warn(message, UnfamiliarInputWarning, stacklevel=2)
    return best.pixels


def _gather(frames: Iterator[Tensor]) -> tuple[list[Frame], list[Still], list[Still]]:
    """Frames that may be the firmest contact, stills, and stills of blank frames."""
    kept = list[Frame]()
    stills = list[Still]()
    blank = list[Still]()

    def with_picture() -> Iterator[Frame]:
        for frame in _distinct(frames):
            if is_blank(frame.small):
                _add_to_stills(blank, frame)
            else:
                yield frame

    for frame in _mark_isolated(with_picture()):
        if frame.isolated and not frame.repeats:
            continue
        _add_to_stills(stills, frame)
        kept.append(frame)
        if len(kept) > max(16, min(MOST_FRAMES, MOST_BYTES // frame.pixels.nbytes)):
            _drop_one(kept)
    return kept, stills, blank


def _alike(small: Tensor, other: Tensor) -> bool:
    return change_of(small, other).max().item() < LEAST_CHANGE


def _distance(small: Tensor, other: Tensor) -> float:
    return (small - other).abs().mean().item()


def _distinct(frames: Iterable[Tensor]) -> Iterator[Frame]:
    """The frames without repeats, which are counted."""
    latest: Frame | None = None
    for index, pixels in enumerate(frames):
        if latest is not None and torch.equal(latest.pixels, pixels):
            latest.repeats += 1
            continue
        if latest is not None:
            yield latest
        latest = Frame(index, pixels, thumbnails(pixels[None]))
    if latest is not None:
        yield latest


def _mark_isolated(frames: Iterable[Frame]) -> Iterator[Frame]:
    """The same frames; `isolated` is set where a frame is unlike its neighbours, which are like each other."""
    before: Frame | None = None
    frame: Frame | None = None
    for after in chain(frames, [None]):
        if frame is not None:
            if before and after:
                step = min(_distance(before.small, frame.small), _distance(frame.small, after.small))
                frame.isolated = _distance(before.small, after.small) < step / 2
            else:  # the first or the last frame
                neighbour = before or after
                frame.isolated = not (neighbour and _alike(frame.small, neighbour.small))
            yield frame
        before = frame
        frame = after


def _add_to_stills(stills: list[Still], frame: Frame) -> None:
    """Adds a frame to the last still if it is like that one's first frame; else begins another still."""
    if stills:
        last = stills[-1]
        change = change_of(frame.small, last.first).max().item()
        if change < LEAST_CHANGE:
            last.frames += 1 + frame.repeats
            last.distinct += 1
            last.noise += (change - last.noise) / last.distinct
            if last.distinct <= QUIET:
                last.small = last.small + (frame.small - last.small) / last.distinct
            return
        if last.frames < QUIET:
            stills.pop()  # a moment of a movement
    stills.append(Still(frame.small, frame.small, 1 + frame.repeats))


def _drop_one(frames: list[Frame]) -> None:
    """Removes the frame that is the least detour between its neighbours, so that turning points stay.

    Lines on maps are simplified in this way, by areas of triangles (Visvalingam & Whyatt, 1993).
    """
    small = torch.cat([frame.small for frame in frames])
    steps = (small[1:] - small[:-1]).abs().mean(dim=(1, 2, 3))
    shortcuts = (small[2:] - small[:-2]).abs().mean(dim=(1, 2, 3))
    detours = steps[:-1] + steps[1:] - shortcuts
    del frames[1 + int(detours.argmin())]


def _at_rest(stills: list[Still], noisy: bool) -> list[Still]:
    """Stills that may be the gel at rest, the likeliest first; several if the recording does not decide.

    Stills that look alike are merged. The gel at rest has the least structure. Of several stills with little structure,
    it is the one that the recording returns to most often.
    """

    def length(still: Still) -> int:
        return still.distinct if noisy else still.frames

    looks = _merged([still for still in stills if length(still) >= QUIET])
    if not looks:
        return []
    smoothest = min(looks, key=lambda look: structure_of(look.small))
    most_structure = CLEARLY * structure_of(smoothest.small)
    looks = [look for look in looks if structure_of(look.small) <= most_structure]
    most_visits = max(look.visits for look in looks)
    looks = [look for look in looks if look.visits == most_visits or look is smoothest]
    return sorted(looks, key=lambda look: (look.visits, length(look)), reverse=True)


def _merged(stills: Iterable[Still]) -> list[Still]:
    """Stills that look alike as one, with their frames and visits added up."""
    looks = list[Still]()
    latest: Still | None = None
    for still in stills:
        alike = [look for look in looks if change_of(look.small, still.small).max() < _least_change(look)]
        if alike:
            look = alike[0]
            look.visits += look is not latest
            look.frames += still.frames
            look.distinct += still.distinct
        else:
            look = still
            looks.append(look)
        latest = look
    return looks


def _least_change(still: Still) -> float:
    """The least change of a cell by which a frame differs from a still; higher if the still is noisy."""
    return max(LEAST_CHANGE, 3.0 * still.noise)


def _most_changed(frames: Iterable[Frame], rest: Still) -> Frame | None:
    """The frame that differs most from the gel at rest; `None` if none does."""
    changed = [frame for frame in frames if change_of(frame.small, rest.small).max() >= _least_change(rest)]
    return max(changed, key=lambda frame: _distance(frame.small, rest.small), default=None)


def _frames(name: str, frames: Iterator[ImageInput]) -> Iterator[Tensor]:
    """Frames of one size as RGB, uint8 (3, H, W)."""
    size = None
    for index, frame in enumerate(frames):
        image = load_images(f"{name}[{index}]", frame)[0]
        pixels = image.clone() if image.dtype == torch.uint8 else (255.0 * image).round().byte()
        size = size or pixels.shape
        if pixels.shape != size:
            sizes = f"{tuple(pixels.shape[1:])} pixels and those before {tuple(size[1:])}"
            raise InvalidInputError(f"`{name}[{index}]` is {sizes}; pass frames of one size.")
        yield pixels


def read_video(name: str, place: str | os.PathLike) -> Iterator[np.ndarray]:
    """Frames of a video file as players show them, with square pixels and upright, uint8 RGB (H, W, 3).

    Frames that cannot be decoded are left out. Raises `InvalidInputError` if the file cannot be read, or PyAV is
    missing.
    """
    av: Any = import_optional("av")
    undecodable = av.FFmpegError  # the module may be gone when Python exits during the loop
    place = os.path.expanduser(place)
    check_file(name, place, "a video")
    options = {"protocol_whitelist": "file"}  # playlists of other places are not followed
    kinds = (undecodable, OSError, ValueError, IndexError)  # IndexError: no video stream
    with (
        explain_errors(f"`{name}` is {str(place)!r}, which is no video", "pass a whole mp4, avi or similar", *kinds),
        # An absolute path, since 10:30.mp4 would be read as a protocol.
        av.open(os.path.abspath(place), options=options) as container,
    ):
        for packet in container.demux(video=0):
            try:
                decoded = packet.decode()
            except undecodable:
                continue
            aspect = float(container.streams.video[0].sample_aspect_ratio or 1)
            for frame in decoded:
                pixels = frame.to_ndarray(format="rgb24", width=round(frame.width * aspect))
                yield np.ascontiguousarray(np.rot90(pixels, round(frame.rotation / 90)))
