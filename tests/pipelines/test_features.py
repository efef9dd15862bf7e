"""What diffusers' pipelines can do beside drawing, held to what its own unCLIP pipeline draws on the same networks.

diffusers' test mixins are not installed with it; these are their invariants of variants, memory and LoRA. Those of
theirs that save pickles are left out, as pickles are read where `use_safetensors=False` says so alone, and those that
need an accelerator run with the CPU in its place.
"""

import copy
import json

import pytest
import torch
from diffusers import AutoencoderKL, DiffusionPipeline, EulerDiscreteScheduler
from diffusers.models.attention_processor import AttnProcessor2_0

from tests.pipelines.test_against_diffusers import D, diffusers_pipeline
from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.pipelines import TouchToImagePipeline, XToTouchPipeline

CPU = torch.device("cpu")


def ours_of(reference, components) -> TouchToImagePipeline:
    ours = TouchToImagePipeline.from_pipe(reference, unitouch=components["unitouch"])
    ours.set_progress_bar_config(disable=True)
    return ours


def draw(pipe, **options) -> torch.Tensor:
    """Two pictures of random embeddings."""
    random = torch.Generator().manual_seed(0)
    embeds, latents = torch.randn(2, D, generator=random), torch.randn(2, 4, 8, 8, generator=random)
    name = "touch_embeds" if isinstance(pipe, TouchToImagePipeline) else "image_embeds"
    prompt = "rough brick" if isinstance(pipe, TouchToImagePipeline) else ["rough brick"] * 2
    latents = latents.to(pipe.unet.dtype)
    options = {"num_inference_steps": 3, "guidance_scale": 3.0, "output_type": "pt", **options}
    options |= {name: embeds.to(pipe.unet.dtype), "latents": latents, "generator": torch.Generator().manual_seed(3)}
    return pipe(prompt=prompt, **options).images


def tile(pipe):
    pipe.vae.enable_tiling()
    pipe.vae.tile_sample_min_size, pipe.vae.tile_latent_min_size = 8, 4


FEATURES = {
    "vae slicing": lambda pipe: pipe.vae.enable_slicing(),
    "vae tiling": tile,
    "freeu": lambda pipe: pipe.enable_freeu(s1=0.9, s2=0.2, b1=1.2, b2=1.4),
    "fused projections": lambda pipe: pipe.fuse_qkv_projections(),
    "attention backend": lambda pipe: pipe.unet.set_attention_backend("native"),
    "attention slicing": lambda pipe: pipe.enable_attention_slicing("max"),
    "layerwise casting": lambda pipe: pipe.unet.enable_layerwise_casting(torch.float8_e4m3fn, torch.float32),
    "group offload by leaf": lambda pipe: pipe.unet.enable_group_offload(CPU, CPU, "leaf_level"),
    "group offload by block": lambda pipe: pipe.unet.enable_group_offload(CPU, CPU, "block_level", 1),
    "compiled blocks": lambda pipe: pipe.unet.compile_repeated_blocks(backend="eager", fullgraph=True),
}


@pytest.mark.parametrize("feature", FEATURES)
def test_a_feature_of_diffusers_draws_what_it_draws_there(components, feature):
    reference = diffusers_pipeline(components)
    ours = ours_of(reference, components)
    FEATURES[feature](reference)  # on networks that both share
    torch.testing.assert_close(draw(ours), draw(reference), atol=1e-5, rtol=0)


@pytest.mark.parametrize("offload_type", ["leaf_level", "block_level"])
def test_group_offloading_of_a_whole_pipeline_changes_no_picture(pipe, touch, offload_type):
    def made():
        return pipe(touch, output_type="pt", generator=torch.Generator().manual_seed(0)).images

    expected = made()
    pipe.enable_group_offload(CPU, CPU, offload_type, num_blocks_per_group=1)
    torch.testing.assert_close(made(), expected, atol=1e-5, rtol=0)


def test_layerwise_casting_to_eight_bits_is_finite_in_half_precision(pipe, touch):
    pipe.to(torch.bfloat16)
    pipe.unet.enable_layerwise_casting(torch.float8_e4m3fn, torch.bfloat16)
    assert torch.isfinite(pipe(touch, output_type="pt").images).all()


def test_tiles_overlap_into_the_whole_picture(components):
    """Slices are exact; tiles are blended, so they are only near."""
    ours = ours_of(diffusers_pipeline(components), components)
    whole = draw(ours)
    ours.vae.enable_slicing()
    torch.testing.assert_close(draw(ours), whole, atol=1e-5, rtol=0)
    assert isinstance(ours.vae, AutoencoderKL)


# Steps that are chosen ------------------------------------------------------------------------------------------------


def euler(components):
    components["scheduler"] = EulerDiscreteScheduler.from_config(components["scheduler"].config)
    ours = ours_of(diffusers_pipeline(components), components)
    return ours, ours.scheduler


def test_timesteps_of_a_number_of_steps_make_its_picture(components):
    ours, scheduler = euler(components)
    scheduler.set_timesteps(4)  # of which each is a whole number
    timesteps = [int(step) for step in scheduler.timesteps]
    expected = draw(ours, num_inference_steps=4)
    torch.testing.assert_close(draw(ours, num_inference_steps=None, timesteps=timesteps), expected, atol=1e-4, rtol=0)


def test_sigmas_of_a_number_of_steps_make_its_picture(components):
    ours, scheduler = euler(components)
    scheduler.set_timesteps(3)
    expected, sigmas = draw(ours), scheduler.sigmas.tolist()
    torch.testing.assert_close(draw(ours, num_inference_steps=None, sigmas=sigmas), expected, atol=1e-4, rtol=0)


@pytest.mark.parametrize("solver", ["euler", "heun", "dpm++2m"])
def test_solvers_take_timesteps(pipe, touch, solver):
    seen: list[float] = []

    def note(pipe, step, timestep, tensors):
        seen.append(round(float(timestep)))
        return {}

    pipe(touch, timesteps=[900, 500, 100], solver=solver, callback_on_step_end=note)
    assert list(dict.fromkeys(seen)) == [900, 500, 100]


def test_stylization_and_x_to_touch_take_timesteps(stylize, x_to_touch, photo, touch):
    for made in (
        stylize(photo[:1], touch[:1], timesteps=[900, 100], solver="euler", init_strength=1.0),
        x_to_touch(image=photo[:1], sigmas=torch.tensor([9.0, 1.0, 0.0]), solver="euler"),
    ):
        assert made.report.steps == 2


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"timesteps": [1, 2]}, "`timesteps` is .*below the one before"),
        ({"timesteps": []}, "`timesteps` is"),
        ({"timesteps": "many"}, "`timesteps` is 'many'"),
        ({"timesteps": [1000]}, r"`timesteps\[0\]` is 1000"),
        ({"timesteps": [2.5]}, r"`timesteps\[0\]` is 2.5"),
        ({"sigmas": [1.0]}, "`sigmas` is .*end in 0"),
        ({"sigmas": [float("nan"), 0.0]}, r"`sigmas\[0\]`"),
        ({"sigmas": [3.0, 0.0], "timesteps": [3]}, "leave one out"),
        ({"timesteps": [3], "num_inference_steps": 1}, "`num_inference_steps` is 1, but `timesteps` came"),
        ({"timesteps": [3], "tolerance": 0.1, "solver": None}, "`tolerance` is 0.1, but `timesteps` came"),
        ({"timesteps": [900], "solver": None}, "DDIMScheduler makes steps of its own"),
    ],
)
def test_steps_that_cannot_be_made_are_refused(pipe, touch, options, words):
    with pytest.raises((InvalidInputError, InvalidTypeError), match=words):
        pipe(touch, **{"solver": "euler", **options})


# LoRA -----------------------------------------------------------------------------------------------------------------


@pytest.fixture
def lora(tmp_path, components):
    """Saved weights of both networks, and the picture that diffusers' own pipeline draws with them."""
    peft = pytest.importorskip("peft", reason="LoRA needs peft")
    reference, layers = diffusers_pipeline(copy.deepcopy(components)), {}
    targets = {"unet": ["to_q", "to_k", "to_v", "to_out.0"], "text_encoder": ["q_proj", "v_proj"]}
    for name, modules in targets.items():
        network = getattr(reference, name)
        torch.manual_seed(0)
        config = peft.LoraConfig(r=4, lora_alpha=4, target_modules=modules, init_lora_weights=False)
        network.add_adapter(config, "made")
        layers[f"{name}_lora_layers"] = peft.get_peft_model_state_dict(network, adapter_name="made")
    type(reference).save_lora_weights(tmp_path / "both", **layers)
    del layers["text_encoder_lora_layers"]
    type(reference).save_lora_weights(tmp_path / "unet", **layers)
    return tmp_path, draw(reference)


def test_lora_weights_draw_what_they_draw_in_diffusers(lora, pipe, components):
    folder, expected = lora
    plain = draw(pipe)
    pipe.load_lora_weights(folder / "both", adapter_name="bricks")
    torch.testing.assert_close(draw(pipe), expected, atol=1e-5, rtol=0)
    assert not torch.allclose(plain, expected, atol=1e-3)
    assert pipe.get_list_adapters() == {"unet": ["bricks"], "text_encoder": ["bricks"]}
    pipe.set_adapters("bricks", 0.0)
    torch.testing.assert_close(draw(pipe), plain, atol=1e-5, rtol=0)
    pipe.set_adapters("bricks", 1.0)
    pipe.fuse_lora()
    torch.testing.assert_close(draw(pipe), expected, atol=1e-4, rtol=0)
    pipe.unfuse_lora()
    pipe.unload_lora_weights()
    torch.testing.assert_close(draw(pipe), plain, atol=1e-4, rtol=0)


HALF = {"cross_attention_kwargs": {"scale": 0.5}}
NONE = {"cross_attention_kwargs": {"scale": 0.0}}


@pytest.mark.parametrize("weights", ["unet", "both"])
def test_a_call_scales_lora_weights_as_one_of_diffusers_does(lora, pipe, components, weights):
    plain = draw(pipe)
    pipe.load_lora_weights(lora[0] / weights)
    whole, expected = draw(pipe), draw(diffusers_pipeline(components), **HALF)  # on networks that both share
    torch.testing.assert_close(draw(pipe, **HALF), expected, atol=1e-5, rtol=0)
    assert not any(torch.allclose(expected, other, atol=1e-3) for other in (plain, whole))
    assert torch.equal(draw(pipe), whole)  # the scale was the call's alone
    torch.testing.assert_close(draw(pipe, **NONE), plain, atol=1e-5, rtol=0)
    assert torch.equal(draw(pipe), whole)


def test_a_prompt_is_encoded_at_a_scale_as_in_diffusers(lora, pipe, components):
    pipe.load_lora_weights(lora[0] / "both")
    with torch.no_grad():
        expected, _ = diffusers_pipeline(components).encode_prompt(["rough brick"], "cpu", 1, False, lora_scale=0.5)
        whole, half = pipe.encode_prompt(["rough brick"]), pipe.encode_prompt(["rough brick"], lora_scale=0.5)
    torch.testing.assert_close(half, expected, atol=1e-6, rtol=0)
    assert not torch.allclose(half, whole, atol=1e-3)


def test_a_text_encoder_that_breaks_leaves_its_lora_weights_at_their_scale(lora, pipe):
    pipe.load_lora_weights(lora[0] / "both")
    whole = draw(pipe)
    handle = pipe.text_encoder.register_forward_hook(lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        draw(pipe, **HALF)
    handle.remove()
    assert torch.equal(draw(pipe), whole)


@pytest.mark.parametrize("kind", ["stylize", "x_to_touch"])
def test_other_pipelines_scale_lora_weights_as_set_adapters_does(request, kind, photo, touch):
    peft = pytest.importorskip("peft", reason="LoRA needs peft")
    pipe = request.getfixturevalue(kind)
    more = {"touch": touch[:1], "init_strength": 1.0} if kind == "stylize" else {}

    def made(**options):
        options |= {"output_type": "latent", "generator": torch.Generator().manual_seed(0), **more}
        return pipe(image=photo[:1], **options).images

    plain = made()
    config = peft.LoraConfig(r=4, lora_alpha=16, target_modules=["to_v", "to_out.0"], init_lora_weights=False)
    pipe.unet.add_adapter(config, "made")
    half = made(**HALF)
    torch.testing.assert_close(made(**NONE), plain, atol=1e-5, rtol=0)
    pipe.set_adapters("made", 0.5)
    torch.testing.assert_close(made(), half, atol=1e-5, rtol=0)
    assert not torch.allclose(half, plain, atol=1e-4)


class Note(AttnProcessor2_0):
    """Keeps what it is passed."""

    def __init__(self, notes: list) -> None:
        super().__init__()
        self.notes = notes

    def __call__(self, *args, note=None, **kwargs):
        self.notes.append(note)
        return super().__call__(*args, **kwargs)


@pytest.mark.parametrize("options", [{"num_inference_steps": 3}, {"tolerance": 0.1}])
def test_attention_processors_get_what_is_passed_in_every_evaluation(pipe, touch, options):
    notes, passed = [], {"note": "rough", "scale": 1}
    layers = len(pipe.unet.attn_processors)
    pipe.unet.set_attn_processor(Note(notes))
    report = pipe(touch, cross_attention_kwargs=passed, **options).report
    assert notes == ["rough"] * (layers * report.evaluations) and passed == {"note": "rough", "scale": 1}


def test_lora_weights_of_a_pipeline_without_a_text_encoder(x_to_touch, photo, tmp_path):
    peft = pytest.importorskip("peft", reason="LoRA needs peft")

    def made():
        return x_to_touch(image=photo[:1], output_type="pt", generator=torch.Generator().manual_seed(0)).images

    plain = made()
    config = peft.LoraConfig(r=4, lora_alpha=4, target_modules=["to_q", "to_v"], init_lora_weights=False)
    x_to_touch.unet.add_adapter(config, "made")
    changed, layers = made(), peft.get_peft_model_state_dict(x_to_touch.unet, adapter_name="made")
    XToTouchPipeline.save_lora_weights(tmp_path, unet_lora_layers=layers)
    x_to_touch.unload_lora_weights()
    torch.testing.assert_close(made(), plain, atol=1e-5, rtol=0)
    x_to_touch.load_lora_weights(tmp_path)
    torch.testing.assert_close(made(), changed, atol=1e-5, rtol=0)
    assert not torch.allclose(plain, changed, atol=1e-4)


def test_lora_weights_that_do_not_fit_are_refused(lora, x_to_touch, pipe, tmp_path):
    folder, _ = lora
    with pytest.raises(InvalidInputError, match="text encoder"):
        x_to_touch.load_lora_weights(folder / "both")
    (tmp_path / "empty").mkdir()
    for place in (tmp_path / "empty", tmp_path / "no" / "such"):
        with pytest.raises(InvalidInputError, match="`pretrained_model_name_or_path_or_dict`"):
            pipe.load_lora_weights(place, local_files_only=True)
    torch.save({"lora": torch.ones(1)}, tmp_path / "empty" / "pytorch_lora_weights.bin")
    with pytest.raises(InvalidInputError, match="`pretrained_model_name_or_path_or_dict`"):  # a pickle
        pipe.load_lora_weights(tmp_path / "empty", local_files_only=True)


# Variants -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("loader", ["ours", "diffusers"])
def test_a_folder_of_one_variant_is_read_with_it_and_not_without(pipe, touch, tmp_path, loader):
    pipe.save_pretrained(tmp_path, variant="fp16")
    kind = TouchToImagePipeline if loader == "ours" else DiffusionPipeline
    options = {} if loader == "ours" else {"trust_remote_code": True}
    loaded = kind.from_pretrained(tmp_path, variant="fp16", **options)
    for name, network in pipe.components.items():
        if isinstance(network, torch.nn.Module):
            if name == "unitouch":
                for modality in network.loaded_modalities:
                    loaded.unitouch.load(modality)
            state = getattr(loaded, name).state_dict()
            assert state and all(torch.equal(state[key], value) for key, value in network.state_dict().items())
    with pytest.raises((ValueError, OSError), match=r"no file named|holds no"):
        kind.from_pretrained(tmp_path, **options).unitouch.load("touch")


def test_a_variant_that_is_not_there_is_refused(family):
    with pytest.raises(ValueError, match="`variant=fp16`, but no such modeling files"):
        TouchToImagePipeline.from_pretrained(family, variant="fp16")


def test_a_variant_is_read_by_a_plan(pipe, touch, tmp_path):
    pipe.save_pretrained(tmp_path, variant="fp16")
    plan = TouchToImagePipeline.plan(touch, output_type="latent")
    made = TouchToImagePipeline.from_pretrained(tmp_path, variant="fp16", plan=plan)(touch, output_type="latent")
    assert made.report.success and "VAE" in made.report.left_out


def test_the_folder_of_a_variant_says_so_of_every_network(pipe, tmp_path):
    pipe.save_pretrained(tmp_path, variant="fp16")
    index = json.loads((tmp_path / "model_index.json").read_text())
    for name, component in pipe.components.items():
        if isinstance(component, torch.nn.Module):
            assert name in index and list((tmp_path / name).glob("*.fp16.safetensors"))
