"""Generative pipelines between touch and image."""

from unitouch_gen.aliases import alias_package
from unitouch_gen.pipelines.output import TouchToTextPipelineOutput, UniTouchPipelineOutput
from unitouch_gen.pipelines.tactile_stylization import TactileStylizationPipeline
from unitouch_gen.pipelines.touch_to_image import TouchToImagePipeline
from unitouch_gen.pipelines.touch_to_text import TouchToTextPipeline
from unitouch_gen.pipelines.x_to_touch import XToTouchPipeline

if __name__ == "pipelines":  # imported by its folder's name
    alias_package(__name__)

__all__ = [
    "TactileStylizationPipeline",
    "TouchToImagePipeline",
    "TouchToTextPipeline",
    "TouchToTextPipelineOutput",
    "UniTouchPipelineOutput",
    "XToTouchPipeline",
]
