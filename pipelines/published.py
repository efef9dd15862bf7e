"""Pipelines of published parts: a diffusers unCLIP folder or a latent diffusion model of touch, on a converted joint
space.
"""

import math
import os
import sys
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any

import torch
from diffusers import StableUnCLIPImg2ImgPipeline, UNet2DConditionModel
from transformers import CLIPTextModel, CLIPTokenizer, CLIPVisionModelWithProjection

from unitouch_gen.errors import (
    InvalidInputError,
    check_arguments,
    check_choice,
    check_device,
    check_dtype,
    check_flag,
    check_number,
)
from unitouch_gen.files import NEVER_READ, OPTIONS, check_variant, local_folder, open_weights, read_json, reading
from unitouch_gen.models.autoencoders import autoencoder_class
from unitouch_gen.models.images import ImageInput
from unitouch_gen.models.joint import MODULES, UniTouchModel
from unitouch_gen.models.processing import UniTouchProcessor
from unitouch_gen.pipelines.common import Plan, check_filled, outline
from unitouch_gen.schedulers.solvers import read_scheduler

UNCLIP_PARTS = ("image_normalizer", "image_noising_scheduler", "unet", "scheduler", "vae")
LDM_PARTS = {"unet": "config.json", "vae": "config.json", "scheduler": "scheduler_config.json"}

OFFLOADS = ("model", "sequential")

SAME_WEIGHTS = 0.01
"""Relative difference of weights that differ by their dtypes alone."""


@dataclass(frozen=True)
class Wanted:
    """How published parts are read and where they go.

    Attributes:
        dtype: Of the networks.
        device: They are moved to, or offloaded from.
        variant: Of the unCLIP's files: "fp16".
        offload: "model" or "sequential", as `enable_model_cpu_offload` and its like; `None` for neither.
        plan: Read no more than it needs; calls that need more are refused.
        low_memory: Whether to free encoders that have done their work.
        hub: Options of a fetch, see `unitouch_gen.files.OPTIONS`.
    """

    dtype: torch.dtype
    device: str | torch.device | None
    variant: str | None
    offload: str | None
    plan: Plan | None
    low_memory: bool
    hub: dict[str, Any]

    def __post_init__(self) -> None:
        object.__setattr__(self, "dtype", check_dtype("dtype", self.dtype))
        check_variant(self.variant)
        if self.device is not None:
            check_device("device", self.device)
        if self.offload is not None:
            check_choice("offload", self.offload, OFFLOADS)
            if self.low_memory:
                raise InvalidInputError(
                    f"`offload` is {self.offload!r} beside `low_memory`, which frees what it would move; pass one of "
                    "them."
                )
        check_flag("low_memory", self.low_memory)
        own = (*(field.name for field in fields(Wanted)), "embedding_norm", "images", "sensors")
        check_arguments("from_published", self.hub, {*OPTIONS, *own})

    @property
    def absent(self) -> dict[str, None]:
        """Components that the plan leaves out."""
        return dict.fromkeys(name for name, needed in (self.plan.components if self.plan else {}).items() if not needed)

    def placed(self, pipe: Any, readers: Mapping[str, Callable[[], Any]]) -> Any:
        """The pipeline as one of the plan, which frees what it can where memory is low, on its device, offloaded if
        that was asked for."""
        pipe._keep_to(self.plan, low_memory=self.low_memory, readers=readers)
        if self.offload is None:
            return pipe if self.device is None else pipe.to(self.device)
        options = {} if self.device is None else {"device": self.device}
        if self.offload == "model":
            pipe.enable_model_cpu_offload(**options)
        else:
            pipe.enable_sequential_cpu_offload(**options)
        return pipe


# The joint space ------------------------------------------------------------------------------------------------------


def joint_parts(unitouch: str | os.PathLike | UniTouchModel, wanted: Wanted) -> tuple[UniTouchModel, UniTouchProcessor]:
    """A converted joint space, of which nothing is read yet, and its processor.

    Raises:
        InvalidInputError: If there is none.
    """
    if isinstance(unitouch, UniTouchModel):
        return unitouch, UniTouchProcessor.for_config(unitouch.config)
    shared = {name: wanted.hub[name] for name in ("cache_dir", "token", "local_files_only") if name in wanted.hub}
    folder = local_folder("unitouch", unitouch, **shared)  # other options are of one repository alone
    if not (folder / "config.json").is_file():
        raise _lacking("unitouch", folder, "joint space", "that `unitouch-gen convert unitouch` wrote")
    return UniTouchModel.from_pretrained(folder, dtype=wanted.dtype), UniTouchProcessor.from_pretrained(folder)


# unCLIP ---------------------------------------------------------------------------------------------------------------


def unclip_pipeline(
    kind: Any,
    unclip: str | os.PathLike,
    unitouch: str | os.PathLike | UniTouchModel,
    embedding_norm: float | None,
    images: ImageInput,
    wanted: Wanted,
) -> Any:
    """A pipeline of a diffusers unCLIP folder on a joint space; see `TouchToImagePipeline.from_published`."""
    kind.check_plan(wanted.plan)
    model, processor = joint_parts(unitouch, wanted)
    own_images = "image" in model.known_modalities
    unread = [*NEVER_READ, *(["image_encoder/*"] if own_images and images is None else [])]
    unread += [] if wanted.variant else ["*.fp16.*"]
    folder = local_folder("unclip", unclip, **{"ignore_patterns": unread, **wanted.hub})
    index = _index("unclip", folder, UNCLIP_PARTS)
    width = read_json("unclip", folder / "image_normalizer" / "config.json").get("embedding_dim")
    if width != model.config.projection_dim:
        raise InvalidInputError(
            f"`unitouch` has embeddings of width {model.config.projection_dim}, the unCLIP model of width {width}; use "
            "models of one width."
        )
    absent: dict[str, Any] = {name: part for name, part in wanted.absent.items() if name in index}
    if "vae" in absent:
        absent["vae"] = _read("unclip", folder, outline, *_autoencoder("unclip", folder))
    read = partial(_read, "unclip", folder)
    source = read(
        StableUnCLIPImg2ImgPipeline.from_pretrained,
        folder,
        dtype=wanted.dtype,
        variant=wanted.variant,
        use_safetensors=True,
        feature_extractor=None,
        image_encoder=None,
        **absent,
    )
    for part in {"unet", "vae"}.difference(absent):
        check_filled(folder / part, getattr(source, part))

    def encoder(network: Any, part: str) -> Any:
        return read(
            network.from_pretrained, folder / part, dtype=wanted.dtype, variant=wanted.variant, use_safetensors=True
        )

    image_encoder = partial(encoder, CLIPVisionModelWithProjection, "image_encoder")
    if own_images:
        warn_of_other_encoder(folder, model)
    elif "image_encoder" in index:
        model.vision_model = image_encoder()
        model.config.vision_config = model.vision_model.config
    if processor.tokenizer is None and isinstance(source.tokenizer, CLIPTokenizer):
        processor.tokenizer = source.tokenizer
    if embedding_norm is None and images is None:
        known = source.image_normalizer  # mean m and deviation s: the norm's root mean square is sqrt(sum of m^2 + s^2)
        squares = known.mean.detach().double().square() + known.std.detach().double().square()
        embedding_norm = math.sqrt(float(squares.sum()))
    set_norm(
        model,
        embedding_norm,
        images,
        lambda: norm_of_images(image_encoder() if own_images else model, processor, images),
    )
    parts = {} if {"unitouch", "processor"} & set(wanted.absent) else {"unitouch": model, "processor": processor}
    made = kind.from_pipe(source, **parts)
    return wanted.placed(made, {"text_encoder": partial(encoder, CLIPTextModel, "text_encoder")})


def set_norm(
    model: UniTouchModel, embedding_norm: float | None, images: ImageInput, measured: Callable[[], float]
) -> None:
    """Makes the norm of image embeddings the joint space's: a given one, or the one of some pictures; if either came.

    Raises:
        InvalidInputError: If both came, or it is not above 0.
    """
    if embedding_norm is not None and images is not None:
        raise InvalidInputError(
            "`embedding_norm` came beside `images`, which are there to measure it; pass one of them."
        )
    if embedding_norm is None and images is not None:
        embedding_norm = measured()
    if embedding_norm is not None:
        model.config.embedding_norm = check_number("embedding_norm", embedding_norm, sys.float_info.min)


def warn_of_other_encoder(folder: Path, model: UniTouchModel) -> None:
    """Warns where an unCLIP's image encoder is on disk, and is another one than the joint space's."""
    module, key = MODULES["image"][0], "visual_projection.weight"
    files = sorted((folder / "image_encoder").glob("*.safetensors"))
    theirs = next((found for file in files if (found := _tensor(file, key)) is not None), None)
    if "image" in model.loaded_modalities:
        ours: torch.Tensor | None = model.vision_model.visual_projection.weight.detach()
    else:
        place = model._stored.get(f"{module}.{key}")
        ours = None if place is None else _tensor(place, f"{module}.{key}")
    if theirs is None or ours is None:
        return
    error = math.inf
    if theirs.shape == ours.shape:
        error = float((theirs.float() - ours.float().cpu()).norm() / theirs.float().norm())
    if not error <= SAME_WEIGHTS:
        warnings.warn(
            "`unclip` brings another image encoder than `unitouch`, and its network was trained on embeddings of its "
            "own; pictures may not follow the touches. Use the unCLIP of that encoder.",
            UserWarning,
            stacklevel=4,
        )


def _tensor(file: Path, key: str) -> torch.Tensor | None:
    """One tensor of a safetensors file, if it is there."""
    with open_weights(file) as weights:
        return weights.get_tensor(key) if key in weights.keys() else None  # noqa: SIM118 - not a dict


@torch.no_grad()
def norm_of_images(encoder: Any, processor: UniTouchProcessor, images: ImageInput) -> float:
    """Mean L2 norm of the embeddings of some pictures."""
    pixels = processor.images(images, name="images")
    if isinstance(encoder, UniTouchModel):
        embeds = encoder.get_image_features(pixels)
    else:
        embeds = encoder(pixel_values=pixels.to(encoder.dtype)).image_embeds
    return float(embeds.double().norm(dim=1).mean())


# Latent diffusion of touch --------------------------------------------------------------------------------------------


def touch_pipeline(
    kind: Any,
    ldm: str | os.PathLike,
    unitouch: str | os.PathLike | UniTouchModel,
    sensors: Any,
    embedding_norm: float | None,
    images: ImageInput,
    wanted: Wanted,
) -> Any:
    """A pipeline of a latent diffusion model in diffusers' layout; see `XToTouchPipeline.from_published`."""
    kind.check_plan(wanted.plan)
    model, processor = joint_parts(unitouch, wanted)
    set_norm(model, embedding_norm, images, lambda: norm_of_images(model, processor, images))
    folder = local_folder("ldm", ldm, **wanted.hub)
    missing = [name for name in LDM_PARTS if not (folder / name / LDM_PARTS[name]).is_file()]
    if missing:
        raise _lacking("ldm", folder, ", ".join(missing), "of a latent diffusion model of touch in diffusers' layout")
    read = partial(_read, "ldm", folder)
    settings = {"dtype": wanted.dtype, "variant": wanted.variant, "use_safetensors": True}
    vae, config = _autoencoder("ldm", folder)
    absent = wanted.absent
    made = kind(
        unet=read(UNet2DConditionModel.from_pretrained, folder / "unet", **settings).eval(),
        vae=read(outline, vae, config)
        if "vae" in absent
        else read(vae.from_pretrained, folder / "vae", **settings).eval(),
        scheduler=read(read_scheduler, folder / "scheduler"),
        unitouch=None if "unitouch" in absent else model,
        processor=None if "processor" in absent else processor,
        sensors=sensors,
    )
    for part in {"unet", "vae"}.difference(absent):
        check_filled(folder / part, getattr(made, part))
    return wanted.placed(made, {})


def _index(name: str, folder: Path, parts: tuple[str, ...]) -> dict[str, Any]:
    """model_index.json of a folder that has these parts."""
    file = folder / "model_index.json"
    index = read_json(name, file) if file.is_file() else {}
    missing = [part for part in parts if part not in index or not (folder / part).is_dir()]
    if missing:
        lacks = ", ".join(missing) if index else file.name
        wanted = "of a diffusers unCLIP pipeline, such as Stable Diffusion 2.1 unCLIP"
        raise _lacking(name, folder, lacks, wanted)
    return index


def _lacking(name: str, folder: Path, missing: str, wanted: str) -> InvalidInputError:
    """What to raise where a folder is not the one that is wanted."""
    return InvalidInputError(f"`{name}` is {str(folder)!r}, which holds no {missing}; pass the folder {wanted}.")


def _autoencoder(name: str, folder: Path) -> tuple[Any, dict[str, Any]]:
    """Class and settings of a folder's autoencoder."""
    config = read_json(name, folder / "vae" / "config.json")
    return autoencoder_class(f"{name}/vae", config.get("_class_name")), config


def _read(name: str, folder: Path, load: Any, *args: Any, **settings: Any) -> Any:
    """What a library reads."""
    with reading(name, folder):
        return load(*args, **settings)
