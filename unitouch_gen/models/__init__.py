"""The joint space of touch, image, text and audio.

Importing this package registers it with `AutoConfig`, `AutoModel` and `AutoProcessor` of transformers.
"""

from transformers import AutoConfig, AutoModel, AutoProcessor

from unitouch_gen.models.config import UniTouchConfig, UniTouchViTConfig
from unitouch_gen.models.joint import MODALITIES, UniTouchModel
from unitouch_gen.models.language import LanguageBridge
from unitouch_gen.models.processing import UniTouchProcessor
from unitouch_gen.models.sensor_bank import SensorBank, SensorMatch
from unitouch_gen.models.vit import StemmedCLIPVisionModel, UniTouchViT

AutoConfig.register(UniTouchConfig.model_type, UniTouchConfig, exist_ok=True)
AutoConfig.register(UniTouchViTConfig.model_type, UniTouchViTConfig, exist_ok=True)
AutoModel.register(UniTouchConfig, UniTouchModel, exist_ok=True)
AutoProcessor.register(UniTouchConfig, UniTouchProcessor, exist_ok=True)

__all__ = [
    "MODALITIES",
    "LanguageBridge",
    "SensorBank",
    "SensorMatch",
    "StemmedCLIPVisionModel",
    "UniTouchConfig",
    "UniTouchModel",
    "UniTouchProcessor",
    "UniTouchViT",
    "UniTouchViTConfig",
]
