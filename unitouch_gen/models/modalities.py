"""The modalities, and which network encodes which."""

from collections.abc import Iterable

from torch import nn
from transformers import CLIPTextModelWithProjection, CLIPVisionModelWithProjection, PreTrainedConfig

from unitouch_gen.models.vit import UniTouchViT

MODALITIES: tuple[str, ...] = ("image", "text", "audio", "touch")

MODULES: dict[str, tuple[str, ...]] = {
    "image": ("vision_model",),
    "text": ("text_model",),
    "audio": ("audio_model",),
    "touch": ("touch_model", "sensor_bank"),
}
"""The sub-modules, and so the key prefixes on disk, of each modality."""


def modalities_of(keys: Iterable[str]) -> tuple[str, ...]:
    """Modalities whose encoders tensors of these names belong to."""
    modules = {key.partition(".")[0] for key in keys}
    return tuple(modality for modality in MODALITIES if MODULES[modality][0] in modules)


def make_encoder(config: PreTrainedConfig, modality: str) -> nn.Module:
    """The encoder of a modality, with projection: transformers' of image and text, ours of audio and touch.

    Args:
        config: A `UniTouchConfig`.
        modality: "image", "text", "audio" or "touch".
    """
    if modality == "image":
        return CLIPVisionModelWithProjection(config.vision_config)
    if modality == "text":
        return CLIPTextModelWithProjection(config.text_config)
    return UniTouchViT(config.audio_config if modality == "audio" else config.touch_config)
