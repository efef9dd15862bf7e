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

from unitouch_gen.errors import InvalidInputError, UnfamiliarInputWarning, check_file, first_line, needed
from unitouch_gen.models.images import ImageInput, load_images

VIDEOS = (".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".wmv")
LEAST_CHANGE = 2.5 / 255  # of a cell where something touches, of full scale; compression makes 1 to 2 levels of 255
QUIET = 5  # frames in a row, each like the first of them, that show the gel at rest or a contact that is held
CLEARLY = 1.1  # more structure than the gel at rest; of 240 presses on a real GelSight, none has less by this factor
MOST_FRAMES = 64  # of a recording that are held in memory
MOST_BYTES = 2**28  # the same, for large frames


def thumbnails(images: Tensor) -> Tensor:
    """Images (B, 3, H, W), uint8 or in [0, 1], as float (B, 3, 32, 32)."""
    scaled = images / 255 if images.dtype == torch.uint8 else images
    return F.interpolate(scaled, (32, 32), mode="bilinear", antialias=True)


def change_of(touch: Tensor, background: Tensor) -> Tensor:
    """By how much each cell of touches (B, 3, H, W), uint8 or in [0, 1], differs from their gel at rest, (B, 8, 8)."""
    return F.avg_pool2d((thumbnails(touch) - thumbnails(background)).abs().mean(dim=1), 4)


def is_untouched(touch: Tensor, background: Tensor) -> Tensor:
    """Whether touches hardly differ from their gel at rest, bool (B,)."""
    return change_of(touch, background).amax(dim=(-2, -1)) < LEAST_CHANGE


def structure_of(images: Tensor) -> float:
    """Mean absolute second difference of thumbnails of images (B, 3, H, W); a contact has more than the gel at rest."""
    small = thumbnails(images)
    return sum(small.diff(n=2, dim=dim).abs().mean().item() for dim in (-2, -1))


def is_blank(images: Tensor) -> bool:
    """Whether images (B, 3, H, W) are black, or an eighth of them is the green of a decoder without data.

    Cameras that start or are unplugged give such frames. The green is Y = U = V = 0.
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
    """Frames in a row that are alike: the gel at rest, a contact that is held, or a moment of a movement."""

    first: Tensor  # thumbnail (1, 3, 32, 32)
    small: Tensor  # mean of the first `QUIET` thumbnails
    frames: int
    distinct: int = 1  # frames without repeats
    noise: float = 0.0  # mean change of the cell that changes most
    visits: int = 1  # times that the recording came to look like this


def firmest(name: str, source: str | os.PathLike | Iterator[ImageInput]) -> Tensor:
    """The frame of firmest contact of a video file or an iterator of frames, uint8 (3, H, W).

    It is the frame that differs most from the gel at rest, which is found over the whole recording. Frames that are
    black, green or unlike both of their neighbours are left out, and frames that repeat the one before count once,
    unless all do, as in simulations. At most `MOST_FRAMES` frames are held in memory.

    Args:
        name: Name of the argument, for the messages.
        source: Path of a video, which takes PyAV (extra `train`), or an iterator of images.

    Warns:
        UnfamiliarInputWarning: If the recording does not show whether the gel or a contact is at rest.

    Raises:
        InvalidInputError, InvalidTypeError: If nothing touches the sensor, a frame is no image or of another size than
            those before, or a video cannot be read.
    """
    frames = _frames(name, source if isinstance(source, Iterator) else read_video(name, source))
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

    noisy = any(still.distinct >= QUIET for still in stills)  # so frames that repeat come from a camera that stalls
    contacts = [frame for frame in kept if not (noisy and frame.isolated)]
    candidates = _at_rest(stills, noisy) or _at_rest(blank, noisy=False)  # black is at rest in differences of images
    if not candidates:
        wanted = f"no {QUIET} frames in a row are alike, which would show the gel at rest"
        raise InvalidInputError(f"`{name}` shows no contact: {wanted}; begin to record before you press.")
    changed = [_most_changed(contacts, rest) for rest in candidates]
    firmest_of_each = [one for one in changed if one is not None]
    if not firmest_of_each:
        wanted = "no frames differ from the gel at rest; press while it records"
        raise InvalidInputError(f"`{name}` shows no contact: {wanted}.")

    best = firmest_of_each[0]
    rest_has_more = CLEARLY * structure_of(best.small) < structure_of(candidates[0].small)
    if rest_has_more or not all(_alike(frame.small, best.small) for frame in firmest_of_each):
        found = f"does not show which of its frames are the gel at rest, so frame {best.index}, which is taken,"
        what_to_do = "Record the gel at rest before and after you press, or pass the frame itself."
        message = f"`{name}` {found} may not be the firmest contact. {what_to_do}"
        warnings.warn(message, UnfamiliarInputWarning, stacklevel=2)
    return best.pixels


def _alike(one: Tensor, other: Tensor) -> bool:
    return change_of(one, other).max().item() < LEAST_CHANGE


def _distance(one: Tensor, other: Tensor) -> float:
    return (one - other).abs().mean().item()


def _distinct(frames: Iterable[Tensor]) -> Iterator[Frame]:
    """The frames without those that equal the one before."""
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
    """The same frames, with `isolated` where one is unlike its neighbours, which are alike."""
    before: Frame | None = None
    frame: Frame | None = None
    for after in chain(frames, [None]):
        if frame is not None:
            if before and after:
                steps = (_distance(before.small, frame.small), _distance(frame.small, after.small))
                frame.isolated = _distance(before.small, after.small) < min(steps) / 2
            else:  # the first frame or the last
                neighbour = before or after
                frame.isolated = not (neighbour and _alike(frame.small, neighbour.small))
            yield frame
        before = frame
        frame = after


def _add_to_stills(stills: list[Still], frame: Frame) -> None:
    """Adds a frame to the last of the stills if it is like the first frame of that, or begins another one."""
    last = stills[-1] if stills else None
    change = change_of(frame.small, last.first).max().item() if last else LEAST_CHANGE
    if last and change < LEAST_CHANGE:
        last.frames += 1 + frame.repeats
        last.distinct += 1
        last.noise += (change - last.noise) / last.distinct
        if last.distinct <= QUIET:
            last.small = last.small + (frame.small - last.small) / last.distinct
        return
    if last and last.frames < QUIET:
        stills.pop()  # a moment of a movement
    stills.append(Still(frame.small, frame.small, 1 + frame.repeats))


def _drop_one(frames: list[Frame]) -> None:
    """Removes the frame that is least a detour between its neighbours, so turning points stay.

    Lines on maps are simplified like that (Visvalingam & Whyatt, 1993), by areas of triangles.
    """
    small = torch.cat([frame.small for frame in frames])
    steps = (small[1:] - small[:-1]).abs().mean(dim=(1, 2, 3))
    across = (small[2:] - small[:-2]).abs().mean(dim=(1, 2, 3))
    detours = steps[:-1] + steps[1:] - across
    del frames[1 + int(detours.argmin())]


def _at_rest(stills: list[Still], noisy: bool) -> list[Still]:
    """Stills that may be the gel at rest, the likeliest first; several where the recording does not tell.

    Stills that look alike are one. The gel at rest has the least structure; of several like that, it is the one that
    the recording comes back to most often.
    """
    looks = list[Still]()
    latest: Still | None = None
    for still in stills:
        if (still.distinct if noisy else still.frames) < QUIET:
            continue
        look = next((one for one in looks if change_of(one.small, still.small).max() < _least_change(one)), None)
        if look is None:
            look = still
            looks.append(look)
        else:
            look.visits += look is not latest
            look.frames += still.frames
            look.distinct += still.distinct
        latest = look
    if not looks:
        return []
    smoothest = min(looks, key=lambda look: structure_of(look.small))
    most_structure = CLEARLY * structure_of(smoothest.small)
    looks = [look for look in looks if structure_of(look.small) <= most_structure]
    often = max(look.visits for look in looks)
    looks = [look for look in looks if look.visits == often or look is smoothest]
    return sorted(looks, key=lambda look: (look.visits, look.distinct if noisy else look.frames), reverse=True)


def _least_change(still: Still) -> float:
    """The change of a cell from which on a frame differs from a still: more where that is noisy."""
    return max(LEAST_CHANGE, 3.0 * still.noise)


def _most_changed(frames: Iterable[Frame], rest: Still) -> Frame | None:
    """The frame that differs most from the gel at rest, if one does."""
    changed = [frame for frame in frames if change_of(frame.small, rest.small).max() >= _least_change(rest)]
    return max(changed, key=lambda frame: _distance(frame.small, rest.small), default=None)


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
    place = os.path.expanduser(place)
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
