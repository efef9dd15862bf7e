"""The same embedding, scheduler, steps and latents give the picture that diffusers' own unCLIP pipeline makes."""

import numpy as np
import pytest
import torch
from diffusers import (
    AutoencoderDC,
    AutoencoderTiny,
    DDIMScheduler,
    DPMSolverMultistepScheduler,
    EulerDiscreteScheduler,
    PNDMScheduler,
    StableUnCLIPImg2ImgPipeline,
    UniPCMultistepScheduler,
)
from PIL import Image
from torch.testing import assert_close
from transformers import CLIPImageProcessor, CLIPVisionConfig, CLIPVisionModelWithProjection

from tests.helpers.calls import quiet, seeded
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.pipelines import TouchToImagePipeline

D = 16
CPU = torch.device("cpu")


def diffusers_pipeline(components: dict) -> StableUnCLIPImg2ImgPipeline:
    config = CLIPVisionConfig(
        hidden_size=16, intermediate_size=32, num_hidden_layers=1, num_attention_heads=2, image_size=32, patch_size=8,
        projection_dim=D,
    )  # fmt: skip
    shared = {key: value for key, value in components.items() if key not in ("unitouch", "processor")}
    return quiet(
        StableUnCLIPImg2ImgPipeline(
            feature_extractor=CLIPImageProcessor(size=32, crop_size=32),
            image_encoder=CLIPVisionModelWithProjection(config).eval(),
            **shared,
        )
    )


@pytest.fixture
def pair(components):
    """diffusers' pipeline and ours, on the same components."""
    theirs = diffusers_pipeline(components)
    return theirs, quiet(TouchToImagePipeline.from_pipe(theirs, unitouch=components["unitouch"]))


def draw(pipe, **options) -> torch.Tensor:
    """A picture of a random embedding."""
    name = "touch_embeds" if isinstance(pipe, TouchToImagePipeline) else "image_embeds"
    embeds = torch.randn(1, D, generator=seeded()).to(pipe.unet.dtype)
    options = {"prompt": "rough brick", "num_inference_steps": 3, "guidance_scale": 3.0, "output_type": "pt", **options}
    return pipe(**{name: embeds}, generator=seeded(3), **options).images


def same(one: torch.Tensor, other: torch.Tensor) -> None:
    assert_close(one, other, atol=1e-5, rtol=0)


@pytest.mark.parametrize(
    "scheduler", [DDIMScheduler, DPMSolverMultistepScheduler, UniPCMultistepScheduler, PNDMScheduler]
)
@pytest.mark.parametrize("guidance_scale", [1.0, 7.5])
def test_same_picture_as_diffusers(pair, scheduler, guidance_scale):
    """From given latents and from its random numbers: embedding noise first, then latents."""
    theirs, ours = pair
    theirs.scheduler = ours.scheduler = scheduler.from_config(ours.scheduler.config)
    options = {"num_inference_steps": 5, "guidance_scale": guidance_scale, "noise_level": 30}
    latents = torch.randn(1, 4, 8, 8, generator=seeded(1))
    same(draw(ours, latents=latents, **options), draw(theirs, latents=latents.clone(), **options))
    options["num_images_per_prompt"] = 2
    same(draw(ours, **options), draw(theirs, **options))


def test_given_latents_are_scaled_by_the_scheduler(pair):
    """diffusers takes `latents` of unit variance as they are, which starts Euler at a fourteenth of its noise."""
    theirs, ours = pair
    theirs.scheduler = ours.scheduler = EulerDiscreteScheduler.from_config(ours.scheduler.config)
    scheduler = EulerDiscreteScheduler.from_config(ours.scheduler.config)
    scheduler.set_timesteps(3)
    noise = torch.randn(1, 4, 8, 8, generator=seeded(1))
    same(draw(ours, latents=noise), draw(theirs, latents=noise * scheduler.init_noise_sigma))


def tile(pipe):
    pipe.vae.enable_tiling()
    pipe.vae.tile_sample_min_size, pipe.vae.tile_latent_min_size = 8, 4


FEATURES = {
    "vae slicing": lambda pipe: pipe.vae.enable_slicing(),
    "vae tiling": tile,
    "freeu": lambda pipe: pipe.enable_freeu(s1=0.9, s2=0.2, b1=1.2, b2=1.4),
    "fused projections": lambda pipe: pipe.fuse_qkv_projections(),
    "attention slicing": lambda pipe: pipe.enable_attention_slicing("max"),
    "layerwise casting": lambda pipe: pipe.unet.enable_layerwise_casting(torch.float8_e4m3fn, torch.float32),
    "group offload by leaf": lambda pipe: pipe.unet.enable_group_offload(CPU, CPU, "leaf_level"),
    "group offload by block": lambda pipe: pipe.unet.enable_group_offload(CPU, CPU, "block_level", 1),
    "compiled blocks": lambda pipe: pipe.unet.compile_repeated_blocks(backend="eager", fullgraph=True),
}


@pytest.mark.parametrize("feature", FEATURES)
def test_a_feature_of_diffusers_draws_what_it_draws_there(pair, feature):
    theirs, ours = pair
    FEATURES[feature](theirs)  # on networks that both share
    same(draw(ours), draw(theirs))


# Our parts in diffusers' pipeline, and back ---------------------------------------------------------------------------


def tiny_vae() -> AutoencoderTiny:
    torch.manual_seed(4)
    counts = {"num_encoder_blocks": (0, 1), "num_decoder_blocks": (1, 0)}
    channels = dict.fromkeys(("encoder_block_out_channels", "decoder_block_out_channels"), (8, 8))
    return AutoencoderTiny(latent_channels=4, **channels, **counts).eval()


@pytest.mark.parametrize("vae", ["kl", "tiny"])
@torch.no_grad()
def test_diffusers_makes_our_picture_of_an_image_of_our_parts(components, vae):
    """From a photo: its own feature extractor, our image encoder; and back again, from the embedding."""
    components |= {} if vae == "kl" else {"vae": tiny_vae()}
    ours = quiet(TouchToImagePipeline(**components))
    theirs = quiet(ours.to_diffusers())
    photo = Image.fromarray(np.random.default_rng(0).integers(0, 256, (32, 32, 3), dtype=np.uint8))
    embeds = components["unitouch"].get_image_features(components["processor"].images(photo))
    options = {"num_inference_steps": 3, "guidance_scale": 3.0, "noise_level": 20, "output_type": "pt"}
    expected = theirs(photo, prompt="metal", generator=seeded(5), **options).images
    back = quiet(TouchToImagePipeline.from_pipe(theirs, unitouch=components["unitouch"]))
    assert back.processor.image_size == 32 and back.unet is ours.unet
    for pipe in (ours, back):
        same(pipe(touch_embeds=embeds, prompt="metal", generator=seeded(5), **options).images, expected)


def test_what_diffusers_cannot_build_on_is_refused(components):
    ends = {
        "block_types": "ResBlock",
        "block_out_channels": (8, 8),
        "layers_per_block": (1, 1),
        "qkv_multiscales": ((), ()),
    }
    blocks = {f"{side}_{name}": value for side in ("encoder", "decoder") for name, value in ends.items()}
    for part, value in {"vae": AutoencoderDC(latent_channels=4, **blocks), "unitouch": None}.items():
        with pytest.raises(InvalidInputError, match=f"`{part}`"):
            TouchToImagePipeline(**{**components, part: value}).to_diffusers()
