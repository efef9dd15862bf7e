"""The frame of firmest contact of recordings whose firmest frame is known."""

from collections import Counter

import numpy as np
import pytest

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


def test_damaged_videos_are_refused_or_their_contact_is_found(tmp_path):
    """Whatever is cut or flipped, and never with another error."""
    pytest.importorskip("av")
    whole = recordings.write(tmp_path / "whole.mp4", list(recordings.frames())).read_bytes()
    rng, file, ended = np.random.default_rng(0), tmp_path / "damaged.mp4", Counter[str]()
    for attempt in range(30):
        damaged = np.frombuffer(whole, np.uint8)[: rng.integers(len(whole)) if attempt % 3 == 0 else None].copy()
        places = rng.integers(len(damaged), size=10 * (attempt % 3)) if len(damaged) else []
        damaged[places] = rng.integers(256, size=len(places))
        file.write_bytes(damaged.tobytes())
        try:
            ended["found"] += firmest_contact(file).firmness > 0
        except InvalidInputError:
            ended["refused"] += 1
    assert ended.total() == 30 and ended["refused"] >= 5 and ended["found"] >= 5
