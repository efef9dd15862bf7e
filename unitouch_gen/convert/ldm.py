"""Checkpoints of CompVis' latent diffusion (Rombach et al., 2022) as folders of diffusers: `unitouch-gen convert ldm`.

diffusers' own readers of such files rename the tensors and the settings. What they would leave out in silence is
refused here by name: settings that diffusers' classes cannot express, tensors without a place, weights not finite.
"""

import os
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import torch
from diffusers import AutoencoderKL, DDIMScheduler, UNet2DConditionModel, VQModel
from diffusers.loaders import single_file_utils as diffusers_readers
from diffusers.models.modeling_utils import ModelMixin
from diffusers.utils import SAFETENSORS_WEIGHTS_NAME
from torch import Tensor

from unitouch_gen.convert.checkpoints import DTYPES, LazyTensor, counted, open_checkpoint, size_of, write_tensors
from unitouch_gen.errors import (
    InvalidInputError,
    check_choice,
    check_flag,
    check_integer,
    check_number,
    describe,
    first_of,
)
from unitouch_gen.files import as_path, read_yaml, writing_folder

Settings: TypeAlias = dict[str, Any]

UNET, VAE, EMA = "model.diffusion_model.", "first_stage_model.", "model_ema."

NO_PART = ("first_stage_model.loss.", "first_stage_model.model_ema.")
"""The autoencoder's discriminator and perceptual loss, and moving averages of weights that it was not used by."""

CODEBOOK = "quantize.embedding.weight"
"""The entries of a VQ model, of the same name in both layouts."""

COUNTED = ".counted"
"""End of a name that stands for a block of a UNet and for none of its tensors."""

BETA_TOLERANCE = 1e-4
"""Relative difference of a checkpoint's betas from diffusers', which are computed in float32, CompVis' in float64."""

NORM_GROUPS = 32
"""Groups of every normalisation in CompVis' networks, and by default in diffusers'."""

MOST_LEVELS, WIDEST = 12, 2**16

BOUNDS: dict[str, tuple[float, float]] = {
    "num_res_blocks": (1, 16), "transformer_depth": (1, 16), "n_embed": (1, 2**24),
    "linear_start": (1e-9, 1), "linear_end": (1e-9, 1), "scale_factor": (1e-6, 1e6),
}  # fmt: skip
"""Least and largest value of numbers that are not from 1 to `WIDEST`."""

AUTOENCODERS: dict[str, type[AutoencoderKL] | type[VQModel]] = {
    "AutoencoderKL": AutoencoderKL,
    "VQModelInterface": VQModel,
}
"""Classes of diffusers by those of CompVis."""

BETA_SCHEDULES = {"linear": "scaled_linear", "sqrt_linear": "linear", "cosine": "squaredcos_cap_v2"}
"""diffusers' names by CompVis', whose "linear" is linear in the root of beta."""

PARAMETERIZATIONS = {"eps": "epsilon", "x0": "sample", "v": "v_prediction"}

UNET_READ = {
    "in_channels": int, "out_channels": int, "model_channels": int, "num_res_blocks": int,
    "attention_resolutions": list, "channel_mult": [1, 2, 4, 8], "transformer_depth": 1, "context_dim": int,
    "image_size": int, "use_scale_shift_norm": False, "use_linear_in_transformer": False,
}  # fmt: skip
"""Settings of a network with their defaults, or with the kind of those that have to be there."""

UNET_FIXED = {
    "use_spatial_transformer": True, "conv_resample": True, "resblock_updown": False, "dims": 2, "num_classes": None,
    "n_embed": None, "disable_self_attentions": None, "num_attention_blocks": None, "disable_middle_self_attn": False,
}  # fmt: skip
"""Settings of which diffusers' networks know one value; they have it where they are left out."""

UNET_OTHERS = (
    "num_heads", "num_head_channels",  # one of which is there
    "dropout", "use_checkpoint", "use_fp16", "use_bf16", "legacy", "use_new_attention_order", "num_heads_upsample",
)  # fmt: skip
"""Settings that are read by themselves, and that matter to training, to memory or to attention without conditions."""

AUTOENCODER_READ = {
    "double_z": True, "z_channels": int, "resolution": int, "in_channels": int, "out_ch": int, "ch": int,
    "ch_mult": [1, 2, 4, 8], "num_res_blocks": int, "attn_resolutions": [],
}  # fmt: skip
AUTOENCODER_FIXED = {
    "attn_type": "vanilla", "resamp_with_conv": True, "give_pre_end": False, "tanh_out": False,
    "use_linear_attn": False,
}  # fmt: skip


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
    layout, place, ema = read_layout(config), as_path("output", output), check_flag("ema", ema)
    tensors = open_checkpoint("ldm", ldm)
    source = f"`ldm` names {str(ldm)!r}"
    check_schedule(source, tensors, layout.scheduler)
    scale, origin = scale_of(source, tensors, layout.scaling_factor)
    with torch.device("meta"):
        models: dict[str, ModelMixin] = {
            "unet": UNet2DConditionModel(**layout.unet),
            "vae": layout.autoencoder(**{**layout.vae, "scaling_factor": scale}),
        }
    weights = {
        "unet": renamed(source, "unet", models["unet"], unet_of(source, tensors, ema), rename_unet),
        "vae": renamed(source, "vae", models["vae"], vae_of(source, tensors), rename_vae),
    }
    for folder, found in weights.items():
        if broken := [name for name, tensor in found.values() if not bool(torch.isfinite(tensor).all())]:
            raise InvalidInputError(
                f"{source}, whose {folder} has NaN or infinite weights: {first_of(broken, ', ')}. Its training broke "
                "down; pass an earlier checkpoint."
            )
    files = {
        f"{folder}/{SAFETENSORS_WEIGHTS_NAME}": {key: LazyTensor.of(tensor) for key, (_, tensor) in found.items()}
        for folder, found in weights.items()
    }
    with writing_folder("output", place, size_of(files)) as place:
        write_tensors(place, files, written)
        for folder, model in models.items():
            model.save_config(place / folder)
        DDIMScheduler(**layout.scheduler).save_config(place / "scheduler")
    for line in account(tensors, ema):
        told(line)
    told(f"Latents are scaled by {scale:g}, as the {origin} says")


# Settings -------------------------------------------------------------------------------------------------------------


class Layout(NamedTuple):
    """What a YAML file says, as settings of diffusers' classes."""

    unet: Settings  # of a UNet2DConditionModel
    autoencoder: type[AutoencoderKL] | type[VQModel]
    vae: Settings  # of it, but for its `scaling_factor`
    scheduler: Settings  # of a DDIMScheduler
    scaling_factor: float | None  # of the latents; `None` where it was measured in training and is in the checkpoint


@dataclass(frozen=True)
class Section:
    """A part of a YAML file that knows where it stands, for the messages."""

    place: str
    values: Mapping[str, Any]

    def section(self, *keys: str) -> "Section":
        """The part under a key, and under others in it."""
        found = self
        for key in keys:
            name, values = f"{found.place}.{key}", found.values.get(key)
            if not isinstance(values, Mapping):
                what = "is missing" if key not in found.values else f"is {describe(values)}"
                raise InvalidInputError(
                    f"`{name}` {what}; it has to hold settings. Pass the YAML file of CompVis' latent diffusion that "
                    "the checkpoint was trained with."
                )
            found = Section(name, values)
        return found

    def get(self, key: str, default: Any, choices: Iterable[str] = ()) -> Any:
        """A setting of the kind of its default, or of the kind itself where that came in its place."""
        required = isinstance(default, type)
        kind = default if required else type(default)
        name, value = f"{self.place}.{key}", self.values.get(key, None if required else default)
        low, high = BOUNDS.get(key, (1, WIDEST))
        if kind is int:
            return check_integer(name, value, int(low), int(high))
        if kind is float:
            if isinstance(value, str):  # YAML 1.1 takes 1e-4 for a string, as it holds no point
                with suppress(ValueError):  # refused below, as the string it is
                    value = float(value)
            return check_number(name, value, low, high)
        if kind is str:
            return check_choice(name, value, choices)
        if kind is bool:
            if not isinstance(value, bool):
                raise InvalidInputError(f"`{name}` is {describe(value)}; it has to be true or false.")
            return value
        least = 0 if key.endswith("resolutions") else 1
        if not isinstance(value, list | tuple) or not least <= len(value) <= MOST_LEVELS:
            raise InvalidInputError(
                f"`{name}` is {describe(value)}; it has to be a list of {least} to {MOST_LEVELS} integers."
            )
        return [check_integer(name, item, 1, WIDEST) for item in value]

    def network(
        self, read: Mapping[str, Any], fixed: Mapping[str, Any], others: tuple[str, ...], base: str, factors: str
    ) -> tuple[Settings, list[int]]:
        """The settings of a network, and the channels of its levels: `base` times `factors`."""
        for key in self.values:
            if key not in read and key not in fixed and key not in others:
                raise InvalidInputError(
                    f"`{self.place}.{key}` is no setting that this converter knows; remove it if it changes nothing of "
                    "what the network computes."
                )
        for key, needed in fixed.items():
            if (value := self.values.get(key, needed)) != needed:
                raise InvalidInputError(
                    f"`{self.place}.{key}` is {describe(value)}; only {describe(needed)} can be converted, as "
                    "diffusers' network has no such part."
                )
        found = {key: self.get(key, default) for key, default in read.items()}
        if found[factors][0] != 1 or found[base] % NORM_GROUPS:
            raise InvalidInputError(
                f"`{self.place}.{base}` is {found[base]} and `{factors}` begins with {found[factors][0]}; the first "
                f"has to be a multiple of {NORM_GROUPS} and the second begin with 1 to be converted."
            )
        return found, [found[base] * factor for factor in found[factors]]


def read_layout(config: str | os.PathLike) -> Layout:
    """What the YAML file of a latent diffusion model says.

    Args:
        config: Path of the file.

    Raises:
        InvalidInputError, InvalidTypeError: If it is no such file, or says what diffusers' classes cannot express.
    """
    model = Section("config", read_yaml("config", as_path("config", config))).section("model", "params")
    model.get("conditioning_key", "crossattn", ["crossattn"])  # others put a picture beside the latents
    autoencoder, stage, codebook = first_stage_settings(model)
    unet = unet_settings(model)
    latents = codebook.get("vq_embed_dim", stage["z_channels"])
    if {unet["in_channels"], unet["out_channels"]} != {latents}:
        raise InvalidInputError(
            f"`config` has a UNet from {unet['in_channels']} to {unet['out_channels']} channels and latents of "
            f"{latents}; they have to be the same, as nothing is put beside the latents."
        )
    networks = {"unet_config": {"params": unet}, "first_stage_config": {"params": {"ddconfig": stage}}}
    # of the checkpoint, diffusers would but guess the sizes of pictures, which the YAML file says
    files = {"original_config": {"model": {"params": networks}}, "checkpoint": {}}
    return Layout(
        unet={
            **diffusers_readers.create_unet_diffusers_config_from_ldm(**files),
            "sample_size": unet["image_size"],
            "resnet_time_scale_shift": "scale_shift" if unet["use_scale_shift_norm"] else "default",
        },
        autoencoder=autoencoder,
        vae={
            **diffusers_readers.create_vae_diffusers_config_from_ldm(**files),
            "sample_size": stage["resolution"],
            **codebook,
        },
        scheduler={  # one that samples as CompVis' own does: timesteps begin at 1, and the last step ends at alpha_0
            "num_train_timesteps": model.get("timesteps", 1000),
            "beta_start": model.get("linear_start", 1e-4),
            "beta_end": model.get("linear_end", 2e-2),
            "beta_schedule": BETA_SCHEDULES[model.get("beta_schedule", "linear", BETA_SCHEDULES)],
            "prediction_type": PARAMETERIZATIONS[model.get("parameterization", "eps", PARAMETERIZATIONS)],
            "clip_sample": False,
            "set_alpha_to_one": False,
            "steps_offset": 1,
        },
        scaling_factor=None if model.get("scale_by_std", False) else model.get("scale_factor", 1.0),
    )


def check_target(model: Section, key: str, known: Iterable[str]) -> str:
    """Name of a network's class, without its module."""
    name = str(model.section(key).values.get("target")).rpartition(".")[2]
    return check_choice(f"{model.place}.{key}.target", name, known)


def unet_settings(model: Section) -> Settings:
    """Settings of CompVis' `UNetModel`, with numbers of heads for each level: CompVis gives them, or their channels."""
    section = model.section("unet_config", "params")
    check_target(model, "unet_config", ["UNetModel"])
    # CompVis' defaults; without its spatial transformer a UNet attends to no condition
    defaults = {"use_spatial_transformer": False, "image_size": model.values.get("image_size", 32)}
    unet = Section(section.place, {**defaults, **section.values})
    found, widths = unet.network(UNET_READ, UNET_FIXED, UNET_OTHERS, "model_channels", "channel_mult")
    factors = [2**level for level in range(len(widths))]
    if unknown := [factor for factor in found["attention_resolutions"] if factor not in factors]:
        raise InvalidInputError(
            f"`{unet.place}.attention_resolutions` has {unknown[0]}; a UNet of {len(widths)} levels attends where it "
            f"is smaller by 1 to {factors[-1]}, in powers of 2."
        )
    key = next((key for key in ("num_head_channels", "num_heads") if unet.values.get(key, -1) != -1), None)
    if key is None:
        raise InvalidInputError(f"`{unet.place}.num_heads` and `num_head_channels` are missing; one has to be there.")
    number = unet.get(key, int)
    for level, width in enumerate(widths):
        attends = factors[level] in found["attention_resolutions"] or level == len(widths) - 1  # so does the middle
        if attends and width % number:
            raise InvalidInputError(
                f"`{unet.place}.{key}` is {number}, which does not divide the {width} channels of level {level}."
            )
    return {**found, "num_heads": [number if key == "num_heads" else max(width // number, 1) for width in widths]}


def first_stage_settings(model: Section) -> tuple[type[AutoencoderKL] | type[VQModel], Settings, Settings]:
    """diffusers' class of the first stage, settings of CompVis' networks in it, and diffusers' of a codebook."""
    stage = model.section("first_stage_config", "params")
    kind = AUTOENCODERS[check_target(model, "first_stage_config", AUTOENCODERS)]
    section = stage.section("ddconfig")
    found, widths = section.network(AUTOENCODER_READ, AUTOENCODER_FIXED, ("dropout",), "ch", "ch_mult")
    sizes = [found["resolution"] // 2**level for level in range(len(widths))]
    if attends := [size for size in sizes if size in found["attn_resolutions"]]:
        raise InvalidInputError(
            f"`{section.place}.attn_resolutions` has {attends[0]}; only autoencoders that attend in their middle "
            "alone, as those of factor 4, can be converted."
        )
    embedded = stage.get("embed_dim", int)
    if found["double_z"] != (kind is AutoencoderKL):
        raise InvalidInputError(
            f"`{section.place}.double_z` is {found['double_z']}; it is true for AutoencoderKL, which encodes mean and "
            "variance, and false for VQ models."
        )
    if kind is VQModel:
        return kind, found, {"num_vq_embeddings": stage.get("n_embed", int), "vq_embed_dim": embedded}
    if embedded != found["z_channels"]:
        raise InvalidInputError(
            f"`{stage.place}.embed_dim` is {embedded} and `ddconfig.z_channels` {found['z_channels']}; for "
            "AutoencoderKL only the same can be converted."
        )
    return kind, found, {}


# Weights --------------------------------------------------------------------------------------------------------------

Weights: TypeAlias = dict[str, tuple[str, Tensor]]
"""By CompVis' or diffusers' names, the names in the checkpoint and the tensors as they are there."""


def unet_of(source: str, tensors: Mapping[str, Tensor], ema: bool) -> Weights:
    """The UNet's weights, or their moving averages, by CompVis' names."""
    part = part_of(source, tensors, UNET)
    if not ema:
        return part
    if not any(key.startswith(EMA) for key in tensors):
        raise InvalidInputError(f"`ema` is True, but {source}, which has no {EMA + '*'!r}; leave `ema` out.")
    if lost := [f"{ema_name(key)!r} is missing" for key in part if ema_name(key) not in tensors]:
        raise misfit(source, "moving averages do", lost)
    return {key: (ema_name(key), tensors[ema_name(key)]) for key in part}


def vae_of(source: str, tensors: Mapping[str, Tensor]) -> Weights:
    """The autoencoder's weights by CompVis' names."""
    return {key: weight for key, weight in part_of(source, tensors, VAE).items() if not key.startswith(NO_PART)}


def part_of(source: str, tensors: Mapping[str, Tensor], prefix: str) -> Weights:
    """The tensors under a prefix, which a checkpoint has to have."""
    part = {key: (key, tensor) for key, tensor in tensors.items() if key.startswith(prefix)}
    if not part:
        raise InvalidInputError(
            f"{source}, which holds no {prefix + '*'!r} but {counted(tensors, place_of)}; pass a checkpoint of latent "
            "diffusion in CompVis' layout."
        )
    return part


def ema_name(key: str) -> str:
    """Name of the moving average of a UNet's tensor: it is a buffer, and names of buffers may have no dots."""
    return EMA + key.removeprefix("model.").replace(".", "")


def rename_unet(part: dict[str, Tensor], config: Mapping[str, Any]) -> dict[str, Tensor]:
    """A UNet's tensors by diffusers' names."""
    count = len(config["block_out_channels"]) * (config["layers_per_block"] + 1)
    numbers = {"input_blocks": count, "middle_block": 3, "output_blocks": count}
    # diffusers counts the blocks that are there: were one missing, it would leave out the last one, too
    all_counted = {f"{UNET}{name}.{i}{COUNTED}": torch.empty(0) for name, n in numbers.items() for i in range(n)}
    found = diffusers_readers.convert_ldm_unet_checkpoint({**part, **all_counted}, config)
    return {name: tensor for name, tensor in found.items() if not name.endswith(COUNTED)}


def rename_vae(part: dict[str, Tensor], config: Mapping[str, Any]) -> dict[str, Tensor]:
    """An autoencoder's tensors by diffusers' names; its reader knows no codebook."""
    codebook = {CODEBOOK: part[VAE + CODEBOOK]} if VAE + CODEBOOK in part else {}
    return {**diffusers_readers.convert_ldm_vae_checkpoint(part, config), **codebook}


def renamed(
    source: str,
    folder: str,
    model: ModelMixin,
    part: Weights,
    rename: Callable[[dict[str, Tensor], Mapping[str, Any]], dict[str, Tensor]],
) -> Weights:
    """All weights of a model, by diffusers' names.

    diffusers' readers pass the tensors of `part` on, or views of them, by whose addresses they are known again. One
    that is missing, misshapen or without a place is refused, by its name in the checkpoint.
    """
    places = {tensor.data_ptr(): (name, tensor) for name, tensor in part.values()}
    try:
        converted = rename({key: tensor for key, (_, tensor) in part.items()}, model.config)
        found = {name: tensor for name, tensor in converted.items() if tensor is not None}
        origins = {name: places[tensor.data_ptr()] for name, tensor in found.items()}
    except LookupError as error:  # what a reader takes for granted
        raise misfit(source, f"{folder} does", [f"{error} is missing or misshapen"]) from error
    needed = {name: tuple(tensor.shape) for name, tensor in model.state_dict().items()}
    problems = [f"{name!r} (diffusers' name) is missing" for name in needed if name not in found]
    for name, tensor in found.items():
        origin, whole = origins[name]
        if name not in needed:
            problems.append(f"{origin!r} has no place")
        elif tuple(tensor.shape) != needed[name] or tensor.numel() != whole.numel():
            problems.append(f"{origin!r} is {tuple(whole.shape)}, which has to give {needed[name]}")
        elif tensor.dtype not in DTYPES or not tensor.is_floating_point():
            problems.append(f"{origin!r} is {describe(tensor)}, which has to be float32, float16 or bfloat16")
    passed_on = {tensor.data_ptr() for tensor in found.values()}
    problems += [f"{name!r} has no place" for name, tensor in part.values() if tensor.data_ptr() not in passed_on]
    if problems:
        raise misfit(source, f"{folder} does", problems)
    return {name: (origins[name][0], tensor) for name, tensor in found.items()}


def misfit(source: str, what: str, problems: list[str]) -> InvalidInputError:
    """An error with the first problems, and how many more there are."""
    return InvalidInputError(
        f"{source}, whose {what} not fit `config`: {first_of(problems)}. Pass a checkpoint and the YAML file that it "
        "was trained with."
    )


# Schedule, and account ------------------------------------------------------------------------------------------------


def check_schedule(source: str, tensors: Mapping[str, Tensor], settings: Settings) -> None:
    """Refuses a configuration whose noise is not what the checkpoint was trained on, where that is known."""
    trained = tensors.get("betas")
    if trained is None:
        return
    betas = DDIMScheduler(**settings).betas
    tolerance = max(BETA_TOLERANCE, torch.finfo(trained.dtype).eps if trained.is_floating_point() else 0.0)
    if trained.shape == betas.shape and torch.allclose(trained.float(), betas, rtol=tolerance, atol=0):
        return
    span = f"betas of shape {tuple(trained.shape)}"
    if trained.ndim == 1 and trained.numel():
        span = f"{len(trained)} with betas from {float(trained[0]):.4g} to {float(trained[-1]):.4g}"
    raise InvalidInputError(
        f"`config` says {len(betas)} timesteps with betas from {betas[0]:.4g} to {betas[-1]:.4g}, but {source}, which "
        f"was trained on {span}; pass the YAML file of that training."
    )


def scale_of(source: str, tensors: Mapping[str, Tensor], said: float | None) -> tuple[float, str]:
    """The factor of latents, and where it comes from: one that was measured in training is in the checkpoint."""
    measured = tensors.get("scale_factor")
    if measured is not None and measured.numel() == 1:
        return check_number("ldm scale_factor", float(measured), *BOUNDS["scale_factor"]), "checkpoint"
    if said is None:
        raise InvalidInputError(
            f"`config` says `scale_by_std: true`, but {source}, which has no scale_factor that was measured; set "
            "`scale_by_std: false` and `scale_factor` in the YAML file."
        )
    return said, "configuration"


def account(tensors: Mapping[str, Tensor], ema: bool) -> list[str]:
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
    """What a key belongs to: "cond_stage_model", or "schedule", whose tensors are the model's own."""
    loss = next((start for start in NO_PART if key.startswith(start)), None)
    return "schedule" if "." not in key else (loss or f"{key.partition('.')[0]}.").rstrip(".")
