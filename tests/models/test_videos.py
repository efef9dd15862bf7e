"""The frame of firmest contact of recordings whose firmest frame is known."""

import sys
import warnings
from collections import Counter

import numpy as np
import pytest

from tests.helpers import recordings
from tests.helpers.recordings import FIRMEST
from unitouch_gen import firmest_contact
from unitouch_gen.errors import DroppedFramesWarning, InvalidInputError, InvalidTypeError
from unitouch_gen.models import UniTouchProcessor
from unitouch_gen.models.videos import ContactTracker, read_video


def test_the_firmest_frame_and_the_gel_at_rest_are_found():
    contact = firmest_contact(recordings.frames())
    assert abs(contact.index - FIRMEST) <= 1 and contact.frames == len(list(recordings.frames()))
    np.testing.assert_array_equal(contact.frame, list(recordings.frames())[contact.index])
    assert abs(contact.background.astype(int) - recordings.rest()).mean() < 1
    assert contact.dropped == 0 and contact.frame.dtype == np.uint8


def test_firmness_is_how_much_the_whole_image_differs():
    images = list(recordings.frames(noise=0.0))
    contact = firmest_contact(images)
    expected = abs(images[contact.index].astype(float) - images[0]).mean() / 255
    assert contact.firmness == pytest.approx(expected, rel=0.05)


def test_colours_come_as_red_green_and_blue():
    contact = firmest_contact((frame[..., ::-1] for frame in recordings.frames()), color="bgr")
    np.testing.assert_array_equal(contact.frame, firmest_contact(recordings.frames()).frame)


def test_a_broken_frame_is_not_the_firmest():
    images = list(recordings.frames())
    images[1] = images[FIRMEST + 5] = np.full_like(images[0], 255)
    images[-3] = np.zeros_like(images[0])
    assert abs(firmest_contact(images).index - FIRMEST) <= 1


def test_an_array_that_is_written_again_and_again_is_not_the_last_frame():
    buffer = np.empty_like(recordings.rest())

    def camera():
        for frame in recordings.frames():
            buffer[:] = frame
            yield buffer

    np.testing.assert_array_equal(firmest_contact(camera()).frame, firmest_contact(recordings.frames()).frame)


def test_a_background_may_be_given():
    pressed = list(recordings.frames())[FIRMEST - 3 : FIRMEST + 4]
    contact = firmest_contact(pressed, background=recordings.rest())
    assert abs(contact.index - 3) <= 1


def test_dropped_frames_are_counted_and_told():
    images = [None if number in (3, 12) else frame for number, frame in enumerate(recordings.frames())]
    with pytest.warns(DroppedFramesWarning, match="2 of 40 frames are missing"):
        contact = firmest_contact(images)
    assert contact.dropped == 2 and abs(contact.index - FIRMEST) <= 1


def test_contacts_settle_once_each():
    tracker = ContactTracker()
    settled = [seen.contact.index for seen in map(tracker.update, recordings.frames(presses=3)) if seen.settled]
    whole = len(list(recordings.frames()))
    assert [abs(index - FIRMEST - number * whole) <= 1 for number, index in enumerate(settled)] == [True] * 3


def test_a_video_is_its_frames(tmp_path):
    pytest.importorskip("av")
    file = recordings.write(tmp_path / "press.mp4", list(recordings.frames()))
    assert len(list(read_video("touch", file))) == len(list(recordings.frames()))
    contact = firmest_contact(file)
    assert abs(contact.index - FIRMEST) <= 2 and contact.dropped == 0
    assert abs(contact.frame.astype(int) - list(recordings.frames())[contact.index]).mean() < 3


def test_gaps_between_timestamps_are_dropped_frames(tmp_path):
    pytest.importorskip("av")
    file = recordings.write(tmp_path / "press.mp4", list(recordings.frames()), left_out=(12, 13, 30))
    with pytest.warns(DroppedFramesWarning, match="3 of 40 frames are missing"):
        contact = firmest_contact(file)
    assert contact.dropped == 3 and abs(contact.index - FIRMEST) <= 2


def test_a_processor_takes_recordings_for_touches(tmp_path):
    processor = UniTouchProcessor(image_size=32)
    expected = processor.touch(firmest_contact(recordings.frames()).frame)
    assert (processor.touch(recordings.frames()) == expected).all()
    both = processor.touch([recordings.frames(), firmest_contact(recordings.frames()).frame])
    assert (both == expected.expand_as(both)).all()


MOVING = [np.roll(recordings.rest(), 20 * number, axis=1) for number in range(12)]


@pytest.mark.parametrize(
    ("images", "words"),
    [
        ([], "holds no frames"),
        ([None] * 3, "holds no frames"),
        ([recordings.rest()] * 4, "holds no 5 frames in a row that are alike"),
        (MOVING, "begin to record before you press"),
        ([recordings.rest()] * 20, "shows no contact"),
        ([recordings.rest()] * 8 + [255 - recordings.rest()] * 2 + [recordings.rest()] * 8, "shows no contact"),
        ([recordings.rest(), recordings.rest()[:-8]], r"`frames\[1\]` is 64 x 40 pixels"),
        ([recordings.rest(), np.zeros((4, 4, 3), np.uint8)], "need at least"),
    ],
)
def test_what_holds_no_contact_is_refused(images, words):
    with pytest.raises(InvalidInputError, match=words):
        firmest_contact(images)


def test_what_are_no_frames_is_refused(tmp_path):
    (tmp_path / "notes.mp4").write_text("This is no video.")
    with pytest.raises(InvalidInputError, match="cannot be read as a video"):
        firmest_contact(tmp_path / "notes.mp4")
    with pytest.raises(InvalidInputError, match="does not exist"):
        UniTouchProcessor(image_size=32).touch("gone.mp4")
    for wrong in (3, recordings.rest(), b"abc"):
        with pytest.raises(InvalidTypeError, match="an iterable of frames"):
            firmest_contact(wrong)
    with pytest.raises(InvalidTypeError, match=r"`frames\[0\]`"):
        firmest_contact([3])
    with pytest.raises(InvalidInputError, match="has to be one of 'rgb', 'bgr'"):
        firmest_contact([], color="gbr")


def test_damaged_videos_are_refused_or_their_contact_is_found(tmp_path):
    """Whatever is cut or flipped, and never with another error."""
    pytest.importorskip("av")
    whole = recordings.write(tmp_path / "whole.mp4", list(recordings.frames())).read_bytes()
    rng, file, ended = np.random.default_rng(0), tmp_path / "damaged.mp4", Counter[str]()
    for attempt in range(60):
        damaged = np.frombuffer(whole, np.uint8)[: rng.integers(len(whole)) if attempt % 3 == 0 else None].copy()
        places = rng.integers(len(damaged), size=10 * (attempt % 3)) if len(damaged) else []
        damaged[places] = rng.integers(256, size=len(places))
        file.write_bytes(damaged.tobytes())
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DroppedFramesWarning)
                contact = firmest_contact(file)
        except InvalidInputError:
            ended["refused"] += 1
        else:
            ended["found"] += contact.frame.ndim == 3 and contact.firmness > 0
    assert ended.total() == 60
    assert ended["refused"] >= 10 and ended["found"] >= 10


def test_a_video_without_pyav_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    (tmp_path / "press.mp4").touch()
    with pytest.raises(InvalidInputError, match=r"pip install 'unitouch_gen\[train\]'"):
        firmest_contact(tmp_path / "press.mp4")
