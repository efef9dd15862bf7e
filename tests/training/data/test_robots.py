"""Data sets that robots and hands have recorded: The Feeling of Success, YCB-Slide, TacQuad."""

import sys
from pathlib import Path

import numpy as np
import pytest

from tests.helpers.data_sets import (
    BLUE,
    GREEN,
    GREY,
    RED,
    colour_of,
    near,
    painted,
    shade,
    write_attempts,
    write_image,
    write_video,
)
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.training.data import open_dataset

# The Feeling of Success -----------------------------------------------------------------------------------------------


def attempt(item: str, lifted: bool, colour: tuple[int, int, int] = RED) -> dict:
    frames = {
        f"gelsight{finger}_{moment}": painted(GREY) for finger in "AB" for moment in ("before", "during", "after")
    }
    frames |= {f"kinectA_rgb_{moment}": painted(GREEN) for moment in ("before", "during", "after")}
    frames |= {"gelsightA_during": painted(colour), "gelsightB_during": painted(BLUE)}
    return {"object_name": np.bytes_(item), "is_gripping": np.bool_(lifted), **frames}


@pytest.fixture
def grasps(tmp_path: Path) -> Path:
    """Twelve attempts with ten objects, in two files."""
    names = [f"object_{number}" for number in range(10)]
    first = [attempt(name, number % 2 == 0, shade(number)) for number, name in enumerate([*names, "object_3"])]
    write_attempts(tmp_path / "calandra_corl2017_000.h5", first)
    write_attempts(tmp_path / "calandra_corl2017_001.h5", [attempt("object_0", True)])
    return tmp_path


def test_each_attempt_is_two_touches_with_a_picture_and_their_backgrounds(grasps: Path) -> None:
    data = open_dataset(grasps)
    assert (data.kind, len(data), data.classes) == ("feeling_of_success", 24, {"grasp": ("dropped", "lifted")})
    for number in range(11):  # i10 comes after i9, not after i1
        left, right = data[2 * number], data[2 * number + 1]
        assert (left.id, right.id, left.recording) == (f"000/i{number}/A", f"000/i{number}/B", right.recording)
        assert colour_of(left.touch.read()) == shade(number) and colour_of(right.touch.read()) == BLUE
        assert colour_of(left.picture.read()) == GREEN and colour_of(right.background.read()) == GREY
        assert left.labels == right.labels == {"grasp": int(number % 2 == 0)}
    assert data[20].object == "object_3" and data[22].object == "object_0"


def test_objects_are_kept_apart_eight_to_one_to_one(grasps: Path) -> None:
    data = open_dataset(grasps)
    parts = {name: {record.object for record in data.split(name).records} for name in ("train", "val", "test")}
    assert {name: len(part) for name, part in parts.items()} == {"train": 8, "val": 1, "test": 1}
    assert len(set.union(*parts.values())) == 10


def test_without_h5py_it_is_said_what_to_install(grasps: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "h5py", None)  # what an import finds where it is not installed
    with pytest.raises(InvalidInputError, match=r"needs the package `h5py`, .* pip install 'unitouch_gen\[train\]'"):
        open_dataset(grasps)


@pytest.mark.parametrize("broken", ["not HDF5", "other values", "a key less"])
def test_a_file_that_is_no_list_of_attempts_is_refused(grasps: Path, broken: str) -> None:
    file = grasps / "calandra_corl2017_001.h5"
    if broken == "not HDF5":
        file.write_bytes(b"gone")
    elif broken == "other values":
        file.unlink()
        write_attempts(file, [{"name": np.bytes_("x")}])
    else:
        less = attempt("object_0", True)
        del less["kinectA_rgb_during"]
        file.unlink()
        write_attempts(file, [less])
    with pytest.raises(InvalidInputError, match=r"_001\.h5' cannot be read as a list of attempts"):
        open_dataset(grasps)


# YCB-Slide ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def slides(tmp_path: Path) -> Path:
    """Two objects with two real recordings each, one of them as a video, and a simulated one."""
    for item, colour in (("004_sugar_box", RED), ("035_power_drill", BLUE)):
        for number in range(11):
            write_image(tmp_path / f"real/{item}/dataset_0/frames/frame_{number:07d}.jpg", colour)
            write_image(tmp_path / f"real/{item}/dataset_0/webcam_frames/frame_{number:07d}.jpg", shade(number))
        write_video(tmp_path / f"real/{item}/dataset_1/frames.mp4", [shade(number) for number in range(6)])
    for number in range(11):
        write_image(tmp_path / f"sim/004_sugar_box/00/tactile_images/{number}.jpg", shade(number))
        write_image(tmp_path / f"sim/004_sugar_box/00/gt_contactmasks/{number}.jpg", RED)
    return tmp_path


def test_recordings_of_slides_have_their_frames_in_order(slides: Path) -> None:
    data = open_dataset(slides)
    assert (data.kind, len(data), data.materials) == ("ycb_slide", 22 + 12 + 11, ("sugar box", "power drill"))
    real, simulated = data.by_sensor()
    assert (real.sensor, simulated.sensor) == ("digit", "tacto")
    for number, record in enumerate(simulated.records):
        assert near(colour_of(record.touch.read()), shade(number)) and record.picture is None
    drill = [record for record in real.records if record.recording == "digit/035_power_drill/dataset_0"]
    for number, record in enumerate(drill):
        assert near(colour_of(record.touch.read()), BLUE) and near(colour_of(record.picture.read()), shade(number))
        assert data.materials[record.labels["material"]] == "power drill"
    video = [record for record in real.records if record.recording == "digit/004_sugar_box/dataset_1"]
    assert len(video) == 6 and near(colour_of(video[4].touch.read()), shade(4)) and video[0].picture is None


def test_recordings_of_slides_are_what_is_kept_apart(slides: Path) -> None:
    train, val = (open_dataset(slides).split(name) for name in ("train", "val"))
    assert not {record.recording for record in train.records} & {record.recording for record in val.records}


@pytest.mark.parametrize(("half", "count"), [("real", 34), ("sim", 11)])
def test_a_half_of_it_is_recognised(slides: Path, half: str, count: int) -> None:
    data = open_dataset(slides / half)
    assert (data.kind, len(data)) == ("ycb_slide", count)


def test_a_recording_without_frames_is_refused(slides: Path) -> None:
    (slides / "real/004_sugar_box/dataset_2").mkdir()
    with pytest.raises(InvalidInputError, match=r"dataset_2' holds no frames"):
        open_dataset(slides)


# TacQuad --------------------------------------------------------------------------------------------------------------


@pytest.fixture
def presses(tmp_path: Path) -> Path:
    """An object under three sensors with recordings of different lengths."""
    for sensor, touches, pictures in (("gelsight", 12, 6), ("digit", 8, 16), ("duragel", 6, 0)):
        for number in range(touches):
            write_image(tmp_path / f"data_indoor/mug/{sensor}/{number}.png", shade(number))
        for number in range(pictures):
            write_image(tmp_path / f"data_indoor/mug/img_{sensor}/{number}.png", shade(20 + number))
    (tmp_path / "contact_indoor.csv").write_text("mug,2,11,0,7,3,4\n")
    return tmp_path


def test_touches_are_paired_with_the_picture_of_the_same_share_of_the_recording(presses: Path) -> None:
    data = open_dataset(presses)
    gelsight, digit, duragel = data.by_sensor()
    assert [part.sensor for part in (gelsight, digit, duragel)] == ["gelsight_mini", "digit", "duragel"]
    assert [len(part) for part in (gelsight, digit, duragel)] == [10, 8, 2]
    for number, record in enumerate(gelsight.records, start=2):
        assert colour_of(record.touch.read()) == shade(number)
        assert colour_of(record.picture.read()) == shade(20 + number // 2)
        assert colour_of(record.background.read()) == shade(0)
    for number, record in enumerate(digit.records):
        assert colour_of(record.picture.read()) == shade(20 + 2 * number) and record.background is None
    assert all(record.picture is None for record in duragel.records)


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("mug,2,12,0,7,3,4", "from frame 2 to 12, but .* has 12 images"),
        ("cup,2,11,0,7,3,4", "has 0 images"),
        ("mug,5,2,0,7,3,4", "from frame 5 to 2"),
        ("mug,2,last,0,7,3,4", "is 'last'; it has to be a whole number"),
        ("mug,2,11,0,7", "other columns in row 1"),
        ("", "no rows"),
    ],
)
def test_contacts_that_cannot_be_meant_are_refused(presses: Path, row: str, message: str) -> None:
    (presses / "contact_indoor.csv").write_text(row)
    with pytest.raises(InvalidInputError, match=message):
        open_dataset(presses)
