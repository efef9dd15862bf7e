"""Generative pipelines between touch and image."""

from unitouch_gen.pipelines.pipeline_output import UniTouchPipelineOutput
from unitouch_gen.pipelines.touch_to_image import TouchToImagePipeline

__all__ = ["TouchToImagePipeline", "UniTouchPipelineOutput"]
