"""Touch and Go as it is published: lists, frames, videos with time stamps."""

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.utils.data import DataLoader, Dataset

from tests.benchmarks.measuring import in_own_process
from tests.helpers.data_sets import BLUE, GREEN, RED, colour_of, near, shade, write_image, write_video
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.training.data import RecordSet, open_dataset
from unitouch_gen.training.data.decoding import Computed
from unitouch_gen.training.data.frames import VideoFrame

ONE, TWO, THREE = "20220601_182052", "20220602_101010", "20220603_090000"


def write_lists(folder: Path, **lists: str) -> None:
    for name, lines in lists.items():
        (folder / f"{name}.txt").write_text(lines)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three recordings of frames; touches and pictures have colours of their own."""
    for recording, colour in ((ONE, RED), (TWO, GREEN), (THREE, BLUE)):
        for number in range(3):
            name = f"{number:010d}.jpg"
            write_image(tmp_path / "dataset" / recording / "gelsight_frame" / name, colour)
            write_image(tmp_path / "dataset" / recording / "video_frame" / name, shade(number))
    write_lists(
        tmp_path,
        label=f"{ONE}/0000000000.jpg,3\n{ONE}/0000000001.jpg,-1\n{TWO}/0000000000.jpg,7\n{TWO}/0000000002.jpg,3\n"
        f"{THREE}/0000000001.jpg,19\n",
        train=f"{ONE}/0000000000.jpg,3\n{TWO}/0000000000.jpg,7\n",
        test=f"{TWO}/0000000002.jpg,3\n",
        train_rough=f"{ONE}/0000000000.jpg,1\n{TWO}/0000000000.jpg,-1\n",
        test_rough=f"{TWO}/0000000002.jpg,0\n",
    )
    return tmp_path


def by_id(data: RecordSet) -> dict:
    return {record.id: record for record in data.records}


def test_every_frame_has_its_own_touch_picture_and_labels(folder: Path) -> None:
    data = open_dataset(folder)
    assert (data.kind, len(data)) == ("touch_and_go", 4)
    record = by_id(data)[f"{TWO}/0000000002.jpg"]
    assert near(colour_of(record.touch.read()), GREEN) and near(colour_of(record.picture.read()), shade(2))
    assert (record.sensor, record.recording, record.split) == ("gelsight", TWO, "test")
    assert {name: data.classes[name][number] for name, number in record.labels.items()} == {
        "material": "wood",
        "soft": "hard",
        "rough": "smooth",
    }
    leather = by_id(data)[f"{TWO}/0000000000.jpg"]
    assert data.classes["soft"][leather.labels["soft"]] == "soft" and "rough" not in leather.labels


def test_inconclusive_frames_are_left_out_and_counted(folder: Path) -> None:
    data = open_dataset(folder)
    assert f"{ONE}/0000000001.jpg" not in by_id(data)
    assert any("1 frames whose material is inconclusive" in note for note in data.notes)


def test_the_official_split_is_that_of_the_lists_and_says_that_it_leaks(folder: Path) -> None:
    train = open_dataset(folder).split("train")
    assert set(by_id(train)) == {f"{ONE}/0000000000.jpg", f"{TWO}/0000000000.jpg"}
    assert train.chosen == "train of the official split"
    assert any("1 of 2 recordings are in more than one" in note for note in train.notes)


def test_recordings_can_be_kept_apart(folder: Path) -> None:
    data = open_dataset(folder)
    parts = [data.split(name, "recording") for name in ("train", "val", "test")]
    recordings = [{record.recording for record in part.records} for part in parts]
    assert sorted(name for part in recordings for name in part) == [ONE, TWO, THREE]
    assert parts[0].chosen == "train, recordings kept apart" and not any("more than one" in n for n in parts[0].notes)


def test_names_of_materials_may_be_quoted_and_explained(folder: Path) -> None:
    lines = ["concrete: 0", '"synthetic fabric": 1', "tree: 2 (bark, and leaves: dry)", "Others: 3", "inconclusive: -1"]
    (folder / "category_reference.txt").write_text("\n".join(lines))
    write_lists(folder, label=f"{ONE}/0000000000.jpg,3\n", train="", test="")
    assert open_dataset(folder).materials == ("concrete", "synthetic fabric", "tree", "others")


# Videos ---------------------------------------------------------------------------------------------------------------

SHADES = [shade(number) for number in range(24)]


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_video(tmp_path_factory.mktemp("video") / "gelsight.mp4", SHADES)


def test_touch_and_picture_of_a_video_are_paired_by_time(folder: Path) -> None:
    place = folder / "dataset" / "20220604_120000"
    write_video(place / "gelsight.mp4", SHADES[:12])
    write_video(place / "video.mp4", SHADES[12:20], rate=15)
    start = 1.654e9
    np.save(place / "time2.npy", start + np.arange(12) / 30)
    np.save(
        place / "time1.npy", start + 0.1 + np.arange(8) / 15
    )  # the camera began three frames later, at half the rate
    write_lists(
        folder, label="".join(f"{place.name}/{number:010d}.jpg,1\n" for number in (11, 0, 7, 3)), train="", test=""
    )
    nearest = {0: 0, 3: 0, 7: 2, 11: 4}  # 7/30 s is 0.133 s after the camera's first frame, which is its frame 2
    for record in open_dataset(folder).records:
        number = int(record.id[-14:-4])
        assert near(colour_of(record.touch.read()), SHADES[number]), number
        assert near(colour_of(record.picture.read()), SHADES[12 + nearest[number]]), number


def test_a_video_without_times_is_paired_by_number(folder: Path) -> None:
    place = folder / "dataset" / ONE
    (place / "gelsight_frame").rename(folder / "elsewhere")
    write_video(place / "gelsight.mp4", SHADES[:8])
    write_video(place / "video.mp4", SHADES[8:16])
    write_lists(folder, label=f"{ONE}/0000000005.jpg,1\n", train="", test="")
    (record,) = open_dataset(folder).records
    assert near(colour_of(record.touch.read()), SHADES[5]) and near(colour_of(record.picture.read()), SHADES[13])


@settings(max_examples=25, deadline=None)
@given(order=st.lists(st.integers(0, 23), min_size=1, max_size=12))
def test_frames_of_a_video_are_the_same_in_any_order(order: list[int], video: Path) -> None:
    for number in order:
        assert near(colour_of(VideoFrame(str(video), number).read()), SHADES[number]), number


@pytest.mark.slow
def test_processes_that_are_forked_read_a_video_that_is_open(video: Path) -> None:
    assert in_own_process(read_by_forks, video) == list(range(22))  # one without the threads that other tests left


def read_by_forks(video: Path) -> list[int]:
    """The frames that two forked processes read right."""
    VideoFrame(str(video), 3).read()  # so that they would share its place in the file
    frames = Computed(len(SHADES), (3, 48, 64), np.uint8, lambda number: VideoFrame(str(video), number).read().numpy())
    steps = [[number, number + 1] for number in range(0, 22, 2)]
    loader = DataLoader(
        Batches(frames, steps), batch_size=None, num_workers=2, multiprocessing_context="fork", timeout=60
    )
    read = [pair for step, batch in zip(steps, loader, strict=True) for pair in zip(step, batch, strict=True)]
    return [number for number, frame in read if near(colour_of(frame), SHADES[number])]


class Batches(Dataset):
    """The rows of some steps."""

    def __init__(self, values: Computed, steps: list[list[int]]) -> None:
        self.values, self.steps = values, steps

    def __len__(self) -> int:
        return len(self.steps)

    def __getitem__(self, step: int) -> torch.Tensor:
        return torch.from_numpy(np.stack([self.values[number] for number in self.steps[step]]))


@pytest.mark.parametrize("number", [24, -1])
def test_a_frame_that_a_video_does_not_have_is_refused(number: int, video: Path) -> None:
    with pytest.raises(InvalidInputError, match=r"gelsight\.mp4.*has 24 frames"):
        VideoFrame(str(video), number).read()


def test_a_video_that_is_cut_short_is_refused(video: Path, tmp_path: Path) -> None:
    cut = tmp_path / "cut.mp4"
    cut.write_bytes(video.read_bytes()[:200])
    with pytest.raises(InvalidInputError, match=r"cut\.mp4.*cannot be read"):
        VideoFrame(str(cut), 0).read()


# What is refused ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("lists", "message"),
    [
        ({"train": f"{ONE}/0000000000.jpg,4\n"}, r"two labels of 20220601_182052/0000000000\.jpg"),
        ({"test": f"{ONE}/0000000000.jpg,3\n"}, r"two splits of 20220601_182052/0000000000\.jpg"),
        ({"label": f"{ONE}/0000000000.jpg,3\n{ONE}/0000000000.jpg,4\n"}, "in line 2; .* one label"),
        ({"label": f"{ONE}/0000000000.jpg;3\n"}, "0000000000.jpg;3' in line 1"),
        ({"label": f"{ONE}/0000000000.jpg,wood\n"}, "in line 1; a line is recording/frame.jpg,label"),
        ({"label": "20220101_000000/0000000000.jpg,3\n"}, "20220101_000000' is listed, but has no gelsight_frame"),
        ({"label": f"{ONE}/0000000000.jpg,20\n", "train": "", "test": ""}, r"no class for .*\(material 20\)"),
        ({"label": f"{ONE}/0000000000.jpg,-1\n", "train": "", "test": ""}, "has no records"),
    ],
)  # fmt: skip
def test_lists_that_cannot_be_meant_are_refused(folder: Path, lists: dict[str, str], message: str) -> None:
    write_lists(folder, **lists)
    with pytest.raises(InvalidInputError, match=rf"read as touch_and_go: .*{message}"):
        open_dataset(folder)


def test_a_list_in_another_encoding_is_refused(folder: Path) -> None:
    (folder / "label.txt").write_bytes(f"{ONE}/0000000000.jpg,3\n".encode("utf-16"))
    with pytest.raises(InvalidInputError, match=r"label\.txt' cannot be read as a text: it is not in UTF-8"):
        open_dataset(folder)


@pytest.mark.parametrize("times", [np.zeros((3, 2)), np.array([1, 2, 3]), np.array([1.0, np.nan]), np.zeros(0)])
def test_times_that_are_none_are_refused(folder: Path, times: np.ndarray) -> None:
    place = folder / "dataset" / ONE
    (place / "gelsight_frame").rename(folder / "elsewhere")
    (place / "gelsight.mp4").touch()
    np.save(place / "time2.npy", times)
    with pytest.raises(InvalidInputError, match=r"time2\.npy' cannot be used: it has to hold seconds"):
        open_dataset(folder)


def test_a_label_beyond_the_times_is_refused(folder: Path) -> None:
    place = folder / "dataset" / ONE
    (place / "gelsight_frame").rename(folder / "elsewhere")
    (place / "gelsight.mp4").touch()
    for name in ("time1", "time2"):
        np.save(place / f"{name}.npy", np.arange(4.0))
    write_lists(folder, label=f"{ONE}/0000000004.jpg,3\n", train="", test="")
    with pytest.raises(InvalidInputError, match="has 4 times, but a label for 4"):
        open_dataset(folder)
