"""Data sets whose touches are named or described: ObjectFolder in its forms, SSVTP, HCT."""

import json
from pathlib import Path

import pytest

from tests.helpers.data_sets import BLUE, GREEN, GREY, RED, colour_of, near, shade, write_image
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.training.data import open_dataset

NAMES = ["wood", "steel", "polycarbonate", "plastic", "iron", "ceramic", "glass"]

# ObjectFolder ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def objects(tmp_path: Path) -> Path:
    """Two objects of 1.0 and two of 2.0, with three points each."""
    for item in ("7", "100", "101", "990"):
        for point in range(3):
            write_image(tmp_path / f"touch/{item}/{point}.png", shade(point))
            write_image(tmp_path / f"vision/{item}/{point}.png", shade(10 + point))
    (tmp_path / "label.json").write_text(json.dumps({"7": 0, "100": 6, "101": 3, "990": 1}))
    split = {"train": [["7", 0], ["101", 2]], "val": [["990", 1]], "test": [["100", 0], ["100", 1]]}
    (tmp_path / "split.json").write_text(json.dumps(split))
    return tmp_path


def test_points_have_the_sensor_of_their_version_and_numbers_for_materials(objects: Path) -> None:
    data = open_dataset(objects)
    assert (data.kind, data.materials) == ("object_folder", tuple("0123456"))
    records = {record.id: record for record in data.records}
    assert {name: (r.sensor, r.split, r.labels["material"]) for name, r in records.items()} == {
        "7/0": ("tacto", "train", 0),
        "101/2": ("taxim", "train", 3),
        "990/1": ("taxim", "val", 1),
        "100/0": ("tacto", "test", 6),
        "100/1": ("tacto", "test", 6),
    }
    assert colour_of(records["101/2"].touch.read()) == shade(2)
    assert colour_of(records["101/2"].picture.read()) == shade(12)
    assert [part.sensor for part in data.split("train").by_sensor()] == ["tacto", "taxim"]


def test_materials_may_be_named_by_their_numbers(objects: Path) -> None:
    assert open_dataset(objects, materials=NAMES).materials == tuple(NAMES)
    with pytest.raises(InvalidInputError, match="`materials` names 3 of 7"):
        open_dataset(objects, materials=NAMES[:3])


def test_without_a_split_all_points_are_there(objects: Path) -> None:
    (objects / "split.json").unlink()
    data = open_dataset(objects)
    assert len(data) == 12 and {record.split for record in data.records} == {None}
    assert len(data.split("train").records) == 6  # of two of four objects


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("label.json", {"7": 0, "100": 6, "101": 7, "990": 1}, r"no class for 101/2 \(material 7\)"),
        ("label.json", {"7": "wood", "100": 6, "101": 3, "990": 1}, "label of object '7' is 'wood'"),
        ("label.json", {"7": 0}, "no label for object '101'"),
        ("label.json", [0, 1], "holds a list of 2"),
        ("split.json", {"train": [["7", 0]], "test": [["7", 0]]}, "several records of one id: 7/0"),
        ("split.json", {"train": ["7"]}, r"no list of \[object, point\]"),
        ("split.json", {"train": [["cup", 0]]}, "no label for object 'cup'"),
    ],
)
def test_object_folders_lists_that_cannot_be_meant_are_refused(
    objects: Path, file: str, content: object, message: str
) -> None:
    (objects / file).write_text(json.dumps(content))
    with pytest.raises(InvalidInputError, match=rf"read as object_folder: .*{message}"):
        open_dataset(objects)


def test_objects_that_are_real_have_their_materials_from_a_table(tmp_path: Path) -> None:
    for item in (1, 2, 10):
        for trial in (0, 1):
            for frame in range(2):
                write_image(tmp_path / f"{item}/tactile_data/{trial}/0/gelsight/{frame}.png", shade(item + trial))
    (tmp_path / "objects.csv").write_text("ID;Name;Material\n1;Bowl;Wood\n2;Cup;Ceramic\n10;Fork;\n")
    data = open_dataset(tmp_path)
    assert (data.kind, data.materials, len(data)) == ("object_folder_real", ("ceramic", "wood"), 12)
    assert [record.object for record in data.records[::4]] == ["1", "2", "10"]
    record = data[5]
    assert (record.id, record.sensor, record.recording, record.labels) == ("2/0/1", "gelslim", "2/0", {"material": 0})
    assert colour_of(record.touch.read()) == shade(2) and data[11].labels == {}


# SSVTP and HCT --------------------------------------------------------------------------------------------------------


def test_touches_of_ssvtp_have_their_words(tmp_path: Path) -> None:
    for number in (1, 2, 30):
        write_image(tmp_path / f"images_tac/image_{number}_tac.jpg", shade(number % 16))
        write_image(tmp_path / f"images_rgb/image_{number}_rgb.jpg", shade(number % 16 + 16))
        (tmp_path / "text").mkdir(exist_ok=True)
        (tmp_path / f"text/labels_{number}.txt").write_text(f"smooth, hard, number {number}\n")
    (tmp_path / "train.csv").write_text(
        "url,tactile,caption\nimages_rgb/image_1_rgb.jpg,images_tac/image_1_tac.jpg,x\n"
    )
    (tmp_path / "test.csv").write_text(
        "url,tactile,caption\nimages_rgb/image_30_rgb.jpg,images_tac/image_30_tac.jpg,x\n"
    )
    data = open_dataset(tmp_path)
    assert data.kind == "ssvtp"
    assert [(record.id, record.split) for record in data.records] == [("1", "train"), ("2", None), ("30", "test")]
    assert data[2].caption == "smooth, hard, number 30" and data[2].sensor == "digit"
    assert near(colour_of(data[2].touch.read()), shade(14)) and near(colour_of(data[2].picture.read()), shade(30))
    (tmp_path / "test.csv").write_text("url\nimages_rgb/image_1_rgb.jpg\n")
    with pytest.raises(InvalidInputError, match=r"image_1_rgb\.jpg', which is in another split"):
        open_dataset(tmp_path)
    (tmp_path / "test.csv").write_text("url\nphoto.jpg\n")
    with pytest.raises(InvalidInputError, match=r"'photo\.jpg' is no name of an image of SSVTP"):
        open_dataset(tmp_path)


def write_hct(folder: Path, swapped: tuple[str, ...] = ()) -> None:
    """Two sessions of grey gels that turn a little red, and pictures of many colours."""
    rows = {"train": [], "test": []}
    for session in ("one", "two"):
        tactile, vision = ("vision", "tactile") if session in swapped else ("tactile", "vision")
        write_image(folder / f"data1/{session}/background/0.jpg", GREY)
        for number in range(5):
            write_image(folder / f"data1/{session}/{tactile}/{number}-0.5.jpg", (150 + number, 120, 120))
            write_image(folder / f"data1/{session}/{vision}/{number}-0.5.jpg", (GREEN, BLUE, RED)[number % 3])
            rows["test" if number == 4 else "train"].append(
                f"{session}/vision/{number}-0.5.jpg,{session}/tactile/{number}-0.5.jpg,{session}/background/0.jpg,"
                f'"soft, {number}"'
            )
    for split, lines in rows.items():
        (folder / f"data1/{split}.csv").write_text("\n".join(["url,tactile,tactile_background,caption", *lines]))


@pytest.mark.parametrize("swapped", [(), ("two",), ("one", "two")])
def test_folders_of_hct_that_are_exchanged_are_put_right_and_told(tmp_path: Path, swapped: tuple[str, ...]) -> None:
    write_hct(tmp_path, swapped)
    data = open_dataset(tmp_path)
    assert (data.kind, len(data)) == ("hct", 10)
    for record in data.records:
        number = int(record.id.rpartition("/")[2][0])
        assert near(colour_of(record.touch.read()), (150 + number, 120, 120), 4), record.id
        assert near(colour_of(record.picture.read()), (GREEN, BLUE, RED)[number % 3]), record.id
        assert (record.caption, record.split) == (f"soft, {number}", "test" if number == 4 else "train")
    expected = [f"pictures and touches of {len(swapped)} of 2 sessions lie in each other's folders; exchanged"]
    assert list(data.notes) == (expected if swapped else [])


def test_a_missing_background_of_hct_is_the_sensors(tmp_path: Path) -> None:
    write_hct(tmp_path)
    (tmp_path / "data1/one/background/0.jpg").rename(tmp_path / "data1/digit_background.png")
    assert near(colour_of(open_dataset(tmp_path)[0].background.read()), GREY)
