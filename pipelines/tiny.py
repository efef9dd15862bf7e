"""The built-in tiny family as pipelines, put together from tensors that are stored once."""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
from diffusers import AutoencoderDC, DDPMScheduler, DiffusionPipeline, UNet2DConditionModel
from diffusers.pipelines.stable_diffusion.stable_unclip_image_normalizer import StableUnCLIPImageNormalizer

from unitouch_gen import weights
from unitouch_gen.diffusion.continuous import ContinuousUniPCScheduler
from unitouch_gen.diffusion.store import EmbeddingStore
from unitouch_gen.encoders import UniTouchModel, UniTouchProcessor
from unitouch_gen.errors import InvalidInputError, check_choice
from unitouch_gen.pipelines.tactile_stylization import TactileStylizationPipeline
from unitouch_gen.pipelines.touch_to_image import TouchToImagePipeline
from unitouch_gen.pipelines.unclip import UnclipPipeline
from unitouch_gen.pipelines.x_to_touch import XToTouchPipeline


def tiny(name: str, *, dtype: torch.dtype = torch.float32, family: str | Path = weights.FAMILY) -> DiffusionPipeline:
    """A pipeline of the built-in family: 64 x 64 pictures and touches, seconds on a laptop's CPU.

    Args:
        name: "touch-to-image", "x-to-touch" or "stylization".
        dtype: Of the networks; the state of the solver is float32 in any case.
        family: Another folder with the same layout, such as one that your own training has written.

    Raises:
        InvalidInputError: If there is no such pipeline, or no family in the folder.

    Example:
        >>> pipe = tiny("touch-to-image")
        >>> pipe.unet.config.sample_size
        16
    """
    make = PIPELINES[check_choice("name", name, PIPELINES)]
    if not (Path(family) / weights.JOINT.name).is_dir():
        raise InvalidInputError(
            f"`family` is {str(family)!r}, which holds no family of weights; pass a folder that "
            "`unitouch_gen.training.assemble` wrote, or leave it out for the built-in one."
        )
    return make(Path(family), dtype)


def joint_space(
    family: Path = weights.FAMILY, dtype: torch.dtype = torch.float32
) -> tuple[UniTouchModel, UniTouchProcessor]:
    """The family's joint space and its processor; encoders are read when they are first used."""
    folder = family / weights.JOINT.name
    return UniTouchModel.from_pretrained(folder, dtype=dtype), UniTouchProcessor.from_pretrained(folder)


def _unclip(kind: type[UnclipPipeline], family: Path, dtype: torch.dtype) -> UnclipPipeline:
    joint, processor = joint_space(family, dtype)
    joint.load("text")  # its transformer is the unCLIP's text encoder, too
    folder = family / weights.TOUCH_TO_IMAGE.name
    return kind(
        unitouch=joint,
        processor=processor,
        image_normalizer=StableUnCLIPImageNormalizer.from_pretrained(folder / "image_normalizer", torch_dtype=dtype),
        image_noising_scheduler=DDPMScheduler.from_pretrained(folder / "image_noising_scheduler"),
        tokenizer=processor.tokenizer,
        text_encoder=joint.text_model.text_model.eval(),
        unet=UNet2DConditionModel.from_pretrained(folder / "unet", torch_dtype=dtype).eval(),
        scheduler=ContinuousUniPCScheduler.from_pretrained(folder / "scheduler"),
        vae=AutoencoderDC.from_pretrained(family / weights.IMAGE_VAE.name, torch_dtype=dtype).eval(),
        **json.loads((folder / "defaults.json").read_text()),
    )


def _x_to_touch(family: Path, dtype: torch.dtype) -> XToTouchPipeline:
    joint, processor = joint_space(family, dtype)
    folder = family / weights.X_TO_TOUCH.name
    return XToTouchPipeline(
        unitouch=joint,
        processor=processor,
        store=EmbeddingStore.from_pretrained(folder / "store", torch_dtype=dtype),
        unet=UNet2DConditionModel.from_pretrained(folder / "unet", torch_dtype=dtype).eval(),
        scheduler=ContinuousUniPCScheduler.from_pretrained(folder / "scheduler"),
        vae=AutoencoderDC.from_pretrained(family / weights.TOUCH_VAE.name, torch_dtype=dtype).eval(),
        **json.loads((folder / "defaults.json").read_text()),
    )


PIPELINES: dict[str, Callable[[Path, torch.dtype], DiffusionPipeline]] = {
    "touch-to-image": partial(_unclip, TouchToImagePipeline),
    "stylization": partial(_unclip, TactileStylizationPipeline),
    "x-to-touch": _x_to_touch,
}
