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
from transformers import CLIPImageProcessor, CLIPVisionConfig, CLIPVisionModelWithProjection

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.pipelines import TouchToImagePipeline

D = 16


def diffusers_pipeline(components: dict) -> StableUnCLIPImg2ImgPipeline:
    config = CLIPVisionConfig(
        hidden_size=16, intermediate_size=32, num_hidden_layers=1, num_attention_heads=2, image_size=32, patch_size=8,
        projection_dim=D,
    )  # fmt: skip
    shared = {key: value for key, value in components.items() if key not in ("unitouch", "processor")}
    pipeline = StableUnCLIPImg2ImgPipeline(
        feature_extractor=CLIPImageProcessor(size=32, crop_size=32),
        image_encoder=CLIPVisionModelWithProjection(config).eval(),
        **shared,
    )
    pipeline.set_progress_bar_config(disable=True)
    return pipeline


@pytest.mark.parametrize(
    "scheduler", [DDIMScheduler, DPMSolverMultistepScheduler, UniPCMultistepScheduler, PNDMScheduler]
)
@pytest.mark.parametrize("guidance_scale", [1.0, 7.5])
def test_same_picture_as_diffusers(components, scheduler, guidance_scale):
    components["scheduler"] = scheduler.from_config(components["scheduler"].config)
    reference = diffusers_pipeline(components)
    ours = TouchToImagePipeline.from_pipe(reference, unitouch=components["unitouch"])
    ours.set_progress_bar_config(disable=True)
    embeds, latents = torch.randn(1, D), torch.randn(1, 4, 8, 8)
    shared = {"num_inference_steps": 5, "guidance_scale": guidance_scale, "noise_level": 30, "output_type": "pt"}
    expected = reference(
        prompt="rough brick", image_embeds=embeds, latents=latents.clone(),
        generator=torch.Generator().manual_seed(3), **shared,
    ).images  # fmt: skip
    got = ours(
        prompt="rough brick", touch_embeds=embeds, latents=latents, generator=torch.Generator().manual_seed(3), **shared
    ).images
    torch.testing.assert_close(got, expected, atol=1e-5, rtol=0)


def test_same_random_numbers_as_diffusers(components):
    """Embedding noise first, then latents, from one generator."""
    reference = diffusers_pipeline(components)
    ours = TouchToImagePipeline.from_pipe(reference, unitouch=components["unitouch"])
    ours.set_progress_bar_config(disable=True)
    embeds = torch.randn(1, D)
    options = {"num_inference_steps": 3, "guidance_scale": 3.0, "output_type": "pt", "num_images_per_prompt": 2}
    expected = reference(prompt="metal", image_embeds=embeds, generator=torch.Generator().manual_seed(5), **options)
    got = ours(prompt="metal", touch_embeds=embeds, generator=torch.Generator().manual_seed(5), **options)
    torch.testing.assert_close(got.images, expected.images, atol=1e-5, rtol=0)


def test_given_latents_are_scaled_by_the_scheduler(components):
    """diffusers takes `latents` of unit variance as they are, which starts Euler at a fourteenth of its noise."""
    components["scheduler"] = EulerDiscreteScheduler.from_config(components["scheduler"].config)
    reference = diffusers_pipeline(components)
    ours = TouchToImagePipeline.from_pipe(reference, unitouch=components["unitouch"])
    ours.set_progress_bar_config(disable=True)
    embeds, noise = torch.randn(1, D), torch.randn(1, 4, 8, 8)
    scheduler = EulerDiscreteScheduler.from_config(components["scheduler"].config)
    scheduler.set_timesteps(4)
    options = {"prompt": "metal", "num_inference_steps": 4, "guidance_scale": 1.0, "output_type": "pt"}
    expected = reference(
        image_embeds=embeds, latents=noise * scheduler.init_noise_sigma,
        generator=torch.Generator().manual_seed(0), **options,
    )  # fmt: skip
    got = ours(touch_embeds=embeds, latents=noise, generator=torch.Generator().manual_seed(0), **options)
    torch.testing.assert_close(got.images, expected.images, atol=1e-5, rtol=0)


def test_components_are_shared_not_copied(components):
    reference = diffusers_pipeline(components)
    ours = TouchToImagePipeline.from_pipe(reference, unitouch=components["unitouch"])
    assert ours.unet is reference.unet
    assert ours.vae is reference.vae
    assert ours.unet.dtype == reference.unet.dtype


def test_from_pipe_makes_a_processor_for_the_joint_space(components):
    ours = TouchToImagePipeline.from_pipe(diffusers_pipeline(components), unitouch=components["unitouch"])
    assert ours.processor.image_size == components["unitouch"].config.touch_config.image_height


# Our parts in diffusers' pipeline -------------------------------------------------------------------------------------


def quick(pipeline):
    pipeline.set_progress_bar_config(disable=True)
    return pipeline


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
    ours = quick(TouchToImagePipeline(**components))
    theirs = quick(ours.to_diffusers())
    photo = Image.fromarray(np.random.default_rng(0).integers(0, 256, (32, 32, 3), dtype=np.uint8))
    embeds = components["unitouch"].get_image_features(components["processor"].images(photo))
    options = {"num_inference_steps": 3, "guidance_scale": 3.0, "noise_level": 20, "output_type": "pt"}
    expected = theirs(photo, prompt="metal", generator=torch.Generator().manual_seed(5), **options).images
    back = quick(TouchToImagePipeline.from_pipe(theirs, unitouch=components["unitouch"]))
    for pipe in (ours, back):
        found = pipe(touch_embeds=embeds, prompt="metal", generator=torch.Generator().manual_seed(5), **options).images
        torch.testing.assert_close(found, expected, atol=1e-5, rtol=0)


def test_what_diffusers_cannot_build_on_is_refused(components):
    blocks = {"encoder_block_types": "ResBlock", "decoder_block_types": "ResBlock",
              "encoder_block_out_channels": (8, 8), "decoder_block_out_channels": (8, 8),
              "encoder_layers_per_block": (1, 1), "decoder_layers_per_block": (1, 1),
              "encoder_qkv_multiscales": ((), ()), "decoder_qkv_multiscales": ((), ())}  # fmt: skip
    other = TouchToImagePipeline(**{**components, "vae": AutoencoderDC(latent_channels=4, **blocks)})
    with pytest.raises(
        InvalidInputError, match="`vae` is AutoencoderDC, which diffusers' unCLIP pipeline does not take"
    ):
        other.to_diffusers()
    alone = TouchToImagePipeline(**{**components, "unitouch": None, "processor": None})
    with pytest.raises(InvalidInputError, match="`to_diffusers` needs `unitouch`, and this pipeline has none"):
        alone.to_diffusers()
