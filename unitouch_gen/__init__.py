"""unitouch_gen: generative pipelines between touch and image, after UniTouch (Yang et al., CVPR 2024).

>>> import unitouch_gen
>>> pipe = unitouch_gen.tiny("touch-to-image")
>>> pipe(unitouch_gen.example("brick")).images[0].save("picture.png")  # doctest: +SKIP

Names are imported when they are first used, so that the command line answers quickly.
"""

import logging
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from unitouch_gen.errors import InvalidInputError, InvalidTypeError, NonFiniteError
    from unitouch_gen.examples import example
    from unitouch_gen.models import (
        LanguageBridge,
        SensorBank,
        StemmedCLIPVisionModel,
        UniTouchConfig,
        UniTouchModel,
        UniTouchProcessor,
    )
    from unitouch_gen.pipelines import (
        TactileStylizationPipeline,
        TouchToImagePipeline,
        TouchToTextPipeline,
        TouchToTextPipelineOutput,
        UniTouchPipelineOutput,
        XToTouchPipeline,
    )
    from unitouch_gen.pipelines.tiny import tiny

__version__ = "0.1.0"

__all__ = [
    "InvalidInputError",
    "InvalidTypeError",
    "LanguageBridge",
    "NonFiniteError",
    "SensorBank",
    "StemmedCLIPVisionModel",
    "TactileStylizationPipeline",
    "TouchToImagePipeline",
    "TouchToTextPipeline",
    "TouchToTextPipelineOutput",
    "UniTouchConfig",
    "UniTouchModel",
    "UniTouchPipelineOutput",
    "UniTouchProcessor",
    "XToTouchPipeline",
    "example",
    "tiny",
]

# Pictures are prepared with Pillow, so transformers' note on missing torchvision is left out.
logging.getLogger("transformers.utils.import_utils").addFilter(
    lambda record: "`CLIPImageProcessor` requires torchvision" not in record.getMessage()
)

_MODULES = ("errors", "examples", "models", "pipelines.tiny", "pipelines")  # those with the fewest imports first


def __getattr__(name: str) -> Any:
    if name in __all__:
        for module_name in _MODULES:
            module = import_module(f"{__name__}.{module_name}")
            if hasattr(module, name):
                return getattr(module, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
