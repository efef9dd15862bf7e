"""The built-in tiny family as pipelines, put together from tensors that are stored once."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from diffusers import AutoencoderDC, DDPMScheduler, UNet2DConditionModel
from diffusers.pipelines.stable_diffusion.stable_unclip_image_normalizer import StableUnCLIPImageNormalizer

from unitouch_gen import weights
from unitouch_gen.embedding_bank import EmbeddingBank
from unitouch_gen.errors import InvalidInputError, check_choice
from unitouch_gen.models import UniTouchModel, UniTouchProcessor
from unitouch_gen.models.casting import compute_in
from unitouch_gen.pipelines.base import JointSpacePipeline
from unitouch_gen.pipelines.planned import Place, outline
from unitouch_gen.pipelines.tactile_stylization import TactileStylizationPipeline
from unitouch_gen.pipelines.touch_to_image import TouchToImagePipeline
from unitouch_gen.pipelines.unclip import UnclipPipeline
from unitouch_gen.pipelines.x_to_touch import XToTouchPipeline
from unitouch_gen.plan import Plan
from unitouch_gen.schedulers.solvers import read_scheduler


def tiny(
    name: str,
    *,
    dtype: torch.dtype = torch.float32,
    family: str | Path = weights.FAMILY,
    plan: Plan | None = None,
    low_memory: bool = False,
) -> JointSpacePipeline:
    """A pipeline of the built-in family: 64 x 64 pictures and touches, seconds on a laptop's CPU.

    Args:
        name: "touch-to-image", "x-to-touch" or "stylization".
        dtype: Of the networks; the state of the solver is float32 in any case.
        family: Another folder with the same layout, such as one that your own training has written.
        plan: Of the requests to come, such as `XToTouchPipeline.plan(text="rough brick")`: no more is read than it
            needs, and calls that need more are refused.
        low_memory: Keep weights as they are stored, in float16, and cast each layer's up while it runs; free encoders
            when they have done their work. The pictures are the same; calls take up to twice as long.

    Raises:
        InvalidInputError: If there is no such pipeline, or no family in the folder.

    Example:
        >>> pipe = tiny("touch-to-image")
        >>> pipe.unet.config.sample_size
        16
    """
    kind = PIPELINES[check_choice("name", name, PIPELINES)]
    if not (Path(family) / weights.JOINT.name).is_dir():
        raise InvalidInputError(
            f"`family` is {str(family)!r}, which holds no family of weights; pass a folder that "
            "`unitouch_gen.training.assemble` wrote, or leave it out for the built-in one."
        )
    reader = Reader(Path(family), dtype, plan.components if plan else {}, low_memory)
    pipe = reader.x_to_touch() if kind is XToTouchPipeline else reader.unclip(kind)
    pipe._keep_to(plan, reader.places(kind), low_memory)
    return pipe


def joint_space(
    family: Path = weights.FAMILY, dtype: torch.dtype = torch.float32
) -> tuple[UniTouchModel, UniTouchProcessor]:
    """The family's joint space and its processor; encoders are read when they are first used."""
    folder = family / weights.JOINT.name
    return UniTouchModel.from_pretrained(folder, dtype=dtype), UniTouchProcessor.from_pretrained(folder)


@dataclass(frozen=True)
class Reader:
    """Reads what a pipeline is put together from.

    Args:
        family: The folder.
        dtype: Of computation.
        needed: `Plan.components`; what it does not name is needed.
        low_memory: Whether weights stay in float16.
    """

    family: Path
    dtype: torch.dtype
    needed: Mapping[str, bool]
    low_memory: bool

    def unclip(self, kind: type[UnclipPipeline]) -> UnclipPipeline:
        joint, processor = joint_space(self.family, self.dtype)
        text = self._needs("text_encoder")
        if text:
            joint.load("text")  # its transformer is the unCLIP's text encoder, too
        folder = self.family / weights.TOUCH_TO_IMAGE.name
        normalizer = StableUnCLIPImageNormalizer.from_pretrained(folder / "image_normalizer", torch_dtype=self.dtype)
        return kind(
            unitouch=joint if self._needs("unitouch") else None,
            processor=processor if self._needs("processor") else None,
            image_normalizer=normalizer,
            image_noising_scheduler=DDPMScheduler.from_pretrained(folder / "image_noising_scheduler"),
            tokenizer=processor.tokenizer if text else None,
            text_encoder=joint.text_model.text_model.eval() if text else None,
            unet=self._network(UNet2DConditionModel, folder / "unet"),
            scheduler=read_scheduler(folder / "scheduler"),
            vae=self._vae(self.family / weights.IMAGE_VAE.name),
            **json.loads((folder / "defaults.json").read_text()),
        )

    def x_to_touch(self) -> XToTouchPipeline:
        joint, processor = joint_space(self.family, self.dtype)
        folder = self.family / weights.X_TO_TOUCH.name
        return XToTouchPipeline(
            unitouch=joint if self._needs("unitouch") else None,
            processor=processor if self._needs("processor") else None,
            embedding_bank=self._stored(EmbeddingBank, folder / "embedding_bank")
            if self._needs("embedding_bank")
            else None,
            unet=self._network(UNet2DConditionModel, folder / "unet"),
            scheduler=read_scheduler(folder / "scheduler"),
            vae=self._vae(self.family / weights.TOUCH_VAE.name),
            **json.loads((folder / "defaults.json").read_text()),
        )

    def places(self, kind: type[JointSpacePipeline]) -> dict[str, Place]:
        """Where the weights of each component are, of those that a plan may leave out."""
        joint = self.family / weights.JOINT.name
        if kind is XToTouchPipeline:
            bank = self.family / weights.X_TO_TOUCH.name / "embedding_bank"
            return {
                "unitouch": (joint, ""),
                "embedding_bank": (bank, ""),
                "vae": (self.family / weights.TOUCH_VAE.name, ""),
            }
        text = (joint, "text_model.text_model.")
        return {"unitouch": (joint, ""), "text_encoder": text, "vae": (self.family / weights.IMAGE_VAE.name, "")}

    def _needs(self, component: str) -> bool:
        return self.needed.get(component, True)

    def _vae(self, folder: Path) -> AutoencoderDC:
        if self._needs("vae"):
            return self._network(AutoencoderDC, folder)
        return outline(AutoencoderDC, AutoencoderDC.load_config(folder))

    def _stored(self, kind: Any, folder: Path) -> Any:
        """A network in the dtype of its weights in memory."""
        dtype = torch.float16 if self.low_memory and self.dtype.itemsize > torch.float16.itemsize else self.dtype
        return kind.from_pretrained(folder, torch_dtype=dtype, use_safetensors=True).eval()

    def _network(self, kind: Any, folder: Path) -> Any:
        """One that computes in the dtype asked for."""
        return compute_in(self._stored(kind, folder), self.dtype)


PIPELINES: dict[str, type[JointSpacePipeline]] = {
    "touch-to-image": TouchToImagePipeline,
    "stylization": TactileStylizationPipeline,
    "x-to-touch": XToTouchPipeline,
}
