"""Features of four modalities: transformers' own for image and text, tokens by sensor for touch, clips for audio."""

import pytest
import torch
import torch.nn.functional as F
from accelerate import cpu_offload_with_hook
from transformers import CLIPTextModelWithProjection, CLIPVisionModelWithProjection

from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.models import MODALITIES, UniTouchConfig, UniTouchModel
from unitouch_gen.models.images import normalise_pixels

pytestmark = pytest.mark.usefixtures("without_gradients")


@pytest.fixture
def without_gradients():
    with torch.no_grad():
        yield


@pytest.fixture
def sensorless(config: UniTouchConfig) -> UniTouchModel:
    torch.manual_seed(0)
    config.sensors = []
    return UniTouchModel(config, modalities=("touch",)).eval()


def features(model: UniTouchModel, modality: str, inputs: dict) -> torch.Tensor:
    return getattr(model, f"get_{modality}_features")(**inputs[modality])


@pytest.mark.parametrize("modality", MODALITIES)
def test_every_modality_lands_in_the_joint_space(model: UniTouchModel, inputs: dict, modality: str) -> None:
    embeds = features(model, modality, inputs)
    assert embeds.shape == (2, 16)
    assert torch.isfinite(embeds).all()


@pytest.mark.parametrize("modality", MODALITIES)
def test_features_are_not_normalised(model: UniTouchModel, inputs: dict, modality: str) -> None:
    norms = features(model, modality, inputs).norm(dim=-1)
    assert not torch.allclose(norms, torch.ones(2), atol=1e-2)


@pytest.mark.parametrize("modality", MODALITIES)
def test_a_sample_is_the_same_alone_and_in_a_batch(model: UniTouchModel, inputs: dict, modality: str) -> None:
    alone = {modality: {key: value[1:] for key, value in inputs[modality].items()}}
    torch.testing.assert_close(
        features(model, modality, alone)[0], features(model, modality, inputs)[1], rtol=1e-5, atol=1e-5
    )


def test_image_features_are_transformers_own(model: UniTouchModel, inputs: dict) -> None:
    reference = CLIPVisionModelWithProjection(model.config.vision_config).eval()
    reference.load_state_dict(model.vision_model.state_dict())
    torch.testing.assert_close(
        features(model, "image", inputs), reference(**inputs["image"]).image_embeds, rtol=1e-6, atol=1e-6
    )


def test_text_features_are_transformers_own(model: UniTouchModel, inputs: dict) -> None:
    reference = CLIPTextModelWithProjection(model.config.text_config).eval()
    reference.load_state_dict(model.text_model.state_dict())
    torch.testing.assert_close(
        features(model, "text", inputs), reference(**inputs["text"]).text_embeds, rtol=1e-6, atol=1e-6
    )


def test_text_features_do_not_depend_on_the_padding(model: UniTouchModel, tokenizer) -> None:
    bare = tokenizer("rough brick", return_tensors="pt").input_ids
    padded = tokenizer("rough brick", padding="max_length", return_tensors="pt")
    assert bare.shape[1] < padded.input_ids.shape[1]
    torch.testing.assert_close(model.get_text_features(bare), model.get_text_features(**padded), rtol=1e-5, atol=1e-5)


def test_texts_differ(model: UniTouchModel, inputs: dict) -> None:
    embeds = features(model, "text", inputs)
    assert not torch.allclose(embeds[0], embeds[1], atol=1e-3)


def test_audio_features_are_the_mean_of_normalised_clips(model: UniTouchModel, inputs: dict) -> None:
    clips = inputs["audio"]["input_values"]
    each = [F.normalize(model.audio_model(clips[:, i]), dim=1) for i in range(2)]
    torch.testing.assert_close(model.get_audio_features(clips), (each[0] + each[1]) / 2)


# Touch and its sensors --------------------------------------------------------------------------------------------


def test_touch_features_are_the_trunk_with_the_sensors_tokens(model: UniTouchModel, inputs: dict) -> None:
    pixels, ids = inputs["touch"]["pixel_values"], torch.tensor([2, 0])
    expected = model.touch_model(pixels, model.sensor_bank.tokens[ids])
    torch.testing.assert_close(model.get_touch_features(pixels, ids), expected)


def test_the_sensor_changes_the_features(model: UniTouchModel, inputs: dict) -> None:
    pixels = inputs["touch"]["pixel_values"]
    first = model.get_touch_features(pixels, torch.tensor([0, 0]))
    second = model.get_touch_features(pixels, torch.tensor([1, 1]))
    assert not torch.allclose(first, second, atol=1e-3)


def test_the_nearest_prototype_is_taken_when_no_sensor_is_given(model: UniTouchModel) -> None:
    levels = torch.tensor([0.79, 0.22, 0.45])  # the prototypes are flat: 0.2, 0.5 and 0.8
    pixels = normalise_pixels(levels[:, None, None, None].expand(3, 3, 32, 32))
    torch.testing.assert_close(
        model.get_touch_features(pixels), model.get_touch_features(pixels, torch.tensor([2, 0, 1]))
    )


def test_matching_undoes_the_normalisation(model: UniTouchModel) -> None:
    match = model.match_sensors(normalise_pixels(torch.full((1, 3, 32, 32), 0.6)))[0]
    assert match.name == "digit"
    assert match.distance == pytest.approx(0.1, abs=1e-5)


def test_sensor_ids_are_indices_into_the_bank(model: UniTouchModel) -> None:
    matches = model.match_sensors(torch.zeros(2, 3, 32, 32), ["taxim", "gelsight"])
    assert model.sensor_ids(matches).tolist() == [2, 0]


def test_touch_works_in_a_bank_of_no_sensors(sensorless: UniTouchModel, inputs: dict) -> None:
    pixels = inputs["touch"]["pixel_values"]
    torch.testing.assert_close(sensorless.get_touch_features(pixels), sensorless.touch_model(pixels))


def test_a_bank_of_no_sensors_matches_none(sensorless: UniTouchModel, inputs: dict) -> None:
    matches = sensorless.match_sensors(**inputs["touch"])
    assert [match.name for match in matches] == [None, None]
    assert sensorless.sensor_ids(matches) is None


def test_retrieval_without_prototypes_is_refused(config: UniTouchConfig, inputs: dict) -> None:
    bare = UniTouchModel(config, modalities=("touch",)).eval()
    with pytest.raises(InvalidInputError, match="`sensor` is None"):
        bare.get_touch_features(**inputs["touch"])
    assert bare.get_touch_features(**inputs["touch"], sensor_ids=torch.tensor([0, 1])).shape == (2, 16)


@pytest.mark.parametrize(
    ("ids", "error"),
    [
        (torch.tensor([0, 3]), InvalidInputError),
        (torch.tensor([-1, 0]), InvalidInputError),
        (torch.tensor([0]), InvalidInputError),
        (torch.tensor([[0, 1]]), InvalidInputError),
        (torch.tensor(0), InvalidInputError),
        (torch.tensor([0.0, 1.0]), InvalidTypeError),
        (torch.tensor([False, True]), InvalidTypeError),
        ([0, 1], InvalidTypeError),
        ("digit", InvalidTypeError),
    ],
)
def test_sensor_ids_that_are_no_indices_into_the_bank_are_refused_by_name(
    model: UniTouchModel, inputs: dict, ids: object, error: type[Exception]
) -> None:
    model.touch_model.register_forward_pre_hook(lambda *args: pytest.fail("the network ran"))
    with pytest.raises(error, match=r"`sensor_ids` is .*\(2,\) from 0 to 2"):
        model.get_touch_features(**inputs["touch"], sensor_ids=ids)


@pytest.mark.parametrize("dtype", [torch.int32, torch.uint8])
def test_sensor_ids_may_be_any_integers(model: UniTouchModel, inputs: dict, dtype: torch.dtype) -> None:
    ids, pixels = torch.tensor([2, 0]), inputs["touch"]["pixel_values"]
    assert torch.equal(model.get_touch_features(pixels, ids.to(dtype)), model.get_touch_features(pixels, ids))


def test_sensor_ids_for_a_bank_of_no_sensors_are_refused(sensorless: UniTouchModel, inputs: dict) -> None:
    with pytest.raises(InvalidInputError, match=r"`sensor_ids` .*no sensor tokens"):
        sensorless.get_touch_features(**inputs["touch"], sensor_ids=torch.tensor([0, 0]))


@pytest.mark.parametrize("modality", ["image", "touch"])
@pytest.mark.parametrize("shape", [(2, 3, 32, 31), (2, 1, 32, 32), (3, 32, 32)])
def test_pixels_of_another_shape_are_refused_by_name(model: UniTouchModel, modality: str, shape: tuple) -> None:
    with pytest.raises(InvalidInputError, match=r"`pixel_values`.*\(B, 3, 32, 32\)"):
        getattr(model, f"get_{modality}_features")(torch.zeros(shape))


@pytest.mark.parametrize("shape", [(2, 1, 16, 24), (2, 2, 1, 16, 25)])
def test_sounds_of_another_shape_are_refused_by_name(model: UniTouchModel, shape: tuple) -> None:
    with pytest.raises(InvalidInputError, match=r"`input_values`.*\(B, clips, 1, 16, 24\)"):
        model.get_audio_features(torch.zeros(shape))


# Offloading -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("modality", MODALITIES)
def test_features_set_off_the_hooks_of_offloading(model: UniTouchModel, inputs: dict, modality: str) -> None:
    """The meta device stands for an accelerator: weights and inputs end up there."""
    inputs["touch"]["sensor_ids"] = torch.tensor([0, 1])  # meta tensors cannot be compared with prototypes
    cpu_offload_with_hook(model, execution_device="meta")
    assert model.device.type == "cpu"
    assert features(model, modality, inputs).device.type == "meta"
    assert model.device.type == "meta"
