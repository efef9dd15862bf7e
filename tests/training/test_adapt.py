"""A sensor learned from touches, in a file of its own: what it changes, and what it leaves as it is."""

import gc
import os
import weakref
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from peft import LoraConfig, inject_adapter_in_model, set_peft_model_state_dict
from safetensors.torch import load_file, save_file

from tests.helpers.damage import replaced
from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.models import UniTouchModel
from unitouch_gen.models.added_sensors import UP, AddedSensor
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.training.adapt import AdaptConfig, adapt, split_groups

CONFIG = AdaptConfig(steps=4, batch_size=8, learning_rate=0.01, rank=2)
COUNT = 24


def touches(count: int = COUNT) -> np.ndarray:
    return np.random.default_rng(3).integers(0, 256, (count, 3, 32, 32), dtype=np.uint8)


def features(model: UniTouchModel, sensor: str) -> torch.Tensor:
    pixels = normalise_pixels(torch.from_numpy(touches(6)).float() / 255)
    with torch.no_grad():
        return model.get_touch_features(pixels, model.sensor_ids(model.match_sensors(pixels, sensor)))


@pytest.fixture
def made(model: UniTouchModel) -> AddedSensor:
    torch.manual_seed(1)
    with torch.no_grad():
        model.sensor_bank.prototypes.uniform_()
        model.sensor_bank.known.fill_(True)
    return adapt(model, "mine", touches(), config=CONFIG)


@pytest.fixture
def file(made: AddedSensor, tmp_path: Path) -> Path:
    made.save(tmp_path / "mine.safetensors")
    return tmp_path / "mine.safetensors"


def test_other_sensors_are_embedded_as_before(model: UniTouchModel, file: Path) -> None:
    before = features(model, "digit")
    assert model.load_sensor(file) == "mine" and model.sensors == (*model.config.sensors, "mine")
    assert torch.equal(features(model, "digit"), before)


def test_updates_are_those_that_peft_adds(model: UniTouchModel, made: AddedSensor, file: Path) -> None:
    model.load_sensor(file)
    layers = ["attention.qkv", "attention.out", "mlp.0", "mlp.2"]
    network = inject_adapter_in_model(LoraConfig(r=2, lora_alpha=2, target_modules=layers), model.touch_model)
    set_peft_model_state_dict(network, dict(made.lora))
    pixels = normalise_pixels(torch.from_numpy(touches(6)).float() / 255)
    with torch.no_grad():
        expected = network(pixels, made.tokens.expand(6, -1, -1))
    torch.testing.assert_close(features(model, "mine"), expected, atol=2e-3, rtol=0)  # the file is in half precision


def test_rows_of_several_sensors_go_each_through_their_own_encoder(model: UniTouchModel, file: Path) -> None:
    model.load_sensor(file)
    pixels = normalise_pixels(torch.from_numpy(touches(6)).float() / 255)
    names = ["digit", "mine", "gelsight", "mine", "digit", "mine"]
    with torch.no_grad():
        mixed = model.get_touch_features(pixels, model.sensor_ids(model.match_sensors(pixels, names)))
    for row, name in enumerate(names):
        torch.testing.assert_close(mixed[row], features(model, name)[row])


def test_a_touch_of_the_sensor_is_known_by_its_prototype(model: UniTouchModel, file: Path) -> None:
    model.load_sensor(file)
    pixels = normalise_pixels(torch.from_numpy(touches()).float() / 255)
    assert {match.name for match in model.match_sensors(pixels)} == {"mine"}
    mean = model.sensor_bank.prototype("mine")
    kept, _ = split_groups([str(row) for row in range(COUNT)], CONFIG.seed)
    torch.testing.assert_close(mean, torch.from_numpy(touches()[kept].mean(axis=0) / 255).float(), atol=1e-3, rtol=0)


def test_a_model_that_is_saved_leaves_added_sensors_out(model: UniTouchModel, file: Path, tmp_path: Path) -> None:
    own = features(model, "digit")
    model.load_sensor(file)
    model.save_pretrained(tmp_path / "saved")
    again = UniTouchModel.from_pretrained(tmp_path / "saved")
    assert again.sensors == tuple(model.config.sensors)
    assert torch.equal(features(again, "digit"), own)
    again.load_sensor(file)
    torch.testing.assert_close(features(again, "mine"), features(model, "mine"))


def test_a_sensor_comes_back_with_the_encoder(model: UniTouchModel, file: Path, tmp_path: Path) -> None:
    model.save_pretrained(tmp_path / "saved")
    again = UniTouchModel.from_pretrained(tmp_path / "saved")
    again.load_sensor(file)
    before = features(again, "mine")
    again.release("touch")
    assert torch.equal(features(again, "mine"), before)


def test_without_updates_tokens_alone_are_learned(model: UniTouchModel) -> None:
    made = adapt(model, "mine", touches(), config=AdaptConfig(steps=2, batch_size=8, rank=0))
    assert not made.lora and made.tokens.shape == (2, 16)


def test_with_pictures_their_retrieval_is_told(model: UniTouchModel) -> None:
    made = adapt(model, "mine", touches(), touches(), config=AdaptConfig(steps=2, batch_size=8, rank=2))
    assert {"view", "chance", "picture"} == set(made.figures["before"]) == set(made.figures["after"])
    assert made.figures["before"]["chance"] == pytest.approx(100 / made.figures["held_out"])


def test_what_is_held_out_is_of_no_group_that_was_learned_from() -> None:
    groups = [f"object {row % 7}" for row in range(50)]
    kept, held = split_groups(groups, 0)
    assert sorted([*kept, *held]) == list(range(50)) and len(held)
    assert not {groups[row] for row in kept} & {groups[row] for row in held}


def test_the_same_seed_learns_the_same_sensor(model: UniTouchModel) -> None:
    first, again = (adapt(model, "mine", touches(), config=CONFIG) for _ in range(2))
    assert torch.equal(first.tokens, again.tokens) and first.figures == again.figures


# Refusals -------------------------------------------------------------------------------------------------------------


def test_few_touches_are_refused(model: UniTouchModel) -> None:
    with pytest.raises(InvalidInputError, match="`touches` are 7; 8 is the least"):
        adapt(model, "mine", touches(7))


def test_one_group_is_refused(model: UniTouchModel) -> None:
    with pytest.raises(InvalidInputError, match="nothing can be held out"):
        adapt(model, "mine", touches(), groups=["one"] * COUNT)


def test_a_name_that_is_taken_is_refused(model: UniTouchModel, file: Path) -> None:
    with pytest.raises(InvalidInputError, match="`sensor` is 'digit', which this model knows already"):
        adapt(model, "digit", touches())
    model.load_sensor(file)
    with pytest.raises(InvalidInputError, match="`sensor` is 'mine', which this model knows already"):
        adapt(model, "mine", touches())


def test_a_sensor_of_the_name_of_an_added_one_replaces_it(model: UniTouchModel, made: AddedSensor, file: Path) -> None:
    for name in ("mine", "other"):
        replace(made, name=name).save(file)
        model.load_sensor(file)
    before = features(model, "other")
    replace(made, tokens=-made.tokens).save(file)
    model.load_sensor(file)
    assert model.sensors == model.sensor_bank.names == (*model.config.sensors, "other", "mine")
    assert torch.equal(features(model, "other"), before)
    torch.testing.assert_close(model.sensor_bank.tokens[-1], -made.tokens, atol=1e-3, rtol=0)


def test_a_sensor_that_is_unloaded_is_gone(model: UniTouchModel, made: AddedSensor, file: Path) -> None:
    with pytest.raises(InvalidInputError, match="`name` is 'mine', but no sensor was added"):
        model.unload_sensor("mine")
    for name in ("mine", "other"):
        replace(made, name=name).save(file)
        model.load_sensor(file)
    before = features(model, "other")
    model.unload_sensor("mine")
    assert model.sensors == model.sensor_bank.names == (*model.config.sensors, "other")
    assert torch.equal(features(model, "other"), before)
    with pytest.raises(InvalidInputError, match="`name` is 'digit'"):
        model.unload_sensor("digit")


def test_a_sensor_of_another_encoder_is_refused(model: UniTouchModel, file: Path) -> None:
    with torch.no_grad():
        model.touch_model.projection.weight *= 1.5
    with pytest.raises(InvalidInputError, match="brings the sensor 'mine' of another touch encoder"):
        model.load_sensor(file)
    assert model.sensors == tuple(model.config.sensors)


@pytest.mark.parametrize("kind", ["missing", "cut", "weights", "nan", "a pipe", "half an update", "another layer's"])
def test_what_is_no_sensor_is_refused(model: UniTouchModel, file: Path, kind: str) -> None:
    if kind == "missing":
        file.unlink()
    elif kind == "cut":
        file.write_bytes(file.read_bytes()[:-100])
    elif kind == "weights":
        save_file({"tokens": torch.zeros(2, 16)}, file)
    elif kind == "a pipe":
        replaced(file, os.mkfifo)
    else:
        made = AddedSensor.read(file)
        if kind == "nan":
            made.tokens[0, 0] = torch.nan
        lora = dict(made.lora)
        if kind == "half an update":
            lora.pop(next(key for key in lora if key.endswith(UP)))
        if kind == "another layer's":
            lora = {key: torch.zeros(3, 3) for key in lora}
        replace(made, lora=lora).save(file)
    with pytest.raises(InvalidInputError, match=r"`file` (is|brings the update)|`tokens` "):
        model.load_sensor(file)
    assert model.sensors == tuple(model.config.sensors)


def test_a_place_that_is_none_is_refused(model: UniTouchModel) -> None:
    with pytest.raises(InvalidTypeError, match="`file` is 3"):
        model.load_sensor(3)


def test_a_file_holds_the_sensor_and_no_encoder(file: Path) -> None:
    width, rank, blocks, tokens = 16, 2, 2, 2
    sizes = {"qkv": (width, 3 * width), "out": (width, width), "mlp.0": (width, 4 * width), "mlp.2": (4 * width, width)}
    updates = blocks * rank * sum(map(sum, sizes.values()))
    stored = load_file(file)
    assert sum(t.numel() for name, t in stored.items() if name != "base") == updates + tokens * width + 3 * 32 * 32


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_a_sensor_goes_with_its_encoder_in_any_precision(model: UniTouchModel, file: Path, dtype: torch.dtype) -> None:
    assert model.to(dtype).load_sensor(file) == "mine"


def test_an_encoder_that_was_trained_on_is_another_one(model: UniTouchModel, file: Path) -> None:
    with torch.no_grad():
        for weight in model.touch_model.parameters():
            weight += 0.05 * weight.abs().mean() * torch.randn_like(weight)
    with pytest.raises(InvalidInputError, match="of another touch encoder"):
        model.load_sensor(file)


def test_freeing_the_encoder_frees_those_of_added_sensors(model: UniTouchModel, file: Path, tmp_path: Path) -> None:
    model.save_pretrained(tmp_path / "saved")
    again = UniTouchModel.from_pretrained(tmp_path / "saved")
    again.load_sensor(file)
    encoder = weakref.ref(again.sensor_bank.encoders[2])
    again.release("touch")
    gc.collect()
    assert encoder() is None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"touches": touches().astype(np.float32)}, "`touches` is an array .* float32; it has to be uint8"),
        ({"touches": touches()[:, :, :16]}, "`touches` is an array"),
        ({"images": touches(5)}, "`images` is an array"),
        ({"groups": ["one"]}, "`groups` are 1 for 24 touches"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(model: UniTouchModel, arguments: dict, message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        adapt(model, "mine", **{"touches": touches(), **arguments})
