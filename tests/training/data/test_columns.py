"""Data sets as the columns that stages are trained on: decoded once, refused where they are broken, mixed, split."""

import json
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch
from accelerate.state import AcceleratorState
from PIL import Image

from tests.helpers.data_sets import RED, write_image
from unitouch_gen.commands import run_commands
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.models import UniTouchModel, UniTouchProcessor
from unitouch_gen.training.commands import app
from unitouch_gen.training.data import Contacts, DataConfig, columns_of, computed_once, open_dataset


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Twenty touches with pictures, captions and sounds, of five objects; noise, so that every one is its own."""
    rng = np.random.default_rng(0)
    rows = ["touch,picture,sound,sensor,material,object,caption"]
    place = tmp_path / "mine"
    place.mkdir()
    for number in range(20):
        for name in ("touch", "picture"):
            pixels = rng.integers(0, 256, (36, 48, 3), dtype=np.uint8)
            Image.fromarray(pixels).save(place / f"{name}{number}.png")
        tone = np.sin(np.arange(4000) * (0.05 + 0.02 * number)).astype(np.float32)
        soundfile.write(place / f"{number}.wav", tone, 16000)
        material = ("wood", "glass", "cork")[number % 3]
        sensor = "digit" if number < 15 else "gelsight"
        rows.append(f"touch{number}.png,picture{number}.png,{number}.wav,{sensor},{material},o{number % 5},n{number}")
    (place / "labels.csv").write_text("\n".join(rows))
    return place


def columns(folder: Path, cache: Path, processor: UniTouchProcessor, *needs: str, **changes: object) -> list[Contacts]:
    config = DataConfig(sets=[{"path": str(folder), "split": "none"}], **changes)
    return columns_of(config.sources(), cache, config, processor, needs)


def test_rows_are_what_the_processor_makes_of_files_and_decoded_once(folder, tmp_path, processor) -> None:
    needs = ("image", "touch", "audio", "text", "sensor")
    written = columns(folder, tmp_path / "cache", processor, *needs, touch_size=24)
    files = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("values.npy")}
    cached = columns(folder, tmp_path / "cache", processor, *needs, touch_size=24)
    assert len(files) == 6
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("values.npy")} == files
    for one, other in zip(written, cached, strict=True):
        assert isinstance(other.touch, np.memmap)
        assert one.fingerprint == other.fingerprint
        for name in ("image", "touch", "audio"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert [({*split.sensors}, len(split)) for split in cached] == [({"digit"}, 15), ({"gelsight"}, 5)]
    smaller = UniTouchProcessor(image_size=24)
    split = cached[1]
    for row, number in enumerate(range(15, 20)):
        image = processor.raw_images(str(folder / f"picture{number}.png"))[0].numpy()
        touch = smaller.raw_images(str(folder / f"touch{number}.png"))[0].numpy()
        sound = processor.sounds(str(folder / f"{number}.wav"))[0, 0].numpy()
        np.testing.assert_allclose(split.image[row] / 255.0, image, atol=0.5 / 255 + 1e-6)
        np.testing.assert_allclose(split.touch[row] / 255.0, touch, atol=0.5 / 255 + 1e-6)
        np.testing.assert_allclose(split.audio[row], sound, rtol=1e-3, atol=1e-3)
        assert split.text[row] == f"n{number}"


def test_a_changed_data_set_has_another_fingerprint(folder: Path, tmp_path: Path, processor: UniTouchProcessor) -> None:
    before = columns(folder, tmp_path, processor, "touch")[0]
    table = (folder / "labels.csv").read_text()
    (folder / "labels.csv").write_text(table.replace("0.wav,digit,wood", "0.wav,digit,glass"))
    named = columns(folder, tmp_path, processor, "touch")[0]
    write_image(folder / "touch3.png", RED, (48, 36))
    after = columns(folder, tmp_path, processor, "touch")[0]
    assert len({before.fingerprint, named.fingerprint, after.fingerprint}) == 3
    assert np.abs(after.touch[3].reshape(3, -1).mean(axis=1) - RED).max() < 1


def test_computed_once_reads_its_cache(tmp_path: Path) -> None:
    values = torch.rand(7, 3)
    file = tmp_path / "cache" / "values.safetensors"
    assert torch.equal(computed_once(file, lambda: values), values)
    assert torch.equal(computed_once(file, pytest.fail), values)


def test_broken_files_are_refused_in_a_list_and_leave_no_cache(folder, tmp_path, processor) -> None:
    for number in (3, 7, 11):
        (folder / f"touch{number}.png").write_bytes(b"\x89PNG")
    message = r"Data set 'mine' .*: 3 of 15 records cannot be read: .*touch3\.png.*touch7\.png.*touch11\.png"
    with pytest.raises(InvalidInputError, match=message):
        columns(folder, tmp_path / "cache", processor, "touch")
    assert list((tmp_path / "cache").glob("*")) == []


@pytest.mark.parametrize("need", ["image", "text", "audio"])
def test_columns_name_what_a_record_lacks_before_anything_is_decoded(need, folder, tmp_path, processor) -> None:
    cells = {"image": "picture4.png", "text": "n4", "audio": "4.wav"}
    header, *rows = (folder / "labels.csv").read_text().splitlines()
    rows[4] = ",".join("" if cell == cells[need] else cell for cell in rows[4].split(","))
    (folder / "labels.csv").write_text("\n".join([header, *rows]))
    with pytest.raises(InvalidInputError, match=rf"Data set 'mine' .* has no {need} for 'touch4\.png'; this stage"):
        columns(folder, tmp_path / "cache", processor, "touch", need)
    assert not (tmp_path / "cache").exists()


@pytest.mark.parametrize("count", [3, 25])
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
    for by in ("official", "recording"):
        with pytest.raises(InvalidInputError, match=rf"`split` is '{by}', but Data set .* and no 'train'"):
            data.split("train", by)


def test_touch_is_bound_to_the_pictures_of_a_folder(folder: Path, tmp_path: Path, joint: str) -> None:
    settings = [
        "trainer.steps=2",
        "trainer.batch_size=4",
        "trainer.warmup=1",
        "trainer.mixed_precision=no",
        f"data.sets=[{{path: {folder}, split: object}}]",
        *(f"objective.{name}=0" for name in ("touch", "attributes", "maps")),
    ]
    words = ["touch", "--output", str(tmp_path / "touch"), "--cache", str(tmp_path / "cache"), "--joint", joint]
    run_commands(app, "unitouch_gen.training", [*words, *(part for one in settings for part in ("--set", one))])
    sets = json.loads((tmp_path / "touch" / "record.json").read_text())["sets"]
    assert [{key: value for key, value in one.items() if key != "ids"} for one in sets] == [
        {"set": "mine", "kind": "folder", "split": "train, objects kept apart", "sensor": name, "records": count}
        for name, count in (("digit", 9), ("gelsight", 3))
    ]
    model = UniTouchModel.from_pretrained(tmp_path / "touch" / "model", modalities=("touch",))
    assert model.sensor_bank.names == ("digit", "gelsight")
    assert len(model.out_of_distribution["touch"].groups["known"].means) == 1  # whatever materials it names
    kept = [record.touch.path for record in open_dataset(folder).split("train").by_sensor()[1].records]
    mean = torch.stack([UniTouchProcessor(32).raw_images(file)[0] for file in kept]).mean(dim=0)
    torch.testing.assert_close(model.sensor_bank.prototype("gelsight"), mean, atol=1 / 255, rtol=0)


def test_a_run_goes_on_with_other_data_only_if_that_is_asked_for(folder, tmp_path, processor, capsys) -> None:
    data = f"data.sets=[{{path: {folder}, split: none}}]"
    settings = [
        data,
        "data.image_size=32",
        "augment.crop=16",
        "model.encoder_block_out_channels=[8, 8, 8, 8]",
        "model.decoder_block_out_channels=[8, 8, 8, 8]",
        "trainer.steps=1",
        "trainer.batch_size=4",
        "trainer.warmup=1",
    ]
    places = ["--output", str(tmp_path / "vae"), "--cache", str(tmp_path / "cache")]

    def run(*words: str) -> None:
        AcceleratorState._reset_state()  # as a process of its own would find it
        run_commands(app, "unitouch_gen.training", ["image_vae", *places, *words])

    run(*(word for setting in settings for word in ("--set", setting)))
    before = json.loads((tmp_path / "vae" / "record.json").read_text())["sets"]
    *rows, _ = (folder / "labels.csv").read_text().splitlines()
    (folder / "labels.csv").write_text("\n".join(rows))
    with pytest.raises(SystemExit, match="2"):
        run("--resume")
    said = capsys.readouterr().err
    assert '"records": 5, ' in said
    assert '"records": 4, ' in said
    run("--resume", "--set", data, "--set", "trainer.steps=2")
    record = json.loads((tmp_path / "vae" / "record.json").read_text())
    assert record["earlier_sets"] == [before]
    assert record["sets"] != before
