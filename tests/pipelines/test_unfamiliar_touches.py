"""Touches that are unlike any the model knows: a warning, and the call goes on. On random and on built-in weights."""

import warnings

import numpy as np
import pytest
import torch
from PIL import Image

from unitouch_gen import weights
from unitouch_gen.errors import ExchangedInputsWarning, UnfamiliarTouchWarning
from unitouch_gen.pipelines.tiny import joint_space
from unitouch_gen.world import COLLECTIONS, World
from unitouch_gen.world.collections import contacts

built_in = pytest.mark.skipif(
    not (weights.JOINT / "model.safetensors").exists(), reason="built-in weights are not there"
)


@pytest.fixture
def checked(touch) -> torch.Tensor:
    """The two touches of `touch`, dark and bright as the two sensors are, and black and white checks between them."""
    checks = (torch.arange(32)[:, None] + torch.arange(32)) % 2
    return torch.stack([touch[0], checks.float().expand(3, 32, 32), touch[1]])


CALLS = {
    "touch to image": lambda request, touch: request("pipe")(touch),
    "its embeddings": lambda request, touch: request("pipe").encode_touch(touch),
    "stylization": lambda request, touch: request("stylize")(request("photo")[:1], touch),
    "x to touch": lambda request, touch: request("x_to_touch")(touch=touch),
}


@pytest.mark.parametrize("name", CALLS)
def test_a_touch_unlike_any_known_is_warned_of(request, checked, name):
    with pytest.warns(UnfamiliarTouchWarning, match=r"^`touch\[1\]`: .*0\.50 of full scale") as caught:
        CALLS[name](request.getfixturevalue, checked)
    assert len(caught) == 1 and "\n" not in str(caught[0].message)


@pytest.mark.parametrize("name", CALLS)
def test_known_touches_are_not(request, touch, name):
    with warnings.catch_warnings():
        warnings.simplefilter("error", UnfamiliarTouchWarning)
        CALLS[name](request.getfixturevalue, touch)


@pytest.mark.filterwarnings("ignore::unitouch_gen.errors.UnfamiliarTouchWarning")  # which a photo is
def test_exchanged_inputs_are_warned_of_and_others_not(stylize, photo, touch):
    with pytest.warns(ExchangedInputsWarning, match="^`image` looks more like a touch than `touch` does"):
        stylize(touch[:1], photo[:1])
    with warnings.catch_warnings():
        warnings.simplefilter("error", ExchangedInputsWarning)
        stylize(photo[:1], touch[:1])


def test_one_touch_has_no_number_and_the_call_goes_on(pipe, checked):
    with pytest.warns(UnfamiliarTouchWarning, match="^`touch`:"):
        output = pipe(checked[1:2])
    assert output.report.success and len(output.images) == 1


def test_a_wrong_sensor_is_warned_of(pipe, touch):
    with pytest.warns(UnfamiliarTouchWarning, match="^`touch`: .*the sensor right"):
        pipe(touch[:1], sensor="digit")  # it is dark, as a GelSight's here are


def test_of_many_the_first_three_are_named(pipe, checked):
    with pytest.warns(UnfamiliarTouchWarning, match=r"^`touch\[0\]`, `touch\[1\]`, `touch\[2\]` and 2 more:"):
        pipe.encode_touch(checked[1:2].expand(5, -1, -1, -1))


def test_what_is_re_centred_is_not_warned_of(pipe, checked):
    with warnings.catch_warnings():
        warnings.simplefilter("error", UnfamiliarTouchWarning)
        pipe(checked[1:2], background=checked[1:2])


def test_a_model_says_what_is_far(pipe, checked):
    pipe.unitouch.sensor_bank.reach = 0.6
    with warnings.catch_warnings():
        warnings.simplefilter("error", UnfamiliarTouchWarning)
        pipe(checked)


def test_how_far_is_far_is_stored_with_the_model(pipe, tmp_path):
    model = pipe.unitouch
    model.config.sensor_reach = 0.35
    model.save_pretrained(tmp_path)
    again = type(model).from_pretrained(tmp_path, modalities=("touch",))
    assert again.sensor_bank.reach == 0.35


# The built-in joint space ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def joint():
    return joint_space()


def unfamiliar(joint, pictures) -> list[int]:
    model, processor = joint
    matches = model.match_sensors(processor.touch(pictures))
    return model.sensor_bank.unfamiliar([match.distance for match in matches])


@built_in
@pytest.mark.parametrize("name", COLLECTIONS)
def test_touches_of_the_world_are_familiar(joint, name):
    """Also of the two sensors that the touch encoder was never trained on."""
    collection = COLLECTIONS[name]
    material, item, contact = (part[::8] for part in contacts(collection, "test", 1))  # two objects of each material
    scene = World().render(
        material, item, contact, modalities=("touch",), sensors=(collection.sensor,), style=collection.style
    )
    assert unfamiliar(joint, scene.touch[collection.sensor]) == []


@built_in
def test_pictures_that_are_no_touches_are_not(joint):
    rng = np.random.default_rng(0)
    noise = Image.fromarray(rng.integers(0, 256, (64, 64, 3), dtype=np.uint8))
    page = Image.new("RGB", (64, 64), "white")
    page.paste("black", (8, 8, 56, 16))
    red = Image.new("RGB", (64, 64), "red")
    assert unfamiliar(joint, [noise, page, red]) == [0, 1, 2]
