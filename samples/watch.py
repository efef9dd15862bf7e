"""Generates a picture from every touch of a sensor's camera or video; needs PyAV, of the extra `train`.

python samples/watch.py 0 --output outputs/watched    # the first camera, on Linux; Ctrl-C ends it
python samples/watch.py press.mp4

Do not touch the sensor for a moment: similar frames show the gel at rest. If it is pressed from the beginning, the gel
is recognised when it is released, since it has less structure than a contact.
"""

import argparse
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

import unitouch_gen
from unitouch_gen.models.videos import (
    CLEARLY,
    LEAST_CHANGE,
    QUIET,
    change_of,
    is_blank,
    read_video,
    structure_of,
    thumbnails,
)

SETTLED = 5  # frames without a firmer one, after which a contact is taken to be at its firmest


@dataclass(frozen=True)
class Contact:
    """A frame, uint8 (H, W, 3), its number, and its mean difference from the gel at rest, as a share of full scale."""

    frame: np.ndarray
    index: int
    firmness: float


def camera(number: str) -> Iterator[np.ndarray]:
    """Frames (H, W, 3) of a camera, uint8 RGB."""
    import av

    with av.open(f"/dev/video{number}", format="v4l2") as container:
        for frame in container.decode(video=0):
            yield frame.to_ndarray(format="rgb24")


def contacts(frames: Iterable[np.ndarray]) -> Iterator[Contact]:
    """Contacts of a stream, each when it is at its firmest, and again if it becomes firmer by a twentieth.

    Frames that are black, green or repeated are left out.
    """
    rest: Tensor | None = None  # thumbnail of the gel at rest
    least = LEAST_CHANGE
    quiet: list[Tensor] = []  # thumbnails of the latest similar frames
    recent = deque[Contact](maxlen=3)
    best: Contact | None = None
    due = False  # whether the best has not been yielded yet
    age = 0  # frames since the best
    previous: np.ndarray | None = None
    for index, frame in enumerate(frames):
        small = thumbnails(torch.from_numpy(frame.copy()).permute(2, 0, 1)[None])
        if is_blank(small):
            continue
        alike = not quiet or change_of(small, quiet[0]).max() < LEAST_CHANGE
        quiet = [*quiet, small][-QUIET:] if alike else [small]
        if len(quiet) == QUIET:
            still = torch.cat(quiet).median(dim=0, keepdim=True).values
            if rest is None or CLEARLY * structure_of(still) < structure_of(rest):
                rest = still
                noise = change_of(torch.cat(quiet), rest).max().item()
                least = max(LEAST_CHANGE, 3.0 * noise)
                best = None  # it was measured against another gel
                due = False
                recent.clear()
        repeated = previous is not None and np.array_equal(frame, previous)
        previous = frame
        if rest is None or repeated:
            continue
        change = change_of(small, rest)
        is_released = change.max().item() < least
        if not is_released:
            recent.append(Contact(frame, index, change.mean().item()))
            median = sorted(recent, key=lambda contact: contact.firmness)[len(recent) // 2]  # leaves out broken frames
            age += 1
            factor = 1.0 if due else 1.05
            is_firmer = best is None or median.firmness > factor * best.firmness
            if len(recent) == 3 and is_firmer:
                best = median
                due = True
                age = 0
        if due and best is not None and (is_released or age >= SETTLED):
            yield best
            due = False
        if is_released:
            best = None
            recent.clear()
    if rest is None:
        raise SystemExit("The stream ended before the gel was seen at rest.")
    if due and best is not None:
        yield best


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("source", help="index of a camera, or a video file")
    parser.add_argument("--output", type=Path, default=Path("outputs/watched"))
    parser.add_argument("--sensor", help="its name; retrieved from the images if left out")
    parser.add_argument("--bgr", action="store_true", help="frames have blue in the place of red")
    arguments = parser.parse_args()

    frames = camera(arguments.source) if arguments.source.isdecimal() else read_video("source", arguments.source)
    if arguments.bgr:
        frames = (frame[..., ::-1] for frame in frames)
    pipe = unitouch_gen.tiny("touch-to-image")
    pipe.set_progress_bar_config(disable=True)
    arguments.output.mkdir(parents=True, exist_ok=True)
    count = 0
    try:
        for count, contact in enumerate(contacts(frames), 1):
            output = pipe(contact.frame, sensor=arguments.sensor, generator=torch.Generator().manual_seed(0))
            Image.fromarray(contact.frame).save(arguments.output / f"{count}-touch.png")
            output.images[0].save(arguments.output / f"{count}-picture.png")
            print(f"Touch {count}, frame {contact.index}: {output.report.sensors[0]}; {output.report}")
    except KeyboardInterrupt:
        pass
    print(f"{count} touches; see {arguments.output}")


if __name__ == "__main__":
    main()
