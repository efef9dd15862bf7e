"""Modalities on demand: what is read when, that it is what was saved, and what cannot be read."""

import json
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.models import MODALITIES, UniTouchConfig, UniTouchModel
from unitouch_gen.models.joint import MODULES


def features(model: UniTouchModel, modality: str, inputs: dict) -> Tensor:
    with torch.no_grad():
        return getattr(model, f"get_{modality}_features")(**inputs[modality])


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
