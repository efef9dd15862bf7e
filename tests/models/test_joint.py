"""The joint model: features against transformers' own encoders, tokens by sensor, and modalities read on demand."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from accelerate import cpu_offload_with_hook
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor
from transformers import CLIPTextModelWithProjection, CLIPVisionModelWithProjection

from tests.helpers.damage import SETTINGS, WEIGHTS, claim
from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.models import MODALITIES, UniTouchConfig, UniTouchModel
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.models.joint import MODULES

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


def features(model: UniTouchModel, modality: str, inputs: dict) -> Tensor:
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
        (torch.tensor([-2, 0]), InvalidInputError),
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


@pytest.mark.parametrize("value", [None, 3, "x", [[0.0]], np.zeros((2, 3, 32, 32), np.float32)])
@pytest.mark.parametrize("modality", MODALITIES)
def test_what_is_no_tensor_is_refused_by_name(model: UniTouchModel, modality: str, value: object) -> None:
    with pytest.raises(InvalidTypeError, match=r"`(pixel_values|input_values|input_ids)` is .*Use UniTouchProcessor"):
        getattr(model, f"get_{modality}_features")(value)


@pytest.mark.parametrize("modality", MODALITIES)
def test_an_empty_batch_is_refused_by_name(model: UniTouchModel, inputs: dict, modality: str) -> None:
    empty = {name: values[:0] for name, values in inputs[modality].items()}
    with pytest.raises(InvalidInputError, match=r"`(pixel_values|input_values|input_ids)` is a tensor of shape \(0, "):
        getattr(model, f"get_{modality}_features")(**empty)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
@pytest.mark.parametrize("modality", ["image", "audio", "touch"])
def test_values_that_are_not_finite_are_refused(model: UniTouchModel, inputs: dict, modality: str, bad: float) -> None:
    ((name, values),) = inputs[modality].items()
    values.view(-1)[0] = bad
    with pytest.raises(InvalidInputError, match=f"`{name}` holds 1 of {values.numel()} values that are NaN"):
        getattr(model, f"get_{modality}_features")(values)


@pytest.mark.parametrize("modality", ["image", "audio", "touch"])
def test_values_that_would_leave_the_range_of_floats_are_refused(model, inputs: dict, modality: str) -> None:
    ((name, values),) = inputs[modality].items()
    with pytest.raises(InvalidInputError, match=rf"`{name}` holds .*e\+30; it may be up to 10000"):
        getattr(model, f"get_{modality}_features")(torch.full_like(values, 1e30))


def test_a_background_of_another_size_is_refused(model: UniTouchModel, inputs: dict) -> None:
    (pixels,) = inputs["touch"].values()
    with pytest.raises(InvalidInputError, match=r"`background` is .*; pass one background"):
        model.recentre(pixels, pixels[:, :, ::2, ::2], model.match_sensors(pixels))


@pytest.mark.parametrize("kind", [torch.uint8, torch.int64, torch.bool, torch.complex64, torch.float8_e4m3fn])
@pytest.mark.parametrize("modality", ["image", "audio", "touch"])
def test_pixels_that_are_no_floating_point_numbers_are_refused(
    model: UniTouchModel, inputs: dict, modality: str, kind: torch.dtype
) -> None:
    """Those of a picture from 0 to 255 would be taken for normalised ones."""
    ((name, values),) = inputs[modality].items()
    with pytest.raises(InvalidTypeError, match=f"`{name}` .*floating-point"):
        getattr(model, f"get_{modality}_features")(values.to(kind))


def test_the_least_and_the_last_token_are_taken(model: UniTouchModel) -> None:
    last = model.config.text_config.vocab_size - 1
    assert model.get_text_features(torch.tensor([[0, last]], dtype=torch.int16)).shape == (1, 16)


@pytest.mark.parametrize("wrong", ["negative", "beyond the vocabulary", "too many"])
def test_token_ids_out_of_range_are_refused(model: UniTouchModel, wrong: str) -> None:
    config = model.config.text_config
    ids = {"negative": torch.tensor([[0, -1]]), "beyond the vocabulary": torch.tensor([[config.vocab_size]]),
           "too many": torch.zeros(1, config.max_position_embeddings + 1, dtype=torch.long)}[wrong]  # fmt: skip
    with pytest.raises(InvalidInputError, match=rf"`input_ids` is .*from 0 to {config.vocab_size - 1}"):
        model.get_text_features(ids)


@pytest.mark.parametrize("ids", [torch.zeros(5).long(), torch.zeros(1, 0).long(), torch.zeros(1, 5)])
def test_token_ids_of_another_shape_or_kind_are_refused(model: UniTouchModel, ids: torch.Tensor) -> None:
    with pytest.raises((InvalidInputError, InvalidTypeError), match="`input_ids` is a tensor"):
        model.get_text_features(ids)


def test_features_of_another_width_cannot_be_scaled(model: UniTouchModel) -> None:
    with pytest.raises(InvalidInputError, match=r"`features` is .*\(B, 16\)"):
        model.scaled("text", torch.ones(2, 8))


# Offloading -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("modality", MODALITIES)
def test_features_set_off_the_hooks_of_offloading(model: UniTouchModel, inputs: dict, modality: str) -> None:
    """The meta device stands for an accelerator: weights and inputs end up there."""
    inputs["touch"]["sensor_ids"] = torch.tensor([0, 1])  # meta tensors cannot be compared with prototypes
    cpu_offload_with_hook(model, execution_device="meta")
    assert model.device.type == "cpu"
    assert features(model, modality, inputs).device.type == "meta"
    assert model.device.type == "meta"


# Modalities on demand -------------------------------------------------------------------------------------------------


def prefixes(model: UniTouchModel) -> set[str]:
    return {key.split(".")[0] for key in model.state_dict()}


@pytest.mark.parametrize("modality", MODALITIES)
def test_only_the_modality_asked_for_is_in_memory(folder: Path, modality: str) -> None:
    model = UniTouchModel.from_pretrained(folder, modalities=(modality,))
    assert model.loaded_modalities == (modality,)
    assert prefixes(model) == set(MODULES[modality])


def test_by_default_nothing_is_in_memory(folder: Path) -> None:
    model = UniTouchModel.from_pretrained(folder)
    assert model.loaded_modalities == ()
    assert not list(model.parameters())


@pytest.mark.parametrize("modality", MODALITIES)
def test_a_modality_is_read_when_first_used_and_is_what_was_saved(
    model: UniTouchModel, folder: Path, inputs: dict, modality: str
) -> None:
    again = UniTouchModel.from_pretrained(folder)
    torch.testing.assert_close(features(again, modality, inputs), features(model, modality, inputs), rtol=0, atol=0)
    assert again.loaded_modalities == (modality,)


def test_all_tensors_return_as_saved(model: UniTouchModel, folder: Path) -> None:
    again = UniTouchModel.from_pretrained(folder, modalities=MODALITIES)
    saved, read = model.state_dict(), again.state_dict()
    assert saved.keys() == read.keys()
    assert all(torch.equal(saved[key], read[key]) for key in saved)


def test_the_file_holds_each_tensor_once(model: UniTouchModel, folder: Path) -> None:
    with safe_open(folder / "model.safetensors", framework="pt") as file:
        assert sorted(file.keys()) == sorted(model.state_dict())


def test_a_read_model_does_not_train(folder: Path) -> None:
    model = UniTouchModel.from_pretrained(folder, modalities=("touch",))
    model.load("audio")
    assert not any(module.training for module in model.modules())


def test_a_released_modality_is_gone_and_comes_back(folder: Path, inputs: dict) -> None:
    model = UniTouchModel.from_pretrained(folder)
    before = features(model, "touch", inputs)
    model.release("touch")
    assert model.loaded_modalities == ()
    assert not list(model.parameters())
    assert not list(model.buffers())
    torch.testing.assert_close(features(model, "touch", inputs), before, rtol=0, atol=0)


def test_releasing_a_modality_that_is_not_there_does_nothing(folder: Path) -> None:
    model = UniTouchModel.from_pretrained(folder, modalities=("text",))
    model.release("audio")
    assert model.loaded_modalities == ("text",)


def test_a_model_that_is_on_no_disk_refuses_to_release(model: UniTouchModel) -> None:
    with pytest.raises(InvalidInputError, match="release"):
        model.release("touch")
    assert model.loaded_modalities == MODALITIES


def test_a_modality_left_out_of_a_model_on_no_disk_is_refused(config: UniTouchConfig, inputs: dict) -> None:
    model = UniTouchModel(config, modalities=("touch",))
    with pytest.raises(InvalidInputError, match="`modalities` left out 'image'"):
        features(model, "image", inputs)


@pytest.mark.parametrize("call", ["load", "release", "add"])
def test_an_unknown_modality_is_refused_by_name(folder: Path, call: str) -> None:
    with pytest.raises(InvalidInputError, match="`modality` is 'smell'"):
        getattr(UniTouchModel.from_pretrained(folder), call)("smell")


def test_an_unknown_modality_is_refused_when_building(config: UniTouchConfig) -> None:
    with pytest.raises(InvalidInputError, match="`modalities` is 'smell'"):
        UniTouchModel(config, modalities=("smell",))


def test_saving_keeps_modalities_that_were_not_in_memory(folder: Path, tmp_path: Path) -> None:
    UniTouchModel.from_pretrained(folder, modalities=("touch",)).save_pretrained(tmp_path / "copy")
    first, second = load_file(folder / "model.safetensors"), load_file(tmp_path / "copy" / "model.safetensors")
    assert first.keys() == second.keys()
    assert all(torch.equal(first[key], second[key]) for key in first)


def test_saving_a_model_of_some_modalities_keeps_those(
    model: UniTouchModel, config: UniTouchConfig, tmp_path: Path
) -> None:
    some = UniTouchModel(config, modalities=("touch", "text"))
    some.save_pretrained(tmp_path / "some")
    again = UniTouchModel.from_pretrained(tmp_path / "some", modalities=("touch",))
    again.add("audio")
    again.save_pretrained(tmp_path / "copy")
    first, second = (load_file(tmp_path / name / "model.safetensors") for name in ("some", "copy"))
    assert {key.split(".")[0] for key in second} == {"touch_model", "sensor_bank", "text_model", "audio_model"}
    assert all(torch.equal(first[key], second[key]) for key in first)


def test_saving_refuses_to_lose_half_an_encoder(folder: Path, tmp_path: Path) -> None:
    state = load_file(folder / "model.safetensors")
    del state["audio_model.position"]
    save_file(state, folder / "model.safetensors", metadata={"format": "pt"})
    with pytest.raises(InvalidInputError, match="does not hold the audio encoder"):
        UniTouchModel.from_pretrained(folder).save_pretrained(tmp_path / "copy")


def test_saving_over_its_own_folder_keeps_every_tensor(folder: Path) -> None:
    before = load_file(folder / "model.safetensors")
    before = {key: value.clone() for key, value in before.items()}
    UniTouchModel.from_pretrained(folder, modalities=("touch",)).save_pretrained(folder)
    after = load_file(folder / "model.safetensors")
    assert all(torch.equal(before[key], after[key]) for key in before)


def test_reading_draws_no_random_weights(folder: Path) -> None:
    before = torch.get_rng_state()
    UniTouchModel.from_pretrained(folder, modalities=("image", "text", "audio", "touch"))
    assert torch.equal(torch.get_rng_state(), before)


def test_sharded_checkpoints_are_read(model: UniTouchModel, tmp_path: Path, inputs: dict) -> None:
    model.save_pretrained(tmp_path, max_shard_size="60KB")
    assert len(list(tmp_path.glob("model-*.safetensors"))) > 2
    again = UniTouchModel.from_pretrained(tmp_path)
    for modality in MODALITIES:
        torch.testing.assert_close(features(again, modality, inputs), features(model, modality, inputs), rtol=0, atol=0)


def test_an_added_modality_is_fresh_and_the_others_stay(folder: Path) -> None:
    model = UniTouchModel.from_pretrained(folder, modalities=("touch", "audio"))
    touch, audio = model.touch_model.position.clone(), model.audio_model.position.clone()
    model.add("touch")
    assert not torch.equal(model.touch_model.position, touch)
    assert torch.equal(model.audio_model.position, audio)


# dtype and device -------------------------------------------------------------------------------------------------


def test_weights_are_read_in_the_dtype_asked_for(folder: Path, inputs: dict) -> None:
    model = UniTouchModel.from_pretrained(folder, dtype=torch.bfloat16)
    assert model.dtype == torch.bfloat16
    assert features(model, "image", inputs).dtype == torch.bfloat16
    assert all(parameter.dtype == torch.bfloat16 for parameter in model.parameters())


def test_diffusers_spelling_of_dtype_is_understood(folder: Path) -> None:
    assert UniTouchModel.from_pretrained(folder, torch_dtype=torch.float16).dtype == torch.float16


def test_modalities_read_later_have_the_dtype_of_the_others(folder: Path) -> None:
    model = UniTouchModel.from_pretrained(folder, modalities=("touch",)).to(torch.float64)
    model.load("text")
    assert next(model.text_model.parameters()).dtype == torch.float64


CASTS = {
    "half": (lambda model: model.half(), torch.float16),
    "bfloat16": (lambda model: model.bfloat16(), torch.bfloat16),
    "double": (lambda model: model.double(), torch.float64),
    "to": (lambda model: model.to(torch.float64), torch.float64),
    "to, as part of another": (lambda model: torch.nn.ModuleList([model]).to(torch.float16), torch.float16),
}


@pytest.mark.parametrize("modalities", [(), ("touch",)])
@pytest.mark.parametrize("cast", CASTS)
def test_modalities_read_later_follow_every_cast(folder: Path, modalities: tuple[str, ...], cast: str) -> None:
    model = UniTouchModel.from_pretrained(folder, modalities=modalities)
    CASTS[cast][0](model)
    model.load("audio")
    assert {model.dtype, *(parameter.dtype for parameter in model.parameters())} == {CASTS[cast][1]}


def test_a_modality_added_later_follows_a_cast(config: UniTouchConfig) -> None:
    model = UniTouchModel(config, modalities=()).half()
    model.add("audio")
    assert next(model.audio_model.parameters()).dtype == torch.float16


@pytest.mark.filterwarnings("ignore:.*copying from a non-meta parameter")
@pytest.mark.parametrize("modalities", [(), ("touch",)])
def test_modalities_read_later_follow_to(folder: Path, modalities: tuple[str, ...]) -> None:
    model = UniTouchModel.from_pretrained(folder, modalities=modalities).to("meta", torch.float16)
    assert (model.device.type, model.dtype) == ("meta", torch.float16)
    model.load("audio")
    assert all((p.device.type, p.dtype) == ("meta", torch.float16) for p in model.audio_model.parameters())


def test_moving_a_model_keeps_its_dtype(folder: Path) -> None:
    model = UniTouchModel.from_pretrained(folder, dtype=torch.bfloat16).to("cpu")
    model.load("audio")
    assert next(model.audio_model.parameters()).dtype == torch.bfloat16


def test_half_precision_features_are_near_full_ones(model: UniTouchModel, folder: Path, inputs: dict) -> None:
    half = UniTouchModel.from_pretrained(folder, dtype=torch.bfloat16)
    for modality in MODALITIES:
        full = features(model, modality, inputs)
        torch.testing.assert_close(
            features(half, modality, inputs).float(), full, rtol=0.1, atol=0.1 * full.abs().max().item()
        )


# Wrong folders ----------------------------------------------------------------------------------------------------


def test_a_folder_without_a_config_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match=r"no config\.json"):
        UniTouchModel.from_pretrained(tmp_path)


def test_a_folder_that_does_not_exist_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="no folder"):
        UniTouchModel.from_pretrained(tmp_path / "nothing" / "here")


@pytest.mark.parametrize("name", ["user/no-such-model", "nothing"])
def test_a_repository_that_is_not_there_is_refused_by_its_id(name: str) -> None:
    with pytest.raises(
        InvalidInputError,
        match=f"`pretrained_model_name_or_path` is '{name}'.*no repository of that id could be fetched",
    ):
        UniTouchModel.from_pretrained(name, local_files_only=True)


def test_a_subfolder_is_looked_into(folder: Path) -> None:
    assert UniTouchModel.from_pretrained(folder.parent, subfolder="model").config.projection_dim == 16
    with pytest.raises(InvalidInputError, match=r"no config\.json"):
        UniTouchModel.from_pretrained(folder.parent, subfolder="other")


@pytest.mark.parametrize("damage", WEIGHTS)
def test_damaged_weights_are_refused_by_their_file(folder: Path, damage: str) -> None:
    WEIGHTS[damage](folder / "model.safetensors")
    model = UniTouchModel.from_pretrained(folder)
    for use in (lambda: model.load("touch"), lambda: model.known_modalities):
        with pytest.raises(InvalidInputError, match=rf"{folder}.*model\.safetensors"):
            use()


@pytest.mark.parametrize("damage", WEIGHTS)
def test_a_damaged_shard_is_refused_by_its_file(model: UniTouchModel, tmp_path: Path, damage: str) -> None:
    model.save_pretrained(tmp_path, max_shard_size="20KB")
    shard = json.loads((tmp_path / "model.safetensors.index.json").read_text())["weight_map"]["touch_model.position"]
    WEIGHTS[damage](tmp_path / shard)
    with pytest.raises(InvalidInputError, match=shard):
        UniTouchModel.from_pretrained(tmp_path).load("touch")


@pytest.mark.parametrize("damage", SETTINGS)
def test_a_damaged_config_is_refused_by_its_place(folder: Path, damage: str) -> None:
    SETTINGS[damage](folder / "config.json")
    with pytest.raises(InvalidInputError, match=rf"`pretrained_model_name_or_path` .*{folder}.*config\.json"):
        UniTouchModel.from_pretrained(folder)


@pytest.mark.parametrize(
    "claimed",
    [
        {"touch_config__num_hidden_layers": 10**9},
        {"vision_config__num_hidden_layers": 10**9},
        {"text_config__vocab_size": 10**12},
        {"touch_config__hidden_size": 10**9},
        {"prototype_size": 10**9},
        {"sensor_tokens": 10**9},
        {"vision_config__num_attention_heads": 0},
        {"text_config__hidden_act": "nope"},
        {"vision_config__patch_size": 64},
        {"text_config__eos_token_id": []},
        {"embedding_norm": 10**400},
        {"logit_scales": {"text": math.nan}},
        {"sensors": 3},
        {"dtype": "bogus"},
    ],
    ids=lambda claimed: next(iter(claimed)),
)
def test_a_config_of_what_cannot_be_is_refused_at_once(folder: Path, claimed: dict) -> None:
    claim(**claimed)(folder / "config.json")
    with pytest.raises(InvalidInputError, match=r"`pretrained_model_name_or_path` .*"):
        UniTouchModel.from_pretrained(folder)


def test_a_dtype_may_be_a_word(folder: Path) -> None:
    assert UniTouchModel.from_pretrained(folder, dtype="bfloat16").dtype is torch.bfloat16
    with pytest.raises(InvalidInputError, match="`dtype` is 'bfloat61'"):
        UniTouchModel.from_pretrained(folder, dtype="bfloat61")


def test_an_argument_that_there_is_not_is_refused(folder: Path) -> None:
    with pytest.raises(InvalidInputError, match=r"`from_pretrained` got \['varient'\].*mean 'variant'"):
        UniTouchModel.from_pretrained(folder, varient="fp16")


@pytest.mark.parametrize("modalities", ["touch", 3, None])
def test_modalities_are_a_list(folder: Path, config: UniTouchConfig, modalities: object) -> None:
    for make in (lambda: UniTouchModel.from_pretrained(folder, modalities=modalities),
                 lambda: UniTouchModel(config, modalities=modalities)):  # fmt: skip
        with pytest.raises(InvalidTypeError, match=r"`modalities` is .*list of names"):
            make()


@pytest.mark.parametrize("place", [3, None, b"model", [], 1.5])
def test_what_is_no_path_is_refused(place: object) -> None:
    with pytest.raises(InvalidTypeError, match="`pretrained_model_name_or_path` is"):
        UniTouchModel.from_pretrained(place)


@pytest.mark.parametrize("place", ["x" * 5000, "\ud800", "a\0b", ""])
def test_paths_that_no_file_system_has_are_refused(place: str) -> None:
    with pytest.raises(InvalidInputError, match="`pretrained_model_name_or_path` is"):
        UniTouchModel.from_pretrained(place, local_files_only=True)


def test_a_folder_without_weights_is_refused_when_they_are_needed(folder: Path) -> None:
    (folder / "model.safetensors").unlink()
    model = UniTouchModel.from_pretrained(folder)
    with pytest.raises(InvalidInputError, match=r"no model\.safetensors"):
        model.load("touch")


@pytest.mark.parametrize("wrong", ["missing", "shape"])
def test_weights_that_do_not_fit_the_config_are_refused(folder: Path, wrong: str) -> None:
    state = load_file(folder / "model.safetensors")
    if wrong == "missing":
        del state["touch_model.position"]
    else:
        state["touch_model.position"] = torch.zeros(1, 3, 32)
    save_file(state, folder / "model.safetensors", metadata={"format": "pt"})
    with pytest.raises(InvalidInputError, match="does not hold the touch encoder"):
        UniTouchModel.from_pretrained(folder, modalities=("touch",))


def test_a_failed_read_leaves_no_random_encoder_behind(folder: Path, inputs: dict) -> None:
    state = load_file(folder / "model.safetensors")
    save_file({key: value for key, value in state.items() if not key.startswith("audio")}, folder / "model.safetensors")
    model = UniTouchModel.from_pretrained(folder)
    for _ in range(2):
        with pytest.raises(InvalidInputError, match="audio"):
            features(model, "audio", inputs)
    assert model.loaded_modalities == ()


def test_a_config_of_another_size_is_refused_when_its_weights_are_read(folder: Path) -> None:
    settings = json.loads((folder / "config.json").read_text())
    settings["touch_config"]["num_hidden_layers"] = 3
    (folder / "config.json").write_text(json.dumps(settings))
    model = UniTouchModel.from_pretrained(folder, modalities=("audio",))
    with pytest.raises(InvalidInputError, match="touch"):
        model.load("touch")


def test_an_encoder_first_used_in_inference_mode_can_still_be_trained_and_moved(folder, inputs) -> None:
    model = UniTouchModel.from_pretrained(folder)
    with torch.inference_mode():
        features(model, "image", inputs)
    model.to(torch.bfloat16).to(torch.float32)
    with torch.enable_grad():
        features(model, "image", inputs).sum().backward()
    assert all(parameter.grad is not None for parameter in model.vision_model.visual_projection.parameters())
