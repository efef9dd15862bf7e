"""The published files at a small size, with random weights."""

from pathlib import Path

import torch

from tests.helpers.imagebind import ImageBind
from unitouch_gen.models import UniTouchConfig, UniTouchModel

VISION = {"hidden_size": 64, "intermediate_size": 256, "num_hidden_layers": 3, "num_attention_heads": 4,
          "image_size": 28, "patch_size": 14, "projection_dim": 32}  # fmt: skip
TEXT = {"hidden_size": 48, "intermediate_size": 192, "num_hidden_layers": 2, "num_attention_heads": 4,
        "vocab_size": 90, "max_position_embeddings": 12, "projection_dim": 32, "eos_token_id": 89,
        "bos_token_id": 88, "pad_token_id": 0}  # fmt: skip
AUDIO = {"hidden_size": 48, "num_hidden_layers": 2, "num_attention_heads": 4, "image_height": 32, "image_width": 44,
         "num_channels": 1, "patch_size": 16, "patch_stride": 10, "stem_norm": True, "projection_dim": 32}  # fmt: skip
TOUCH = {"hidden_size": 64, "num_hidden_layers": 3, "num_attention_heads": 4, "image_height": 28, "image_width": 28,
         "projection_dim": 32}  # fmt: skip
CLIP = {"hidden_act": "gelu", "layer_norm_eps": 1e-6}


def small() -> UniTouchConfig:
    return UniTouchConfig(
        vision_config={**VISION, **CLIP}, text_config={**TEXT, **CLIP}, audio_config=AUDIO, touch_config=TOUCH,
        projection_dim=32, prototype_size=28,
    )  # fmt: skip


def published(folder: Path, config: UniTouchConfig) -> tuple[dict[str, Path], dict[str, torch.nn.Module]]:
    """ImageBind's and UniTouch's files, and the networks that are in them by modality."""
    torch.manual_seed(0)
    imagebind = ImageBind(config)
    torch.manual_seed(1)
    unitouch = ImageBind(config, ("touch", "vision"))
    files = {"imagebind": folder / "imagebind_huge.pth", "touch": folder / "last_new.ckpt"}
    torch.save(imagebind.state_dict(), files["imagebind"])
    state = {f"model.{key}": value for key, value in unitouch.state_dict().items()}
    torch.save({"epoch": 3, "state_dict": state}, files["touch"])
    return files, {"image": imagebind, "text": imagebind, "audio": imagebind, "touch": unitouch}


def inputs_of(config: UniTouchConfig) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(2)
    side, text, audio = config.vision_config.image_size, config.text_config, config.audio_config
    ids = torch.randint(1, text.vocab_size - 2, (3, text.max_position_embeddings), generator=generator)
    ids[:, 0] = text.vocab_size - 2
    for row, end in enumerate((4, 7, text.max_position_embeddings - 1)):
        ids[row, end], ids[row, end + 1 :] = text.vocab_size - 1, 0
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
