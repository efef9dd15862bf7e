"""Pipelines on disk and in other hands: saving, loading, dtypes, sharing components."""

import json

import pytest
import torch
from accelerate.hooks import ModelHook, add_hook_to_module

from unitouch_gen.models import UniTouchModel
from unitouch_gen.pipelines import TouchToImagePipeline
from unitouch_gen.schedulers.solvers import SOLVERS, make_scheduler

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


def same_pictures(one, other):
    """To the rounding of sums, whose order depends on where weights lie in memory."""
    torch.testing.assert_close(one, other, rtol=0.0, atol=1e-5)


def test_a_loaded_pipeline_makes_the_same_picture(pipe, family, touch):
    options = {"prompt": "rough brick", "negative_prompt": "metal"}
    same_pictures(pictures(load(family), touch, **options), pictures(pipe, touch, **options))


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


def test_only_the_modality_that_is_used_is_read(family, touch):
    pipe = load(family)
    assert pipe.unitouch.loaded_modalities == ()
    pictures(pipe, touch)
    assert pipe.unitouch.loaded_modalities == ("touch",)


def test_given_embeddings_read_no_modality(family):
    pipe = load(family)
    pictures(pipe, touch_embeds=torch.ones(1, 16))
    assert pipe.unitouch.loaded_modalities == ()


def test_saving_a_loaded_pipeline_loses_no_modality(pipe, family, tmp_path):
    load(family).save_pretrained(tmp_path)
    saved = UniTouchModel.from_pretrained(
        tmp_path / "unitouch", modalities=("image", "text", "audio", "touch")
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


def test_to_moves_modalities_that_are_read_later(family, touch):
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


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_pipeline_with_a_solver_as_its_scheduler_is_saved_and_read_again(pipe, touch, solver, tmp_path):
    pipe.scheduler = make_scheduler(pipe.scheduler, solver)
    pipe.save_pretrained(tmp_path)
    loaded = load(tmp_path)
    assert type(loaded.scheduler) is SOLVERS[solver].scheduler
    same_pictures(pictures(loaded, touch), pictures(pipe, touch))


def test_the_docstring_has_a_runnable_example(pipe):
    assert "Examples:" in type(pipe).__call__.__doc__
    assert "unitouch_gen.tiny" in type(pipe).__call__.__doc__


# Offloading, with the CPU in place of an accelerator ------------------------------------------------------------------


def test_the_order_of_offloading_names_every_network(pipe):
    named = set(pipe.model_cpu_offload_seq.split("->")) | set(pipe._exclude_from_cpu_offload)
    assert named == set(NETWORKS)


class Note(ModelHook):
    """Writes down when offloading brings a network to its device."""

    def __init__(self, name: str, notes: list[str]):
        self.name, self.notes = name, notes

    def pre_forward(self, module, *args, **kwargs):
        self.notes.append(self.name)
        return args, kwargs


def test_every_network_sets_off_its_hook_in_the_order_of_offloading(pipe, touch):
    notes: list[str] = []
    for name in pipe.model_cpu_offload_seq.split("->"):
        add_hook_to_module(getattr(pipe, name), Note(name, notes))
    pictures(pipe, touch, guidance_scale=1.0)
    assert list(dict.fromkeys(notes)) == pipe.model_cpu_offload_seq.split("->")


@pytest.mark.parametrize("where", ["memory", "disk"])
@pytest.mark.filterwarnings("ignore::unitouch_gen.errors.UnfamiliarTouchWarning")  # a dark touch for a DIGIT
def test_offloading_changes_no_picture(pipe, family, touch, where):
    expected = pictures(pipe, touch, sensor=["digit", None])
    offloaded = load(family) if where == "disk" else pipe
    offloaded.enable_model_cpu_offload(device="cpu")
    for _ in range(2):
        torch.testing.assert_close(pictures(offloaded, touch, sensor=["digit", None]), expected, atol=1e-6, rtol=0)


def test_sequential_offloading_leaves_the_joint_space_its_weights(family, touch):
    """There is no test of the whole call: on a CPU, accelerate 1.x breaks under diffusers' own pipelines, too."""
    expected = load(family).encode_touch(touch)
    pipe = load(family)
    pipe.enable_sequential_cpu_offload(device="cpu")
    torch.testing.assert_close(pipe.encode_touch(touch), expected)


def test_offloading_changes_no_picture_where_networks_share_weights(components, touch):
    """As in the built-in family, whose text encoder is that of the joint space."""
    text = components["unitouch"].text_model.text_model
    components |= {"text_encoder": text, "tokenizer": components["tokenizer"]}
    pipe = TouchToImagePipeline(**components, **DEFAULTS)
    pipe.set_progress_bar_config(disable=True)
    expected = pictures(pipe, touch)
    pipe.enable_model_cpu_offload(device="cpu")
    torch.testing.assert_close(pictures(pipe, touch), expected, atol=1e-6, rtol=0)
