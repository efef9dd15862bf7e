"""Data sets as they are published, and folders of one's own: a small tree in each layout, and broken ones."""

import csv
import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.helpers.data_sets import colour_of, painted, shade, write_attempts, write_image, write_video
from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.training.data import RecordSet, open_dataset
from unitouch_gen.training.data.frames import Frame
from unitouch_gen.training.data.reading import read_table

ONE, TWO, THREE = "20220601_182052", "20220602_101010", "20220603_090000"


def write(folder: Path, name: str, number: int) -> None:
    """An image of the colour of a number, or a text."""
    write_image(folder / name, shade(number))


def write_texts(folder: Path, **texts: str) -> None:
    for name, text in texts.items():
        folder.joinpath(name.replace("_csv", ".csv").replace("_json", ".json").replace("_txt", ".txt")).write_text(text)


def number_of(frame: Frame | None) -> int | None:
    """The number of the colour that an image was written with, also where compression has changed it a little."""
    if frame is None:
        return None
    colour = np.array(colour_of(frame.read()))
    return int(np.argmin([np.abs(colour - shade(number)).sum() for number in range(64)]))


def told(data: RecordSet) -> dict[str, tuple]:
    """Of each record: numbers of touch, picture and background, what it is of, its classes by name, and its split."""
    return {
        record.id: (
            *map(number_of, (record.touch, record.picture, record.background)),
            (record.sensor, record.object, record.recording),
            {label: data.classes[label][number] for label, number in record.labels.items()},
            record.split,
        )
        for record in data.records
    }


# One tree a layout ----------------------------------------------------------------------------------------------------


def touch_and_go(folder: Path) -> None:
    for number, recording in enumerate((ONE, TWO, THREE)):
        for frame in range(3):
            write(folder, f"dataset/{recording}/gelsight_frame/{frame:010d}.jpg", 10 * number + frame)
            write(folder, f"dataset/{recording}/video_frame/{frame:010d}.jpg", 40 + frame)
    write_texts(
        folder,
        label_txt=f"{ONE}/0000000000.jpg,3\n{ONE}/0000000001.jpg,-1\n{TWO}/0000000002.jpg, 7\n"
        f"{THREE}/0000000001.jpg,19\n",
        train_txt=f"{ONE}/0000000000.jpg,3\n",
        test_txt=f"{TWO}/0000000002.jpg,7\n",
        train_rough_txt=f"{ONE}/0000000000.jpg,1\n",
        test_rough_txt=f"{TWO}/0000000002.jpg,-1\n",
    )


def attempt(item: str, lifted: bool, number: int) -> dict:
    arrays = {f"gelsight{finger}_before": painted(shade(60)) for finger in "AB"}
    arrays |= {"gelsightA_during": painted(shade(number)), "gelsightB_during": painted(shade(20 + number))}
    arrays["kinectA_rgb_during"] = painted(shade(40 + number))
    return {"object_name": np.bytes_(item), "is_gripping": np.bool_(lifted), **arrays}


def feeling_of_success(folder: Path) -> None:
    """Eleven attempts, so that i10 comes after i9, and one in another file."""
    first = [attempt(f"object_{number}", number % 2 == 0, number) for number in range(11)]
    write_attempts(folder / "calandra_corl2017_000.h5", first)
    write_attempts(folder / "calandra_corl2017_001.h5", [attempt("object_0", True, 12)])


def ycb_slide(folder: Path) -> None:
    for number in range(11):  # frames that are in another order by their letters
        write(folder, f"sim/004_sugar_box/00/tactile_images/{number}.jpg", number)
    write(folder, "real/035_power_drill/dataset_0/frames/frame_0000007.jpg", 1)
    write(folder, "real/035_power_drill/dataset_0/webcam_frames/frame_0000007.jpg", 2)
    write_video(folder / "real/004_sugar_box/dataset_1/frames.mp4", [shade(20), shade(21)])


def object_folder(folder: Path) -> None:
    for item in ("7", "101"):
        for point in range(2):
            write(folder, f"touch/{item}/{point}.png", point)
            write(folder, f"vision/{item}/{point}.png", 10 + point)
    write_texts(folder, label_json='{"7": 0, "101": 6}', split_json='{"train": [["7", 0]], "test": [["101", 1]]}')


def object_folder_real(folder: Path) -> None:
    for item, frame in (("1", 2), ("1", 10), ("2", 0)):
        write(folder, f"{item}/tactile_data/3/0/gelsight/{frame}.png", frame)
    write_texts(folder, objects_csv="ID;Name;Material\n1;Bowl;Wood\n2;Fork;\n")


def ssvtp(folder: Path) -> None:
    for number in (1, 2, 30):
        write(folder, f"images_tac/image_{number}_tac.jpg", number)
        write(folder, f"images_rgb/image_{number}_rgb.jpg", 10 + number)
        (folder / "text").mkdir(exist_ok=True)
        (folder / f"text/labels_{number}.txt").write_text(f"smooth, number {number}\n")
    write_texts(
        folder,
        train_csv="url,tactile\nimages_rgb/image_1_rgb.jpg,images_tac/image_1_tac.jpg\n",
        test_csv="url,tactile\nimages_rgb/image_30_rgb.jpg,images_tac/image_30_tac.jpg\n",
    )


def hct(folder: Path, swapped: tuple[str, ...] = ()) -> None:
    """Two sessions of gels that change a little, and pictures that are very different."""
    rows = ["url,tactile,tactile_background,caption"]
    for session in ("one", "two"):
        tactile, vision = ("vision", "tactile") if session in swapped else ("tactile", "vision")
        write(folder, f"data1/{session}/background/0.jpg", 0)
        for number in range(3):
            write(folder, f"data1/{session}/{tactile}/{number}-0.5.jpg", 1 + number % 2)
            write(folder, f"data1/{session}/{vision}/{number}-0.5.jpg", 63 - number)
            names = [f"{session}/{place}/{number}-0.5.jpg" for place in ("vision", "tactile")]
            rows.append(f'{names[0]},{names[1]},{session}/background/0.jpg,"soft, {number}"')
    write_texts(folder / "data1", train_csv="\n".join(rows))


def tacquad(folder: Path) -> None:
    for sensor, touches, pictures in (("gelsight", 12, 6), ("digit", 2, 4), ("duragel", 6, 0)):
        for number in range(touches):
            write(folder, f"data_indoor/mug/{sensor}/{number}.png", number)
        for number in range(pictures):
            write(folder, f"data_indoor/mug/img_{sensor}/{number}.png", 20 + number)
    write_texts(folder, contact_indoor_csv="mug,10,11,0,1,3,3\n")


def table(folder: Path) -> None:
    for number, name in enumerate("abc"):
        write(folder, f"{name}.png", number)
    write_texts(
        folder,
        labels_csv="touch,picture,background,sensor,material,object,caption,split,hardness\n"
        'a.png,b.png,c.png,digit,wood,one,"rough, and hard",train,2\n'
        "b.png,,c.png,gelsight,glass,two,smooth,test,-1\n"
        "c.png,b.png,,digit,,three,,train,10\n",
    )


def tree(folder: Path) -> None:
    files = {"touch/wood/2.png": 2, "touch/wood/10.png": 10, "touch/wood/background.png": 40, "touch/11.png": 11,
             "picture/wood/2.jpg": 20, "picture/wood/10.png": 30, "background/wood/2.bmp": 41}  # fmt: skip
    for name, number in files.items():
        write(folder, name, number)


def tree_of_splits(folder: Path) -> None:
    for number, name in enumerate(
        ("train/wood/1.png", "train/glass/1.PNG", "test/wood/1.png", "test/wood/.hidden.png")
    ):
        write(folder, name, number)


GEL = "gelsight"
LAYOUTS: dict[Callable, dict[str, tuple]] = {
    touch_and_go: {
        f"{ONE}/0000000000.jpg": (0, 40, None, (GEL, None, ONE),
                                  {"material": "wood", "soft": "hard", "rough": "rough"}, "train"),
        f"{TWO}/0000000002.jpg": (12, 42, None, (GEL, None, TWO), {"material": "leather", "soft": "soft"}, "test"),
        f"{THREE}/0000000001.jpg": (21, 41, None, (GEL, None, THREE), {"material": "others", "soft": "hard"}, None),
    },
    feeling_of_success: {
        f"{file}/i{place}/{finger}": (
            number + (20 if finger == "B" else 0), 40 + number, 60, (GEL, f"object_{number % 12}", f"{file}/i{place}"),
            {"grasp": ("lifted", "dropped")[number % 2]}, None)
        for file, place, number in (*(("000", number, number) for number in range(11)), ("001", 0, 12))
        for finger in "AB"
    },
    ycb_slide: {
        f"{run}/{name}.jpg": (touch, picture, None, (*run.split("/")[:2], run), {"material": what}, None)
        for run, name, touch, picture, what in (
            ("digit/004_sugar_box/dataset_1", "frame_0000000", 20, None, "sugar box"),
            ("digit/004_sugar_box/dataset_1", "frame_0000001", 21, None, "sugar box"),
            ("digit/035_power_drill/dataset_0", "frame_0000007", 1, 2, "power drill"),
            *(("tacto/004_sugar_box/00", number, number, None, "sugar box") for number in range(11)),
        )
    },
    object_folder: {
        "7/0": (0, 10, None, ("tacto", "7", None), {"material": "0"}, "train"),
        "101/1": (1, 11, None, ("taxim", "101", None), {"material": "6"}, "test"),
    },
    object_folder_real: {
        "1/3/2": (2, None, None, ("gelslim", "1", "1/3"), {"material": "wood"}, None),
        "1/3/10": (10, None, None, ("gelslim", "1", "1/3"), {"material": "wood"}, None),
        "2/3/0": (0, None, None, ("gelslim", "2", "2/3"), {}, None),
    },
    ssvtp: {
        str(number): (number, 10 + number, None, ("digit", None, None), {}, split)
        for number, split in ((1, "train"), (2, None), (30, "test"))
    },
    hct: {
        f"data1/{session}/tactile/{number}-0.5.jpg": (
            1 + number % 2, 63 - number, 0, ("digit", None, f"data1/{session}"), {}, "train")
        for session in ("one", "two") for number in range(3)
    },
    tacquad: {  # a touch goes with the picture of the same share of the recording
        "data_indoor/mug/gelsight/10": (10, 25, 0, ("gelsight_mini", "mug", "data_indoor/mug/gelsight"), {}, None),
        "data_indoor/mug/gelsight/11": (11, 25, 0, ("gelsight_mini", "mug", "data_indoor/mug/gelsight"), {}, None),
        "data_indoor/mug/digit/0": (0, 20, None, ("digit", "mug", "data_indoor/mug/digit"), {}, None),
        "data_indoor/mug/digit/1": (1, 22, None, ("digit", "mug", "data_indoor/mug/digit"), {}, None),
        "data_indoor/mug/duragel/3": (3, None, 0, ("duragel", "mug", "data_indoor/mug/duragel"), {}, None),
    },
    table: {
        "a.png": (0, 1, 2, ("digit", "one", None), {"material": "wood", "hardness": "2"}, "train"),
        "b.png": (1, None, 2, (GEL, "two", None), {"material": "glass"}, "test"),
        "c.png": (2, 1, None, ("digit", "three", None), {"hardness": "10"}, "train"),
    },
    tree: {
        "11.png": (11, None, None, (None, None, None), {}, None),
        "wood/2.png": (2, 20, 41, (None, None, None), {"material": "wood"}, None),
        "wood/10.png": (10, 30, 40, (None, None, None), {"material": "wood"}, None),
    },
    tree_of_splits: {
        "train/glass/1.PNG": (1, None, None, (None, None, None), {"material": "glass"}, "train"),
        "train/wood/1.png": (0, None, None, (None, None, None), {"material": "wood"}, "train"),
        "test/wood/1.png": (2, None, None, (None, None, None), {"material": "wood"}, "test"),
    },
}  # fmt: skip


@pytest.mark.parametrize("make", LAYOUTS, ids=lambda make: make.__name__)
def test_a_layout_is_recognised_and_read(make: Callable, tmp_path: Path) -> None:
    make(tmp_path)
    data = open_dataset(tmp_path)
    assert data.kind == (make.__name__ if make not in (table, tree, tree_of_splits) else "folder")
    assert list(told(data).items()) == list(LAYOUTS[make].items())  # in order


@pytest.mark.parametrize("swapped", [("two",), ("one", "two")])
def test_folders_of_hct_that_are_exchanged_are_put_right_and_told(swapped: tuple[str, ...], tmp_path: Path) -> None:
    hct(tmp_path, swapped)
    data = open_dataset(tmp_path)
    assert told(data) == LAYOUTS[hct]
    assert data.notes == (
        f"pictures and touches of {len(swapped)} of 2 sessions lie in each other's folders; exchanged",
    )


def test_captions_notes_and_leaks_are_told(tmp_path: Path) -> None:
    for make in (table, tree, touch_and_go, ssvtp):
        (tmp_path / make.__name__).mkdir()
        make(tmp_path / make.__name__)
    assert [record.caption for record in open_dataset(tmp_path / "table").records] == [
        "rough, and hard",
        "smooth",
        None,
    ]
    assert open_dataset(tmp_path / "ssvtp")[2].caption == "smooth, number 30"
    write(tmp_path / "tree", "photos/1.png", 5)
    assert (
        "1 images are not read, as no touch in `touch` has their names: photos/1.png"
        in open_dataset(tmp_path / "tree").notes[0]
    )
    folder = tmp_path / "touch_and_go"
    (folder / "test.txt").write_text(f"{TWO}/0000000002.jpg,7\n{ONE}/0000000002.jpg,4\n")
    data = open_dataset(folder)
    assert data.notes == ("1 frames whose material is inconclusive (-1) are left out",)
    assert data.split("train").notes[1:] == ("1 of 2 recordings are in more than one of its own splits",)
    parts = [
        {record.recording for record in data.split(name, "recording").records} for name in ("train", "val", "test")
    ]
    assert sorted(name for part in parts for name in part) == [ONE, TWO, THREE]


def test_what_a_user_says_of_a_data_set_holds(tmp_path: Path) -> None:
    object_folder(tmp_path)
    names = ["wood", "steel", "polycarbonate", "plastic", "iron", "ceramic", "glass"]
    data = open_dataset(tmp_path, sensor="mine", materials=names, bgr=True, sampling_rate=44100)
    assert (data.materials, data.sampling_rate, {record.sensor for record in data.records}) == (
        tuple(names), 44100, {"mine"},
    )  # fmt: skip
    first = data[0]
    assert colour_of(first.touch.read()) == shade(0)[::-1] and colour_of(first.picture.read()) == shade(10)
    (tmp_path / "split.json").unlink()
    assert len(open_dataset(tmp_path)) == 4  # without a split all points are there


def test_half_of_ycb_slide_is_recognised(tmp_path: Path) -> None:
    ycb_slide(tmp_path)
    assert [(data.kind, len(data)) for data in map(open_dataset, (tmp_path / "real", tmp_path / "sim"))] == [
        ("ycb_slide", 3), ("ycb_slide", 11),
    ]  # fmt: skip


# Tables ---------------------------------------------------------------------------------------------------------------

CELLS = st.text(st.characters(exclude_categories=("C", "Z"), exclude_characters="\ufeff"), min_size=1, max_size=12)


@settings(max_examples=50, deadline=None)
@given(
    rows=st.lists(st.tuples(CELLS, CELLS), min_size=1, max_size=6),
    delimiter=st.sampled_from(",;\t"),
    encoding=st.sampled_from(["utf-8", "utf-8-sig"]),
)
def test_a_table_is_read_as_it_was_written(rows: list, delimiter: str, encoding: str, tmp_path_factory) -> None:
    file = tmp_path_factory.mktemp("table") / "table.csv"
    with file.open("w", newline="", encoding=encoding) as stream:
        csv.writer(stream, delimiter=delimiter).writerows([("One", "two"), *rows])
    assert read_table(file) == [{"one": one, "two": two} for one, two in rows]


# Videos ---------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> str:
    return str(write_video(tmp_path_factory.mktemp("video") / "gelsight.mp4", [shade(number) for number in range(24)]))


@settings(max_examples=25, deadline=None)
@given(order=st.lists(st.integers(0, 23), min_size=1, max_size=12))
def test_frames_of_a_video_are_the_same_in_any_order(order: list[int], video: str) -> None:
    assert [number_of(Frame(video, index=number)) for number in order] == order


@pytest.mark.parametrize("timed", [True, False])
def test_touch_and_picture_of_videos_are_paired_by_time_or_number(timed: bool, tmp_path: Path) -> None:
    place = tmp_path / "dataset" / ONE
    write_video(place / "gelsight.mp4", [shade(number) for number in range(12)])
    write_video(place / "video.mp4", [shade(20 + number) for number in range(12)], rate=15)
    if timed:  # the camera began three frames later, at half the rate
        np.save(place / "time2.npy", 1.654e9 + np.arange(12) / 30)
        np.save(place / "time1.npy", 1.654e9 + 0.1 + np.arange(12) / 15)
    (tmp_path / "label.txt").write_text("".join(f"{ONE}/{number:010d}.jpg,1\n" for number in (11, 0, 7, 3)))
    pairs = {facts[0]: facts[1] - 20 for facts in told(open_dataset(tmp_path)).values()}
    assert pairs == ({0: 0, 3: 0, 7: 2, 11: 4} if timed else {number: number for number in (0, 3, 7, 11)})


@pytest.mark.slow
def test_a_forked_process_reads_a_video_that_is_open(video: str) -> None:
    """In a process of its own, without the threads that other tests have left."""
    code = f"""
import os
from tests.helpers.data_sets import colour_of
from unitouch_gen.training.data.frames import Frame
Frame({video!r}, index=3).read()  # so that both would share its place in the file
child = os.fork()
read = [colour_of(Frame({video!r}, index=number).read()) for number in range(4, 20)]
print(read, flush=True)
os.waitpid(child, 0) if child else os._exit(0)  # as processes of multiprocessing end
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=True)
    one, other = done.stdout.splitlines()
    assert one == other == str([colour_of(Frame(video, index=number).read()) for number in range(4, 20)])


# What is broken -------------------------------------------------------------------------------------------------------


def without(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).unlink()


def text(name: str, content: str) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_text(content)


def as_videos(folder: Path) -> None:
    (folder / "dataset" / ONE / "gelsight_frame").rename(folder / "elsewhere")


def attempts(*given: dict) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        (folder / "calandra_corl2017_001.h5").unlink()
        write_attempts(folder / "calandra_corl2017_001.h5", given)

    return write


BROKEN = [
    (touch_and_go, without(f"dataset/{TWO}/gelsight_frame/0000000002.jpg"), r"1 of 6 files are not there: .*02\.jpg"),
    (touch_and_go, as_videos, r"2 of 6 files are not there: .*gelsight\.mp4; .*video\.mp4"),
    (touch_and_go, text("test.txt", f"{ONE}/0000000000.jpg,3\n"), r"train.txt and test.txt both list .*00\.jpg"),
    (touch_and_go, text("label.txt", f"{ONE}/0.jpg;3\n"), r"label\.txt' has '.*;3'; a line is recording/frame"),
    (touch_and_go, text("label.txt", f"{ONE}/0.jpg,3\n{ONE}/0.jpg,4\n"), "a frame has one label"),
    (touch_and_go, text("train.txt", f"{ONE}/0000000002.jpg,20\n"), "no name for material 20"),
    (touch_and_go, lambda folder: (folder / "label.txt").write_bytes("a".encode("utf-16")), "not in UTF-8"),
    (feeling_of_success, text("calandra_corl2017_001.h5", "gone"), r"_001\.h5' is no list of attempts"),
    (feeling_of_success, attempts({"name": np.bytes_("x")}), r"_001\.h5' is no list of attempts"),
    (ycb_slide, lambda folder: (folder / "real/mug/dataset_2").mkdir(parents=True), "dataset_2' holds no frames"),
    (ycb_slide, text("real/004_sugar_box/dataset_1/frames.mp4", "gone"), "Invalid data"),
    (object_folder, text("label.json", '{"7": 0, "101": 7}'), "no name for material 7"),
    (object_folder, text("label.json", '{"7": "wood", "101": 7}'), "invalid literal for int.*'wood'"),
    (object_folder, text("label.json", '{"7": 0}'), "no label for the objects 101"),
    (object_folder, text("label.json", "[0, 1]"), "'list' object has no attribute"),
    (object_folder, text("split.json", '{"train": [["7", 0]], "test": [["7", 0]]}'), "several records of one id: 7/0"),
    (object_folder, text("split.json", '{"train": ["7"]}'), "not enough values to unpack"),
    (object_folder, text("split.json", '{"train": [["7", 5], ["7", 6]]}'), r"2 of 2 files are not there.*6\.png"),
    (ssvtp, text("test.csv", "url\nimages_rgb/image_1_rgb.jpg\n"), r"image_1_rgb\.jpg', which is in another split"),
    (ssvtp, text("test.csv", "url\nphoto.jpg\n"), r"'photo\.jpg' is no name of an image of SSVTP"),
    (tacquad, text("contact_indoor.csv", "mug,2,12,0,1,3,3"), "from frame 2 to 12, but .* has 12 images"),
    (tacquad, text("contact_indoor.csv", "mug,5,2,0,1,3,3"), "from frame 5 to 2"),
    (tacquad, text("contact_indoor.csv", "mug,2,last,0,1,3,3"), "'last'"),
    (tacquad, text("contact_indoor.csv", "mug,2,11,0,7"), "other columns in row 1"),
    (table, text("labels.csv", "tuoch,material\na.png,wood\n"), r"columns \['tuoch', 'material'\], and none of touch"),
    (table, text("labels.csv", "touch,material\na.png,wood\na.png,wood\n"), r"several records of one id: a\.png"),
    (table, text("labels.csv", "touch\na.png\nd.png\ne.png\n"), r"2 of 3 files are not there: .*d\.png; .*e\.png"),
    (table, text("labels.csv", "touch,split\na.png,training\n"), r"splits other than .*\{'training'\}"),
    (table, text("labels.csv", "touch,touch\na.png,b.png\n"), "two of one name"),
    (table, text("labels.csv", ""), "no rows"),
    (table, text("more.csv", ""), r"2 tables, labels\.csv; more\.csv; leave one"),
    (tree, lambda folder: [shutil.rmtree(folder / name) for name in ("touch", "picture")], "no records"),
]  # fmt: skip


@pytest.mark.parametrize(("make", "damage", "message"), BROKEN)
def test_a_broken_data_set_is_refused(make: Callable, damage: Callable, message: str, tmp_path: Path) -> None:
    make(tmp_path)
    damage(tmp_path)
    with pytest.raises(InvalidInputError, match=f"`path` is .*, read as .*{message}"):
        open_dataset(tmp_path)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"path": "nowhere"}, InvalidInputError, "`path` is 'nowhere', which is not there"),
        ({"path": "labels.csv"}, InvalidInputError, "which is no folder; unpack it"),
        ({"path": "empty"}, InvalidInputError, "which is not there or empty"),
        ({"path": "two"}, InvalidInputError, "looks like object_folder and ssvtp; say its `kind`"),
        ({"kind": "touch_and_goo"}, InvalidInputError, "`kind` is 'touch_and_goo'.*Did you mean 'touch_and_go'"),
        ({"kind": "ssvtp"}, InvalidInputError, "has no records"),
        ({"materials": ["wood"]}, InvalidInputError, "`materials` names 1 of 2"),
        *(({name: torch.zeros(2)}, InvalidTypeError, f"`{name}` is a tensor")
          for name in ("path", "sensor", "materials", "bgr")),
    ],
)  # fmt: skip
def test_arguments_that_cannot_be_meant_are_refused(arguments, error, message, tmp_path, monkeypatch) -> None:
    table(tmp_path)
    (tmp_path / "empty").mkdir()
    write(tmp_path, "two/images_tac/image_1_tac.jpg", 1)
    (tmp_path / "two/label.json").write_text(json.dumps({}))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(error, match=message):
        open_dataset(**{"path": tmp_path, **arguments})


@pytest.mark.parametrize("index", [24, -1])
def test_a_frame_that_a_video_does_not_have_is_refused(index: int, video: str) -> None:
    with pytest.raises(
        InvalidInputError, match=rf"gelsight\.mp4' cannot be read: the video has 24 frames, but .* {index}"
    ):
        Frame(video, index=index).read()


def test_without_h5py_it_is_said_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    feeling_of_success(tmp_path)
    monkeypatch.setitem(sys.modules, "h5py", None)  # what an import finds where it is not installed
    with pytest.raises(InvalidInputError, match=r"needs the package `h5py`, .* pip install 'unitouch_gen\[train\]'"):
        open_dataset(tmp_path)
