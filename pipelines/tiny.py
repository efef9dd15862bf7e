"""The built-in tiny family as pipelines, put together from tensors that are stored once."""

import json
from collections.abc import Callable
from pathlib import Path

import torch
from diffusers import AutoencoderDC, DDPMScheduler, DiffusionPipeline, DPMSolverMultistepScheduler, UNet2DConditionModel
from diffusers.pipelines.stable_diffusion.stable_unclip_image_normalizer import StableUnCLIPImageNormalizer

from unitouch_gen import weights
from unitouch_gen.encoders import UniTouchModel, UniTouchProcessor
from unitouch_gen.errors import check_choice
from unitouch_gen.pipelines.touch_to_image import TouchToImagePipeline


def tiny(name: str, *, dtype: torch.dtype = torch.float32, family: str | Path = weights.FAMILY) -> DiffusionPipeline:
    """A pipeline of the built-in family: 64 x 64 pictures and touches, seconds on a laptop's CPU.

    Args:
        name: "touch-to-image".
        dtype: Of the networks; the state of the solver is float32 in any case.
        family: Another folder with the same layout, such as one that your own training has written.

    Raises:
        InvalidInputError: If there is no such pipeline.

    Example:
        >>> pipe = tiny("touch-to-image")
        >>> pipe.unet.config.sample_size
        16
    """
    return PIPELINES[check_choice("name", name, PIPELINES)](Path(family), dtype)


def joint_space(
    family: Path = weights.FAMILY, dtype: torch.dtype = torch.float32
) -> tuple[UniTouchModel, UniTouchProcessor]:
    """The family's joint space and its processor; encoders are read when they are first used."""
    folder = family / weights.JOINT.name
    return UniTouchModel.from_pretrained(folder, dtype=dtype), UniTouchProcessor.from_pretrained(folder)


def _touch_to_image(family: Path, dtype: torch.dtype) -> TouchToImagePipeline:
    joint, processor = joint_space(family, dtype)
    joint.load("text")  # its transformer is the unCLIP's text encoder, too
    folder = family / weights.TOUCH_TO_IMAGE.name
    pipeline = TouchToImagePipeline(
        unitouch=joint,
        processor=processor,
        image_normalizer=StableUnCLIPImageNormalizer.from_pretrained(folder / "image_normalizer", torch_dtype=dtype),
        image_noising_scheduler=DDPMScheduler.from_pretrained(folder / "image_noising_scheduler"),
        tokenizer=processor.tokenizer,
        text_encoder=joint.text_model.text_model,
        unet=UNet2DConditionModel.from_pretrained(folder / "unet", torch_dtype=dtype),
        scheduler=DPMSolverMultistepScheduler.from_pretrained(folder / "scheduler"),
        vae=AutoencoderDC.from_pretrained(family / weights.IMAGE_VAE.name, torch_dtype=dtype),
        **json.loads((folder / "defaults.json").read_text()),
    )
    for module in (pipeline.unet, pipeline.vae, pipeline.text_encoder):
        module.eval()
    return pipeline


PIPELINES: dict[str, Callable[[Path, torch.dtype], DiffusionPipeline]] = {"touch-to-image": _touch_to_image}
