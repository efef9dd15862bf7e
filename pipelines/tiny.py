"""The built-in tiny family as pipelines, put together from tensors that are stored once."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from diffusers import DDPMScheduler, UNet2DConditionModel
from diffusers.pipelines.stable_diffusion.stable_unclip_image_normalizer import StableUnCLIPImageNormalizer

from unitouch_gen import weights
from unitouch_gen.conditioning import EmbeddingBank, SensorBackgrounds
from unitouch_gen.errors import InvalidInputError, check_choice, check_dtype, check_flag
from unitouch_gen.files import as_path, complete_folder, read_json, reading
from unitouch_gen.models import UniTouchModel, UniTouchProcessor
from unitouch_gen.models.autoencoders import autoencoder_class
from unitouch_gen.pipelines.common import Plan, UniTouchPipeline, check_filled, outline
from unitouch_gen.pipelines.hub import Card
from unitouch_gen.pipelines.tactile_stylization import TactileStylizationPipeline
from unitouch_gen.pipelines.touch_to_image import TouchToImagePipeline
from unitouch_gen.pipelines.x_to_touch import XToTouchPipeline
from unitouch_gen.schedulers.solvers import read_scheduler


def tiny(
    name: str,
    *,
    dtype: torch.dtype = torch.float32,
    family: str | Path = weights.FAMILY,
    plan: Plan | None = None,
    low_memory: bool = False,
) -> UniTouchPipeline:
    """A pipeline of the built-in family: 128 x 128 pictures and touches, seconds on a laptop's CPU.

    Args:
        name: "touch-to-image", "x-to-touch" or "stylization".
        dtype: Of the networks; the state of the solver is float32 in any case.
        family: Another folder with the same layout, such as one that your own training has written.
        plan: Of the requests to come, such as `XToTouchPipeline.plan(text="rough brick")`: no more is read than it
            needs, and calls that need more are refused.
        low_memory: Free encoders when they have done their work; the next call reads them again.

    Raises:
        InvalidInputError, InvalidTypeError: If there is no such pipeline, the family is none or cannot be read, or the
            plan is another pipeline's.

    Example:
        >>> pipe = tiny("touch-to-image")
        >>> pipe.unet.config.sample_size
        16
    """
    kind = PIPELINES[check_choice("name", name, PIPELINES)]
    kind.check_plan(plan)
    dtype, low_memory = check_dtype("dtype", dtype), check_flag("low_memory", low_memory)
    family, needed = _family(family), plan.components if plan else {}
    of_touch = kind is XToTouchPipeline
    names = (weights.X_TO_TOUCH, weights.TOUCH_VAE) if of_touch else (weights.TOUCH_TO_IMAGE, weights.IMAGE_VAE)
    folder, vae = (family / one.name for one in names)
    with reading("family", family), reading("family", folder):
        pipe: UniTouchPipeline = kind(**_parts(kind, family, folder, vae, dtype, needed))
    pipe._keep_to(plan, family / weights.EMBEDDING_BANK.name, low_memory)
    pipe._card = _card(family, name)
    return pipe


def _card(family: Path, name: str) -> Card:
    """What is known of a family's pipeline: what is read off its images, and what the built-in one was made of."""
    file = family / weights.FIGURES.name
    known = read_json("family", file).get("figures", {}) if file.is_file() else {}
    figures = {
        key: f"{row['value']:.1%} ({row['class_mean']:.1%} class mean, {row['shuffled']:.1%} another "
        f"contact's, {row['ceiling']:.1%} real images)"
        for key, row in known.get("quality", {}).get("rows", {}).items()
        if key in MEASURED[name]
    }
    if family.resolve() != weights.FAMILY.resolve():
        return Card(figures=figures)
    picture = weights.CARDS / f"{name}.jpg"
    return Card(
        figures=figures,
        data="The procedural world of touches, pictures, sounds and captions that `unitouch_gen` renders itself, with "
        "scanned materials (CC0 and MIT) among its surfaces; no recording of a real sensor.",
        license="apache-2.0",
        limits=f"It is small and knows a procedural world. {FALLS_SHORT[PIPELINES[name]]} Of real touches a probe "
        "reads no more off its encoder than off plain statistics of the image, or off the same encoder untrained.",
        pictures={SHOWN[PIPELINES[name]]: picture} if picture.is_file() else {},  # which is drawn by its pipeline
    )


READ = ("material", "contact within material", "grain within 20")
"""What classifiers read of images, of which shares are told."""

MEASURED: dict[str, tuple[str, ...]] = {
    "touch-to-image": tuple(f"touch to picture: {what}" for what in READ),
    "stylization": (),
    "x-to-touch": tuple(f"{of} to touch: {what}" for of in ("photo", "caption", "sound") for what in READ),
}
"""Figures that a model card has of each pipeline."""

FALLS_SHORT: dict[type[UniTouchPipeline], str] = {
    TouchToImagePipeline: "Its pictures show how far a touch reaches, how rough it is and which way it runs, and "
    "hardly what it is of.",
    TactileStylizationPipeline: "Of the touch's relief nothing was found in what it restyles.",
    XToTouchPipeline: "Of a photo it shows some of the relief and which way it runs, of a sound nothing.",
}
"""What pictures of each kind do not show, by what was measured."""


def joint_space(
    family: Path = weights.FAMILY, dtype: torch.dtype = torch.float32
) -> tuple[UniTouchModel, UniTouchProcessor]:
    """The family's joint space and its processor; encoders are read when they are first used.

    Raises:
        InvalidInputError, InvalidTypeError: If the family is none, or its joint space cannot be read.
    """
    folder = _family(family) / weights.JOINT.name
    return UniTouchModel.from_pretrained(folder, dtype=dtype), UniTouchProcessor.from_pretrained(folder)


def _family(family: str | Path) -> Path:
    """The folder of a family."""
    family = as_path("family", family)
    complete_folder(family)
    if not (family / weights.JOINT.name).is_dir():
        raise InvalidInputError(
            f"`family` is {str(family)!r}, which holds no family of weights; pass a folder that "
            "`unitouch_gen.training.assemble` wrote, or leave it out for the built-in one."
        )
    return family


def _parts(
    kind: type[UniTouchPipeline],
    family: Path,
    folder: Path,
    vae: Path,
    dtype: torch.dtype,
    needed: Mapping[str, bool],
) -> dict[str, Any]:
    """What a pipeline is called with: its components, and the defaults that its folder brings."""
    joint, processor = joint_space(family, dtype)
    of_touch = kind is XToTouchPipeline
    if text := not of_touch and needed.get("text_encoder", True):
        joint.load("text")  # its transformer is the unCLIP's text encoder, too
    bank, untouched = family / weights.EMBEDDING_BANK.name, folder / "backgrounds"
    decoder = autoencoder_class("vae", read_json("family", vae / "config.json").get("_class_name"))
    banked = bank.is_dir() and needed.get("embedding_bank", True)
    parts = {
        "unitouch": joint if needed.get("unitouch", True) else None,
        "processor": processor if needed.get("processor", True) else None,
        "unet": _stored(UNet2DConditionModel, folder / "unet", dtype),
        "scheduler": read_scheduler(folder / "scheduler"),
        "vae": _stored(decoder, vae, dtype) if needed.get("vae", True) else outline(decoder, decoder.load_config(vae)),
        "embedding_bank": _stored(EmbeddingBank, bank, dtype) if banked else None,
        **read_json("family", folder / "defaults.json"),
    }
    if of_touch:
        shown = _stored(SensorBackgrounds, untouched, dtype) if untouched.is_dir() else None
        return {**parts, "backgrounds": shown}
    return {
        **parts,
        "image_normalizer": _stored(StableUnCLIPImageNormalizer, folder / "image_normalizer", dtype),
        "image_noising_scheduler": DDPMScheduler.from_pretrained(folder / "image_noising_scheduler"),
        "tokenizer": processor.tokenizer if text else None,
        "text_encoder": joint.text_model.text_model.eval() if text else None,
    }


def _stored(kind: Any, folder: Path, dtype: torch.dtype) -> Any:
    """A network of a folder, for inference."""
    made = kind.from_pretrained(folder, torch_dtype=dtype, use_safetensors=True)
    check_filled(folder, made)
    return made.eval()


PIPELINES: dict[str, type[UniTouchPipeline]] = {
    "touch-to-image": TouchToImagePipeline,
    "stylization": TactileStylizationPipeline,
    "x-to-touch": XToTouchPipeline,
}

SHOWN: dict[type[UniTouchPipeline], str] = {
    TouchToImagePipeline: "Touches of objects that the model never saw, and below each the picture generated from it. "
    "Colour cannot be felt, so it is invented.",
    TactileStylizationPipeline: "Photos, touches of other materials, and the photos restyled by them. By what was "
    "measured, these show nothing of the touch's relief.",
    XToTouchPipeline: "Photos of objects that the model never saw, and below each the touch generated from it.",
}
"""What a model card says of its picture."""
