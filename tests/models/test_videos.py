"""The frame of firmest contact of recordings whose firmest frame is known."""

import struct
from contextlib import nullcontext

import numpy as np
import pytest
from PIL import Image

from tests.helpers import recordings
from tests.helpers.recordings import FIRMEST
from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.models import UniTouchProcessor
from unitouch_gen.models.videos import Contact, contacts, read_video


def firmest_contact(frames, color="rgb") -> Contact:
    return max(contacts(frames, color), key=lambda contact: contact.firmness)


def test_the_firmest_frame_and_the_gel_at_rest_are_found():
    images = list(recordings.frames())
    contact = firmest_contact(iter(images))
    assert abs(contact.index - FIRMEST) <= 1
    np.testing.assert_array_equal(contact.frame, images[contact.index])
    assert contact.frame.dtype == np.uint8 and abs(contact.background.astype(int) - recordings.rest()).mean() < 1


def test_colours_come_as_red_green_and_blue():
    contact = firmest_contact((frame[..., ::-1] for frame in recordings.frames()), color="bgr")
    np.testing.assert_array_equal(contact.frame, firmest_contact(recordings.frames()).frame)


def test_a_broken_frame_is_not_the_firmest():
    images = list(recordings.frames())
    images[1] = images[FIRMEST + 5] = np.full_like(images[0], 255)
    images[-3] = np.zeros_like(images[0])
    assert abs(firmest_contact(images).index - FIRMEST) <= 1


def test_contacts_settle_once_each():
    whole = len(list(recordings.frames()))
    settled = [contact.index for contact in contacts(recordings.frames(presses=3))]
    assert [abs(index - FIRMEST - number * whole) <= 1 for number, index in enumerate(settled)] == [True] * 3


def test_a_contact_that_gets_firmer_after_a_while_comes_again():
    rest, levels = recordings.rest(), [0] * 6 + [20] * 12 + [40] * 12
    found = list(contacts(np.minimum(rest.astype(int) + level, 255).astype(np.uint8) for level in levels))
    assert [contact.index for contact in found] == [pytest.approx(7, abs=1), pytest.approx(19, abs=1)]
    assert found[1].firmness > 1.5 * found[0].firmness


def test_a_video_is_its_frames_and_a_touch(tmp_path):
    pytest.importorskip("av")
    file, images = tmp_path / "press.mp4", list(recordings.frames())
    recordings.write(file, images)
    assert len(list(read_video("touch", file))) == len(images)
    contact, processor = firmest_contact(file), UniTouchProcessor(image_size=32)
    assert abs(contact.index - FIRMEST) <= 2
    assert abs(contact.frame.astype(int) - images[contact.index]).mean() < 3
    expected = processor.touch([contact.frame, firmest_contact(images).frame])
    assert (processor.touch([file, recordings.frames()]) == expected).all()


@pytest.mark.parametrize(
    ("matrix", "turned"),
    [
        ((0, 1, -1, 0), lambda frame: np.rot90(frame, -1)), ((0, -1, 1, 0), np.rot90), ((-1, 0, 0, 1), np.fliplr),
        ((-1, 0, 0, -1), lambda frame: np.rot90(frame, 2)), ((0, 1, 1, 0), lambda frame: frame.transpose(1, 0, 2)),
    ],
)  # fmt: skip
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


@pytest.mark.parametrize("kind", ["gif", "png", "webp", "tiff", "mp4"])
def test_images_that_move_are_videos_by_any_name(tmp_path, kind):
    """Equal frames are stored as a longer one; they count by their time."""
    images = list(recordings.frames(noise=0.0))
    if kind == "mp4":
        recordings.write(tmp_path / "press.mp4", images)
    else:
        first, *others = map(Image.fromarray, images)
        options = {} if kind == "tiff" else {"duration": 40, "lossless": True}
        first.save(tmp_path / f"press.{kind}", save_all=True, append_images=others, **options)
    file = (tmp_path / f"press.{kind}").rename(tmp_path / "press")
    with nullcontext() if kind == "mp4" else pytest.warns(UserWarning, match=r"contact is used, frame (19|20|21)"):
        found = UniTouchProcessor(image_size=32).touch(file)
    expected = UniTouchProcessor(image_size=32).touch(images[FIRMEST])
    assert (found - expected).abs().mean() < 0.1


def test_what_holds_no_contact_is_refused():
    for images, error, words in (
        ([], InvalidInputError, "shows no contact"),
        ([np.roll(recordings.rest(), 20 * row, 1) for row in range(12)], InvalidInputError, "are alike"),
        ([recordings.rest()] * 20, InvalidInputError, "press while it records"),
        ([recordings.rest(), recordings.rest()[:-8]], InvalidInputError, r"`frames\[1\]` is \(40, 64\) pixels"),
        ([3], InvalidTypeError, r"`frames\[0\]`"),
        (3, InvalidTypeError, "an iterable of frames"),
        (recordings.rest(), InvalidTypeError, "an iterable of frames"),
        ("gone.mp4", InvalidInputError, "does not exist"),
    ):
        with pytest.raises(error, match=words):
            firmest_contact(images)
