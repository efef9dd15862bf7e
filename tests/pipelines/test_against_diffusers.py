"""The same embedding, scheduler, steps, latents and LoRA weights give what diffusers' own unCLIP pipeline draws."""

import copy

import diffusers
import numpy as np
import pytest
import torch
from PIL import Image
from torch.testing import assert_close

from tests.helpers.calls import diffusers_pipeline, quiet, seeded
from tests.helpers.components import D
from unitouch_gen.pipelines import TouchToImagePipeline

CPU = torch.device("cpu")
SCHEDULERS = (
    "DDIM",
    "DDPM",
    "DPMSolverMultistep",
    "EulerAncestralDiscrete",
    "EulerDiscrete",
    "HeunDiscrete",
    "PNDM",
    "UniPCMultistep",
)


@pytest.fixture
def pair(components):
    """diffusers' pipeline and ours, on the same components."""
    theirs = diffusers_pipeline(components)
    return theirs, quiet(TouchToImagePipeline.from_pipe(theirs, unitouch=components["unitouch"]))


def draw(pipe, **options) -> torch.Tensor:
    """A picture of a random embedding, by either pipeline."""
    name = "touch_embeds" if isinstance(pipe, TouchToImagePipeline) else "image_embeds"
    embeds = torch.randn(1, D, generator=seeded()).to(pipe.unet.dtype)
    given = {"prompt": "rough brick", "num_inference_steps": 3, "guidance_scale": 3.0, "output_type": "pt", **options}
    return pipe(**{name: embeds}, generator=seeded(3), **given).images


@pytest.mark.parametrize("guidance_scale", [1.0, 7.5])
@pytest.mark.parametrize("scheduler", SCHEDULERS)
def test_same_picture_as_diffusers(pair, scheduler, guidance_scale):
    """From given latents, which it takes at the scheduler's first noise level, and from its random numbers."""
    theirs, ours = pair
    theirs.scheduler = ours.scheduler = getattr(diffusers, f"{scheduler}Scheduler").from_config(ours.scheduler.config)
    options = {"num_inference_steps": 5, "guidance_scale": guidance_scale, "noise_level": 30}
    theirs.scheduler.set_timesteps(5)
    noise = torch.randn(1, 4, 8, 8, generator=seeded(1))
    expected = draw(theirs, latents=noise * theirs.scheduler.init_noise_sigma, **options)
    assert_close(draw(ours, latents=noise, **options), expected, atol=1e-5, rtol=0)
    options["num_images_per_prompt"] = 2
    assert_close(draw(ours, **options), draw(theirs, **options), atol=1e-5, rtol=0)


FEATURES = {
    "vae slicing": lambda pipe: pipe.vae.enable_slicing(),
    "vae tiling": lambda pipe: (pipe.vae.enable_tiling(), setattr(pipe.vae, "tile_latent_min_size", 4)),
    "freeu": lambda pipe: pipe.enable_freeu(s1=0.9, s2=0.2, b1=1.2, b2=1.4),
    "fused projections": lambda pipe: pipe.fuse_qkv_projections(),
    "attention slicing": lambda pipe: pipe.enable_attention_slicing("max"),
    "layerwise casting": lambda pipe: pipe.unet.enable_layerwise_casting(torch.float8_e4m3fn, torch.float32),
    "group offload": lambda pipe: pipe.unet.enable_group_offload(CPU, CPU, "block_level", 1),
    "compiled blocks": lambda pipe: pipe.unet.compile_repeated_blocks(backend="eager", fullgraph=True),
}


@pytest.mark.parametrize("feature", FEATURES)
def test_a_feature_of_diffusers_draws_what_it_draws_there(pair, feature):
    theirs, ours = pair
    FEATURES[feature](theirs)  # on networks that both share
    assert_close(draw(ours), draw(theirs), atol=1e-5, rtol=0)


@pytest.mark.parametrize("vae", ["kl", "tiny"])
@torch.no_grad()
def test_diffusers_makes_our_picture_of_an_image_of_our_parts(components, vae):
    """From a photo: its own feature extractor, our image encoder; and back again, from the embedding."""
    if vae == "tiny":
        counts = {"num_encoder_blocks": (0, 1), "num_decoder_blocks": (1, 0)}
        channels = dict.fromkeys(("encoder_block_out_channels", "decoder_block_out_channels"), (8, 8))
        components["vae"] = diffusers.AutoencoderTiny(latent_channels=4, **channels, **counts).eval()
    ours = quiet(TouchToImagePipeline(**components))
    theirs = quiet(ours.to_diffusers())
    photo = Image.fromarray(np.random.default_rng(0).integers(0, 256, (32, 32, 3), dtype=np.uint8))
    embeds = components["unitouch"].get_image_features(components["processor"].images(photo))
    options = {"prompt": "metal", "num_inference_steps": 3, "guidance_scale": 3.0}
    options |= {"noise_level": 20, "output_type": "pt"}
    expected = theirs(photo, generator=seeded(5), **options).images
    back = quiet(TouchToImagePipeline.from_pipe(theirs, unitouch=components["unitouch"]))
    assert back.processor.image_size == 32
    assert back.unet is ours.unet
    for pipe in (ours, back):
        assert_close(pipe(touch_embeds=embeds, generator=seeded(5), **options).images, expected, atol=1e-5, rtol=0)


# LoRA -----------------------------------------------------------------------------------------------------------------

HALF, NONE = ({"cross_attention_kwargs": {"scale": scale}} for scale in (0.5, 0.0))


def close(one: torch.Tensor, other: torch.Tensor, atol: float = 2e-5) -> bool:
    return torch.allclose(one, other, atol=atol, rtol=0)


def adapter(network, *targets: str) -> dict:
    """Gives a network an adapter of random weights, and returns these."""
    peft = pytest.importorskip("peft", reason="LoRA needs peft")
    torch.manual_seed(0)
    config = peft.LoraConfig(r=4, lora_alpha=4, target_modules=list(targets), init_lora_weights=False)
    network.add_adapter(config, "made")
    return peft.get_peft_model_state_dict(network, adapter_name="made")


@pytest.fixture
def lora(tmp_path, components):
    """The folder of saved weights of both networks, and the picture that diffusers' own pipeline draws with them."""
    reference = diffusers_pipeline(copy.deepcopy(components))
    layers = {"unet_lora_layers": adapter(reference.unet, "to_q", "to_k", "to_v", "to_out.0")}
    layers["text_encoder_lora_layers"] = adapter(reference.text_encoder, "q_proj", "v_proj")
    type(reference).save_lora_weights(tmp_path, **layers)
    return tmp_path, draw(reference)


def test_weights_draw_what_they_draw_in_diffusers(lora, pipe, components):
    plain = draw(pipe)
    pipe.load_lora_weights(lora[0], adapter_name="bricks")
    whole = draw(pipe)  # on networks that both share
    half = draw(diffusers_pipeline(components), **HALF)
    assert close(whole, lora[1])
    assert close(draw(pipe, **HALF), half)
    assert close(draw(pipe, **NONE), plain)
    assert not any(close(one, other) for one, other in ((whole, plain), (half, plain), (half, whole)))
    with torch.no_grad():
        states, _ = diffusers_pipeline(components).encode_prompt(["brick"], "cpu", 1, False, lora_scale=0.5)
        assert_close(pipe.encode_prompt(["brick"], lora_scale=0.5), states, atol=1e-6, rtol=0)
    assert torch.equal(draw(pipe), whole)  # the scale was the call's alone
    pipe.fuse_lora()
    assert close(draw(pipe), lora[1], 1e-4)
    pipe.unfuse_lora()
    pipe.unload_lora_weights()
    assert close(draw(pipe), plain, 1e-4)


def test_weights_of_each_pipeline_are_scaled_saved_and_loaded(call, tmp_path):
    plain = call.latents()
    layers = adapter(call.pipe.unet, "to_v", "to_out.0")
    half = call.latents(**HALF)
    whole = call.latents()
    assert close(call.latents(**NONE), plain)
    assert not close(half, plain)
    call.pipe.set_adapters("made", 0.5)
    assert close(call.latents(), half)
    call.pipe.save_lora_weights(tmp_path, unet_lora_layers=layers)
    call.pipe.unload_lora_weights()
    assert close(call.latents(), plain)
    call.pipe.load_lora_weights(tmp_path)
    assert close(call.latents(), whole)
    call.pipe.fuse_lora()
    assert close(call.latents(), whole, 1e-4)
    call.pipe.unfuse_lora()
    assert close(call.latents(**NONE), plain, 1e-4)
