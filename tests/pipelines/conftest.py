"""Tiny randomly initialised components of a touch-to-image pipeline, made once and copied."""

import copy
from pathlib import Path

import numpy as np
import pytest
import torch
from diffusers import AutoencoderKL, DDIMScheduler, DDPMScheduler, UNet2DConditionModel, VQModel
from diffusers.pipelines.stable_diffusion.stable_unclip_image_normalizer import StableUnCLIPImageNormalizer
from transformers import CLIPTextConfig, CLIPTextModel

from unitouch_gen.diffusion.store import EmbeddingStore
from unitouch_gen.encoders import UniTouchConfig, UniTouchModel, UniTouchProcessor
from unitouch_gen.pipelines import TactileStylizationPipeline, TouchToImagePipeline, XToTouchPipeline
from unitouch_gen.training.tokenizer import train_tokenizer

D = 16


def joint_config() -> UniTouchConfig:
    clip = {"hidden_size": 16, "intermediate_size": 32, "num_hidden_layers": 1, "num_attention_heads": 2}
    vit = {"hidden_size": 16, "num_hidden_layers": 2, "num_attention_heads": 2, "patch_size": 8, "patch_stride": 8}
    return UniTouchConfig(
        projection_dim=D,
        embedding_norm=3.0,
        sensors=["gelsight", "digit"],
        sensor_tokens=2,
        prototype_size=32,
        vision_config={**clip, "image_size": 32, "patch_size": 8, "projection_dim": D},
        text_config={**clip, "vocab_size": 600, "max_position_embeddings": 12, "projection_dim": D,
                     "bos_token_id": 0, "eos_token_id": 1, "pad_token_id": 1},
        touch_config={**vit, "image_height": 32, "image_width": 32, "projection_dim": D},
        audio_config={**vit, "image_height": 32, "image_width": 16, "num_channels": 1, "projection_dim": D},
    )  # fmt: skip


def make_components() -> dict:
    torch.manual_seed(0)
    tokenizer = train_tokenizer(["high quality rough brick", "smooth grey metal"], 600, 12)
    model = UniTouchModel(joint_config()).eval()
    model.sensor_bank.set_prototype("gelsight", torch.full((3, 32, 32), 0.2))
    model.sensor_bank.set_prototype("digit", torch.full((3, 32, 32), 0.8))
    normalizer = StableUnCLIPImageNormalizer(embedding_dim=D)
    normalizer.mean.data.normal_()
    normalizer.std.data.uniform_(0.5, 1.5)
    unet = UNet2DConditionModel(
        sample_size=8,
        block_out_channels=(8, 16),
        layers_per_block=1,
        down_block_types=("DownBlock2D", "CrossAttnDownBlock2D"),
        up_block_types=("CrossAttnUpBlock2D", "UpBlock2D"),
        cross_attention_dim=16,
        attention_head_dim=2,
        norm_num_groups=4,
        class_embed_type="projection",
        projection_class_embeddings_input_dim=2 * D,
    )
    vae = AutoencoderKL(
        block_out_channels=(8, 8),
        norm_num_groups=4,
        latent_channels=4,
        sample_size=16,
        down_block_types=("DownEncoderBlock2D",) * 2,
        up_block_types=("UpDecoderBlock2D",) * 2,
    )
    text_config = CLIPTextConfig(
        vocab_size=len(tokenizer), hidden_size=16, intermediate_size=32, num_hidden_layers=1, num_attention_heads=2,
        max_position_embeddings=12, bos_token_id=tokenizer.bos_token_id, eos_token_id=tokenizer.eos_token_id,
        pad_token_id=tokenizer.pad_token_id,
    )  # fmt: skip
    return {
        "unitouch": model,
        "processor": UniTouchProcessor(
            image_size=32,
            audio={"clip_seconds": 0.2, "clips": 1, "mel_bins": 32, "frames": 16},
            tokenizer=tokenizer,
        ),
        "image_normalizer": normalizer.requires_grad_(False),
        "image_noising_scheduler": DDPMScheduler(beta_schedule="squaredcos_cap_v2"),
        "tokenizer": tokenizer,
        "text_encoder": CLIPTextModel(text_config).eval(),
        "unet": unet.eval(),
        "scheduler": DDIMScheduler(
            beta_start=0.00085, beta_end=0.012, beta_schedule="scaled_linear", clip_sample=False, set_alpha_to_one=False
        ),
        "vae": vae.eval(),
    }


_COMPONENTS = make_components()


@pytest.fixture
def components() -> dict:
    """A fresh copy, so no test sees another's changes."""
    return copy.deepcopy(_COMPONENTS)


@pytest.fixture
def pipe(components: dict) -> TouchToImagePipeline:
    pipeline = TouchToImagePipeline(
        **components, default_num_inference_steps=2, default_guidance_scale=2.0, default_strength=0.75
    )
    pipeline.set_progress_bar_config(disable=True)
    return pipeline


@pytest.fixture
def touch() -> torch.Tensor:
    """Two touch images, one dark and one bright."""
    generator = torch.Generator().manual_seed(0)
    noise = 0.1 * torch.rand(2, 3, 32, 32, generator=generator)
    return noise + torch.tensor([0.15, 0.75]).view(2, 1, 1, 1)


@pytest.fixture(scope="session")
def family(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The pipeline of the fixture `pipe`, saved."""
    folder = tmp_path_factory.mktemp("family")
    TouchToImagePipeline(
        **copy.deepcopy(_COMPONENTS), default_num_inference_steps=2, default_guidance_scale=2.0, default_strength=0.75
    ).save_pretrained(folder)
    return folder


@pytest.fixture
def stylize(components: dict) -> TactileStylizationPipeline:
    """On the components of `pipe`."""
    pipeline = TactileStylizationPipeline(**components, default_num_inference_steps=2, default_guidance_scale=2.0)
    pipeline.set_progress_bar_config(disable=True)
    return pipeline


@pytest.fixture
def photo() -> torch.Tensor:
    """Two photos, (2, 3, 32, 48)."""
    return torch.rand(2, 3, 32, 48, generator=torch.Generator().manual_seed(1))


def make_x_to_touch() -> dict:
    """What an `XToTouchPipeline` has beside the joint space and its processor."""
    torch.manual_seed(1)
    unet = UNet2DConditionModel(
        sample_size=8, in_channels=3, out_channels=3, block_out_channels=(8, 16), layers_per_block=1,
        down_block_types=("DownBlock2D", "CrossAttnDownBlock2D"), up_block_types=("CrossAttnUpBlock2D", "UpBlock2D"),
        cross_attention_dim=D, attention_head_dim=2, norm_num_groups=4, num_class_embeds=2,
    )  # fmt: skip
    vae = VQModel(
        block_out_channels=(8, 8), norm_num_groups=4, latent_channels=3, num_vq_embeddings=32,
        down_block_types=("DownEncoderBlock2D",) * 2, up_block_types=("UpDecoderBlock2D",) * 2,
    )  # fmt: skip
    return {"unet": unet.eval(), "vae": vae.eval(), "store": EmbeddingStore.of(torch.randn(20, D)).eval()}


_X_TO_TOUCH = make_x_to_touch()


@pytest.fixture
def x_components(components: dict) -> dict:
    shared = {name: components[name] for name in ("unitouch", "processor", "scheduler")}
    return {**shared, **copy.deepcopy(_X_TO_TOUCH)}


@pytest.fixture
def x_to_touch(x_components: dict) -> XToTouchPipeline:
    pipeline = XToTouchPipeline(
        **x_components, sensors=["gelsight", "digit"], default_num_inference_steps=2, default_guidance_scale=2.0
    )
    pipeline.set_progress_bar_config(disable=True)
    return pipeline


@pytest.fixture
def sound() -> tuple[np.ndarray, int]:
    """A quarter of a second of a decaying tone, and its rate."""
    time = np.arange(4000) / 16_000
    return (np.exp(-20 * time) * np.sin(2 * np.pi * 440 * time)).astype(np.float32), 16_000
