"""Published parts of a few kilobytes, in folders."""

from pathlib import Path

import torch
from diffusers import StableUnCLIPImg2ImgPipeline
from transformers import CLIPImageProcessor, CLIPVisionModelWithProjection

from tests.helpers.components import D, make_components
from tests.helpers.imagebind import ImageBind
from unitouch_gen.convert import convert_published
from unitouch_gen.models import UniTouchConfig

FEW = {"num_inference_steps": 2, "guidance_scale": 2.0, "output_type": "pt"}


def sizes(width: int = D) -> UniTouchConfig:
    """Sizes of encoders in ImageBind's layout."""
    clip = {"hidden_size": 16, "intermediate_size": 64, "num_hidden_layers": 1, "num_attention_heads": 2,
            "hidden_act": "gelu", "layer_norm_eps": 1e-6, "projection_dim": width}  # fmt: skip
    vit = {"hidden_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2, "projection_dim": width}
    return UniTouchConfig(
        projection_dim=width, prototype_size=32,
        vision_config={**clip, "image_size": 32, "patch_size": 8},
        text_config={**clip, "vocab_size": 600, "max_position_embeddings": 12, "eos_token_id": 599},
        touch_config={**vit, "image_height": 32, "image_width": 32, "patch_size": 8, "patch_stride": 8},
        audio_config={**vit, "image_height": 32, "image_width": 16, "num_channels": 1, "patch_size": 8,
                      "patch_stride": 8, "stem_norm": True},
    )  # fmt: skip


def converted(folder: Path, width: int = D, imagebind: bool = True) -> Path:
    config = sizes(width)
    torch.manual_seed(0)
    files = {"touch": folder / "last.ckpt"}
    torch.save({"state_dict": ImageBind(config, ("touch",)).state_dict()}, files["touch"])
    if imagebind:
        files["imagebind"] = folder / "imagebind.pth"
        torch.save(ImageBind(config).state_dict(), files["imagebind"])
    convert_published(folder / "unitouch", **files, config=config)
    return folder / "unitouch"


def write_unclip(folder: Path, image_encoder: CLIPVisionModelWithProjection) -> Path:
    parts = make_components()
    kept = ("image_normalizer", "image_noising_scheduler", "tokenizer", "text_encoder", "unet", "scheduler", "vae")
    StableUnCLIPImg2ImgPipeline(
        **{name: parts[name] for name in kept},
        image_encoder=image_encoder,
        feature_extractor=CLIPImageProcessor(size={"shortest_edge": 32}, crop_size={"height": 32, "width": 32}),
    ).save_pretrained(folder)
    return folder


def made(pipe, *args, **kwargs) -> torch.Tensor:
    pipe.set_progress_bar_config(disable=True)
    return pipe(*args, generator=torch.Generator().manual_seed(0), **{**FEW, **kwargs}).images
