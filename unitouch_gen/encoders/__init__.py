"""The joint space of touch, image, text and audio."""

from unitouch_gen.encoders.config import UniTouchConfig, UniTouchViTConfig
from unitouch_gen.encoders.model import UniTouchModel
from unitouch_gen.encoders.processing import UniTouchProcessor
from unitouch_gen.encoders.senses import SENSES
from unitouch_gen.encoders.sensors import SensorBank, SensorMatch
from unitouch_gen.encoders.vit import UniTouchViT

__all__ = [
    "SENSES",
    "SensorBank",
    "SensorMatch",
    "UniTouchConfig",
    "UniTouchModel",
    "UniTouchProcessor",
    "UniTouchViT",
    "UniTouchViTConfig",
]
