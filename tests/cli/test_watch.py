"""`unitouch-gen watch`, and videos as touches, on recordings of presses and a tiny random pipeline."""

import json

import numpy as np
import pytest
from PIL import Image

from tests.helpers import recordings

pytest.importorskip("av")


@pytest.fixture
def video(here) -> str:
    """A video of two touches."""
    recordings.write(here / "press.mp4", list(recordings.frames(presses=2)))
    return "press.mp4"


@pytest.fixture
def watch(command, models):
    """Runs `unitouch-gen watch ...`."""
    return lambda *words: command("watch", *words, "--model", models["touch-to-image"], "--device", "cpu")


def test_every_touch_of_a_video_has_a_picture(video, watch, here, files):
    code, out, err = watch(video, "-o", "out", "--json")
    assert (code, err) == (0, "")
    rows = [json.loads(line) for line in out.splitlines()]
    assert [row["pictures"] for row in rows] == [["out/1-picture.png"], ["out/2-picture.png"]]
    assert files(here / "out") == ["1-picture.png", "1-touch.png", "2-picture.png", "2-touch.png"]
    assert Image.open("out/1-picture.png").size == (16, 16) and Image.open("out/1-touch.png").size == (64, 48)
    assert all(row["sensor"] in ("gelsight", "digit") and len(row["materials"]) == 3 for row in rows)
    assert abs(rows[0]["frame"] - recordings.FIRMEST) <= 2


def test_what_is_there_stays(video, watch, here, files):
    for _ in range(2):
        code, out, _ = watch(video, "-o", "out", "--touches", 1)
        assert code == 0 and "1 touch; they are in" in out and "%" in out
    assert files(here / "out") == ["1-picture.png", "1-touch.png", "2-picture.png", "2-touch.png"]


def test_a_loop_goes_on_until_there_are_enough(video, watch, here, files):
    code, _, err = watch(video, "-o", "out", "--loop", "--touches", 3, "--images", 2, "--steps", 2)
    assert (code, err) == (0, "")
    assert [name for name in files(here / "out") if name.startswith("3")] == [
        "3-picture-1.png", "3-picture-2.png", "3-touch.png",
    ]  # fmt: skip


def test_red_and_blue_may_be_exchanged(here, watch):
    recordings.write(here / "press.mp4", [frame[..., ::-1] for frame in recordings.frames()])
    assert watch("press.mp4", "-o", "out", "--bgr", "--recentre")[0] == 0
    touch = np.asarray(Image.open("out/1-touch.png"), dtype=int)
    assert abs(touch - list(recordings.frames())[recordings.FIRMEST]).mean() < 6


def test_dropped_frames_and_no_quiet_moment_are_told(here, watch):
    images = list(recordings.frames())
    recordings.write(here / "gaps.mp4", images, left_out=(25, 26))
    code, out, err = watch("gaps.mp4", "-o", "out")
    assert code == 0 and err == "unitouch-gen: 2 of 40 frames are missing\n"
    recordings.write(here / "short.mp4", images[:3])
    code, out, err = watch("short.mp4", "-o", "more")
    assert code == 0 and out == "3 frames, 0 touches\n" and "no quiet frames came" in err and err.count("\n") == 1


def test_a_video_is_a_touch_for_other_commands(video, make, here, command, models, files):
    (here / "in" / "press.mp4").write_bytes((here / "press.mp4").read_bytes())
    code, *_ = make("in", "-o", "out")
    assert code == 0 and files(here / "out") == ["bright.png", "dark.png", "press.png"]
    words = ("x-to-touch", "--touch", video, "-o", "touches", "--model", models["x-to-touch"])
    assert command(*words)[0] == 0 and files(here / "touches") == ["press-gelsight.png"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["gone.mp4", "-o", "out"], "`source` names 'gone.mp4', which does not exist"),
        (["in/dark.png", "-o", "out.png"], "`--output` is 'out.png'; name a folder"),
        (["press.mp4", "-o", "x" * 300], "`--output`"),
        (["https://example.org/press.mp4", "-o", "out"], "`source`"),
        (["999999", "-o", "out"], "`source` is '/dev/video999999'"),
        (["0", "-o", "out", "--loop"], "`--loop` came"),
        (["press.mp4", "-o", "out", "--touches", 0], "`--touches` is 0"),
        (["press.mp4", "-o", "out", "--background", "gone.png"], "gone.png"),
        (["press.mp4", "-o", "out", "--sensor", "gelsigt"], "Did you mean 'gelsight'"),
    ],
)
def test_mistakes(video, watch, refused, here, words, said):
    refused(watch(*words), said)
    assert not (here / "out").exists()
