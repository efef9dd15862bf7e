"""Networks of the published size, with random weights: the paper's touch encoder, and Stable Diffusion 2.1 unCLIP.

Each is built where and in the dtype that torch's defaults say: `with torch.device("meta")` it takes no memory.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from diffusers import AutoencoderKL, DDIMScheduler, DDPMScheduler, UNet2DConditionModel
from diffusers.pipelines.stable_diffusion.stable_unclip_image_normalizer import StableUnCLIPImageNormalizer
from torch import nn
from transformers import CLIPTextConfig, CLIPTextModel

from unitouch_gen.models import UniTouchConfig

EMBEDDING_DIM = 1024
"""Width of the joint space, and of the OpenCLIP ViT-H image embeddings that SD 2.1 unCLIP was trained on."""

Settings = Mapping[str, Any]

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


def unclip_scheduler() -> DDIMScheduler:
    """DDIM, by which the paper samples, with the noise that Stable Diffusion 2.1 unCLIP was trained on."""
    return DDIMScheduler(**UNCLIP_NOISE, clip_sample=False, set_alpha_to_one=False)


def embedding_noise() -> DDPMScheduler:
    """The schedule of the noise on Stable Diffusion 2.1 unCLIP's embeddings: 1,000 levels, `squaredcos_cap_v2`."""
    return DDPMScheduler(num_train_timesteps=1000, beta_schedule="squaredcos_cap_v2")


def touch_config() -> UniTouchConfig:
    """The paper's joint space, with the sensors of the data sets that it was trained on (Section 4.1)."""
    return UniTouchConfig(sensors=["gelsight", "digit", "taxim"])


@contextmanager
def made_in(dtype: torch.dtype, seed: int) -> Iterator[None]:
    """Networks that are built meanwhile are built in a dtype, and with the weights of a seed."""
    before = torch.get_default_dtype()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        torch.set_default_dtype(dtype)
        try:
            yield
        finally:
            torch.set_default_dtype(before)
