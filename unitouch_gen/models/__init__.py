"""The joint space of touch, image, text and audio."""

from unitouch_gen.models.config import UniTouchConfig, UniTouchViTConfig
from unitouch_gen.models.joint import MODALITIES, UniTouchModel
from unitouch_gen.models.processing import UniTouchProcessor
from unitouch_gen.models.sensors import SensorBank, SensorMatch
from unitouch_gen.models.vit import UniTouchViT

__all__ = [
    "MODALITIES",
    "SensorBank",
    "SensorMatch",
    "UniTouchConfig",
    "UniTouchModel",
    "UniTouchProcessor",
    "UniTouchViT",
    "UniTouchViTConfig",
]
