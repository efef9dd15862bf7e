"""Data sets as the columns that stages are trained on: decoded once, checked before, mixed."""

import json
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch
from PIL import Image

from tests.helpers.data_sets import BLUE, GREEN, RED, shade, write_image
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.models import UniTouchModel, UniTouchProcessor
from unitouch_gen.training.data import DataConfig, RecordSet, Rendered, columns_of, material_names, open_dataset
from unitouch_gen.training.stages import Stage, run
from unitouch_gen.world import MATERIAL_NAMES

COUNT = 20


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Twenty touches with pictures, captions and sounds, of five objects; noise, so that every one is its own."""
    rng, rows = np.random.default_rng(0), ["touch,picture,sound,sensor,material,object,caption"]
    place = tmp_path / "mine"
    place.mkdir()
    for number in range(COUNT):
        for name in ("touch", "picture"):
            pixels = rng.integers(0, 256, (36, 48, 3), dtype=np.uint8)
            Image.fromarray(pixels).save(place / f"{name}{number}.png")
        tone = np.sin(np.arange(4000) * (0.05 + 0.02 * number)).astype(np.float32)
        soundfile.write(place / f"{number}.wav", tone, 16000)
        material, sensor = ("wood", "glass", "cork")[number % 3], "digit" if number < 15 else "gelsight"
        rows.append(f"touch{number}.png,picture{number}.png,{number}.wav,{sensor},{material},o{number % 5},n{number}")
    (place / "labels.csv").write_text("\n".join(rows))
    return place


def config(folder: Path, **changes: object) -> DataConfig:
    return DataConfig(sets=[{"path": str(folder), "split": "none"}], **changes)


def columns(
    folder: Path, cache: Path, processor: UniTouchProcessor, *needs: str, **changes: object
) -> tuple[list[RecordSet], list[Rendered]]:
    settings = config(folder, **changes)
    sources = settings.sources()
    return sources, columns_of(sources, cache, settings, processor, needs)


@pytest.mark.parametrize("split", ["object", "none"])
def test_what_is_held_out_is_not_trained_on(folder: Path, split: str) -> None:
    data = DataConfig(sets=[{"path": str(folder), "split": split}])
    trained = {record.id for part in data.sources() for record in part.records}
    held = data.held_out(3)
    assert all(1 < len(part) <= 3 and not trained & {r.id for r in part.records} for part in held)
    assert bool(held) == (split == "object")


EVERYTHING = ("image", "touch", "audio", "text", "material", "sensor")


@pytest.mark.parametrize("stream", [False, True])
def test_every_row_is_what_the_processor_makes_of_its_files(
    stream: bool, folder: Path, tmp_path: Path, processor: UniTouchProcessor
) -> None:
    _, splits = columns(folder, tmp_path / "cache", processor, *EVERYTHING, stream=stream, touch_size=24)
    assert [(split.sensor, len(split)) for split in splits] == [("digit", 15), ("gelsight", 5)]
    smaller = UniTouchProcessor(image_size=24)
    for split, first in zip(splits, (0, 15), strict=True):
        for row in range(len(split)):
            number = first + row
            image = processor.raw_images(str(folder / f"picture{number}.png"))[0].numpy()
            touch = smaller.raw_images(str(folder / f"touch{number}.png"))[0].numpy()
            np.testing.assert_allclose(split.image[row] / 255.0, image, atol=0.5 / 255 + 1e-6)
            np.testing.assert_allclose(split.touch[row] / 255.0, touch, atol=0.5 / 255 + 1e-6)
            sound = processor.sounds(str(folder / f"{number}.wav"))[0, 0].numpy()
            np.testing.assert_allclose(split.audio[row], sound, rtol=1e-3, atol=1e-3)
            assert split.text[row] == f"n{number}"
        assert split.image.dtype == split.touch.dtype == np.uint8 and split.touch.shape[1:] == (3, 24, 24)
        np.testing.assert_array_equal(split.image[2:4], np.stack([split.image[2], split.image[3]]))
        np.testing.assert_array_equal(split.image[np.array([3, 1])], np.stack([split.image[3], split.image[1]]))


def test_what_is_decoded_is_mapped_from_disk_and_not_decoded_again(
    folder: Path, tmp_path: Path, processor: UniTouchProcessor
) -> None:
    _, (first, _) = columns(folder, tmp_path, processor, "image", "touch")
    assert isinstance(first.image, np.memmap) and first.audio is None
    files = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.npy")}
    assert len(files) == 4  # pictures and touches of two sensors
    for number in range(COUNT):  # their sizes stay
        (folder / f"picture{number}.png").write_bytes(bytes((folder / f"picture{number}.png").stat().st_size))
    again, other = config(folder), tmp_path / "again"
    assert len(columns_of(again.sources(), tmp_path, again, processor, ["touch"])) == 2
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("values.npy")} == files
    with pytest.raises(InvalidInputError, match="cannot be read as an image"):
        columns(folder, other, processor, "image")


@pytest.mark.parametrize("change", ["another file", "another label", "another size"])
def test_what_has_changed_is_decoded_anew_and_has_another_fingerprint(
    change: str, folder: Path, tmp_path: Path, processor: UniTouchProcessor
) -> None:
    _, (before, _) = columns(folder, tmp_path, processor, "touch", "material")
    if change == "another file":
        write_image(folder / "touch3.png", RED, (48, 36))
    if change == "another label":
        table = (folder / "labels.csv").read_text()
        (folder / "labels.csv").write_text(
            table.replace("touch0.png,picture0.png,0.wav,digit,wood", "touch0.png,picture0.png,0.wav,digit,glass")
        )
    size = 16 if change == "another size" else None
    _, (after, _) = columns(folder, tmp_path, processor, "touch", "material", touch_size=size)
    assert after.fingerprint != before.fingerprint
    if change == "another file":
        assert np.abs(after.touch[3].reshape(3, -1).mean(axis=1) - RED).max() < 1
    np.testing.assert_array_equal(after.touch.shape[2:], (size or 32, size or 32))


def test_a_file_in_the_middle_that_is_broken_leaves_no_cache(
    folder: Path, tmp_path: Path, processor: UniTouchProcessor
) -> None:
    (folder / "touch7.png").write_bytes(b"\x89PNG")
    with pytest.raises(
        InvalidInputError, match=r"Data set 'mine' \(folder; all.*\), record 'touch7\.png': .*cannot be read"
    ):
        columns(folder, tmp_path / "cache", processor, "touch")
    assert not list((tmp_path / "cache").rglob("*.npy"))


@pytest.mark.parametrize("number", [0, 14, 15, 19])
def test_first_and_last_files_are_read_before_anything_is_decoded(
    number: int, folder: Path, tmp_path: Path, processor: UniTouchProcessor
) -> None:
    (folder / f"picture{number}.png").write_bytes(b"\x89PNG")
    with pytest.raises(InvalidInputError, match=rf"record 'touch{number}\.png': .*picture{number}\.png'"):
        columns(folder, tmp_path / "cache", processor, "touch", "image")
    assert not (tmp_path / "cache").exists()


@pytest.mark.parametrize(
    ("need", "column"),
    [("image", "picture"), ("audio", "sound"), ("text", "caption"), ("material", "material"), ("sensor", "sensor")],
)
def test_what_a_record_lacks_is_named_before_anything_is_decoded(
    need: str, column: str, folder: Path, tmp_path: Path, processor: UniTouchProcessor
) -> None:
    header, *rows = (folder / "labels.csv").read_text().splitlines()
    cells = rows[4].split(",")
    cells[header.split(",").index(column)] = ""
    (folder / "labels.csv").write_text("\n".join([header, *rows[:4], ",".join(cells), *rows[5:]]))
    with pytest.raises(
        InvalidInputError, match=rf"Data set 'mine' .* has no {need} for 'touch4\.png'; this stage needs"
    ):
        columns(folder, tmp_path / "cache", processor, "touch", need)
    assert not (tmp_path / "cache").exists()


def test_one_record_is_too_few(tmp_path: Path, processor: UniTouchProcessor) -> None:
    write_image(tmp_path / "one" / "a.png", RED)
    with pytest.raises(InvalidInputError, match=r"Data set 'one' .* has a single record"):
        columns(tmp_path / "one", tmp_path, processor, "touch")


def test_samples_of_sounds_need_a_rate(folder: Path, tmp_path: Path, processor: UniTouchProcessor) -> None:
    for number in range(COUNT):
        samples, _ = soundfile.read(folder / f"{number}.wav", dtype="float32")
        np.save(folder / f"{number}.npy", samples)
    (folder / "labels.csv").write_text((folder / "labels.csv").read_text().replace(".wav", ".npy"))
    with pytest.raises(InvalidInputError, match=r"sound of .* without a sampling rate"):
        columns(folder, tmp_path / "cache", processor, "audio")
    rated = DataConfig(sets=[{"path": str(folder), "split": "none", "sampling_rate": 16000}])
    split = columns_of(rated.sources(), tmp_path / "cache", rated, processor, ["audio"])[0]
    clips = processor.sounds(str(folder / "4.wav"))[0, 0]
    np.testing.assert_allclose(split.audio[4], clips, rtol=2e-2, atol=2e-2)  # 16 bits of a file


# Mixtures -------------------------------------------------------------------------------------------------------------


def test_materials_of_a_mixture_are_those_of_the_world_and_what_others_add(
    folder: Path, tmp_path: Path, processor: UniTouchProcessor, cache: Path
) -> None:
    mixed = config(folder, drawn={"sensors": ["digit"]})
    sources = mixed.sources()
    names = material_names(sources)
    assert names == (*MATERIAL_NAMES, "cork")
    split = columns_of(sources[1:], tmp_path, mixed, processor, ["material"])[0]
    assert material_names(sources[1:]) == ("cork", "glass", "wood")
    assert [material_names(sources[1:])[number] for number in split.material[:3]] == ["wood", "glass", "cork"]


def test_the_worlds_materials_keep_their_numbers() -> None:
    assert material_names(DataConfig(drawn={}).sources()) == MATERIAL_NAMES


def test_materials_that_are_numbers_are_not_mixed(folder: Path, tmp_path: Path) -> None:
    for number in range(3):
        write_image(tmp_path / "numbered" / str(number) / "a.png", shade(number))
    sets = [{"path": str(folder), "split": "none"}, {"path": str(tmp_path / "numbered"), "split": "none"}]
    with pytest.raises(InvalidInputError, match=r"numbers for materials cannot be mixed .* `materials`"):
        material_names(DataConfig(sets=sets).sources())
    assert material_names(DataConfig(sets=sets[1:]).sources()) == ("0", "1", "2")
    sets[1]["materials"] = ["wood", "iron", "clay"]
    assert material_names(DataConfig(sets=sets).sources()) == ("cork", "glass", "wood", "iron", "clay")


@pytest.mark.parametrize("given", [{}, {"sets": []}, {"drawn": None, "stream": True}])
def test_data_that_name_nothing_are_refused(given: dict) -> None:
    with pytest.raises(InvalidInputError, match=r"`data` names nothing to train on; give it `sets`, .* or `drawn`"):
        DataConfig(**given).check_named()


# Splits ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [3, 4, 10, 25])
def test_splits_by_objects_are_disjoint_whole_and_do_not_depend_on_the_order(count: int, tmp_path: Path) -> None:
    rows = [f"{item}-{touch}.png,object {item}" for item in range(count) for touch in range(2)]
    for row in rows:
        write_image(tmp_path / row.split(",")[0], RED)
    (tmp_path / "labels.csv").write_text("\n".join(["touch,object", *rows]))
    data = open_dataset(tmp_path)
    parts = {name: {record.id for record in data.split(name).records} for name in ("train", "val", "test")}
    assert sum(map(len, parts.values())) == 2 * count == len(set.union(*parts.values()))
    assert {name: len(part) // 2 for name, part in parts.items() if name != "train"} == dict.fromkeys(
        ("val", "test"), max(round(count / 10), 1)
    )
    (tmp_path / "labels.csv").write_text("\n".join(["touch,object", *reversed(rows)]))
    again = open_dataset(tmp_path)
    assert {record.id for record in again.split("val").records} == parts["val"]


@pytest.mark.parametrize(
    ("by", "message"),
    [("official", "has the splits None, and no 'train'"), ("recording", "has the recordings None, and no 'train'")],
)
def test_a_split_by_what_is_not_known_is_refused(by: str, message: str, folder: Path) -> None:
    with pytest.raises(InvalidInputError, match=rf"`split` is '{by}', but Data set 'mine' .* {message}"):
        open_dataset(folder).split("train", by)


# Stages ---------------------------------------------------------------------------------------------------------------

SHORT = [
    "--set",
    "trainer.steps=2",
    "--set",
    "trainer.batch_size=4",
    "--set",
    "trainer.warmup=1",
    "--set",
    "trainer.mixed_precision=no",
]


ALONE = [word for name in ("touch", "attributes", "maps") for word in ("--set", f"objective.{name}=0")]
SMALL = ("--set", "data.image_size=32", "--set", "objective.attributes=0")


def trained(name: str, folder: Path, place: Path, *words: str, split: str = "none") -> dict:
    """The record of a stage that was run on the folder alone."""
    sets = f"data.sets=[{{path: {folder}, split: {split}}}]"
    output = ["--output", str(place / name), "--cache", str(place / "cache")]
    run(name, import_module(f"unitouch_gen.training.{name}").main, [*SHORT, "--set", sets, *output, *words])
    return json.loads((place / name / "record.json").read_text())


def test_touch_is_bound_to_the_pictures_of_a_folder(folder: Path, tmp_path: Path, joint: str) -> None:
    record = trained("touch", folder, tmp_path, "--joint", joint, *ALONE, split="object")
    assert record["sets"] == [
        {"set": "mine", "kind": "folder", "split": "train, objects kept apart", "sensor": name, "records": count}
        for name, count in (("digit", 9), ("gelsight", 3))
    ]
    model = UniTouchModel.from_pretrained(tmp_path / "touch" / "model", modalities=("touch",))
    assert model.sensor_bank.names == ("digit", "gelsight")
    rows = [r.split(",")[0] for r in (folder / "labels.csv").read_text().splitlines() if ",gelsight," in r]
    kept = [name for name in rows if name in {r.id for r in open_dataset(folder).split("train").records}]
    mean = torch.stack([UniTouchProcessor(32).raw_images(str(folder / name))[0] for name in kept]).mean(dim=0)
    torch.testing.assert_close(model.sensor_bank.prototype("gelsight"), mean, atol=1 / 255, rtol=0)


@pytest.mark.parametrize("stream", ["false", "true"])
def test_a_classifier_names_the_materials_of_a_folder(stream: str, folder: Path, tmp_path: Path) -> None:
    trained("touch_classifier", folder, tmp_path, "--set", f"data.stream={stream}", *SMALL)
    config = json.loads((tmp_path / "touch_classifier" / "model" / "config.json").read_text())
    assert config["id2label"] == {"0": "cork", "1": "glass", "2": "wood"}
    assert (tmp_path / "cache").exists() == (stream == "false")


def test_pictures_of_other_data_have_another_key(folder: Path, tmp_path: Path, processor: UniTouchProcessor) -> None:
    def key() -> str:
        stage = Stage("image_text", overrides=[f"data.sets=[{{path: {folder}, split: none}}]"], cache=tmp_path)
        return stage.key(stage.splits(processor, "image", "text"))

    first = key()
    assert first.startswith("mine-train") and key() == first
    write_image(folder / "picture5.png", BLUE, (48, 36))
    second = key()
    write_image(folder / "picture5.png", GREEN, (64, 36))
    assert len({first, second, key()}) == 3


def test_a_stage_refuses_a_set_that_is_misspelled(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match=r"`data\.sets\.0\.pth` is .*not permitted|Field required"):
        Stage("touch_vae", overrides=[f"data.sets=[{{pth: {folder}}}]"], output=tmp_path)
