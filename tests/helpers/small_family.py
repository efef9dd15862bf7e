"""A family of a few kilobytes, in folders."""

import shutil
from pathlib import Path

import torch
from diffusers import AutoencoderTiny, UNet2DConditionModel
from diffusers.pipelines.stable_diffusion.stable_unclip_image_normalizer import StableUnCLIPImageNormalizer

from tests.helpers.components import make_language_parts
from unitouch_gen import weights
from unitouch_gen.conditioning import EmbeddingBank, SensorBackgrounds
from unitouch_gen.models import UniTouchConfig, UniTouchModel


def write_small_family(folder: Path) -> None:
    """What `tiny` reads, of random weights, in the layers of the built-in family."""
    joint = folder / weights.JOINT.name
    x_to_touch = folder / weights.X_TO_TOUCH.name
    unclip = folder / weights.TOUCH_TO_IMAGE.name
    shutil.copytree(weights.JOINT, joint, ignore=shutil.ignore_patterns("*.safetensors"))
    width = 16
    config = UniTouchConfig.from_pretrained(weights.JOINT).to_dict()
    for name in ("vision_config", "text_config", "touch_config", "audio_config"):
        config[name] |= {"hidden_size": width, "num_hidden_layers": 1, "projection_dim": width}
    for name in ("vision_config", "text_config"):
        config[name] |= {"intermediate_size": width}
    config = UniTouchConfig(**{**config, "projection_dim": width, "ood_thresholds": {}})
    UniTouchModel(config).half().save_pretrained(joint)

    for part, own in (
        (weights.X_TO_TOUCH, {}),
        (weights.TOUCH_TO_IMAGE, {"projection_class_embeddings_input_dim": 2 * width}),
    ):
        unet = UNet2DConditionModel.load_config(part / "unet")
        unet |= {"block_out_channels": [width] * 3, "attention_head_dim": 1, "cross_attention_dim": width, **own}
        UNet2DConditionModel.from_config(unet).half().save_pretrained(folder / part.name / "unet")
        shutil.copytree(part / "scheduler", folder / part.name / "scheduler")
        shutil.copy(part / "defaults.json", folder / part.name)
    shutil.copytree(weights.TOUCH_TO_IMAGE / "image_noising_scheduler", unclip / "image_noising_scheduler")
    StableUnCLIPImageNormalizer(embedding_dim=width).half().save_pretrained(unclip / "image_normalizer")
    (folder / "stylization").mkdir()
    shutil.copy(weights.FAMILY / "stylization" / "defaults.json", folder / "stylization")
    language = folder / weights.TOUCH_TO_TEXT.name
    parts = make_language_parts()
    parts["language_bridge"].half().save_pretrained(language / "language_bridge")
    parts["language_model"].half().save_pretrained(language / "language_model")
    parts["tokenizer"].save_pretrained(language / "language_model")
    shutil.copy(weights.TOUCH_TO_TEXT / "defaults.json", language)
    EmbeddingBank.of(torch.randn(8, width)).half().save_pretrained(folder / weights.EMBEDDING_BANK.name)
    unet = UNet2DConditionModel.load_config(weights.X_TO_TOUCH / "unet")
    gels = torch.randn(unet["num_class_embeds"] - 1, unet["out_channels"], *[unet["sample_size"]] * 2)
    SensorBackgrounds.of(gels).half().save_pretrained(x_to_touch / "backgrounds")
    for part in (weights.TOUCH_VAE, weights.IMAGE_VAE):
        vae = AutoencoderTiny.load_config(part)
        vae |= dict.fromkeys(("encoder_block_out_channels", "decoder_block_out_channels"), [width] * 4)
        AutoencoderTiny.from_config(vae).half().save_pretrained(folder / part.name)
