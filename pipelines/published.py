"""Reads published weights: a converted joint space and an unCLIP pipeline."""

import copy
import os
from typing import Any

import torch
from diffusers import StableUnCLIPImg2ImgPipeline
from transformers import CLIPVisionModelWithProjection

from unitouch_gen.errors import check_dtype
from unitouch_gen.files import NEVER_READ, check_filled, local_folder, read_network, reading
from unitouch_gen.models.joint import UniTouchModel
from unitouch_gen.models.processing import UniTouchProcessor
from unitouch_gen.pipelines.base import check_components


def read_joint(
    unitouch: str | os.PathLike | UniTouchModel, dtype: torch.dtype, **hub: Any
) -> tuple[UniTouchModel, UniTouchProcessor]:
    """A converted joint space and its processor; no encoder is read yet."""
    if isinstance(unitouch, UniTouchModel):
        unitouch = copy.copy(unitouch)  # the caller's keeps its norm, encoders, dtype and device
        unitouch.config, unitouch._modules = copy.deepcopy((unitouch.config, unitouch._modules))
        return unitouch, UniTouchProcessor.for_config(unitouch.config)
    folder = local_folder("unitouch", unitouch, **hub)
    dtype = check_dtype("dtype", dtype)
    with reading("unitouch", folder):
        return UniTouchModel.from_pretrained(folder, dtype=dtype), UniTouchProcessor.from_pretrained(folder)


def read_unclip(
    unclip: str | os.PathLike, model: UniTouchModel, dtype: torch.dtype, variant: str | None, **hub: Any
) -> StableUnCLIPImg2ImgPipeline:
    """An unCLIP pipeline; a joint space without image encoder gets the pipeline's."""
    own = "image" in model.known_modalities
    unread = [*NEVER_READ, *([] if variant else ["*.fp16.*"]), *(["image_encoder/*"] if own else [])]
    folder = local_folder("unclip", unclip, ignore_patterns=unread, **hub)
    files: dict[str, Any] = {"dtype": check_dtype("dtype", dtype), "variant": variant}
    with reading("unclip", folder):
        unused = {"feature_extractor": None, "image_encoder": None}
        check_components(StableUnCLIPImg2ImgPipeline, folder, unused)
        pipe = StableUnCLIPImg2ImgPipeline.from_pretrained(folder, **files, **unused, use_safetensors=True)
        for part in ("unet", "vae", "text_encoder", "image_normalizer"):
            check_filled(folder / part, getattr(pipe, part))
        if not own and (folder / "image_encoder").is_dir():
            encoder = read_network(CLIPVisionModelWithProjection, folder / "image_encoder", **files)
            model.vision_model = encoder
            model.config.vision_config = encoder.config
    return pipe
