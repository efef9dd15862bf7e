"""Parts that others published: a converted joint space, an unCLIP pipeline, a latent diffusion model of touch."""

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
from diffusers.pipelines.stable_diffusion.stable_unclip_image_normalizer import StableUnCLIPImageNormalizer
from safetensors import safe_open
from transformers import CLIPVisionModelWithProjection

from unitouch_gen.errors import InvalidInputError, check_dtype, check_number
from unitouch_gen.files import NEVER_READ, local_folder, read_json, reading
from unitouch_gen.models.autoencoders import autoencoder_class
from unitouch_gen.models.images import ImageInput
from unitouch_gen.models.joint import UniTouchModel
from unitouch_gen.models.processing import UniTouchProcessor
from unitouch_gen.pipelines.base import check_filled

SHARED_OPTIONS = ("cache_dir", "token", "local_files_only")  # of fetches; `revision` is of one repository


def read_joint(
    unitouch: str | os.PathLike | UniTouchModel, dtype: torch.dtype, hub: dict[str, Any]
) -> tuple[UniTouchModel, UniTouchProcessor]:
    """A converted joint space, of which no encoder is read yet, and its processor."""
    if unknown := sorted(set(hub) - {*SHARED_OPTIONS, "revision"}):
        raise InvalidInputError(
            f"`{unknown[0]}` came; beside the named arguments there are `revision`, {', '.join(SHARED_OPTIONS)}."
        )
    if isinstance(unitouch, UniTouchModel):
        return unitouch, UniTouchProcessor.for_config(unitouch.config)
    folder = local_folder("unitouch", unitouch, **{name: hub[name] for name in SHARED_OPTIONS if name in hub})
    check_holds("unitouch", folder, ["config.json"], "a joint space that `unitouch-gen convert unitouch` wrote")
    dtype = check_dtype("dtype", dtype)
    return UniTouchModel.from_pretrained(folder, dtype=dtype), UniTouchProcessor.from_pretrained(folder)


def read_unclip(
    unclip: str | os.PathLike, model: UniTouchModel, dtype: torch.dtype, variant: str | None, hub: dict[str, Any]
) -> StableUnCLIPImg2ImgPipeline:
    """An unCLIP pipeline; its image encoder becomes the joint space's, if that one has none."""
    own = "image" in model.known_modalities
    unread = [*NEVER_READ, *([] if variant else ["*.fp16.*"]), *(["image_encoder/*"] if own else [])]
    folder = local_folder("unclip", unclip, **{"ignore_patterns": unread, **hub})
    parts = ["image_normalizer", "image_noising_scheduler", "unet", "scheduler", "vae"]
    check_holds("unclip", folder, parts, "a diffusers unCLIP pipeline, such as Stable Diffusion 2.1 unCLIP")
    width = read_json("unclip", folder / "image_normalizer" / "config.json").get("embedding_dim")
    if width != model.config.projection_dim:
        raise InvalidInputError(
            f"`unitouch` has embeddings of width {model.config.projection_dim}, `unclip` of width {width}; use models "
            "of one width."
        )
    files: dict[str, Any] = {"dtype": check_dtype("dtype", dtype), "variant": variant, "use_safetensors": True}
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
            model.vision_model = encoder
            model.config.vision_config = encoder.config
    return source


def read_ldm(ldm: str | os.PathLike, dtype: torch.dtype, variant: str | None, hub: dict[str, Any]) -> dict[str, Any]:
    """UNet, VAE and scheduler of a latent diffusion model in diffusers' layout."""
    folder = local_folder("ldm", ldm, **hub)
    check_holds("ldm", folder, ["unet", "vae", "scheduler"], "a latent diffusion model in diffusers' layout")
    files = {"dtype": check_dtype("dtype", dtype), "variant": variant, "use_safetensors": True}
    with reading("ldm", folder):
        kind = autoencoder_class("ldm/vae", read_json("ldm", folder / "vae" / "config.json").get("_class_name"))
        unet = UNet2DConditionModel.from_pretrained(folder / "unet", **files).eval()
        vae = kind.from_pretrained(folder / "vae", **files).eval()
        check_filled(folder / "unet", unet)
        check_filled(folder / "vae", vae)
        return {"unet": unet, "vae": vae, "scheduler": read_scheduler(folder / "scheduler")}


def read_scheduler(folder: Path) -> SchedulerMixin:
    """The scheduler of a checkpoint, of the class of diffusers that its config names."""
    name = DDIMScheduler.load_config(folder)["_class_name"]
    kind = getattr(diffusers, name, None)
    if not (isinstance(kind, type) and issubclass(kind, SchedulerMixin)):
        raise InvalidInputError(f"`{folder}` names the scheduler {name!r}, which diffusers does not have.")
    return getattr(diffusers, name).from_pretrained(folder)


def expected_norm(normalizer: StableUnCLIPImageNormalizer) -> float:
    """Root mean square of the norm of embeddings with mean m and deviation s: sqrt(sum of m^2 + s^2)."""
    mean, std = normalizer.mean.detach().double(), normalizer.std.detach().double()
    return math.sqrt(float((mean.square() + std.square()).sum()))


@torch.no_grad()
def set_norm(model: UniTouchModel, processor: UniTouchProcessor, norm: float | None, images: ImageInput) -> None:
    """Makes the norm of image embeddings the joint space's: a given one, or the mean of some pictures."""
    if norm is not None and images is not None:
        raise InvalidInputError("`embedding_norm` came beside `images`, which measure it; pass one of them.")
    if images is not None:
        norm = float(model.get_image_features(processor.images(images, name="images")).double().norm(dim=1).mean())
    if norm is not None:
        model.config.embedding_norm = check_number("embedding_norm", norm, sys.float_info.min)


def warn_of_other_encoder(folder: Path, model: UniTouchModel) -> None:
    """Warns where the unCLIP's image encoder is on disk and differs from the joint space's."""
    key = "visual_projection.weight"
    for file in (folder / "image_encoder").glob("*.safetensors"):
        with safe_open(file, framework="pt") as weights:
            if key not in weights.keys():  # noqa: SIM118 - not a dict
                continue
            theirs = weights.get_tensor(key).float()
        ours = model.load("image")[0].visual_projection.weight.detach().float().cpu()
        # Weights that differ by their dtypes alone are within 1 % of each other.
        if theirs.shape != ours.shape or not float((theirs - ours).norm() / theirs.norm()) <= 0.01:
            warnings.warn(
                "`unclip` brings another image encoder than `unitouch`, and its network was trained on embeddings of "
                "its own; pictures may not follow the touches. Use the unCLIP of that encoder.",
                UserWarning,
                stacklevel=4,
            )
        return


def check_holds(name: str, folder: Path, parts: Sequence[str], wanted: str) -> None:
    """Raises unless a folder holds some parts."""
    if missing := [part for part in parts if not (folder / part).exists()]:
        raise InvalidInputError(f"`{name}` is {str(folder)!r}, which holds no {', '.join(missing)}; pass {wanted}.")
