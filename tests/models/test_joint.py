"""The joint model: features against transformers' own encoders, tokens by sensor, and encoders read when first used."""

import re
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from safetensors.torch import load_file, save_file
from torch import Tensor
from transformers import CLIPTextModelWithProjection, CLIPVisionModelWithProjection

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.models import MODALITIES, UniTouchConfig, UniTouchModel, UniTouchProcessor
from unitouch_gen.models.joint import MODULES

pytestmark = pytest.mark.usefixtures("without_gradients")


@pytest.fixture
def without_gradients():
    with torch.no_grad():
        yield


def features(model: UniTouchModel, modality: str, inputs: dict) -> Tensor:
    return getattr(model, f"get_{modality}_features")(**inputs[modality])


@pytest.mark.parametrize("modality", MODALITIES)
def test_features_are_the_same_alone_and_in_a_batch(model, inputs, modality) -> None:
    embeds = features(model, modality, inputs)
    assert embeds.shape == (2, 16)
    assert torch.isfinite(embeds).all()
    alone = {modality: {key: value[1:] for key, value in inputs[modality].items()}}
    torch.testing.assert_close(features(model, modality, alone)[0], embeds[1], rtol=1e-5, atol=1e-5)


def test_image_and_text_features_are_transformers_own(model, inputs) -> None:
    for modality, kind in (("image", CLIPVisionModelWithProjection), ("text", CLIPTextModelWithProjection)):
        (encoder,) = model.load(modality)
        reference = kind(encoder.config).eval()
        reference.load_state_dict(encoder.state_dict())
        expected = reference(**inputs[modality])[f"{modality}_embeds"]
        torch.testing.assert_close(features(model, modality, inputs), expected, rtol=1e-6, atol=1e-6)


def test_text_features_do_not_depend_on_the_padding(model: UniTouchModel, tokenizer) -> None:
    bare = tokenizer("rough brick", return_tensors="pt").input_ids
    padded = tokenizer("rough brick", padding="max_length", return_tensors="pt")
    assert bare.shape[1] < padded.input_ids.shape[1]
    torch.testing.assert_close(model.get_text_features(bare), model.get_text_features(**padded), rtol=1e-5, atol=1e-5)


def test_audio_features_are_the_mean_of_normalised_clips(model: UniTouchModel, inputs: dict) -> None:
    clips = inputs["audio"]["input_values"]
    each = [F.normalize(model.audio_model(clips[:, i]), dim=1) for i in range(2)]
    torch.testing.assert_close(model.get_audio_features(clips), (each[0] + each[1]) / 2)


def test_touch_features_are_the_trunk_with_the_sensors_tokens(model: UniTouchModel, inputs: dict) -> None:
    pixels = inputs["touch"]["pixel_values"]
    ids = torch.tensor([2, 0])
    expected = model.touch_model(pixels, model.sensor_bank.tokens[ids])
    torch.testing.assert_close(model.get_touch_features(pixels, ids.to(torch.uint8)), expected)
    assert not torch.allclose(model.get_touch_features(pixels, torch.tensor([1, 1])), expected, atol=1e-3)
    expected[1] = model.touch_model(pixels)[1]  # of no sensor
    torch.testing.assert_close(model.get_touch_features(pixels, torch.tensor([2, -1])), expected)


# Encoders on demand ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("modality", MODALITIES)
def test_an_encoder_is_read_when_first_used_and_is_what_was_saved(model, folder, inputs, modality) -> None:
    before = torch.get_rng_state()
    again = UniTouchModel.from_pretrained(folder)
    assert not again.state_dict()
    torch.testing.assert_close(features(again, modality, inputs), features(model, modality, inputs), rtol=0, atol=0)
    assert {key.split(".")[0] for key in again.state_dict()} == set(MODULES[modality])
    assert not any(module.training for module in again.modules())
    assert torch.equal(torch.get_rng_state(), before)  # no random weights are drawn first


def test_threads_that_share_a_model_read_each_encoder_once_and_get_what_serial_calls_get(model, folder, inputs) -> None:
    shared = UniTouchModel.from_pretrained(folder)
    asked = MODALITIES * 8

    def used(modality: str) -> tuple[int, Tensor]:
        with torch.inference_mode():
            return id(shared.load(modality)[0]), features(shared, modality, inputs)

    with ThreadPoolExecutor(16) as pool:
        found = list(pool.map(used, asked))
    assert len({place for place, _ in found}) == len(MODALITIES)
    for modality, (_, embeds) in zip(asked, found, strict=True):
        assert torch.equal(embeds, features(model, modality, inputs))


@pytest.mark.parametrize("modalities", [(), ("touch",)])
def test_saving_over_its_own_folder_and_elsewhere_keeps_every_tensor(folder, tmp_path, modalities) -> None:
    before = {key: value.clone() for key, value in load_file(folder / "model.safetensors").items()}
    model = UniTouchModel.from_pretrained(folder, modalities=modalities)
    for place in (folder, tmp_path / "copy"):
        model.save_pretrained(place)
        after = load_file(place / "model.safetensors")
        assert before.keys() == after.keys()
        assert all(torch.equal(before[key], after[key]) for key in before)


def test_other_parts_are_saved_beside_shards_and_shards_give_way_to_other_shards(
    model: UniTouchModel, tokenizer, tmp_path: Path
) -> None:
    """A processor beside a sharded model; then the model in one file, in fewer shards, and as a variant of either."""
    (tmp_path / "controlnet.safetensors").write_text("theirs")
    for variant, size in ((None, "20KB"), (None, "10GB"), ("fp16", "20KB"), (None, "40KB"), ("fp16", "10GB")):
        model.save_pretrained(tmp_path, max_shard_size=size, variant=variant)
        UniTouchProcessor.for_config(model.config, tokenizer).save_pretrained(tmp_path)
        assert equal_states(UniTouchModel.from_pretrained(tmp_path, variant=variant, modalities=MODALITIES), model)
    assert equal_states(UniTouchModel.from_pretrained(tmp_path, modalities=MODALITIES), model)
    assert UniTouchProcessor.from_pretrained(tmp_path).tokenizer.get_vocab() == tokenizer.get_vocab()
    weights = {file.name for file in tmp_path.glob("*.safetensors*")}
    shards = {name for name in weights if re.fullmatch(r"model-\d+-of-\d+\.safetensors", name)}
    assert len(shards) > 1
    assert len({name.rpartition("-")[2] for name in shards}) == 1
    others = {"controlnet.safetensors", "model.fp16.safetensors", "model.safetensors.index.json"}
    assert weights - shards == others


def equal_states(one: UniTouchModel, other: UniTouchModel) -> bool:
    wanted = other.state_dict()
    state = one.state_dict()
    return state.keys() == wanted.keys() and all(torch.equal(state[key], value) for key, value in wanted.items())


def test_a_model_of_some_modalities_is_saved_with_those(config: UniTouchConfig, tmp_path: Path) -> None:
    UniTouchModel(config, modalities=("touch", "text")).save_pretrained(tmp_path)
    again = UniTouchModel.from_pretrained(tmp_path)
    assert again.known_modalities == ("text", "touch")
    with pytest.raises(InvalidInputError, match="no image encoder; it has text, touch"):
        again.load("image")


@pytest.mark.filterwarnings("ignore:.*copying from a non-meta parameter")
def test_encoders_read_later_follow_casts_and_moves(folder: Path) -> None:
    for cast in (lambda model: model.half(), lambda model: torch.nn.ModuleList([model]).to("meta", torch.float16)):
        model = UniTouchModel.from_pretrained(folder, modalities=("touch",))
        cast(model)
        model.load("audio")
        assert {(weight.device, weight.dtype) for weight in model.parameters()} == {(model.device, torch.float16)}
        assert model.dtype == torch.float16


# Wrong folders --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("wrong", ["missing", "shape"])
def test_weights_that_do_not_fit_the_config_leave_no_encoder_behind(folder: Path, inputs: dict, wrong: str) -> None:
    state = load_file(folder / "model.safetensors")
    state["touch_model.position"] = torch.zeros(1, 3, 32)
    if wrong == "missing":
        del state["touch_model.position"]
    save_file(state, folder / "model.safetensors", metadata={"format": "pt"})
    model = UniTouchModel.from_pretrained(folder)
    for _ in range(2):
        with pytest.raises(InvalidInputError, match="does not hold the touch encoder"):
            features(model, "touch", inputs)
    assert not model.state_dict()
    with pytest.raises(InvalidInputError, match="does not hold the touch encoder"):
        model.save_pretrained(folder.parent / "copy")
