"""A folder of one's own: tables of all kinds, and folders named by materials."""

import csv
import io
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.helpers.data_sets import BLUE, GREEN, GREY, RED, colour_of, near, write_image
from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.files import natural
from unitouch_gen.training.data import KINDS, open_dataset
from unitouch_gen.training.data.reading import read_table

TABLE = """touch,picture,background,sensor,material,object,caption,split,hardness
a.png,b.png,rest.png,digit,wood,one,"rough, and hard",train,2
b.png,,rest.png,gelsight,glass,two,smooth,test,-1
c.png,b.png,,digit,,three,,train,0
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, colour in (("a", RED), ("b", GREEN), ("c", BLUE), ("rest", GREY)):
        write_image(tmp_path / f"{name}.png", colour)
    (tmp_path / "labels.csv").write_text(TABLE)
    return tmp_path


def test_a_table_says_all_there_is_to_say_of_its_files(folder: Path) -> None:
    data = open_dataset(folder)
    assert data.kind == "folder" and data.classes == {"material": ("glass", "wood"), "hardness": ("0", "1", "2")}
    first, second, third = data.records
    assert [colour_of(frame.read()) for frame in (first.touch, first.picture, first.background)] == [RED, GREEN, GREY]
    assert (first.id, first.sensor, first.object, first.caption) == ("a.png", "digit", "one", "rough, and hard")
    assert (first.labels, second.labels, third.labels) == (
        {"material": 1, "hardness": 2},
        {"material": 0},
        {"hardness": 0},
    )
    assert (second.picture, third.background, third.caption, third.split) == (None, None, None, "train")
    assert [len(part) for part in data.by_sensor()] == [2, 1]


@pytest.mark.parametrize("change", ["semicolons", "tabs", "a byte order mark", "another name", "capitals"])
def test_tables_of_other_programs_are_read(folder: Path, change: str) -> None:
    expected = open_dataset(folder).records
    rows = list(csv.reader(io.StringIO(TABLE)))
    if change == "another name":
        rows[0][0] = "File"
    if change == "capitals":
        rows[0] = [name.upper() for name in rows[0]]
    file = io.StringIO()
    csv.writer(file, delimiter={"semicolons": ";", "tabs": "\t"}.get(change, ",")).writerows(rows)
    text = file.getvalue()
    (folder / "labels.csv").write_text(text, encoding="utf-8-sig" if change == "a byte order mark" else "utf-8")
    assert open_dataset(folder).records == expected


def test_files_may_follow_from_patterns_over_the_columns(tmp_path: Path) -> None:
    for clip in ("mug_0", "pen_1"):
        write_image(tmp_path / f"{clip}_peak.jpg", RED if clip == "mug_0" else BLUE)
        write_image(tmp_path / f"{clip}_bg.jpg", GREY)
    (tmp_path / "labels.csv").write_text("clip,object,material\nmug_0,mug,ceramic\npen_1,pen,plastic\n")
    patterns = {"touch": "{clip}_peak.jpg", "background": "{clip}_bg.jpg"}
    data = open_dataset(tmp_path, sensor="gelsight", patterns=patterns)
    assert near(colour_of(data[1].touch.read()), BLUE) and near(colour_of(data[1].background.read()), GREY)
    assert (set(data.classes), data[1].object, data[1].sensor) == ({"material"}, "pen", "gelsight")
    with pytest.raises(InvalidInputError, match=r"`patterns` is .*the columns of labels\.csv are \['clip'"):
        open_dataset(tmp_path, patterns={"touch": "{clap}_peak.jpg"})


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("tuoch,material\na.png,wood\n", r"has the columns \['tuoch', 'material'\], .* Did you mean 'touch'"),
        ("touch,material\na.png,wood\na.png,wood\n", r"several records of one id: a\.png"),
        ("id,touch\n1,a.png\n1,b.png\n", "several records of one id: 1"),
        ("touch\na.png\nd.png\n", r"names files that are not there: .*d\.png"),
        ("touch,split\na.png,training\n", r"splits other than \('train', 'val', 'test'\): \{'training'\}"),
        ("touch,hardness\na.png,-2\n", "has hardness -2; number classes from 0"),
        ("touch,hardness\na.png,1000\n", "has hardness 1000; number classes from 0"),
        ("touch,material\na.png,wood,hard\n", "other columns in row 1"),
        ("touch,touch\na.png,b.png\n", "two of one name"),
        ("touch\n", "no rows"),
        ("", "no rows"),
    ],
)  # fmt: skip
def test_tables_that_cannot_be_meant_are_refused(folder: Path, table: str, message: str) -> None:
    (folder / "labels.csv").write_text(table)
    with pytest.raises(InvalidInputError, match=message):
        open_dataset(folder)


@pytest.mark.parametrize("encoding", ["utf-16", "latin-1"])
def test_a_table_in_another_encoding_is_refused(folder: Path, encoding: str) -> None:
    (folder / "labels.csv").write_bytes(TABLE.replace("rough", "f\u00fcr").encode(encoding))
    with pytest.raises(InvalidInputError, match="not in UTF-8; save it as UTF-8"):
        open_dataset(folder)


def test_two_tables_are_refused(folder: Path) -> None:
    (folder / "more.csv").write_text(TABLE)
    with pytest.raises(InvalidInputError, match=r"2 tables, labels\.csv; more\.csv; leave one"):
        open_dataset(folder)


CELLS = st.text(st.characters(exclude_categories=("C", "Z"), exclude_characters="\ufeff"), min_size=1, max_size=12)


@settings(max_examples=50, deadline=None)
@given(rows=st.lists(st.tuples(CELLS, CELLS), min_size=1, max_size=6), delimiter=st.sampled_from(",;\t"))
def test_a_table_is_read_as_it_was_written(
    rows: list, delimiter: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    file = tmp_path_factory.mktemp("table") / "table.csv"
    with file.open("w", newline="", encoding="utf-8") as stream:
        csv.writer(stream, delimiter=delimiter).writerows([("one", "two"), *rows])
    assert read_table(file) == [{"one": one, "two": two} for one, two in rows]


@given(st.lists(st.integers(0, 10**6), unique=True))
def test_numbers_in_names_are_in_order(numbers: list[int]) -> None:
    assert sorted((f"frame{n}.png" for n in numbers), key=natural) == [f"frame{n}.png" for n in sorted(numbers)]


# Without a table ------------------------------------------------------------------------------------------------------


def test_folders_are_named_by_materials_in_folders_named_by_splits(tmp_path: Path) -> None:
    for split, material, colour in (("train", "wood", RED), ("train", "glass", GREEN), ("test", "wood", BLUE)):
        write_image(tmp_path / split / material / "1.png", colour)
    data = open_dataset(tmp_path)
    found = {r.id: (data.materials[r.labels["material"]], r.split, colour_of(r.touch.read())) for r in data.records}
    assert found == {
        "train/wood/1.png": ("wood", "train", RED),
        "train/glass/1.png": ("glass", "train", GREEN),
        "test/wood/1.png": ("wood", "test", BLUE),
    }


def test_pictures_and_backgrounds_may_lie_in_trees_of_their_own(tmp_path: Path) -> None:
    for number in (2, 10):
        write_image(tmp_path / f"touch/wood/{number}.png", RED)
        write_image(tmp_path / f"picture/wood/{number}.png", GREEN)
    write_image(tmp_path / "background/wood/2.png", BLUE)
    write_image(tmp_path / "touch/wood/background.png", GREY)
    two, ten = open_dataset(tmp_path).records
    assert (two.id, ten.id) == ("wood/2.png", "wood/10.png") and two.labels == {"material": 0}
    assert colour_of(two.picture.read()) == GREEN
    assert (colour_of(two.background.read()), colour_of(ten.background.read())) == (BLUE, GREY)


def test_images_without_folders_have_no_materials(tmp_path: Path) -> None:
    write_image(tmp_path / "b.PNG", RED)
    write_image(tmp_path / ".hidden.png", RED)
    (tmp_path / "notes.txt").touch()
    (record,) = open_dataset(tmp_path).records
    assert (record.id, record.labels, record.split) == ("b.PNG", {}, None)


# Which data set it is -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda path: None, "which is not there"),
        (lambda path: path.mkdir(), "which is empty"),
        (lambda path: path.touch(), "which is a file; unpack it"),
        (lambda path: (path / "notes").mkdir(parents=True), "has no table and no images, but the folders notes"),
    ],
)
def test_what_is_no_data_set_is_refused(tmp_path: Path, make: object, message: str) -> None:
    make(tmp_path / "touches.zip")
    with pytest.raises(InvalidInputError, match=rf"`path` is .*touches\.zip', .*{message}"):
        open_dataset(tmp_path / "touches.zip")


def test_a_folder_that_looks_like_two_data_sets_needs_its_kind(folder: Path) -> None:
    (folder / "label.json").write_text("{}")
    write_image(folder / "images_tac/image_1_tac.jpg", RED)
    with pytest.raises(InvalidInputError, match="looks like object_folder and ssvtp; say its `kind`"):
        open_dataset(folder)
    assert open_dataset(folder, "ssvtp").kind == "ssvtp"


def test_an_unknown_kind_is_refused_with_those_there_are(folder: Path) -> None:
    with pytest.raises(InvalidInputError, match=r"`kind` is 'touch_and_goo'.*Did you mean 'touch_and_go'"):
        open_dataset(folder, "touch_and_goo")
    assert len(KINDS) == 9


@pytest.mark.parametrize("argument", ["path", "sensor", "materials", "bgr", "patterns"])
def test_arguments_of_another_kind_are_refused_by_name(folder: Path, argument: str) -> None:
    with pytest.raises(InvalidTypeError, match=f"`{argument}` is a tensor"):
        open_dataset(**{"path": folder, argument: torch.zeros(2)})


def test_patterns_are_refused_where_there_is_no_table_to_read(tmp_path: Path) -> None:
    write_image(tmp_path / "images_tac/image_1_tac.jpg", RED)
    with pytest.raises(InvalidInputError, match=r"`patterns` are for folders with a table, .* is read as ssvtp"):
        open_dataset(tmp_path, patterns={"touch": "{id}.jpg"})


def test_touches_that_are_stored_blue_first_are_turned(folder: Path) -> None:
    data = open_dataset(folder, bgr=True)
    red, green, blue = RED
    assert colour_of(data[0].touch.read()) == (blue, green, red) and colour_of(data[0].picture.read()) == GREEN


# What lies beside touches ---------------------------------------------------------------------------------------------


def test_pictures_and_backgrounds_go_by_their_names_whatever_the_endings(tmp_path: Path) -> None:
    files = {"touch/wood/1.png": RED, "touch/wood/2.png": RED, "background/wood/1.bmp": GREY}
    files |= {"picture/wood/1.jpg": GREEN, "picture/wood/2.jpg": BLUE, "picture/wood/2.png": GREEN}
    for name, colour in files.items():
        write_image(tmp_path / name, colour)
    data = open_dataset(tmp_path)
    assert all(near(colour_of(record.picture.read()), GREEN) for record in data.records if record.picture)
    assert [record.background is not None for record in data.records] == [True, False]
    assert data.notes == ("1 of 3 pictures have no touch of their name and are not read: picture/wood/2.jpg",)


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (["touch/1.png", "photos/1.png"], "Its folders photos are not read; photos of what is touched go into"),
        (["touch/1.png", "picture/wood/1.png"], "1 of 1 pictures have no touch of their name"),
        (["touches/1.png", "Photos/1.png"], "The images in Photos are taken for touches; if they are none"),
        (["1.png", "picture/1.png"], "The images in picture are taken for touches"),
    ],
)
def test_pictures_that_are_not_read_or_taken_for_touches_are_told(tmp_path: Path, names: list[str], said: str) -> None:
    for name in names:
        write_image(tmp_path / name, RED)
    (note,) = open_dataset(tmp_path).notes
    assert said in note


def test_touches_that_are_alike_but_for_their_endings_are_two(tmp_path: Path) -> None:
    for name in ("1.png", "1.jpg", "wood/1.png"):
        write_image(tmp_path / name, RED)
    data = open_dataset(tmp_path)
    assert [record.id for record in data.records] == ["1.jpg", "1.png", "wood/1.png"] and not data.notes
