"""Tiny randomly initialised components of the pipelines."""

from typing import Any

import torch
from diffusers import AutoencoderKL, DDIMScheduler, DDPMScheduler, UNet2DConditionModel, VQModel
from diffusers.pipelines.stable_diffusion.stable_unclip_image_normalizer import StableUnCLIPImageNormalizer
from transformers import AutoTokenizer, CLIPTextConfig, CLIPTextModel, CLIPTokenizer, LlamaConfig, LlamaForCausalLM

from unitouch_gen import weights
from unitouch_gen.conditioning import EmbeddingBank
from unitouch_gen.models import UniTouchConfig, UniTouchModel, UniTouchProcessor
from unitouch_gen.models.language import LanguageBridge
from unitouch_gen.models.processing import read_tokenizer
from unitouch_gen.pipelines import TactileStylizationPipeline, TouchToImagePipeline, XToTouchPipeline

D = 16

AUDIO = {"clip_seconds": 0.2, "clips": 1, "mel_bins": 16, "frames": 24}
CLIP = {
    "hidden_size": 16,
    "intermediate_size": 32,
    "num_hidden_layers": 1,
    "num_attention_heads": 2,
    "projection_dim": D,
}
VIT = {
    "hidden_size": 16,
    "num_hidden_layers": 1,
    "num_attention_heads": 2,
    "patch_size": 8,
    "patch_stride": 8,
    "projection_dim": D,
}
SPACE = {
    "projection_dim": D,
    "sensors": ["gelsight", "digit"],
    "sensor_tokens": 2,
    "prototype_size": 32,
    "vision_config": {**CLIP, "image_size": 32, "patch_size": 8},
    "text_config": {**CLIP, "vocab_size": 600, "max_position_embeddings": 32},
    "touch_config": {**VIT, "image_height": 32, "image_width": 32},
    "audio_config": {**VIT, "image_height": 16, "image_width": 24, "num_channels": 1},
}


UNET = {
    "sample_size": 8,
    "block_out_channels": (8,),
    "layers_per_block": 1,
    "cross_attention_dim": D,
    "down_block_types": ("CrossAttnDownBlock2D",),
    "up_block_types": ("CrossAttnUpBlock2D",),
    "attention_head_dim": 2,
    "norm_num_groups": 4,
}
VAE = {
    "block_out_channels": (8, 8),
    "norm_num_groups": 4,
    "down_block_types": ("DownEncoderBlock2D",) * 2,
    "up_block_types": ("UpDecoderBlock2D",) * 2,
}
LLAMA = {
    "hidden_size": 32,
    "intermediate_size": 48,
    "num_hidden_layers": 2,
    "num_attention_heads": 4,
    "max_position_embeddings": 64,
    "tie_word_embeddings": True,
}


def clip_tokenizer() -> CLIPTokenizer:
    """The built-in one, which cuts and pads texts to twelve tokens."""
    tokenizer = read_tokenizer("tokenizer", weights.JOINT)
    tokenizer.model_max_length = 12
    return tokenizer


def joint_config(tokenizer: CLIPTokenizer, **changes: Any) -> UniTouchConfig:
    """Of a joint space that reads the tokenizer's words."""
    config = UniTouchConfig(**{**SPACE, **changes})
    ids = {f"{name}_token_id": getattr(tokenizer, f"{name}_token_id") for name in ("bos", "eos", "pad")}
    config.text_config.update({"vocab_size": len(tokenizer), "max_position_embeddings": 12, **ids})
    return config


def make_components() -> dict:
    torch.manual_seed(0)
    tokenizer = clip_tokenizer()
    model = UniTouchModel(joint_config(tokenizer, embedding_norm=3.0)).eval()
    model.sensor_bank.set_prototype("gelsight", torch.full((3, 32, 32), 0.2))
    model.sensor_bank.set_prototype("digit", torch.full((3, 32, 32), 0.8))
    normalizer = StableUnCLIPImageNormalizer(embedding_dim=D)
    normalizer.mean.data.normal_()
    normalizer.std.data.uniform_(0.5, 1.5)
    unet = UNet2DConditionModel(**UNET, class_embed_type="projection", projection_class_embeddings_input_dim=2 * D)
    vae = AutoencoderKL(**VAE, latent_channels=4, sample_size=16)
    text_config = CLIPTextConfig(
        vocab_size=len(tokenizer),
        hidden_size=16,
        intermediate_size=32,
        num_hidden_layers=1,
        num_attention_heads=2,
        max_position_embeddings=12,
        bos_token_id=tokenizer.bos_token_id,
        eos_token_id=tokenizer.eos_token_id,
        pad_token_id=tokenizer.pad_token_id,
    )
    return {
        "unitouch": model,
        "processor": UniTouchProcessor(image_size=32, audio=AUDIO, tokenizer=tokenizer),
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


def make_x_to_touch() -> dict:
    """What an `XToTouchPipeline` has beside the joint space and its processor."""
    torch.manual_seed(1)
    unet = UNet2DConditionModel(**UNET, in_channels=3, out_channels=3, num_class_embeds=2)
    vae = VQModel(**VAE, latent_channels=3, num_vq_embeddings=32)
    return {"unet": unet.eval(), "vae": vae.eval(), "embedding_bank": EmbeddingBank.of(torch.randn(20, D)).eval()}


def make_language_parts(**sizes: object) -> dict:
    """Those of a `TouchToTextPipeline`: a small LLaMA and a bridge whose gates are open, so that answers differ."""
    torch.manual_seed(0)
    tokenizer = AutoTokenizer.from_pretrained(weights.TOUCH_TO_TEXT / "language_model")
    special = {"vocab_size": len(tokenizer), "pad_token_id": 0, "bos_token_id": 1, "eos_token_id": 2}
    model = LlamaForCausalLM(LlamaConfig(**{**LLAMA, **special, "initializer_range": 0.3, **sizes})).eval()
    bridge = LanguageBridge.for_model(model, D, num_blocks=2, intermediate_size=24).eval()
    torch.nn.init.normal_(bridge.gates, std=2.0)
    return {"language_bridge": bridge, "language_model": model, "tokenizer": tokenizer}


def make_pipelines() -> dict[str, Any]:
    """Pipelines by command; X-to-touch has two sensors."""
    few: Any = {"default_num_inference_steps": 2, "default_guidance_scale": 2.0}
    parts = make_components()
    own = {name: parts[name] for name in ("unitouch", "processor", "scheduler")} | make_x_to_touch()
    return {
        "stylize": TactileStylizationPipeline(**parts, **few),
        "touch-to-image": TouchToImagePipeline(**parts, **few),
        "x-to-touch": XToTouchPipeline(**own, **few, sensors=["gelsight", "digit"]),
    }
