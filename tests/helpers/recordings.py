"""Recordings of a gel that is pressed, of which the firmest frame is known, as frames and as video files."""

from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np

REST, RISE = 8, 12
"""Frames before a press, and until it is firmest; it goes as it came."""

FIRMEST = REST + RISE


def frames(presses: int = 1, size: tuple[int, int] = (48, 64), noise: float = 1.0) -> Iterator[np.ndarray]:
    """RGB frames of a gel that is pressed and let go, the firmest at `FIRMEST` and every 2 (REST + RISE) after it."""
    rng = np.random.default_rng(0)
    rows, columns = np.mgrid[: size[0], : size[1]] / 16.0
    gel = np.stack([100 + 8 * rows, 120 + 4 * columns, 90 + 0 * rows], axis=2)
    bump = np.exp(-((rows - size[0] / 32) ** 2) - (columns - size[1] / 32) ** 2)[..., None] * [80, -40, 20]
    rise = np.linspace(0, 1, RISE + 1)
    depths = np.concatenate([np.zeros(REST), rise, rise[-2::-1], np.zeros(REST - 1)])
    for depth in np.tile(depths, presses):
        yield (gel + depth * bump + noise * rng.standard_normal(gel.shape)).clip(0, 255).astype(np.uint8)


def rest() -> np.ndarray:
    """The gel without noise."""
    return next(frames(noise=0.0))


def write(file: Path, images: Sequence[np.ndarray], pixel_aspect: int = 1) -> Path:
    """Writes a video of 30 frames a second, of pixels that are as much wider than high."""
    import av

    with av.open(str(file), "w") as container:
        stream = container.add_stream("mpeg4", rate=30)
        stream.height, stream.width = images[0].shape[:2]
        stream.bit_rate, stream.gop_size = 4_000_000, 1
        stream.codec_context.sample_aspect_ratio = Fraction(pixel_aspect)
        for number, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            frame.pts = number
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return file
