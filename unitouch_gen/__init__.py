"""unitouch_gen: generative pipelines between touch and image, after UniTouch (Yang et al., CVPR 2024).

>>> import unitouch_gen
>>> pipe = unitouch_gen.tiny("touch-to-image")
>>> pipe(unitouch_gen.example("brick")).images[0].save("picture.png")  # doctest: +SKIP

Names are imported when they are first used, so that the command line answers quickly.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from unitouch_gen.errors import InvalidInputError, InvalidTypeError, NonFiniteError
    from unitouch_gen.examples import example
    from unitouch_gen.models import (
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
        UniTouchPipelineOutput,
        XToTouchPipeline,
    )
    from unitouch_gen.pipelines.tiny import tiny

__version__ = "0.1.0"

_HOMES = {
    "SensorBank": "models",
    "StemmedCLIPVisionModel": "models",
    "UniTouchConfig": "models",
    "UniTouchModel": "models",
    "UniTouchProcessor": "models",
    "InvalidInputError": "errors",
    "InvalidTypeError": "errors",
    "NonFiniteError": "errors",
    "TactileStylizationPipeline": "pipelines",
    "TouchToImagePipeline": "pipelines",
    "TouchToTextPipeline": "pipelines",
    "UniTouchPipelineOutput": "pipelines",
    "XToTouchPipeline": "pipelines",
    "example": "examples",
    "tiny": "pipelines.tiny",
}

__all__ = [
    "InvalidInputError",
    "InvalidTypeError",
    "NonFiniteError",
    "SensorBank",
    "StemmedCLIPVisionModel",
    "TactileStylizationPipeline",
    "TouchToImagePipeline",
    "TouchToTextPipeline",
    "UniTouchConfig",
    "UniTouchModel",
    "UniTouchPipelineOutput",
    "UniTouchProcessor",
    "XToTouchPipeline",
    "example",
    "tiny",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
