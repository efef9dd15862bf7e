"""The senses, and which network encodes which."""

from collections.abc import Iterable

from torch import nn
from transformers import CLIPTextModelWithProjection, CLIPVisionModelWithProjection, PreTrainedConfig

from unitouch_gen.encoders.vit import UniTouchViT

SENSES: tuple[str, ...] = ("image", "text", "audio", "touch")

MODULES: dict[str, tuple[str, ...]] = {
    "image": ("vision_model",),
    "text": ("text_model",),
    "audio": ("audio_model",),
    "touch": ("touch_model", "sensor_bank"),
}
"""The sub-modules, and so the key prefixes on disk, of each sense."""


def senses_of(keys: Iterable[str]) -> tuple[str, ...]:
    """Senses whose encoders tensors of these names belong to."""
    modules = {key.partition(".")[0] for key in keys}
    return tuple(sense for sense in SENSES if MODULES[sense][0] in modules)


def make_encoder(config: PreTrainedConfig, sense: str) -> nn.Module:
    """The encoder of a sense, with projection: transformers' of image and text, ours of audio and touch.

    Args:
        config: A `UniTouchConfig`.
        sense: "image", "text", "audio" or "touch".
    """
    if sense == "image":
        return CLIPVisionModelWithProjection(config.vision_config)
    if sense == "text":
        return CLIPTextModelWithProjection(config.text_config)
    return UniTouchViT(config.audio_config if sense == "audio" else config.touch_config)
