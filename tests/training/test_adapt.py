"""A sensor learned from touches, in a file of its own: what it changes, and what it leaves as it is."""

from pathlib import Path

import numpy as np
import pytest
import torch
from peft import LoraConfig, inject_adapter_in_model, set_peft_model_state_dict

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.models import UniTouchModel
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.models.sensors import AddedSensor
from unitouch_gen.training.adapt import AdaptConfig, adapt, split_groups

CONFIG = AdaptConfig(steps=4, batch_size=8, learning_rate=0.01, rank=2)
COUNT = 24
TOUCHES = np.random.default_rng(3).integers(0, 256, (COUNT, 3, 32, 32), dtype=np.uint8)
PIXELS = normalise_pixels(torch.from_numpy(TOUCHES).float() / 255)


def features(model: UniTouchModel, sensor: str | list[str]) -> torch.Tensor:
    with torch.no_grad():
        return model.get_touch_features(PIXELS[:6], model.sensor_ids(model.match_sensors(PIXELS[:6], sensor)))


@pytest.fixture
def model(model: UniTouchModel) -> UniTouchModel:
    torch.manual_seed(1)
    with torch.no_grad():
        model.sensor_bank.prototypes.uniform_()
        model.sensor_bank.known.fill_(True)
    return model


@pytest.fixture
def made(model: UniTouchModel) -> AddedSensor:
    return adapt(model, "mine", TOUCHES, config=CONFIG)


@pytest.fixture
def file(made: AddedSensor, tmp_path: Path) -> Path:
    made.save(tmp_path / "mine.safetensors")
    return tmp_path / "mine.safetensors"


def test_other_sensors_are_embedded_as_before_and_rows_go_each_through_their_own_encoder(
    model: UniTouchModel, file: Path
) -> None:
    before = features(model, "digit")
    assert model.load_sensor(file) == "mine" and model.sensors == (*model.config.sensors, "mine")
    assert torch.equal(features(model, "digit"), before) and not torch.allclose(features(model, "mine"), before)
    names = ["digit", "mine", "gelsight", "mine", "digit", "mine"]
    for row, name in enumerate(names):
        torch.testing.assert_close(features(model, names)[row], features(model, name)[row])


def test_updates_are_those_that_peft_adds(model: UniTouchModel, made: AddedSensor, file: Path) -> None:
    model.load_sensor(file)
    layers = ["attention.qkv", "attention.out", "mlp.0", "mlp.2"]
    network = inject_adapter_in_model(LoraConfig(r=2, lora_alpha=2, target_modules=layers), model.touch_model)
    set_peft_model_state_dict(network, dict(made.lora))
    with torch.no_grad():
        expected = network(PIXELS[:6], made.tokens.expand(6, -1, -1))
    torch.testing.assert_close(features(model, "mine"), expected, atol=2e-3, rtol=0)  # the file is in half precision


def test_a_touch_of_the_sensor_is_known_by_its_prototype(model: UniTouchModel, file: Path) -> None:
    model.load_sensor(file)
    assert {match.name for match in model.match_sensors(PIXELS)} == {"mine"}
    kept, _ = split_groups([str(row) for row in range(COUNT)], CONFIG.seed)
    expected = torch.from_numpy(TOUCHES[kept].mean(axis=0) / 255).float()
    torch.testing.assert_close(model.sensor_bank.prototype("mine"), expected, atol=1e-3, rtol=0)


def test_without_updates_tokens_alone_are_learned_and_with_pictures_their_retrieval_is_told(
    model: UniTouchModel,
) -> None:
    made = adapt(model, "mine", TOUCHES, TOUCHES, config=AdaptConfig(steps=2, batch_size=8, rank=0))
    assert not made.lora and made.tokens.shape == (2, 16)
    assert {"view", "chance", "picture"} == {*made.figures["before"]} == {*made.figures["after"]}
    assert made.figures["before"]["chance"] == pytest.approx(100 / made.figures["held_out"])


def test_what_is_held_out_is_of_no_group_that_was_learned_from() -> None:
    groups = [f"object {row % 7}" for row in range(50)]
    kept, held = split_groups(groups, 0)
    assert sorted([*kept, *held]) == list(range(50)) and len(held)
    assert not {groups[row] for row in kept} & {groups[row] for row in held}


def test_what_does_not_fit_is_refused(model: UniTouchModel) -> None:
    cases: list[tuple[str, dict, str]] = [
        ("digit", {}, "`sensor` is 'digit', which this model knows already"),
        ("mine", {"touches": TOUCHES[:7]}, "Got 7 touches of 7 objects"),
        ("mine", {"groups": ["one"] * COUNT}, "Got 24 touches of 1 objects; .* held out"),
    ]
    for name, arguments, message in cases:
        with pytest.raises(InvalidInputError, match=message):
            adapt(model, name, **{"touches": TOUCHES, **arguments})
