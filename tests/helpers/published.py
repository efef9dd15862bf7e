"""The published files at a small size, with random weights, and folders of what is made of them."""

from pathlib import Path

import torch
from diffusers import StableUnCLIPImg2ImgPipeline
from transformers import CLIPImageProcessor, CLIPVisionModelWithProjection

from tests.helpers.components import D, make_components
from tests.helpers.imagebind import ImageBind
from unitouch_gen.convert import convert_published
from unitouch_gen.models import UniTouchConfig, UniTouchModel


def sizes(width: int = D) -> UniTouchConfig:
    """Sizes of encoders in ImageBind's layout."""
    shared = {"hidden_size": 32, "num_hidden_layers": 2, "num_attention_heads": 4, "projection_dim": width}
    clip = {**shared, "intermediate_size": 128, "hidden_act": "gelu", "layer_norm_eps": 1e-6}
    text = {
        "vocab_size": 600,
        "max_position_embeddings": 12,
        "bos_token_id": 598,
        "eos_token_id": 599,
        "pad_token_id": 0,
    }
    return UniTouchConfig(
        projection_dim=width,
        prototype_size=32,
        vision_config={**clip, "image_size": 32, "patch_size": 8},
        text_config={**clip, **text, "hidden_size": 48, "intermediate_size": 192},
        touch_config={**shared, "image_height": 32, "image_width": 32, "patch_size": 8, "patch_stride": 8},
        audio_config={
            **shared,
            "image_height": 32,
            "image_width": 44,
            "num_channels": 1,
            "patch_size": 16,
            "patch_stride": 10,
            "stem_norm": True,
        },
    )


def published(folder: Path, config: UniTouchConfig) -> tuple[dict[str, Path], dict[str, torch.nn.Module]]:
    """ImageBind's and UniTouch's files, and the networks that are in them by modality."""
    torch.manual_seed(0)
    imagebind = ImageBind(config)
    torch.manual_seed(1)
    unitouch = ImageBind(config, ("touch", "vision"))
    files = {"imagebind": folder / "imagebind_huge.pth", "touch": folder / "last_new.ckpt"}
    depth = {"modality_trunks.depth.blocks.0.attn.bias_k": torch.ones(1, 1, 16)}  # of a modality that is left out
    torch.save({**imagebind.state_dict(), **depth}, files["imagebind"])
    state = {f"model.{key}": value for key, value in unitouch.state_dict().items()}
    torch.save({"epoch": 3, "state_dict": state}, files["touch"])
    return files, {"image": imagebind, "text": imagebind, "audio": imagebind, "touch": unitouch}


def converted(folder: Path, width: int = D, imagebind: bool = True) -> Path:
    """A joint space made of the files, or of UniTouch's alone."""
    files, _ = published(folder, sizes(width))
    if not imagebind:
        del files["imagebind"]
    convert_published(folder / "unitouch", **files, config=sizes(width))
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


def inputs_of(config: UniTouchConfig) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(2)
    side = config.vision_config.image_size
    text = config.text_config
    audio = config.audio_config
    ids = torch.randint(1, text.vocab_size - 2, (3, text.max_position_embeddings), generator=generator)
    ids[:, 0] = text.vocab_size - 2
    for row, end in enumerate((4, 7, text.max_position_embeddings - 1)):
        ids[row, end] = text.vocab_size - 1
        ids[row, end + 1 :] = 0
    return {
        "image": torch.randn(3, 3, side, side, generator=generator),
        "text": ids,
        "audio": torch.randn(3, 1, audio.image_height, audio.image_width, generator=generator),
        "touch": torch.randn(3, 3, side, side, generator=generator),
    }


def features_of(model: UniTouchModel, modality: str, values: torch.Tensor) -> torch.Tensor:
    with torch.no_grad():
        if modality == "audio":
            return model.get_audio_features(values[:, None])
        return getattr(model, f"get_{modality}_features")(values)
