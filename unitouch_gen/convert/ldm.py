"""Checkpoints of CompVis' latent diffusion (Rombach et al., 2022) as folders of diffusers: `unitouch-gen convert ldm`.

Tensors are renamed by diffusers' own converters. What those would leave out in silence is refused here by name.
"""

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from diffusers import DDIMScheduler, UNet2DConditionModel
from diffusers.loaders.single_file_utils import convert_ldm_unet_checkpoint, convert_ldm_vae_checkpoint
from diffusers.models.modeling_utils import ModelMixin
from diffusers.utils import SAFETENSORS_WEIGHTS_NAME
from torch import Tensor

from unitouch_gen.convert.checkpoints import (
    DTYPES,
    Checkpoint,
    bytes_of,
    counted,
    counting,
    open_checkpoint,
    promised,
    write_tensors,
)
from unitouch_gen.convert.ldm_config import Layout, Settings, read_layout
from unitouch_gen.errors import InvalidInputError, check_number, describe, first_of
from unitouch_gen.files import adding_to_folder

UNET = "model.diffusion_model."
VAE = "first_stage_model."
EMA = "model_ema."

NO_PART = ("first_stage_model.loss.", "first_stage_model.model_ema.")
"""Of the autoencoder: its discriminator and perceptual loss, and moving averages of weights that it was not used by."""

COUNTED = ".counted"
"""End of a name that stands for a block of a UNet and for none of its tensors."""

CODEBOOK = "quantize.embedding.weight"
"""Of a VQ model, of the same name in both layouts; diffusers' converter knows KL models alone."""

BUFFERS = (
    "betas", "alphas_cumprod", "alphas_cumprod_prev", "sqrt_alphas_cumprod", "sqrt_one_minus_alphas_cumprod",
    "log_one_minus_alphas_cumprod", "sqrt_recip_alphas_cumprod", "sqrt_recipm1_alphas_cumprod", "posterior_variance",
    "posterior_log_variance_clipped", "posterior_mean_coef1", "posterior_mean_coef2", "lvlb_weights", "logvar",
    "scale_factor",
)  # fmt: skip
"""Tensors of the schedule, which follow from `betas`, and the scale of latents."""

BETA_TOLERANCE = 1e-4
"""Of the schedule in a checkpoint, relative: CompVis computes it in float64 and diffusers in float32."""


@dataclass(frozen=True, eq=False)
class Network:
    """One converted network.

    Attributes:
        folder: Its name in a pipeline.
        skeleton: Of its class, without weights.
        tensors: By diffusers' names, as they are in the checkpoint.
        origins: Their names in the checkpoint, by diffusers'.
    """

    folder: str
    skeleton: ModelMixin
    tensors: Mapping[str, Tensor]
    origins: Mapping[str, str]


def convert_ldm(
    ldm: str | os.PathLike,
    config: str | os.PathLike,
    output: str | os.PathLike,
    ema: bool = False,
    told: Callable[[str], object] = print,
    written: Callable[[int, int], object] = lambda done, size: None,
) -> None:
    """Writes the folders `unet`, `vae` and `scheduler` of a latent diffusion model, for `XToTouchPipeline`.

    Latents are (B, C, H / f, W / f), scaled by `vae.config.scaling_factor`. Weights keep their dtype. The same input
    makes the same bytes.

    Args:
        ldm: Checkpoint in CompVis' layout: a pickle of tensors, with or without Lightning's wrapping, or safetensors.
        config: The YAML file that it was trained with.
        output: The folder; made if it is not there. Files of the same names are replaced.
        ema: Take the UNet's moving averages, `model_ema.*`, in place of its last weights.
        told: Gets lines on what was used, ignored and missed.
        written: Told how many bytes of how many are written.

    Raises:
        InvalidInputError, InvalidTypeError: If a file cannot be read, the two do not fit each other, weights are NaN or
            infinite, or the output cannot be written to; nothing is changed then.
    """
    layout = read_layout(config)
    checkpoint = open_checkpoint("ldm", ldm)
    check_schedule(checkpoint, layout.scheduler)
    scale, origin = scale_of(checkpoint, layout)
    networks = [
        convert_unet(checkpoint, layout.unet, ema),
        convert_vae(checkpoint, layout.autoencoder, {**layout.vae, "scaling_factor": scale}),
    ]
    for network in networks:
        check_values(checkpoint, network)
    promises = {
        network.folder: {name: promised(tensor) for name, tensor in network.tensors.items()} for network in networks
    }
    whole = sum(bytes_of(tensors.values()) for tensors in promises.values())
    count = counting(whole, written)
    with adding_to_folder("output", Path(output), whole) as folder:
        for network in networks:
            place = folder / network.folder
            place.mkdir()
            write_tensors(place / SAFETENSORS_WEIGHTS_NAME, promises[network.folder], count)
            network.skeleton.save_config(place)
        DDIMScheduler(**layout.scheduler).save_config(folder / "scheduler")
    for line in account(checkpoint.tensors, ema):
        told(line)
    told(f"Latents are scaled by {scale:g}, as the {origin} says")


# Networks -------------------------------------------------------------------------------------------------------------


def convert_unet(checkpoint: Checkpoint, settings: Settings, ema: bool = False) -> Network:
    """The UNet.

    Args:
        checkpoint: In CompVis' layout.
        settings: Of a `UNet2DConditionModel`.
        ema: Take moving averages.

    Raises:
        InvalidInputError: If the checkpoint has none of these settings.
    """
    part = part_of(checkpoint, UNET)
    named = {key: key for key in part}
    if ema:
        if not any(key.startswith(EMA) for key in checkpoint.tensors):
            raise InvalidInputError(
                f"`ema` is True, but `ldm` names {str(checkpoint.path)!r}, which has no {EMA + '*'!r}; leave `ema` out."
            )
        named = {key: ema_name(key) for key in part}
        part = {key: checkpoint.tensors[name] for key, name in named.items() if name in checkpoint.tensors}
        if lost := [f"{name!r} is missing" for name in named.values() if name not in checkpoint.tensors]:
            raise misfit(checkpoint, "moving averages do", lost)
    with torch.device("meta"):
        skeleton = UNet2DConditionModel(**settings)

    def convert(part: dict[str, Tensor]) -> dict[str, Tensor]:
        count = len(settings["block_out_channels"]) * (settings["layers_per_block"] + 1)
        numbers = {"input_blocks": count, "middle_block": 3, "output_blocks": count}
        # diffusers counts the blocks that are there: were one missing, it would leave out the last one, too
        all_counted = {f"{UNET}{name}.{i}{COUNTED}": torch.empty(0) for name, n in numbers.items() for i in range(n)}
        found = convert_ldm_unet_checkpoint({**part, **all_counted}, settings)
        return {name: tensor for name, tensor in found.items() if not name.endswith(COUNTED)}

    return renamed(checkpoint, "unet", skeleton, part, named, convert)


def ema_name(key: str) -> str:
    """Of the moving average of a UNet's tensor: it is a buffer, and names of buffers may have no dots."""
    return EMA + key.removeprefix("model.").replace(".", "")


def convert_vae(checkpoint: Checkpoint, kind: type[ModelMixin], settings: Settings) -> Network:
    """The autoencoder.

    Args:
        checkpoint: In CompVis' layout.
        kind: `AutoencoderKL` or `VQModel`.
        settings: Of it.

    Raises:
        InvalidInputError: If the checkpoint has none of these settings.
    """
    part = {key: tensor for key, tensor in part_of(checkpoint, VAE).items() if not key.startswith(NO_PART)}
    with torch.device("meta"):
        skeleton = kind(**settings)

    def convert(part: dict[str, Tensor]) -> dict[str, Tensor]:
        codebook = {CODEBOOK: part[VAE + CODEBOOK]} if VAE + CODEBOOK in part else {}
        return {**convert_ldm_vae_checkpoint(part, settings), **codebook}

    return renamed(checkpoint, "vae", skeleton, part, {key: key for key in part}, convert)


def part_of(checkpoint: Checkpoint, prefix: str) -> dict[str, Tensor]:
    """The tensors under a prefix.

    Raises:
        InvalidInputError: If there are none.
    """
    part = {key: tensor for key, tensor in checkpoint.tensors.items() if key.startswith(prefix)}
    if not part:
        held = counted(checkpoint.tensors, place_of)
        raise InvalidInputError(
            f"`ldm` names {str(checkpoint.path)!r}, which holds no {prefix + '*'!r} but {held}; pass a "
            "checkpoint of latent diffusion in CompVis' layout."
        )
    return part


def renamed(
    checkpoint: Checkpoint,
    folder: str,
    skeleton: ModelMixin,
    part: dict[str, Tensor],
    named: Mapping[str, str],
    convert: Callable[[dict[str, Tensor]], dict[str, Tensor]],
) -> Network:
    """A network whose every tensor is there, has its shape, and comes from one of the checkpoint.

    Args:
        checkpoint: For the messages.
        folder, skeleton: Of the network.
        part: Its tensors in CompVis' layout.
        named: Names in the checkpoint by those in `part`.
        convert: Renames them; diffusers' converters pass tensors on, or views of them.

    Raises:
        InvalidInputError: Otherwise, with the names of what does not fit.
    """
    places = {tensor.data_ptr(): key for key, tensor in part.items()}
    try:
        found = {name: tensor for name, tensor in convert(part).items() if tensor is not None}
        origins = {name: places[tensor.data_ptr()] for name, tensor in found.items()}
    except LookupError as error:  # what a converter takes for granted
        raise misfit(checkpoint, f"{folder} does", [f"{error} is missing or misshapen"]) from error
    needed = {name: tuple(tensor.shape) for name, tensor in skeleton.state_dict().items()}
    problems = [f"{name!r} (diffusers' name) is missing" for name in needed if name not in found]
    for name, tensor in found.items():
        key = origins[name]
        if name not in needed:
            problems.append(f"{named[key]!r} has no place")
        elif tuple(tensor.shape) != needed[name] or tensor.numel() != part[key].numel():
            problems.append(f"{named[key]!r} is {tuple(part[key].shape)}, which has to give {needed[name]}")
        elif tensor.dtype not in DTYPES or not tensor.is_floating_point():
            problems.append(f"{named[key]!r} is {describe(tensor)}, which has to be float32, float16 or bfloat16")
    passed_on = {tensor.data_ptr() for tensor in found.values()}
    problems += [f"{named[key]!r} has no place" for key, tensor in part.items() if tensor.data_ptr() not in passed_on]
    if problems:
        raise misfit(checkpoint, f"{folder} does", problems)
    return Network(folder, skeleton, found, {name: named[key] for name, key in origins.items()})


def misfit(checkpoint: Checkpoint, what: str, problems: list[str]) -> InvalidInputError:
    """An error with the first problems, and how many more there are."""
    return InvalidInputError(
        f"`ldm` names {str(checkpoint.path)!r}, whose {what} not fit `config`: {first_of(problems)}. Pass a checkpoint "
        "and the YAML file that it was trained with."
    )


def check_values(checkpoint: Checkpoint, network: Network) -> None:
    """Refuses weights that are NaN or infinite."""
    tensors = network.tensors.items()
    broken = [network.origins[name] for name, tensor in tensors if not bool(torch.isfinite(tensor).all())]
    if broken:
        raise InvalidInputError(
            f"`ldm` names {str(checkpoint.path)!r}, whose {network.folder} has NaN or infinite weights: "
            f"{first_of(broken, ', ')}. Its training broke down; pass an earlier checkpoint."
        )


# Schedule -------------------------------------------------------------------------------------------------------------


def check_schedule(checkpoint: Checkpoint, settings: Settings) -> None:
    """Refuses a configuration whose noise is not what the checkpoint was trained on, where that is known."""
    trained = checkpoint.tensors.get("betas")
    if trained is None:
        return
    betas = DDIMScheduler(**settings).betas
    precision = torch.finfo(trained.dtype).eps if trained.is_floating_point() else 0.0
    tolerance = max(BETA_TOLERANCE, precision)
    if trained.shape != betas.shape or not torch.allclose(trained.float(), betas, rtol=tolerance, atol=0):
        raise InvalidInputError(
            f"`config` says {len(betas)} timesteps with betas from {betas[0]:.4g} to {betas[-1]:.4g}, but `ldm` names "
            f"{str(checkpoint.path)!r}, which was trained on {span_of(trained)}; pass the YAML file of that training."
        )


def span_of(betas: Tensor) -> str:
    if betas.ndim != 1 or not betas.numel():
        return f"betas of shape {tuple(betas.shape)}"
    return f"{len(betas)} with betas from {float(betas[0]):.4g} to {float(betas[-1]):.4g}"


def scale_of(checkpoint: Checkpoint, layout: Layout) -> tuple[float, str]:
    """The factor of latents, and where it comes from: one that was measured in training is in the checkpoint.

    Raises:
        InvalidInputError: If it is in neither file, or not a positive number.
    """
    measured = checkpoint.tensors.get("scale_factor")
    if measured is not None and measured.numel() == 1:
        return check_number("ldm scale_factor", float(measured), 1e-6, 1e6), "checkpoint"
    if layout.scaling_factor is None:
        raise InvalidInputError(
            f"`config` says `scale_by_std: true`, but `ldm` names {str(checkpoint.path)!r}, which has no scale_factor "
            "that was measured; set `scale_by_std: false` and `scale_factor` in the YAML file."
        )
    return layout.scaling_factor, "configuration"


# Account --------------------------------------------------------------------------------------------------------------


def account(tensors: Mapping[str, Any], ema: bool) -> list[str]:
    """What was used, ignored and missed, in lines."""
    unet = [key for key in tensors if key.startswith(UNET)]
    first_stage = [key for key in tensors if key.startswith(VAE) and not key.startswith(NO_PART)]
    used = {*first_stage, *(map(ema_name, unet) if ema else unet), *({"betas", "scale_factor"} & set(tensors))}
    lines = [f"Used: {counted(used, place_of)}"]
    if ignored := [key for key in tensors if key not in used]:
        lines.append(f"Ignored: {counted(ignored, place_of)}")
    if not ema and any(key.startswith(EMA) for key in tensors):
        lines.append("The checkpoint has moving averages of the UNet, which `ema` would use in place of its weights")
    return [*lines, "Missed: the encoder of conditions, cond_stage_model; a joint space takes its place"]


def place_of(key: str) -> str:
    """What a key belongs to: "cond_stage_model", "schedule"."""
    loss = next((start for start in NO_PART if key.startswith(start)), None)
    return "schedule" if key in BUFFERS else (loss or f"{key.partition('.')[0]}.").rstrip(".")
