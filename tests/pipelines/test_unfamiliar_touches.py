"""Touches that are unlike any the model knows: a warning, and the call goes on. On random and on built-in weights."""

import warnings

import numpy as np
import pytest
import torch
from PIL import Image

from unitouch_gen import weights
from unitouch_gen.errors import ExchangedInputsWarning, UnfamiliarInputWarning
from unitouch_gen.models.out_of_distribution import Gaussians, OutOfDistribution, pixel_statistics
from unitouch_gen.pipelines.tiny import joint_space
from unitouch_gen.world import FIRST_OBJECT, MATERIAL_NAMES, SENSORS, World

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
    with pytest.warns(UnfamiliarInputWarning, match=r"^`touch\[1\]`: .*0\.50 of full scale") as caught:
        CALLS[name](request.getfixturevalue, checked)
    assert len(caught) == 1 and "\n" not in str(caught[0].message)


@pytest.mark.parametrize("name", CALLS)
def test_known_touches_are_not(request, touch, name):
    with warnings.catch_warnings():
        warnings.simplefilter("error", UnfamiliarInputWarning)
        CALLS[name](request.getfixturevalue, touch)


@pytest.mark.filterwarnings("ignore::unitouch_gen.errors.UnfamiliarInputWarning")  # which a photo is
def test_exchanged_inputs_are_warned_of_and_others_not(stylize, photo, touch):
    with pytest.warns(ExchangedInputsWarning, match="^`image` looks more like a touch than `touch` does"):
        stylize(touch[:1], photo[:1])
    with warnings.catch_warnings():
        warnings.simplefilter("error", ExchangedInputsWarning)
        stylize(photo[:1], touch[:1])


def test_one_touch_has_no_number_and_the_call_goes_on(pipe, checked):
    with pytest.warns(UnfamiliarInputWarning, match="^`touch`:"):
        output = pipe(checked[1:2])
    assert output.report.success and len(output.images) == 1


def test_a_sensor_that_is_named_is_an_answer_and_no_doubt(pipe, checked):
    with warnings.catch_warnings():
        warnings.simplefilter("error", UnfamiliarInputWarning)
        pipe(checked, sensor="digit")
        with pytest.raises(UnfamiliarInputWarning, match=r"^`touch\[1\]`:"):
            pipe(checked[:2], sensor=["digit", None])


def test_a_touch_that_is_its_background_is_one_of_nothing(pipe, touch):
    pressed = touch.clone()
    pressed[:, :, 8:16, 8:16] += 0.1
    with pytest.warns(UnfamiliarInputWarning, match=r"^`touch\[0\]`: nothing is touched\. "):
        report = pipe(torch.stack([touch[0], pressed[1]]), background=touch).report
    assert report.unknown == {"touch": ["nothing is touched", None]}
    assert "1 input is unknown" in str(report)


def test_of_many_the_first_three_are_named(pipe, checked):
    with pytest.warns(UnfamiliarInputWarning, match=r"^`touch\[0\]`, `touch\[1\]`, `touch\[2\]` and 2 more:"):
        pipe.encode_touch(checked[1:2].expand(5, -1, -1, -1))


def test_what_is_re_centred_is_not_warned_of(pipe, checked):
    with warnings.catch_warnings():
        warnings.simplefilter("error", UnfamiliarInputWarning)
        pipe(checked[1:2], background=1.0 - checked[1:2])


def test_a_model_says_what_is_far(pipe, checked):
    pipe.unitouch.sensor_bank.reach = 0.6
    with warnings.catch_warnings():
        warnings.simplefilter("error", UnfamiliarInputWarning)
        pipe(checked)


def test_how_far_is_far_is_stored_with_the_model(pipe, tmp_path):
    model = pipe.unitouch
    model.config.sensor_reach = 0.35
    model.save_pretrained(tmp_path)
    again = type(model).from_pretrained(tmp_path, modalities=("touch",))
    assert again.sensor_bank.reach == 0.35


@pytest.fixture
def abstaining(request):
    """Gives a model scores by which it knows nothing."""

    def give(pipe, *modalities):
        model = pipe.unitouch
        for modality in modalities:
            width = model.config.projection_dim
            if modality == "touch":
                width = model.config.touch_config.hidden_size + pixel_statistics(torch.rand(1, 3, 8, 8)).shape[1]
            known = Gaussians.of(torch.randn(40, width, generator=torch.Generator().manual_seed(0)))
            model.out_of_distribution[modality] = OutOfDistribution({"known": known}, {"distance": -1.0})
            request.addfinalizer(model.out_of_distribution.clear)
        return pipe

    return give


def test_what_the_scores_say_is_warned_of_once_and_reported(request, abstaining, touch):
    pipe = abstaining(request.getfixturevalue("x_to_touch"), "touch", "text")
    message = "^`text`: unlike anything known; `touch`: unlike anything known. What is made of it is a guess.$"
    with pytest.warns(UnfamiliarInputWarning, match=message) as caught:
        report = pipe(touch=touch[:1], text="rough brick").report
    assert len(caught) == 1 and caught[0].filename == __file__
    assert report.unknown == {"text": ["unlike anything known"], "touch": ["unlike anything known"]}
    assert type(report).joined([report, report]).unknown["text"] == 2 * ["unlike anything known"]


@pytest.mark.parametrize("name", ["touch to image", "its embeddings", "stylization"])
def test_every_pipeline_asks_the_scores(request, abstaining, touch, name):
    for fixture in ("pipe", "stylize"):
        abstaining(request.getfixturevalue(fixture), "touch")
    with pytest.warns(UnfamiliarInputWarning, match=r"^`touch\[0\]`, `touch\[1\]`: unlike anything known") as caught:
        CALLS[name](request.getfixturevalue, touch)
    assert len(caught) == 1 and caught[0].filename == __file__


# The built-in joint space ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def joint():
    return joint_space()


def unfamiliar(joint, pictures) -> list[int]:
    model, processor = joint
    matches = model.match_sensors(processor.touch(pictures))
    return model.sensor_bank.unfamiliar([match.distance for match in matches])


@built_in
@pytest.mark.parametrize("name", SENSORS)
def test_touches_of_the_world_are_familiar(joint, name):
    material = torch.arange(len(MATERIAL_NAMES))
    names = material, torch.full_like(material, FIRST_OBJECT["test"]), torch.zeros_like(material)
    scene = World().render(*names, modalities=("touch",), sensors=(name,))
    assert len(unfamiliar(joint, scene.touch[name])) <= 1


@built_in
def test_pictures_that_are_no_touches_are_not(joint):
    rng = np.random.default_rng(0)
    patches = Image.fromarray(rng.integers(0, 256, (8, 8, 3), dtype=np.uint8)).resize(
        (64, 64), Image.Resampling.NEAREST
    )
    page = Image.new("RGB", (64, 64), "white")
    page.paste("black", (8, 8, 56, 16))
    red = Image.new("RGB", (64, 64), "red")
    assert unfamiliar(joint, [patches, page, red]) == [0, 1, 2]
