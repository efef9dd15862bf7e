"""Data sets as they are published, and folders of one's own: a small tree in each layout, and broken ones."""

import shutil
import unicodedata
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.helpers.data_sets import painted, shade, write_attempts, write_image
from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.training.data import RecordSet, open_dataset
from unitouch_gen.training.data.records import Frame

ONE, TWO, THREE = "20220601_182052", "20220602_101010", "20220603_090000"


def write(folder: Path, files: dict) -> None:
    """Images of the colours of numbers, and texts; a folder of no content is removed."""
    for name, content in files.items():
        if content is None:
            shutil.rmtree(folder / name)
        elif isinstance(content, int):
            write_image(folder / name, shade(content))
        else:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(content)


def number_of(frame: Frame | None) -> int | None:
    """The number of the colour that an image was written with, also where compression has changed it a little."""
    if frame is None:
        return None
    colour = frame.read().float().mean(dim=(1, 2)).numpy()
    return int(np.argmin([np.abs(colour - shade(number)).sum() for number in range(64)]))


def told(data: RecordSet) -> list[str]:
    """Of each record: id, numbers of touch, picture and background, sensor, object, recording, split, and classes."""
    lines = []
    for record in data.records:
        numbers = [number_of(frame) for frame in (record.touch, record.picture, record.background)]
        labels = [f"{label}={data.classes[label][number]}" for label, number in record.labels.items()]
        words = [record.id, *numbers, record.sensor, record.object, record.recording, record.split, *labels]
        lines.append(" ".join("-" if word is None else str(word) for word in words))
    return lines


def touch_and_go(folder: Path) -> None:
    for number, recording in enumerate((ONE, TWO, THREE)):
        for frame in range(3):
            write(folder, {f"dataset/{recording}/gelsight_frame/{frame:010d}.jpg": 10 * number + frame,
                           f"dataset/{recording}/video_frame/{frame:010d}.jpg": 40 + frame})  # fmt: skip
    first, third = f"{ONE}/0000000000.jpg", f"{TWO}/0000000002.jpg"
    label = f"{first},3\n{ONE}/0000000001.jpg,-1\n{third}, 7\n{THREE}/0000000001.jpg,19\n"
    write(folder, {"label.txt": label, "train.txt": f"{first},3\n", "test.txt": f"{third},7\n",
                   "train_rough.txt": f"{first},1\n", "test_rough.txt": f"{third},-1\n"})  # fmt: skip


def feeling_of_success(folder: Path) -> None:
    """Eleven attempts, so that i10 comes after i9, and one in another file."""

    def attempt(number: int) -> dict:
        numbers = {"gelsightA_during": number, "gelsightB_during": 20 + number, "kinectA_rgb_during": 40 + number}
        arrays = {name: painted(shade(at)) for name, at in numbers.items()}
        arrays |= {f"gelsight{finger}_before": painted(shade(60)) for finger in "AB"}
        return {"object_name": np.bytes_(f"object_{number}"), "is_gripping": np.bool_(number % 2 == 0), **arrays}

    write_attempts(folder / "calandra_corl2017_000.h5", [attempt(number) for number in range(11)])
    write_attempts(folder / "calandra_corl2017_001.h5", [attempt(12)])


def ycb_slide(folder: Path) -> None:
    run = "real/035_drill/dataset_0"
    write(folder, {f"sim/004_box/00/tactile_images/{number}.jpg": number for number in (2, 10)})
    write(folder, {f"{run}/frames/frame_7.jpg": 1, f"{run}/webcam_frames/frame_7.jpg": 2})
    write(folder, {f"real/004_box/dataset_1/frames/frame_{number}.jpg": 20 + number for number in (0, 1)})


def object_folder(folder: Path) -> None:
    for number, item in enumerate(("7", "101")):
        write(folder, {f"touch/{item}/{point}.png": point + 2 * number for point in range(2)})
        write(folder, {f"vision/{item}/{point}.png": 10 + point + 2 * number for point in range(2)})
    write(folder, {"label.json": '{"7": 0, "101": 6}', "split.json": '{"train": [["7", 0]], "test": [["101", 1]]}'})


def object_folder_real(folder: Path) -> None:
    write(folder, {f"{item}/tactile_data/3/0/gelsight/{at}.png": at for item, at in (("1", 2), ("1", 10), ("2", 0))})
    write(folder, {"objects.csv": "ID;Name;Material\n1;Bowl;Wood\n2;Fork;\n"})


def ssvtp(folder: Path) -> None:
    for number in (1, 2, 30):
        write(folder, {f"images_tac/image_{number}_tac.jpg": number, f"images_rgb/image_{number}_rgb.jpg": 10 + number,
                       f"text/labels_{number}.txt": f"smooth, number {number}\n"})  # fmt: skip
    write(folder, {f"{split}.csv": f"url,tactile\nimages_rgb/image_{number}_rgb.jpg,x\n"
                   for split, number in (("train", 1), ("test", 30))})  # fmt: skip


def hct(folder: Path) -> None:
    rows = ["url,tactile,tactile_background,caption"]
    for session in ("one", "two"):
        write(folder, {f"data1/{session}/background/0.jpg": 0})
        for number in range(3):
            write(folder, {f"data1/{session}/tactile/{number}-0.5.jpg": 1 + number % 2,
                           f"data1/{session}/vision/{number}-0.5.jpg": 63 - number})  # fmt: skip
            picture, touch = (f"{session}/{place}/{number}-0.5.jpg" for place in ("vision", "tactile"))
            rows.append(f'{picture},{touch},{session}/background/0.jpg,"soft, {number}"')
    write(folder, {"data1/train.csv": "\n".join(rows)})


def tacquad(folder: Path) -> None:
    for sensor, touches, pictures in (("gelsight", 12, 6), ("digit", 2, 4), ("duragel", 6, 0)):
        write(folder, {f"data_indoor/mug/{sensor}/{number}.png": number for number in range(touches)})
        write(folder, {f"data_indoor/mug/img_{sensor}/{number}.png": 20 + number for number in range(pictures)})
    write(folder, {"contact_indoor.csv": "mug,10,11,0,1,3,3\n"})


def table(folder: Path) -> None:
    rows = ("touch,picture,background,sensor,material,object,caption,split,hardness",
            'a.png,b.png,c.png,digit,wood,one,"rough, and hard",train,2',
            "b.png,,c.png,gelsight,glass,two,smooth,test,-1", "c.png,b.png,,digit,,three,,train,10")  # fmt: skip
    write(folder, {"a.png": 0, "b.png": 1, "c.png": 2, "labels.csv": "\n".join(rows)})


def tree(folder: Path) -> None:
    write(folder, {"touch/wood/2.png": 2, "touch/wood/10.png": 10, "touch/wood/background.png": 40, "touch/11.png": 11,
                   "picture/wood/2.jpg": 20, "picture/wood/10.png": 30, "background/wood/2.bmp": 41})  # fmt: skip


def tree_of_splits(folder: Path) -> None:
    write(folder, {"train/wood/1.png": 0, "train/glass/1.PNG": 1, "test/wood/1.png": 2, "test/wood/.hidden.png": 3})


def tree_of_objects(folder: Path) -> None:
    write(
        folder, {"Train/wood/plank/1.png": 1, "Train/wood/2.png": 2, "VALID/glass/jar/3.png": 3, "test/glass/4.png": 4}
    )


LAYOUTS: dict[Callable, tuple[int, str]] = {
    touch_and_go: (3, f"""
        {ONE}/0000000000.jpg 0 40 - gelsight - {ONE} train material=wood soft=hard rough=rough
        {TWO}/0000000002.jpg 12 42 - gelsight - {TWO} test material=leather soft=soft
        {THREE}/0000000001.jpg 21 41 - gelsight - {THREE} - material=others soft=hard"""),
    feeling_of_success: (24, """
        000/i2/A 2 42 60 gelsight object_2 000/i2 - grasp=lifted
        000/i2/B 22 42 60 gelsight object_2 000/i2 - grasp=lifted
        000/i9/A 9 49 60 gelsight object_9 000/i9 - grasp=dropped
        000/i10/A 10 50 60 gelsight object_10 000/i10 - grasp=lifted
        001/i0/B 32 52 60 gelsight object_12 001/i0 - grasp=lifted"""),
    ycb_slide: (5, """
        digit/004_box/dataset_1/frame_0.jpg 20 - - digit 004_box digit/004_box/dataset_1 - material=box
        digit/004_box/dataset_1/frame_1.jpg 21 - - digit 004_box digit/004_box/dataset_1 - material=box
        digit/035_drill/dataset_0/frame_7.jpg 1 2 - digit 035_drill digit/035_drill/dataset_0 - material=drill
        tacto/004_box/00/2.jpg 2 - - tacto 004_box tacto/004_box/00 - material=box
        tacto/004_box/00/10.jpg 10 - - tacto 004_box tacto/004_box/00 - material=box"""),
    object_folder: (2, """
        7/0 0 10 - tacto 7 - train material=0
        101/1 3 13 - taxim 101 - test material=6"""),
    object_folder_real: (3, """
        1/3/2 2 - - gelslim 1 1/3 - material=wood
        1/3/10 10 - - gelslim 1 1/3 - material=wood
        2/3/0 0 - - gelslim 2 2/3 -"""),
    ssvtp: (3, """
        1 1 11 - digit - - train
        2 2 12 - digit - - -
        30 30 40 - digit - - test"""),
    hct: (6, """
        data1/one/tactile/0-0.5.jpg 1 63 0 digit - data1/one train
        data1/one/tactile/1-0.5.jpg 2 62 0 digit - data1/one train
        data1/two/tactile/2-0.5.jpg 1 61 0 digit - data1/two train"""),
    tacquad: (5, """
        data_indoor/mug/gelsight/10 10 25 0 gelsight_mini mug data_indoor/mug/gelsight -
        data_indoor/mug/gelsight/11 11 25 0 gelsight_mini mug data_indoor/mug/gelsight -
        data_indoor/mug/digit/1 1 22 - digit mug data_indoor/mug/digit -
        data_indoor/mug/duragel/3 3 - 0 duragel mug data_indoor/mug/duragel -"""),
    table: (3, """
        a.png 0 1 2 digit one - train material=wood hardness=2
        b.png 1 - 2 gelsight two - test material=glass
        c.png 2 1 - digit three - train hardness=10"""),
    tree: (3, """
        11.png 11 - - - - - -
        wood/2.png 2 20 41 - - - - material=wood
        wood/10.png 10 30 40 - - - - material=wood"""),
    tree_of_splits: (3, """
        train/glass/1.PNG 1 - - - - - train material=glass
        train/wood/1.png 0 - - - - - train material=wood
        test/wood/1.png 2 - - - - - test material=wood"""),
    tree_of_objects: (4, """
        Train/wood/2.png 2 - - - - - train material=wood
        Train/wood/plank/1.png 1 - - - wood/plank - train material=wood
        VALID/glass/jar/3.png 3 - - - glass/jar - val material=glass
        test/glass/4.png 4 - - - - - test material=glass"""),
}  # fmt: skip


@pytest.mark.parametrize("make", LAYOUTS, ids=lambda make: make.__name__)
def test_a_layout_is_recognised_and_read(make: Callable, tmp_path: Path) -> None:
    make(tmp_path)
    data = open_dataset(tmp_path)
    assert data.kind == (make.__name__ if make not in (table, tree, tree_of_splits, tree_of_objects) else "folder")
    count, lines = LAYOUTS[make]
    expected = [line.strip() for line in lines.strip().splitlines()]
    assert len(data) == count and [line for line in told(data) if line in expected] == expected
    captions = {table: "rough, and hard", ssvtp: "smooth, number 1", hct: "soft, 0"}
    assert data.records[0].caption == captions.get(make)


def test_a_table_names_files_however_their_letters_are_composed(tmp_path: Path) -> None:
    """Composed in the table, decomposed on the disk, as macOS writes names."""
    names = [unicodedata.normalize(form, "hölzchen/größe.png") for form in ("NFC", "NFD")]
    assert names[0] != names[1]
    write(tmp_path, {names[1]: 5, "labels.csv": f"touch,material\n{names[0]},wood"})
    assert number_of(open_dataset(tmp_path).records[0].touch) == 5


def test_a_folder_in_which_no_touch_is_where_one_is_expected_says_where(tmp_path: Path) -> None:
    write(tmp_path, {"a/b/c/d/1.png": 1})
    with pytest.raises(InvalidInputError, match=r"it has no touches where they are expected: MATERIAL/x\.png"):
        open_dataset(tmp_path)


def test_integers_that_pandas_has_made_floats_are_labels_by_number(tmp_path: Path) -> None:
    """Of a column of integers with blanks; -1 and nan are no labels."""
    rows = ("touch,material", "a.png,2.0", "b.png,-1.0", "c.png,nan", "d.png,0.0", "e.png,")
    write(tmp_path, {**{f"{name}.png": 0 for name in "abcde"}, "labels.csv": "\n".join(rows)})
    data = open_dataset(tmp_path, materials=["wood", "glass", "brick"])
    found = {record.id: data.classes["material"][record.labels["material"]] for record in data.records if record.labels}
    assert found == {"a.png": "brick", "d.png": "wood"}


@pytest.mark.parametrize("make", [table, tree])
def test_files_that_are_not_read_are_named(make: Callable, tmp_path: Path) -> None:
    make(tmp_path)
    write(tmp_path, {"photos/1.png": 5, "photos/2.heic": "", "photos/.hidden.png": 5})
    expected = "2 other files are not read, as they belong to no touch: photos/1.png; photos/2.heic"
    assert expected in open_dataset(tmp_path).notes


def test_what_a_user_says_of_a_data_set_holds(tmp_path: Path) -> None:
    object_folder(tmp_path)
    names = ["wood", "steel", "polycarbonate", "plastic", "iron", "ceramic", "glass"]
    data = open_dataset(tmp_path, sensor="mine", materials=names)
    assert data.classes["material"] == tuple(names) and {record.sensor for record in data.records} == {"mine"}
    (tmp_path / "split.json").unlink()
    assert len(open_dataset(tmp_path)) == 4  # without a split all points are there


BROKEN = [
    (touch_and_go, {f"dataset/{ONE}/gelsight_frame": None}, r"1 of 6 files are not there: .*gelsight_frame/0+\.jpg"),
    (touch_and_go, {f"dataset/{name}/gelsight_frame": None for name in (ONE, TWO, THREE)}, r"run .* extract_frame\.py"),
    (ycb_slide, {"real/004_box/dataset_1/frames": None}, r"has no images; .* run: .*ffmpeg"),
    (touch_and_go, {"test.txt": f"{ONE}/0000000000.jpg,3\n"}, r"train.txt and test.txt both list .*00\.jpg"),
    (touch_and_go, {"label.txt": f"{ONE}/0.jpg;3\n"}, r"label\.txt' has '.*;3'; a line is recording/frame"),
    (feeling_of_success, {"calandra_corl2017_001.h5": "gone"}, r"_001\.h5' is no list of attempts"),
    (object_folder, {"label.json": '{"7": "wood", "101": 7}'}, "no label from 0 to 6 for the objects 101; 7"),
    (object_folder, {"split.json": '{"train": [["7", 0]], "test": [["7", 0]]}'}, "several records of one id: 7/0"),
    (ssvtp, {"test.csv": "url\nimages_rgb/image_1_rgb.jpg\n"}, r"image_1_rgb\.jpg', which is in another split"),
    (tacquad, {"contact_indoor.csv": "mug,2,12,0,1,3,3"}, "has 12 images, but contact from 2 to 12"),
    (table, {"labels.csv": "tuoch,material\na.png,wood\n"}, r"columns \['tuoch', 'material'\], and none of touch"),
    (table, {"labels.csv": "touch,split\na.png,training\n"}, "has the split 'training'"),
    (table, {"more.csv": ""}, r"2 tables, labels\.csv; more\.csv; leave one"),
]


@pytest.mark.parametrize(("make", "damage", "message"), BROKEN)
def test_a_broken_data_set_is_refused(make: Callable, damage, message: str, tmp_path: Path) -> None:
    make(tmp_path)
    write(tmp_path, damage)
    with pytest.raises(InvalidInputError, match=f"`path` is .*, read as .*{message}"):
        open_dataset(tmp_path)


def test_arguments_that_cannot_be_meant_are_refused(tmp_path: Path, monkeypatch) -> None:
    table(tmp_path)
    write(tmp_path, {"two/images_tac/image_1_tac.jpg": 1, "two/label.json": "{}"})
    monkeypatch.chdir(tmp_path)
    for arguments, message in (
        ({"path": "nowhere"}, "`path` is 'nowhere', which is not there"),
        ({"path": "labels.csv"}, "which is no folder; unpack it"),
        ({"path": "two"}, "looks like object_folder and ssvtp; say its `kind`"),
        ({"kind": "touch_and_goo"}, "`kind` is 'touch_and_goo'.*Did you mean 'touch_and_go'"),
        *(({name: 3}, f"`{name}` is 3") for name in ("path", "sensor", "materials")),
    ):
        with pytest.raises((InvalidInputError, InvalidTypeError), match=message):
            open_dataset(**{"path": tmp_path, **arguments})
