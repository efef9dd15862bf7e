"""A family of a few kilobytes, in folders."""

import shutil
from pathlib import Path

import torch
from diffusers import AutoencoderTiny, UNet2DConditionModel

from unitouch_gen import weights
from unitouch_gen.conditioning import EmbeddingBank, SensorBackgrounds
from unitouch_gen.models import UniTouchConfig, UniTouchModel


def write_small_family(folder: Path) -> None:
    """What `tiny("x-to-touch")` reads, of random weights, in the layers of the built-in family."""
    joint, x_to_touch = folder / weights.JOINT.name, folder / weights.X_TO_TOUCH.name
    shutil.copytree(weights.JOINT, joint, ignore=shutil.ignore_patterns("*.safetensors"))
    width = 16
    config = UniTouchConfig.from_pretrained(weights.JOINT).to_dict()
    for name in ("vision_config", "text_config", "touch_config", "audio_config"):
        config[name] |= {"hidden_size": width, "num_hidden_layers": 1, "projection_dim": width}
    for name in ("vision_config", "text_config"):
        config[name] |= {"intermediate_size": width}
    UniTouchModel(UniTouchConfig(**{**config, "projection_dim": width, "ood_thresholds": {}})).half().save_pretrained(
        joint
    )

    unet = UNet2DConditionModel.load_config(weights.X_TO_TOUCH / "unet")
    unet |= {"block_out_channels": [width] * 3, "attention_head_dim": 1, "cross_attention_dim": width}
    UNet2DConditionModel.from_config(unet).half().save_pretrained(x_to_touch / "unet")
    shutil.copytree(weights.X_TO_TOUCH / "scheduler", x_to_touch / "scheduler")
    shutil.copy(weights.X_TO_TOUCH / "defaults.json", x_to_touch)
    EmbeddingBank.of(torch.randn(8, width)).half().save_pretrained(x_to_touch / "embedding_bank")
    gels = torch.randn(unet["num_class_embeds"] - 1, unet["out_channels"], *[unet["sample_size"]] * 2)
    SensorBackgrounds.of(gels).half().save_pretrained(x_to_touch / "backgrounds")
    vae = AutoencoderTiny.load_config(weights.TOUCH_VAE)
    vae |= dict.fromkeys(("encoder_block_out_channels", "decoder_block_out_channels"), [width] * 4)
    AutoencoderTiny.from_config(vae).half().save_pretrained(folder / weights.TOUCH_VAE.name)
