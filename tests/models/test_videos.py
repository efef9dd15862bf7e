"""The frame of firmest contact of recordings whose firmest frame is known."""

import struct

import numpy as np
import pytest
import torch

from tests.helpers import recordings
from tests.helpers.recordings import FIRMEST
from unitouch_gen.errors import UnfamiliarInputWarning
from unitouch_gen.models import UniTouchProcessor
from unitouch_gen.models.videos import firmest, read_video


def place_of_firmest(images: list[np.ndarray]) -> int:
    found = firmest("touch", iter(images)).permute(1, 2, 0).numpy()
    return next(index for index, image in enumerate(images) if np.array_equal(image, found))


def test_the_firmest_frame_is_found_and_is_not_a_broken_one():
    images = list(recordings.frames(presses=2))
    assert abs(place_of_firmest(images) % 40 - FIRMEST) <= 1
    images[1] = images[FIRMEST + 5] = np.full_like(images[0], 255)
    images[-3] = np.zeros_like(images[0])
    assert abs(place_of_firmest(images) % 40 - FIRMEST) <= 1


def green(image: np.ndarray, top: int = 0) -> np.ndarray:
    """A frame whose rows from `top` on are Y = U = V = 0 in RGB (ITU-R BT.601)."""
    rows = np.arange(len(image))[:, None, None]
    return np.where(rows < top, image, [0, 135, 0]).astype(np.uint8)


def test_black_green_and_frozen_frames_are_no_contacts():
    images = list(recordings.frames())
    garbage = np.random.default_rng(1).integers(0, 256, images[0].shape, dtype=np.uint8)
    black = np.zeros_like(garbage)
    for before, after in (
        ([black] * 6, []),
        ([], [black] * 6),
        ([green(images[0])] * 6, [green(images[0], top=24)] * 6),
        ([garbage] * 9, []),
        ([], [green(images[0], top=44), *[garbage] * 9]),
    ):
        found = place_of_firmest([*before, *images, *after]) - len(before)
        assert abs(found - FIRMEST) <= 1


def test_a_simulation_without_noise_is_not_frozen():
    images = list(recordings.frames(noise=0.0))
    held = [*images[:FIRMEST], *[images[FIRMEST]] * 10, *images[FIRMEST:]]
    assert FIRMEST <= place_of_firmest(held) < FIRMEST + 10


def test_the_gel_at_rest_is_found_wherever_it_is_in_a_recording():
    images = list(recordings.frames())
    rest = images[:8]
    rise = images[8:FIRMEST]
    held = list(recordings.frames(presses=6))[FIRMEST::40]
    for order in ([held, rise[::-1], rest], [rest, rise, held], [held, rise[::-1], rest, rise, held]):
        recording = [image for part in order for image in part]
        assert np.abs(recording[place_of_firmest(recording)] - images[FIRMEST].astype(int)).mean() < 3


def test_the_firmest_of_many_presses_is_found():
    """Of more frames than are held in memory."""
    strong = 2 * np.array(list(recordings.frames(noise=0.0)), dtype=int) - recordings.rest()
    presses = [recordings.frames(presses=3), iter(strong.clip(0, 255).astype(np.uint8)), recordings.frames(presses=3)]
    assert abs(place_of_firmest([image for part in presses for image in part]) - 120 - FIRMEST) <= 1


def test_a_recording_that_does_not_tell_what_rests_is_named():
    """Two looks of the same structure: one is brighter."""
    rest = recordings.rest()
    other = rest + np.uint8(20)
    noise = np.random.default_rng(0).integers(0, 2, (12, *rest.shape), dtype=np.uint8)
    with pytest.warns(UnfamiliarInputWarning, match=r"`touch` does not show which .* frame \d+.*\. Record the gel"):
        firmest("touch", iter([*(noise[:6] + rest), *(noise[6:] + other)]))


def test_a_video_is_its_frames_and_a_touch(tmp_path):
    pytest.importorskip("av")
    file = tmp_path / "press.mp4"
    images = list(recordings.frames())
    recordings.write(file, images)
    assert len(list(read_video("touch", file))) == len(images)
    found = firmest("touch", file)
    processor = UniTouchProcessor(image_size=32)
    assert found.dtype == torch.uint8
    assert abs(found.permute(1, 2, 0).numpy().astype(int) - images[FIRMEST]).mean() < 3
    expected = processor.touch([found, images[place_of_firmest(images)]])
    assert (processor.touch([file, recordings.frames()]) == expected).all()


@pytest.mark.parametrize(
    ("matrix", "turned"),
    [
        ((0, 1, -1, 0), lambda frame: np.rot90(frame, -1)),
        ((0, -1, 1, 0), np.rot90),
        ((-1, 0, 0, -1), lambda frame: np.rot90(frame, 2)),
    ],
)
def test_a_video_is_turned_as_its_container_says(tmp_path, matrix, turned):
    """And its name is no address."""
    pytest.importorskip("av")
    file = recordings.write(tmp_path / "10:30 [a].mp4", list(recordings.frames()))
    stored = list(read_video("touch", file))
    content, (a, b, c, d) = file.read_bytes(), (struct.pack(">i", value << 16) for value in matrix)
    at = content.index(b"tkhd") + 44  # the first two rows of the track's display matrix: ISO/IEC 14496-12, 8.3.2
    file.write_bytes(content[:at] + a + b + bytes(4) + c + d + content[at + 20 :])
    for one, other in zip(read_video("touch", file), stored, strict=True):
        np.testing.assert_array_equal(one, turned(other))


def test_pixels_of_a_video_are_made_square(tmp_path):
    file = recordings.write(tmp_path / "wide.mkv", list(recordings.frames()), pixel_aspect=2)
    assert next(read_video("touch", file)).shape == (48, 128, 3)
