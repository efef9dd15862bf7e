"""Data sets as the columns that stages are trained on: decoded once, refused where they are broken, mixed, split."""

import copy
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
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.training.data import (
    DataConfig,
    Rendered,
    columns_of,
    image_embeddings,
    material_names,
    open_dataset,
    weights_hash,
)
from unitouch_gen.training.stages import Stage, run
from unitouch_gen.world import MATERIAL_NAMES

EVERYTHING = ("image", "touch", "audio", "text", "material", "sensor")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Twenty touches with pictures, captions and sounds, of five objects; noise, so that every one is its own."""
    rng, rows = np.random.default_rng(0), ["touch,picture,sound,sensor,material,object,caption"]
    place = tmp_path / "mine"
    place.mkdir()
    for number in range(20):
        for name in ("touch", "picture"):
            pixels = rng.integers(0, 256, (36, 48, 3), dtype=np.uint8)
            Image.fromarray(pixels).save(place / f"{name}{number}.png")
        tone = np.sin(np.arange(4000) * (0.05 + 0.02 * number)).astype(np.float32)
        soundfile.write(place / f"{number}.wav", tone, 16000)
        material, sensor = ("wood", "glass", "cork")[number % 3], "digit" if number < 15 else "gelsight"
        rows.append(f"touch{number}.png,picture{number}.png,{number}.wav,{sensor},{material},o{number % 5},n{number}")
    (place / "labels.csv").write_text("\n".join(rows))
    return place


def columns(folder: Path, cache: Path, processor: UniTouchProcessor, *needs: str, **changes: object) -> list[Rendered]:
    config = DataConfig(sets=[{"path": str(folder), "split": "none"}], **changes)
    return columns_of(config.sources(), cache, config, processor, needs)


# Cached and fresh -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("stream", [False, True])
def test_every_row_is_what_the_processor_makes_of_its_files(
    stream: bool, folder: Path, tmp_path: Path, processor: UniTouchProcessor
) -> None:
    splits = columns(folder, tmp_path / "cache", processor, *EVERYTHING, stream=stream, touch_size=24)
    assert [(split.sensor, len(split)) for split in splits] == [("digit", 15), ("gelsight", 5)]
    assert (tmp_path / "cache").exists() == (not stream)
    smaller = UniTouchProcessor(image_size=24)
    for split, first in zip(splits, (0, 15), strict=True):
        for row, number in enumerate(range(first, first + len(split))):
            image = processor.raw_images(str(folder / f"picture{number}.png"))[0].numpy()
            touch = smaller.raw_images(str(folder / f"touch{number}.png"))[0].numpy()
            sound = processor.sounds(str(folder / f"{number}.wav"))[0, 0].numpy()
            np.testing.assert_allclose(split.image[row] / 255.0, image, atol=0.5 / 255 + 1e-6)
            np.testing.assert_allclose(split.touch[row] / 255.0, touch, atol=0.5 / 255 + 1e-6)
            np.testing.assert_allclose(split.audio[row], sound, rtol=1e-3, atol=1e-3)
            assert split.text[row] == f"n{number}"
        few = split.thinned(3)
        np.testing.assert_array_equal(few.touch, split.touch[[0, (len(split) - 1) // 2, len(split) - 1]])


def test_what_is_cached_is_the_same_and_is_not_decoded_again(
    folder: Path, tmp_path: Path, processor: UniTouchProcessor
) -> None:
    fresh = columns(folder, tmp_path, processor, "touch", "image", stream=True)
    first = columns(folder, tmp_path, processor, "touch", "image")
    files = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("values.npy")}
    again = columns(folder, tmp_path, processor, "touch", "image")
    assert len(files) == 4 and {path: path.stat().st_mtime_ns for path in tmp_path.rglob("values.npy")} == files
    for one, other, third in zip(fresh, first, again, strict=True):
        assert isinstance(third.touch, np.memmap)
        assert one.fingerprint == other.fingerprint == third.fingerprint
        for name in ("touch", "image", "material", "object"):
            np.testing.assert_array_equal(getattr(one, name)[:], getattr(other, name))
            np.testing.assert_array_equal(getattr(other, name), getattr(third, name))


@pytest.mark.parametrize("change", ["a file", "a label", "the size"])
def test_what_has_changed_has_another_fingerprint(
    change: str, folder: Path, tmp_path: Path, processor: UniTouchProcessor
) -> None:
    before = columns(folder, tmp_path, processor, "touch", "material")[0]
    if change == "a file":
        write_image(folder / "touch3.png", RED, (48, 36))
    if change == "a label":
        table = (folder / "labels.csv").read_text()
        (folder / "labels.csv").write_text(table.replace("0.wav,digit,wood", "0.wav,digit,glass"))
    size = 16 if change == "the size" else 32
    after = columns(folder, tmp_path, processor, "touch", "material", touch_size=size)[0]
    assert after.fingerprint != before.fingerprint and after.touch.shape[2:] == (size, size)
    assert (np.abs(after.touch[3].reshape(3, -1).mean(axis=1) - RED).max() < 1) == (change == "a file")


PICTURES = np.random.default_rng(0).integers(0, 256, (7, 3, 32, 32), dtype=np.uint8)


def test_embeddings_are_the_encoders_and_computed_once_for_its_weights(model: UniTouchModel, tmp_path: Path) -> None:
    embeds = image_embeddings(model, [PICTURES[:4], PICTURES[4:]], "k", tmp_path, batch_size=3)
    with torch.no_grad():
        expected = model.get_image_features(normalise_pixels(torch.from_numpy(PICTURES) / 255.0))
    torch.testing.assert_close(embeds, expected)
    assert torch.equal(image_embeddings(model, [], "k", tmp_path), embeds)  # no picture is looked at
    assert len(image_embeddings(model, [PICTURES[:2]], "other", tmp_path)) == 2
    with torch.no_grad():
        model.vision_model.visual_projection.weight[3, 5] += 1.0
    assert not torch.equal(image_embeddings(model, [PICTURES], "k", tmp_path), embeds)


def test_a_hash_changes_with_any_weight_and_with_nothing_else(model: UniTouchModel) -> None:
    module = model.touch_model
    hashes = {weights_hash(module)}
    assert weights_hash(copy.deepcopy(module).train()) in hashes
    for parameter in module.parameters():
        with torch.no_grad():
            parameter.view(-1)[-1] += 1e-4
        hashes.add(weights_hash(module))
    assert len(hashes) == 1 + len(list(module.parameters()))


# What is refused ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("stream", [False, True])
def test_broken_files_are_refused_in_a_list_and_leave_no_cache(
    stream: bool, folder: Path, tmp_path: Path, processor: UniTouchProcessor
) -> None:
    for number in (3, 7, 11):
        (folder / f"touch{number}.png").write_bytes(b"\x89PNG")
    message = r"Data set 'mine' .*: 3 of 15 records cannot be read: .*touch3\.png.*touch7\.png.*touch11\.png"
    with pytest.raises(InvalidInputError, match=message):
        columns(folder, tmp_path / "cache", processor, "touch", stream=stream)
    assert not (tmp_path / "cache").exists() or list((tmp_path / "cache").iterdir()) == []


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
    message = rf"Data set 'mine' .* has no {need} for 'touch4\.png'; this stage needs"
    with pytest.raises(InvalidInputError, match=message):
        columns(folder, tmp_path / "cache", processor, "touch", need)
    assert not (tmp_path / "cache").exists()


def test_samples_of_sounds_need_a_rate(folder: Path, tmp_path: Path, processor: UniTouchProcessor) -> None:
    for number in range(20):
        samples, _ = soundfile.read(folder / f"{number}.wav", dtype="float32")
        np.save(folder / f"{number}.npy", samples)
    (folder / "labels.csv").write_text((folder / "labels.csv").read_text().replace(".wav", ".npy"))
    with pytest.raises(InvalidInputError, match=r"0\.npy.* without a sampling rate"):
        columns(folder, tmp_path / "cache", processor, "audio")
    rated = DataConfig(sets=[{"path": str(folder), "split": "none", "sampling_rate": 16000}])
    split = columns_of(rated.sources(), tmp_path / "cache", rated, processor, ["audio"])[0]
    clips = processor.sounds(str(folder / "4.wav"))[0, 0]
    np.testing.assert_allclose(split.audio[4], clips, rtol=2e-2, atol=2e-2)  # 16 bits of a file


def test_materials_that_are_numbers_are_not_mixed_with_others(folder: Path, tmp_path: Path) -> None:
    for number in range(3):
        write_image(tmp_path / "numbered" / str(number) / "a.png", shade(number))
    sets = [{"path": str(folder), "split": "none"}, {"path": str(tmp_path / "numbered"), "split": "none"}]
    with pytest.raises(InvalidInputError, match=r"numbers cannot be mixed .* `materials`"):
        material_names(DataConfig(sets=sets).sources())
    assert material_names(DataConfig(sets=sets[1:]).sources()) == ("0", "1", "2")
    sets[1]["materials"] = ["wood", "iron", "clay"]
    assert material_names(DataConfig(sets=sets).sources()) == ("cork", "glass", "wood", "iron", "clay")
    mixed = DataConfig(sets=sets, drawn={"sensors": ["digit"]})
    assert material_names(mixed.sources())[: len(MATERIAL_NAMES)] == MATERIAL_NAMES  # they keep their numbers


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({}, "`data` names nothing; give `data` sets, .* or `drawn`"),
        ({"drawn": None, "stream": True}, "`data` names nothing"),
        ({"sets": [{"path": "touches"}], "grasps": [None]}, r"`data\.grasps` are of contacts"),
    ],
)
def test_data_that_name_nothing_are_refused(given: dict, message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        DataConfig(**given).check_named()


# Splits ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [3, 4, 10, 25])
def test_splits_by_objects_are_disjoint_whole_and_do_not_depend_on_the_order(count: int, tmp_path: Path) -> None:
    rows = [f"{item}-{touch}.png,object {item}" for item in range(count) for touch in range(2)]
    for row in rows:
        write_image(tmp_path / row.split(",")[0], RED)
    (tmp_path / "labels.csv").write_text("\n".join(["touch,object", *rows]))
    data = open_dataset(tmp_path)
    parts = {name: {record.object for record in data.split(name).records} for name in ("train", "val", "test")}
    assert sum(map(len, parts.values())) == count == len(set.union(*parts.values()))
    assert len(parts["val"]) == len(parts["test"]) == max(round(count / 10), 1)
    (tmp_path / "labels.csv").write_text("\n".join(["touch,object", *reversed(rows)]))
    assert {record.object for record in open_dataset(tmp_path).split("val").records} == parts["val"]


@pytest.mark.parametrize("by", ["official", "recording"])
def test_a_split_by_what_is_not_known_is_refused(by: str, folder: Path) -> None:
    with pytest.raises(InvalidInputError, match=rf"`split` is '{by}', but Data set 'mine' .* and no 'train'"):
        open_dataset(folder).split("train", by)


@pytest.mark.parametrize("split", ["object", "none"])
def test_what_is_held_out_is_not_trained_on(folder: Path, split: str) -> None:
    data = DataConfig(sets=[{"path": str(folder), "split": split}])
    trained = {record.object for part in data.sources() for record in part.records}
    held = data.held_out(3)
    assert all(1 < len(part) <= 3 and not trained & {r.object for r in part.records} for part in held)
    assert bool(held) == (split == "object")


# Stages ---------------------------------------------------------------------------------------------------------------


def trained(name: str, folder: Path, place: Path, *words: str, split: str = "none") -> dict:
    """The record of a stage that was run on the folder alone."""
    short = ["trainer.steps=2", "trainer.batch_size=4", "trainer.warmup=1", "trainer.mixed_precision=no"]
    sets = f"data.sets=[{{path: {folder}, split: {split}}}]"
    settings = [part for word in (*short, sets, *words) for part in ("--set", word)]
    output = ["--output", str(place / name), "--cache", str(place / "cache")]
    joint = ["--joint", str(place / "joint")] if name == "touch" else []
    run(name, import_module(f"unitouch_gen.training.{name}").main, [*settings, *output, *joint])
    return json.loads((place / name / "record.json").read_text())


@pytest.mark.usefixtures("joint")
def test_touch_is_bound_to_the_pictures_of_a_folder(folder: Path, tmp_path: Path) -> None:
    alone = [f"objective.{name}=0" for name in ("touch", "attributes", "maps")]
    record = trained("touch", folder, tmp_path, *alone, split="object")
    assert record["sets"] == [
        {"set": "mine", "kind": "folder", "split": "train, objects kept apart", "sensor": name, "records": count}
        for name, count in (("digit", 9), ("gelsight", 3))
    ]
    model = UniTouchModel.from_pretrained(tmp_path / "touch" / "model", modalities=("touch",))
    assert model.sensor_bank.names == ("digit", "gelsight")
    kept = [record.touch.path for record in open_dataset(folder).split("train").by_sensor()[1].records]
    mean = torch.stack([UniTouchProcessor(32).raw_images(file)[0] for file in kept]).mean(dim=0)
    torch.testing.assert_close(model.sensor_bank.prototype("gelsight"), mean, atol=1 / 255, rtol=0)


def test_a_classifier_names_the_materials_of_a_folder(folder: Path, tmp_path: Path) -> None:
    trained("touch_classifier", folder, tmp_path, "data.image_size=32", "objective.attributes=0")
    config = json.loads((tmp_path / "touch_classifier" / "model" / "config.json").read_text())
    assert config["id2label"] == {"0": "cork", "1": "glass", "2": "wood"}


def test_pictures_of_other_data_have_another_key(folder: Path, tmp_path: Path, processor: UniTouchProcessor) -> None:
    def key() -> str:
        stage = Stage("image_text", overrides=[f"data.sets=[{{path: {folder}, split: none}}]"], cache=tmp_path)
        return stage.key(stage.splits(processor, "image", "text"))

    keys = [key(), key()]
    for colour in (BLUE, GREEN):
        write_image(folder / "picture5.png", colour, (48, 36))
        keys.append(key())
    assert keys[0].startswith("mine-train") and keys[0] == keys[1] and len(set(keys)) == 3


def test_a_stage_refuses_a_set_that_is_misspelled(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match=r"`data\.sets\.0\.pth` is .*not permitted|Field required"):
        Stage("touch_vae", overrides=[f"data.sets=[{{pth: {folder}}}]"], output=tmp_path)
