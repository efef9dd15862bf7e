"""Data sets as they are published, and folders of one's own: a small tree in each layout is recognised and read."""

import unicodedata
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.helpers.data_sets import shade
from tests.helpers.layouts import (
    ONE,
    THREE,
    TWO,
    feeling_of_success,
    hct,
    object_folder,
    object_folder_real,
    ssvtp,
    table,
    tacquad,
    touch_and_go,
    tree,
    tree_of_objects,
    tree_of_splits,
    write,
    ycb_slide,
)
from unitouch_gen.training.data import RecordSet, open_dataset
from unitouch_gen.training.data.records import Frame


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


LAYOUTS: dict[Callable, tuple[int, str]] = {
    touch_and_go: (
        3,
        f"""
        {ONE}/0000000000.jpg 0 40 - gelsight - {ONE} train material=wood soft=hard rough=rough
        {TWO}/0000000002.jpg 12 42 - gelsight - {TWO} test material=leather soft=soft
        {THREE}/0000000001.jpg 21 41 - gelsight - {THREE} - material=others soft=hard""",
    ),
    feeling_of_success: (
        24,
        """
        000/i2/A 2 42 60 gelsight object_2 000/i2 - grasp=lifted
        000/i2/B 22 42 60 gelsight object_2 000/i2 - grasp=lifted
        000/i9/A 9 49 60 gelsight object_9 000/i9 - grasp=dropped
        000/i10/A 10 50 60 gelsight object_10 000/i10 - grasp=lifted
        001/i0/B 32 52 60 gelsight object_12 001/i0 - grasp=lifted""",
    ),
    ycb_slide: (
        5,
        """
        digit/004_box/dataset_1/frame_0.jpg 20 - - digit 004_box digit/004_box/dataset_1 - material=box
        digit/004_box/dataset_1/frame_1.jpg 21 - - digit 004_box digit/004_box/dataset_1 - material=box
        digit/035_drill/dataset_0/frame_7.jpg 1 2 - digit 035_drill digit/035_drill/dataset_0 - material=drill
        tacto/004_box/00/2.jpg 2 - - tacto 004_box tacto/004_box/00 - material=box
        tacto/004_box/00/10.jpg 10 - - tacto 004_box tacto/004_box/00 - material=box""",
    ),
    object_folder: (
        2,
        """
        7/0 0 10 - tacto 7 - train material=0
        101/1 3 13 - taxim 101 - test material=6""",
    ),
    object_folder_real: (
        3,
        """
        1/3/2 2 - - gelslim 1 1/3 - material=wood
        1/3/10 10 - - gelslim 1 1/3 - material=wood
        2/3/0 0 - - gelslim 2 2/3 -""",
    ),
    ssvtp: (
        3,
        """
        1 1 11 - digit - - train
        2 2 12 - digit - - -
        30 30 40 - digit - - test""",
    ),
    hct: (
        6,
        """
        data1/one/tactile/0-0.5.jpg 1 63 0 digit - data1/one train
        data1/one/tactile/1-0.5.jpg 2 62 0 digit - data1/one train
        data1/two/tactile/2-0.5.jpg 1 61 0 digit - data1/two train""",
    ),
    tacquad: (
        5,
        """
        data_indoor/mug/gelsight/10 10 25 0 gelsight_mini mug data_indoor/mug/gelsight -
        data_indoor/mug/gelsight/11 11 25 0 gelsight_mini mug data_indoor/mug/gelsight -
        data_indoor/mug/digit/1 1 22 - digit mug data_indoor/mug/digit -
        data_indoor/mug/duragel/3 3 - 0 duragel mug data_indoor/mug/duragel -""",
    ),
    table: (
        3,
        """
        a.png 0 1 2 digit one - train material=wood hardness=2
        b.png 1 - 2 gelsight two - test material=glass
        c.png 2 1 - digit three - train hardness=10""",
    ),
    tree: (
        3,
        """
        11.png 11 - - - - - -
        wood/2.png 2 20 41 - - - - material=wood
        wood/10.png 10 30 40 - - - - material=wood""",
    ),
    tree_of_splits: (
        3,
        """
        train/glass/1.PNG 1 - - - - - train material=glass
        train/wood/1.png 0 - - - - - train material=wood
        test/wood/1.png 2 - - - - - test material=wood""",
    ),
    tree_of_objects: (
        4,
        """
        Train/wood/2.png 2 - - - - - train material=wood
        Train/wood/plank/1.png 1 - - - wood/plank - train material=wood
        VALID/glass/jar/3.png 3 - - - glass/jar - val material=glass
        test/glass/4.png 4 - - - - - test material=glass""",
    ),
}


@pytest.mark.parametrize("make", LAYOUTS, ids=lambda make: make.__name__)
def test_a_layout_is_recognised_and_read(make: Callable, tmp_path: Path) -> None:
    make(tmp_path)
    data = open_dataset(tmp_path)
    assert data.kind == (make.__name__ if make not in (table, tree, tree_of_splits, tree_of_objects) else "folder")
    count, lines = LAYOUTS[make]
    expected = [line.strip() for line in lines.strip().splitlines()]
    assert len(data) == count
    assert [line for line in told(data) if line in expected] == expected
    captions = {table: "rough, and hard", ssvtp: "smooth, number 1", hct: "soft, 0"}
    assert data.records[0].caption == captions.get(make)


def test_a_table_names_files_however_their_letters_are_composed(tmp_path: Path) -> None:
    """Composed in the table, decomposed on the disk, as macOS writes names."""
    names = [unicodedata.normalize(form, "hölzchen/größe.png") for form in ("NFC", "NFD")]
    assert names[0] != names[1]
    write(tmp_path, {names[1]: 5, "labels.csv": f"touch,material\n{names[0]},wood"})
    assert number_of(open_dataset(tmp_path).records[0].touch) == 5


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


def test_open_dataset_keeps_the_sensor_and_materials_it_is_told(tmp_path: Path) -> None:
    object_folder(tmp_path)
    names = ["wood", "steel", "polycarbonate", "plastic", "iron", "ceramic", "glass"]
    data = open_dataset(tmp_path, sensor="mine", materials=names)
    assert data.classes["material"] == tuple(names)
    assert {record.sensor for record in data.records} == {"mine"}
    (tmp_path / "split.json").unlink()
    assert len(open_dataset(tmp_path)) == 4  # without a split all points are there
