"""Pipelines of the built-in tiny family; components they share are stored once."""

import copy
from functools import partial
from pathlib import Path
from typing import Any

import diffusers
import torch
from diffusers import DDPMScheduler, LCMScheduler, UNet2DConditionModel
from diffusers.pipelines.stable_diffusion.stable_unclip_image_normalizer import StableUnCLIPImageNormalizer
from transformers import AutoTokenizer, LlamaForCausalLM

from unitouch_gen import weights
from unitouch_gen.conditioning import EmbeddingBank, SensorBackgrounds
from unitouch_gen.errors import InvalidInputError, check_choice, check_dtype, import_optional
from unitouch_gen.files import as_path, read_network, read_settings, reading
from unitouch_gen.models import LanguageBridge, UniTouchModel, UniTouchProcessor
from unitouch_gen.models.autoencoders import autoencoder_class
from unitouch_gen.models.processing import read_tokenizer
from unitouch_gen.pipelines.base import UniTouchPipeline
from unitouch_gen.pipelines.hub import Card
from unitouch_gen.pipelines.tactile_stylization import TactileStylizationPipeline
from unitouch_gen.pipelines.touch_to_image import TouchToImagePipeline
from unitouch_gen.pipelines.touch_to_text import TouchToTextPipeline
from unitouch_gen.pipelines.x_to_touch import XToTouchPipeline

PIPELINES: dict[str, type[UniTouchPipeline]] = {
    "touch-to-image": TouchToImagePipeline,
    "stylization": TactileStylizationPipeline,
    "x-to-touch": XToTouchPipeline,
    "touch-to-text": TouchToTextPipeline,
}
TRAINED_BY = {
    "touch-to-image": "unclip",
    "stylization": "unclip",
    "x-to-touch": "touch_ldm",
    "touch-to-text": "touch_llm",
}
"""The stages of training of their networks."""

TURBO = {"touch-to-image-turbo": "touch-to-image", "x-to-touch-turbo": "x-to-touch"}
"""Distilled pipelines, and those that they were distilled from, whose folders hold the LoRA weights in `turbo`."""


def tiny(name: str, *, dtype: torch.dtype = torch.float32, family: str | Path = weights.FAMILY) -> UniTouchPipeline:
    """A pipeline of the built-in family: 128 x 128 pictures and touches, seconds on a laptop's CPU.

    Args:
        name: "touch-to-image", "x-to-touch", "stylization" or "touch-to-text"; "touch-to-image-turbo" and
            "x-to-touch-turbo" draw in four evaluations and need peft.
        dtype: dtype of the networks; the solver's state is always float32.
        family: Another folder of the same layout, such as one of your own training.

    Raises:
        InvalidInputError: If there is no such pipeline, or the family cannot be read.

    Example:
        >>> pipe = tiny("touch-to-image")
        >>> pipe.unet.config.sample_size
        16
    """
    teacher = TURBO.get(check_choice("name", name, [*PIPELINES, *TURBO]), name)
    kind = PIPELINES[teacher]
    dtype = check_dtype("dtype", dtype)
    family = _family(family)
    folder = family / ("touch-to-image" if teacher == "stylization" else teacher)  # which share their networks

    stored = partial(read_network, torch_dtype=dtype)
    with reading("family", family):
        joint, processor = joint_space(family, dtype)
        parts: dict[str, Any] = {"unitouch": joint, "processor": processor}
        parts |= read_settings("family", family / teacher / "defaults.json")
        # Without a bank, pictures and answers keep more of a touch's grain and place.
        if kind in (TactileStylizationPipeline, XToTouchPipeline) and (family / "embedding-bank").is_dir():
            parts["embedding_bank"] = stored(EmbeddingBank, family / "embedding-bank")
        if kind is TouchToTextPipeline:
            language = folder / "language_model"
            parts["language_model"] = stored(LlamaForCausalLM, language)
            parts["language_bridge"] = stored(LanguageBridge, folder / "language_bridge")
            parts["tokenizer"] = read_tokenizer("family", language, AutoTokenizer)
        else:
            vae = family / ("touch-vae" if kind is XToTouchPipeline else "image-vae")
            autoencoder = read_settings("family", vae / "config.json").get("_class_name")
            parts["vae"] = stored(autoencoder_class("vae", autoencoder), vae)
            parts["unet"] = stored(UNet2DConditionModel, folder / "unet")
            scheduler = read_settings("family", folder / "scheduler" / "scheduler_config.json")["_class_name"]
            parts["scheduler"] = getattr(diffusers, scheduler).from_pretrained(folder / "scheduler")
        if kind is XToTouchPipeline and (folder / "backgrounds").is_dir():
            parts["backgrounds"] = stored(SensorBackgrounds, folder / "backgrounds")
        if kind in (TouchToImagePipeline, TactileStylizationPipeline):
            joint.load("text")  # its transformer is also the unCLIP's text encoder
            parts |= {
                "image_normalizer": stored(StableUnCLIPImageNormalizer, folder / "image_normalizer"),
                "image_noising_scheduler": DDPMScheduler.from_pretrained(folder / "image_noising_scheduler"),
                "tokenizer": processor.tokenizer,
                "text_encoder": joint.text_model.text_model.eval(),
            }
        pipe = kind(**parts)
        if name in TURBO:
            pipe = distilled(pipe, folder / "turbo")
        content = _family_content(family)
        pipe._card = _card(family, content, name)
        record = content.get("training", {}).get(TRAINED_BY.get(name), {})
        pipe._record = {key: value for key, value in record.items() if key != "started_from"}
    return pipe


def distilled(pipe: Any, folder: Path) -> Any:
    """A copy of a pipeline with LoRA weights of `unitouch-gen distill` fused into its UNet, and their defaults."""
    import_optional("peft")
    defaults = read_settings("lora", folder / "defaults.json")
    student = copy.copy(pipe)
    unet = copy.deepcopy(pipe.unet)
    # As `pipe.load_lora_weights` does, which would look for weights of the text encoder, too.
    unet.load_lora_adapter(folder, prefix="unet", use_safetensors=True)
    if not getattr(unet, "peft_config", None):
        raise InvalidInputError(f"{str(folder)!r} holds no LoRA weights of a UNet.")
    unet.fuse_lora()
    unet.unload_lora()
    student.unet = unet
    student.scheduler = LCMScheduler.from_config(pipe.scheduler.config)
    student.register_to_config(**defaults)
    return student


def joint_space(
    family: Path = weights.FAMILY, dtype: torch.dtype = torch.float32
) -> tuple[UniTouchModel, UniTouchProcessor]:
    """The family's joint space and its processor; encoders are read when they are first used."""
    folder = _family(family) / "joint"
    return UniTouchModel.from_pretrained(folder, dtype=dtype), UniTouchProcessor.from_pretrained(folder)


def _family(family: str | Path) -> Path:
    family = as_path("family", family)
    if not (family / "joint").is_dir():
        raise InvalidInputError(
            f"`family` is {str(family)!r}, which holds no family of weights; pass a folder that "
            "`samples/assemble_family.py` wrote, or leave it out for the built-in one."
        )
    return family


def _family_content(family: Path) -> dict[str, Any]:
    """The family's `family.json`; empty if it has none."""
    file = family / weights.FIGURES.name
    return read_settings("family", file) if file.is_file() else {}


def _card(family: Path, content: dict[str, Any], name: str) -> Card:
    """The model card that the `content` of the family's `family.json` describes, or a plain one."""
    settings = dict(content.get("cards", {}).get(name, {}))
    pictures = {
        caption: family / weights.CARDS.name / stored for caption, stored in settings.pop("pictures", {}).items()
    }
    return Card(**settings, pictures=pictures)
