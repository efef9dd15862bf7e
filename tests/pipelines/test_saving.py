"""Pipelines on disk and in other hands: saving, loading, dtypes, sharing components."""

import json

import pytest
import torch

from unitouch_gen.encoders import UniTouchModel
from unitouch_gen.pipelines import TouchToImagePipeline

DEFAULTS = {
    "default_strength": 0.75,
    "default_guidance_scale": 2.0,
    "default_num_inference_steps": 2,
    "default_noise_level": 0,
}
NETWORKS = ("unitouch", "image_normalizer", "text_encoder", "unet", "vae")
OPTIONAL = ("unitouch", "processor", "tokenizer", "text_encoder")


def load(folder, **kwargs) -> TouchToImagePipeline:
    pipe = TouchToImagePipeline.from_pretrained(folder, **kwargs)
    pipe.set_progress_bar_config(disable=True)
    return pipe


def pictures(pipe, *args, **kwargs) -> torch.Tensor:
    """(B, 3, H, W), from one seed."""
    return pipe(*args, generator=torch.Generator().manual_seed(0), output_type="pt", **kwargs).images


# On disk --------------------------------------------------------------------------------------------------------------


def test_a_loaded_pipeline_makes_the_same_picture(pipe, family, touch):
    options = {"prompt": "rough brick", "negative_prompt": "metal"}
    assert torch.equal(pictures(load(family), touch, **options), pictures(pipe, touch, **options))


def test_a_loaded_pipeline_has_the_same_defaults(family):
    config = load(family).config
    assert {name: config[name] for name in DEFAULTS} == DEFAULTS


def test_a_default_may_be_overridden_on_loading(family):
    assert load(family, default_strength=0.5).config.default_strength == 0.5


def test_loaded_networks_are_in_evaluation_mode(family):
    pipe = load(family)
    assert not any(getattr(pipe, name).training for name in NETWORKS)


def test_only_safetensors_are_written(family):
    weights = {file.suffix for file in family.rglob("*") if file.is_file()} - {".json", ".txt"}
    assert weights == {".safetensors"}


def test_only_the_sense_that_is_used_is_read(family, touch):
    pipe = load(family)
    assert pipe.unitouch.loaded_senses == ()
    pictures(pipe, touch)
    assert pipe.unitouch.loaded_senses == ("touch",)


def test_given_embeddings_read_no_sense(family):
    pipe = load(family)
    pictures(pipe, touch_embeds=torch.ones(1, 16))
    assert pipe.unitouch.loaded_senses == ()


def test_saving_a_loaded_pipeline_loses_no_sense(pipe, family, tmp_path):
    load(family).save_pretrained(tmp_path)
    saved = UniTouchModel.from_pretrained(
        tmp_path / "unitouch", senses=("image", "text", "audio", "touch")
    ).state_dict()
    expected = pipe.unitouch.state_dict()
    assert set(saved) == set(expected)
    assert all(torch.equal(saved[name], expected[name]) for name in expected)


def test_optional_components_may_be_missing_on_disk(components, tmp_path):
    TouchToImagePipeline(**(components | dict.fromkeys(OPTIONAL))).save_pretrained(tmp_path)
    index = json.loads((tmp_path / "model_index.json").read_text())
    pipe = load(tmp_path)
    assert [index[name] for name in OPTIONAL] == [[None, None]] * len(OPTIONAL)
    assert [pipe.components[name] for name in OPTIONAL] == [None] * len(OPTIONAL)


def test_optional_components_may_be_left_on_disk(family):
    pipe = load(family, unitouch=None, processor=None)
    assert pipe.unitouch is None
    assert torch.isfinite(pictures(pipe, touch_embeds=torch.ones(1, 16))).all()


def test_components_may_be_replaced_on_loading(family, components):
    pipe = load(family, unitouch=components["unitouch"])
    assert pipe.unitouch is components["unitouch"]


# Dtypes ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_networks_are_read_in_the_dtype_asked_for(family, touch, dtype):
    pipe = load(family, dtype=dtype)
    assert {getattr(pipe, name).dtype for name in NETWORKS} == {dtype}
    assert torch.isfinite(pictures(pipe, touch)).all()
    assert pipe.unitouch.touch_model.position.dtype == dtype


def test_the_deprecated_name_of_the_dtype_still_works(family):
    with pytest.warns(FutureWarning, match="torch_dtype"):
        assert load(family, torch_dtype=torch.float16).unet.dtype == torch.float16


def test_float16_is_close_to_float32(family, touch):
    latents = torch.randn(2, 4, 8, 8, generator=torch.Generator().manual_seed(0))
    options = {"latents": latents, "output_type": "latent"}
    exact = load(family)(touch, **options, generator=torch.Generator().manual_seed(0)).images
    half = load(family, dtype=torch.float16)(touch, **options, generator=torch.Generator().manual_seed(0)).images
    assert (half - exact).norm() / exact.norm() < 0.02


# Components in other hands --------------------------------------------------------------------------------------------


def test_components_make_another_pipeline(pipe, touch):
    other = TouchToImagePipeline(**pipe.components, **DEFAULTS)
    assert torch.equal(pictures(other, touch), pictures(pipe, touch))


def test_optional_components_are_those_that_may_be_none(pipe):
    assert set(pipe._optional_components) == set(OPTIONAL)
    assert set(OPTIONAL) < set(pipe.components)


def test_from_pipe_of_itself_is_the_same_pipeline(pipe, touch):
    other = TouchToImagePipeline.from_pipe(pipe)
    assert all(component is pipe.components[name] for name, component in other.components.items())
    assert {name: other.config[name] for name in DEFAULTS} == DEFAULTS
    assert torch.equal(pictures(other, touch), pictures(pipe, touch))


def test_from_pipe_takes_what_should_differ(pipe):
    other = TouchToImagePipeline.from_pipe(pipe, unitouch=None, processor=None, default_guidance_scale=4.0)
    assert other.unitouch is None
    assert other.config.default_guidance_scale == 4.0
    assert other.unet is pipe.unet


def test_from_pipe_keeps_the_dtypes_of_its_components(pipe):
    pipe.unet.to(torch.bfloat16)
    other = TouchToImagePipeline.from_pipe(pipe)
    assert (other.unet.dtype, other.vae.dtype) == (torch.bfloat16, torch.float32)


@pytest.mark.parametrize("name", ["dtype", "torch_dtype"])
def test_from_pipe_casts_when_asked_to(pipe, name):
    other = TouchToImagePipeline.from_pipe(pipe, **{name: torch.float64})
    assert {getattr(other, network).dtype for network in NETWORKS} == {torch.float64}


def test_to_moves_senses_that_are_read_later(family, touch):
    pipe = load(family)
    pipe.to(torch.float64)
    pipe.encode_touch(touch)
    assert pipe.unitouch.touch_model.position.dtype == torch.float64


def test_attention_slicing_changes_no_picture(pipe, touch):
    expected = pictures(pipe, touch)
    pipe.enable_attention_slicing("max")
    torch.testing.assert_close(pictures(pipe, touch), expected, atol=1e-5, rtol=0)


def test_channels_last_changes_no_picture(pipe, touch):
    expected = pictures(pipe, touch)
    pipe.unet.to(memory_format=torch.channels_last)
    torch.testing.assert_close(pictures(pipe, touch), expected, atol=1e-5, rtol=0)


def test_the_order_of_offloading_names_every_network(pipe):
    named = set(pipe.model_cpu_offload_seq.split("->")) | set(pipe._exclude_from_cpu_offload)
    assert named == set(NETWORKS)


def test_the_docstring_has_a_runnable_example(pipe):
    assert "Examples:" in type(pipe).__call__.__doc__
    assert "unitouch_gen.tiny" in type(pipe).__call__.__doc__
