"""A sensor learned from touches, in a file of its own: what it changes, and what it leaves as it is."""

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.models import UniTouchModel
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.models.sensors import AddedSensor
from unitouch_gen.training.adapt import AdaptConfig, adapt

CONFIG = AdaptConfig(steps=4, batch_size=8, learning_rate=0.01)
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


def test_other_sensors_are_as_before_and_each_row_gets_its_own_tokens(model: UniTouchModel, file: Path) -> None:
    before = features(model, "digit")
    assert model.load_sensor(file) == "mine" and model.sensors == (*model.config.sensors, "mine")
    assert torch.equal(features(model, "digit"), before) and not torch.allclose(features(model, "mine"), before)
    names = ["digit", "mine", "gelsight", "mine", "digit", "mine"]
    for row, name in enumerate(names):
        torch.testing.assert_close(features(model, names)[row], features(model, name)[row])


def test_a_touch_of_the_sensor_is_known_by_its_prototype(model: UniTouchModel, file: Path) -> None:
    model.load_sensor(file)
    assert {match.name for match in model.match_sensors(PIXELS)} == {"mine"}
    expected = torch.from_numpy(TOUCHES.mean(axis=0) / 255).float()
    torch.testing.assert_close(model.sensor_bank.prototype("mine"), expected, atol=1e-3, rtol=0)


def test_touches_with_pictures_are_bound_to_them_and_the_model_stays(model: UniTouchModel) -> None:
    before = {key: value.clone() for key, value in model.state_dict().items()}
    alone, bound = (adapt(model, "mine", TOUCHES, images, CONFIG).tokens for images in (None, 255 - TOUCHES))
    assert alone.shape == bound.shape == (2, 16) and not torch.allclose(alone, bound, atol=1e-4)
    assert all(torch.equal(value, before[key]) for key, value in model.state_dict().items())


def test_a_sensor_with_an_update_of_the_encoder_is_refused(model: UniTouchModel, file: Path) -> None:
    save_file({**load_file(file), "blocks.0.mlp.0.lora_A.weight": torch.ones(2, 16)}, file, {"name": "mine"})
    with pytest.raises(InvalidInputError, match=r"holds blocks.0.mlp.0.lora_A.weight, .* adapt the sensor anew"):
        model.load_sensor(file)


def test_what_does_not_fit_is_refused(model: UniTouchModel) -> None:
    cases: list[tuple[str, dict, str]] = [
        ("digit", {}, "`sensor` is 'digit', which this model knows already"),
        ("mine", {"touches": TOUCHES[:7]}, "Got 7 touches; take 8"),
    ]
    for name, arguments, message in cases:
        with pytest.raises(InvalidInputError, match=message):
            adapt(model, name, **{"touches": TOUCHES, **arguments})
