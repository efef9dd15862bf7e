"""Pipelines of published parts, on a converted joint space: a diffusers unCLIP folder, or a latent diffusion model of
touch.
"""

import math
import os
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import diffusers
import torch
from diffusers import DDIMScheduler, SchedulerMixin, StableUnCLIPImg2ImgPipeline, UNet2DConditionModel
from safetensors import safe_open
from torch import Tensor
from transformers import CLIPTokenizer, CLIPVisionModelWithProjection

from unitouch_gen.errors import InvalidInputError, check_dtype, check_number
from unitouch_gen.files import NEVER_READ, local_folder, read_json, reading
from unitouch_gen.models.autoencoders import autoencoder_class
from unitouch_gen.models.images import ImageInput
from unitouch_gen.models.joint import UniTouchModel
from unitouch_gen.models.processing import UniTouchProcessor
from unitouch_gen.pipelines.base import check_filled

UNCLIP_PARTS = ("image_normalizer", "image_noising_scheduler", "unet", "scheduler", "vae")
SHARED_OPTIONS = ("cache_dir", "token", "local_files_only")  # of a fetch; others are of one repository alone
SAME_WEIGHTS = 0.01  # relative difference of weights that differ by their dtypes alone


def unclip_pipeline(
    kind: Any,
    unclip: str | os.PathLike,
    unitouch: str | os.PathLike | UniTouchModel,
    embedding_norm: float | None,
    images: ImageInput,
    dtype: torch.dtype,
    variant: str | None,
    hub: dict[str, Any],
) -> Any:
    """A pipeline of a diffusers unCLIP folder on a joint space; see `TouchToImagePipeline.from_published`."""
    model, processor = _joint(unitouch, dtype, hub)
    own = "image" in model.known_modalities
    unread = [*NEVER_READ, *([] if variant else ["*.fp16.*"]), *(["image_encoder/*"] if own else [])]
    folder = local_folder("unclip", unclip, **{"ignore_patterns": unread, **hub})
    missing = [part for part in UNCLIP_PARTS if not (folder / part).is_dir()]
    if missing:
        raise _lacking("unclip", folder, missing, "a diffusers unCLIP pipeline, such as Stable Diffusion 2.1 unCLIP")
    width = read_json("unclip", folder / "image_normalizer" / "config.json").get("embedding_dim")
    if width != model.config.projection_dim:
        raise InvalidInputError(
            f"`unitouch` has embeddings of width {model.config.projection_dim}, `unclip` of width {width}; use models "
            "of one width."
        )
    files = {"dtype": check_dtype("dtype", dtype), "variant": variant, "use_safetensors": True}
    with reading("unclip", folder):
        source = StableUnCLIPImg2ImgPipeline.from_pretrained(
            folder, **files, feature_extractor=None, image_encoder=None
        )
        for part in ("unet", "vae"):
            check_filled(folder / part, getattr(source, part))
        if own:
            warn_of_other_encoder(folder, model)
        elif (folder / "image_encoder").is_dir():
            encoder = CLIPVisionModelWithProjection.from_pretrained(folder / "image_encoder", **files)
            model.set_image_encoder(encoder)
    if processor.tokenizer is None and isinstance(source.tokenizer, CLIPTokenizer):
        processor.tokenizer = source.tokenizer
    if embedding_norm is None and images is None:
        # Mean m and deviation s of each component: the root mean square of the norm is sqrt(sum of m^2 + s^2).
        mean, std = (getattr(source.image_normalizer, name).detach().double() for name in ("mean", "std"))
        embedding_norm = math.sqrt(float((mean.square() + std.square()).sum()))
    _set_norm(model, processor, embedding_norm, images)
    return kind.from_pipe(source, unitouch=model, processor=processor)


def touch_pipeline(
    kind: Any,
    ldm: str | os.PathLike,
    unitouch: str | os.PathLike | UniTouchModel,
    sensors: Sequence[str],
    embedding_norm: float | None,
    images: ImageInput,
    dtype: torch.dtype,
    variant: str | None,
    hub: dict[str, Any],
) -> Any:
    """A pipeline of a latent diffusion model in diffusers' layout; see `XToTouchPipeline.from_published`."""
    model, processor = _joint(unitouch, dtype, hub)
    _set_norm(model, processor, embedding_norm, images)
    folder = local_folder("ldm", ldm, **hub)
    missing = [part for part in ("unet", "vae", "scheduler") if not (folder / part).is_dir()]
    if missing:
        raise _lacking("ldm", folder, missing, "a latent diffusion model of touch in diffusers' layout")
    files = {"dtype": check_dtype("dtype", dtype), "variant": variant, "use_safetensors": True}
    with reading("ldm", folder):
        vae = autoencoder_class("ldm/vae", read_json("ldm", folder / "vae" / "config.json").get("_class_name"))
        parts = {
            "unet": UNet2DConditionModel.from_pretrained(folder / "unet", **files).eval(),
            "vae": vae.from_pretrained(folder / "vae", **files).eval(),
        }
        for part, network in parts.items():
            check_filled(folder / part, network)
        scheduler = read_scheduler(folder / "scheduler")
    return kind(**parts, scheduler=scheduler, unitouch=model, processor=processor, sensors=sensors)


def read_scheduler(folder: Path) -> SchedulerMixin:
    """The scheduler of a checkpoint, of the class of diffusers that its config names."""
    name = DDIMScheduler.load_config(folder)["_class_name"]
    kind: Any = getattr(diffusers, name, None)
    if not (isinstance(kind, type) and issubclass(kind, SchedulerMixin)):
        raise InvalidInputError(f"`{folder}` names the scheduler {name!r}, which diffusers does not have.")
    return kind.from_pretrained(folder)


def _joint(
    unitouch: str | os.PathLike | UniTouchModel, dtype: torch.dtype, hub: dict[str, Any]
) -> tuple[UniTouchModel, UniTouchProcessor]:
    """A converted joint space, of which no encoder is read yet, and its processor."""
    if isinstance(unitouch, UniTouchModel):
        return unitouch, UniTouchProcessor.for_config(unitouch.config)
    shared = {name: hub[name] for name in SHARED_OPTIONS if name in hub}
    folder = local_folder("unitouch", unitouch, **shared)
    if not (folder / "config.json").is_file():
        raise _lacking("unitouch", folder, ["joint space"], "that `unitouch-gen convert unitouch` wrote")
    return UniTouchModel.from_pretrained(folder, dtype=dtype), UniTouchProcessor.from_pretrained(folder)


@torch.no_grad()
def _set_norm(
    model: UniTouchModel, processor: UniTouchProcessor, embedding_norm: float | None, images: ImageInput
) -> None:
    """Makes the norm of image embeddings the joint space's: a given one, or the mean of some pictures."""
    if embedding_norm is not None and images is not None:
        raise InvalidInputError("`embedding_norm` came beside `images`, which measure it; pass one of them.")
    if images is not None:
        embeds = model.get_image_features(processor.images(images, name="images"))
        embedding_norm = float(embeds.double().norm(dim=1).mean())
    if embedding_norm is not None:
        model.config.embedding_norm = check_number("embedding_norm", embedding_norm, sys.float_info.min)


def warn_of_other_encoder(folder: Path, model: UniTouchModel) -> None:
    """Warns where the unCLIP's image encoder is on disk and differs from the joint space's."""
    theirs: Tensor | None = None
    for file in sorted((folder / "image_encoder").glob("*.safetensors")):
        with safe_open(file, framework="pt") as weights:
            if "visual_projection.weight" in weights.keys():  # noqa: SIM118 - not a dict
                theirs = weights.get_tensor("visual_projection.weight").float()
    if theirs is None:
        return
    ours = model.load("image")[0].visual_projection.weight.detach().float().cpu()
    if theirs.shape != ours.shape or not float((theirs - ours).norm() / theirs.norm()) <= SAME_WEIGHTS:
        warnings.warn(
            "`unclip` brings another image encoder than `unitouch`, and its network was trained on embeddings of its "
            "own; pictures may not follow the touches. Use the unCLIP of that encoder.",
            UserWarning,
            stacklevel=4,
        )


def _lacking(name: str, folder: Path, missing: Sequence[str], wanted: str) -> InvalidInputError:
    return InvalidInputError(f"`{name}` is {str(folder)!r}, which holds no {', '.join(missing)}; pass {wanted}.")
