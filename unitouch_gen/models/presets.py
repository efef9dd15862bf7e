"""Full-size networks and noise schedules of published diffusion models, with random weights: SD 2.1 unCLIP, and latent
diffusion of touch.

Each is built where and in the dtype that torch's defaults say: `with torch.device("meta")` it takes no memory.
"""

from collections.abc import Mapping
from typing import Any

from diffusers import (
    AutoencoderKL,
    DDIMScheduler,
    DDPMScheduler,
    PNDMScheduler,
    SchedulerMixin,
    UNet2DConditionModel,
    VQModel,
)
from diffusers.pipelines.stable_diffusion.stable_unclip_image_normalizer import StableUnCLIPImageNormalizer
from torch import nn
from transformers import CLIPTextConfig, CLIPTextModel

from unitouch_gen.errors import check_choice

EMBEDDING_DIM = 1024
"""Width of the joint space, and of the OpenCLIP ViT-H image embeddings that SD 2.1 unCLIP was trained on."""

Settings = Mapping[str, Any]

# Stable Diffusion 2.1 unCLIP ------------------------------------------------------------------------------------------

UNCLIP_UNET: Settings = {
    "sample_size": 96,  # 768 pixels
    "block_out_channels": (320, 640, 1280, 1280),
    "layers_per_block": 2,
    "attention_head_dim": (5, 10, 20, 20),  # numbers of heads: diffusers' name for them, kept for its checkpoints
    "cross_attention_dim": 1024,
    "use_linear_projection": True,
    "class_embed_type": "projection",
    "projection_class_embeddings_input_dim": 2 * EMBEDDING_DIM,  # the embedding, and that of its noise level
}

UNCLIP_VAE: Settings = {
    "sample_size": 768,
    "block_out_channels": (128, 256, 512, 512),
    "layers_per_block": 2,
    "latent_channels": 4,
    "down_block_types": ("DownEncoderBlock2D",) * 4,
    "up_block_types": ("UpDecoderBlock2D",) * 4,
    "scaling_factor": 0.18215,
}

UNCLIP_TEXT: Settings = {  # OpenCLIP ViT-H's, without its last layer
    "vocab_size": 49_408,
    "hidden_size": 1024,
    "intermediate_size": 4096,
    "num_hidden_layers": 23,
    "num_attention_heads": 16,
    "max_position_embeddings": 77,
    "hidden_act": "gelu",
}

UNCLIP_NOISE: Settings = {
    "num_train_timesteps": 1000,
    "beta_start": 0.00085,
    "beta_end": 0.012,
    "beta_schedule": "scaled_linear",
    "prediction_type": "v_prediction",
    "steps_offset": 1,
}

UNCLIP_SCHEDULERS: dict[str, tuple[type[SchedulerMixin], Settings]] = {
    "ddim": (DDIMScheduler, {"clip_sample": False, "set_alpha_to_one": False}),
    "pndm": (PNDMScheduler, {"skip_prk_steps": True, "set_alpha_to_one": False}),
    "ddpm": (DDPMScheduler, {"clip_sample": False}),
}
"""Schedulers with what each has of its own. The paper samples by the first; the checkpoint comes with the second."""


def unclip_networks() -> dict[str, nn.Module]:
    """The networks of Stable Diffusion 2.1 unCLIP by the names of their components, the image encoder left out.

    Latents are (B, 4, 96, 96) for pictures (B, 3, 768, 768), hidden states of prompts (B, 77, 1024), class labels
    (B, 2048).
    """
    return {
        "image_normalizer": StableUnCLIPImageNormalizer(embedding_dim=EMBEDDING_DIM).requires_grad_(False),
        "text_encoder": CLIPTextModel(CLIPTextConfig(**UNCLIP_TEXT)).eval(),
        "unet": UNet2DConditionModel(**UNCLIP_UNET).eval(),
        "vae": AutoencoderKL(**UNCLIP_VAE).eval(),
    }


def unclip_scheduler(kind: str = "ddim") -> SchedulerMixin:
    """A scheduler of latents with the noise that Stable Diffusion 2.1 unCLIP was trained on.

    Args:
        kind: "ddim", "pndm" or "ddpm".

    Raises:
        InvalidInputError: If it is none of these.
    """
    scheduler, settings = UNCLIP_SCHEDULERS[check_choice("kind", kind, UNCLIP_SCHEDULERS)]
    return scheduler(**UNCLIP_NOISE, **settings)


def embedding_noise() -> DDPMScheduler:
    """The schedule of the noise on Stable Diffusion 2.1 unCLIP's embeddings: 1,000 levels, `squaredcos_cap_v2`."""
    return DDPMScheduler(num_train_timesteps=1000, beta_schedule="squaredcos_cap_v2")


# Latent diffusion of touch --------------------------------------------------------------------------------------------

LDM_UNET: Settings = {  # LDM-4 of ImageNet classes (Rombach et al., 2022), on another condition
    "sample_size": 64,  # 256 pixels
    "in_channels": 3,
    "out_channels": 3,
    "block_out_channels": (192, 384, 576, 960),
    "layers_per_block": 2,
    "down_block_types": ("DownBlock2D", *("CrossAttnDownBlock2D",) * 3),
    "up_block_types": (*("CrossAttnUpBlock2D",) * 3, "UpBlock2D"),
    "attention_head_dim": 1,  # one head
    "cross_attention_dim": EMBEDDING_DIM,
}

VQ_F4: Settings = {
    "sample_size": 256,
    "block_out_channels": (128, 256, 512),
    "layers_per_block": 2,
    "latent_channels": 3,
    "num_vq_embeddings": 8192,
    "down_block_types": ("DownEncoderBlock2D",) * 3,
    "up_block_types": ("UpDecoderBlock2D",) * 3,
    "scaling_factor": 1.0,  # latents of a VQ model are diffused as they are
}

LDM_NOISE: Settings = {
    "num_train_timesteps": 1000,
    "beta_start": 0.0015,
    "beta_end": 0.0195,
    "beta_schedule": "scaled_linear",
    "clip_sample": False,
    "set_alpha_to_one": False,
    "steps_offset": 1,
}


def touch_ldm_networks() -> dict[str, nn.Module]:
    """UNet and autoencoder of a latent diffusion of touch, by the names of their components.

    Latents are (B, 3, 64, 64) for touches (B, 3, 256, 256); the UNet attends to one embedding, (B, 1, 1024). Settings
    are those of Rombach et al. (2022) for ImageNet, whose condition has a width of 512.
    """
    return {"unet": UNet2DConditionModel(**LDM_UNET).eval(), "vae": VQModel(**VQ_F4).eval()}


def touch_ldm_scheduler() -> DDIMScheduler:
    """DDIM with the noise that Rombach et al. (2022) trained on."""
    return DDIMScheduler(**LDM_NOISE)
