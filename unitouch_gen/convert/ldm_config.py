"""YAML files of CompVis' latent diffusion (Rombach et al., 2022) as configurations of diffusers.

A setting that would change what a network computes, and that diffusers' classes cannot express, is refused rather than
left out.
"""

import os
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import yaml
from diffusers import AutoencoderKL, VQModel

from unitouch_gen.errors import InvalidInputError, check_choice, check_integer, check_number, describe, first_line

Settings: TypeAlias = dict[str, Any]

NORM_GROUPS = 32
"""Of every group normalisation in CompVis' networks, and by default in diffusers'."""

LARGEST_FILE = 2**20
"""Bytes of a YAML file; published ones have 2 to 4 thousand, and what has more is likely the checkpoint."""

MOST_LEVELS, MOST_LAYERS, WIDEST = 12, 16, 2**16

AUTOENCODERS: dict[str, type[AutoencoderKL] | type[VQModel]] = {
    "AutoencoderKL": AutoencoderKL,
    "VQModelInterface": VQModel,
}
"""Classes of diffusers by those of CompVis."""

BETA_SCHEDULES = {"linear": "scaled_linear", "sqrt_linear": "linear", "cosine": "squaredcos_cap_v2"}
"""diffusers' names by CompVis', whose "linear" is linear in the root of beta."""

PARAMETERIZATIONS = {"eps": "epsilon", "x0": "sample", "v": "v_prediction"}

UNET_READ = (
    "in_channels", "out_channels", "model_channels", "num_res_blocks", "attention_resolutions", "channel_mult",
    "num_heads", "num_head_channels", "transformer_depth", "context_dim", "image_size", "use_scale_shift_norm",
    "use_linear_in_transformer",
)  # fmt: skip
UNET_INDIFFERENT = ("dropout", "use_checkpoint", "use_fp16", "use_bf16", "legacy", "use_new_attention_order",
                    "num_heads_upsample")  # fmt: skip
"""Matter to training alone, to memory, or to attention without conditions."""
UNET_FIXED = {"use_spatial_transformer": True, "conv_resample": True, "resblock_updown": False, "dims": 2,
              "num_classes": None, "n_embed": None, "disable_self_attentions": None, "num_attention_blocks": None,
              "disable_middle_self_attn": False}  # fmt: skip
UNET_DEFAULTS = {**UNET_FIXED, "use_spatial_transformer": False}
"""CompVis' own: without its spatial transformer a UNet attends to no condition."""

AUTOENCODER_READ = ("double_z", "z_channels", "resolution", "in_channels", "out_ch", "ch", "ch_mult", "num_res_blocks",
                    "attn_resolutions")  # fmt: skip
AUTOENCODER_INDIFFERENT = ("dropout",)
AUTOENCODER_FIXED = {"attn_type": "vanilla", "resamp_with_conv": True, "give_pre_end": False, "tanh_out": False,
                     "use_linear_attn": False}  # fmt: skip


@dataclass(frozen=True)
class Layout:
    """What a YAML file says, as diffusers calls it.

    Attributes:
        unet: Of a `UNet2DConditionModel`.
        autoencoder: Class of the first stage.
        vae: Its configuration, without `scaling_factor`.
        scheduler: Of a `DDIMScheduler`, with the noise it was trained on.
        scaling_factor: Of the latents; `None` where it was measured in training and is in the checkpoint.
    """

    unet: Settings
    autoencoder: type[AutoencoderKL] | type[VQModel]
    vae: Settings
    scheduler: Settings
    scaling_factor: float | None


@dataclass(frozen=True)
class Section:
    """A part of a YAML file that knows where it stands, for the messages."""

    place: str
    values: Mapping[str, Any]

    def name(self, key: str) -> str:
        return f"{self.place}.{key}"

    def section(self, key: str) -> "Section":
        found = self.values.get(key)
        if not isinstance(found, Mapping):
            what = "is missing" if key not in self.values else f"is {describe(found)}"
            raise InvalidInputError(
                f"`{self.name(key)}` {what}; it has to hold settings. Pass the YAML file of CompVis' latent diffusion "
                "that the checkpoint was trained with."
            )
        return Section(self.name(key), found)

    def network(self, key: str) -> tuple[str, "Section"]:
        """Name of the class and the section of its settings."""
        section = self.section(key)
        return str(section.values.get("target")).rpartition(".")[2], section.section("params")

    def number(self, key: str, default: float | None, low: float, high: float) -> float:
        value = self.values.get(key, default)
        if isinstance(value, str):  # YAML 1.1 takes 1e-4 for a string, as it holds no point
            with suppress(ValueError):  # refused below, as the string it is
                value = float(value)
        return check_number(self.name(key), value, low, high)

    def integer(self, key: str, default: int | None = None, low: int = 1, high: int = WIDEST) -> int:
        return check_integer(self.name(key), self.values.get(key, default), low, high)

    def integers(self, key: str, default: tuple[int, ...] | None, most: int, low: int = 1) -> list[int]:
        values = self.values.get(key, default)
        if not isinstance(values, list | tuple) or not low <= len(values) <= most:
            raise InvalidInputError(
                f"`{self.name(key)}` is {describe(values)}; it has to be a list of {low} to {most} integers."
            )
        return [check_integer(self.name(key), value, 1, WIDEST) for value in values]

    def flag(self, key: str, default: bool = False) -> bool:
        value = self.values.get(key, default)
        if not isinstance(value, bool):
            raise InvalidInputError(f"`{self.name(key)}` is {describe(value)}; it has to be true or false.")
        return value

    def choice(self, key: str, default: str, choices: Iterable[str]) -> str:
        return check_choice(self.name(key), self.values.get(key, default), choices)

    def check_known(
        self,
        read: tuple[str, ...],
        indifferent: tuple[str, ...],
        fixed: Mapping[str, Any],
        defaults: Mapping[str, Any] | None = None,
    ) -> None:
        """Refuses settings that are neither read nor of no consequence, and those that diffusers knows one value of."""
        for key in self.values:
            if key not in read and key not in indifferent and key not in fixed:
                raise InvalidInputError(
                    f"`{self.name(str(key))}` is no setting that this converter knows; remove it if it changes nothing "
                    "of what the network computes."
                )
        for key, needed in fixed.items():
            found = self.values.get(key, (defaults or fixed)[key])
            if found != needed:
                raise InvalidInputError(
                    f"`{self.name(key)}` is {describe(found)}; only {describe(needed)} can be converted, as diffusers' "
                    "network has no such part."
                )


def read_layout(config: str | os.PathLike) -> Layout:
    """What the YAML file of a latent diffusion model says.

    Args:
        config: Path of the file.

    Raises:
        InvalidInputError, InvalidTypeError: If it is no such file, or says what diffusers' classes cannot express.
    """
    model = Section("config", read_yaml(Path(config))).section("model").section("params")
    model.choice("conditioning_key", "crossattn", ["crossattn"])  # others put a picture beside the latents
    autoencoder, vae = vae_settings(model)
    unet = unet_settings(model)
    latents = vae.get("vq_embed_dim", vae["latent_channels"])
    if {unet["in_channels"], unet["out_channels"]} != {latents}:
        raise InvalidInputError(
            f"`config` has a UNet from {unet['in_channels']} to {unet['out_channels']} channels and latents of "
            f"{latents}; they have to be the same, as nothing is put beside the latents."
        )
    scale = None if model.flag("scale_by_std") else model.number("scale_factor", 1.0, 1e-6, 1e6)
    return Layout(unet, autoencoder, vae, scheduler_settings(model), scale)


def read_yaml(path: Path) -> Mapping[str, Any]:
    """The settings in a file.

    Raises:
        InvalidInputError: If it is not there, or no YAML, or no settings.
    """
    if not path.is_file():
        what = "is a folder" if path.is_dir() else "does not exist"
        raise InvalidInputError(f"`config` names {str(path)!r}, which {what}; pass the YAML file of the checkpoint.")
    size = path.stat().st_size
    if size > LARGEST_FILE:
        raise InvalidInputError(
            f"`config` names {str(path)!r}, which has {size} bytes; the YAML file of a checkpoint has a few thousand. "
            "Was `ldm` meant?"
        )
    try:
        found = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, ValueError, RecursionError, OSError) as error:  # ValueError: no UTF-8, or no such date
        raise InvalidInputError(
            f"`config` names {str(path)!r}, which cannot be read as YAML: {first_line(error)}."
        ) from error
    if not isinstance(found, Mapping):
        raise InvalidInputError(
            f"`config` names {str(path)!r}, which holds {describe(found)}; pass the YAML file of the checkpoint, which "
            "begins with `model:`."
        )
    return found


def unet_settings(model: Section) -> Settings:
    """Of a `UNet2DConditionModel`, from those of CompVis' `UNetModel`."""
    kind, unet = model.network("unet_config")
    check_choice(f"{model.name('unet_config')}.target", kind, ["UNetModel"])
    unet.check_known(UNET_READ, UNET_INDIFFERENT, UNET_FIXED, UNET_DEFAULTS)
    widths = widths_of(unet, "model_channels", "channel_mult", (1, 2, 4, 8))
    factors = unet.integers("attention_resolutions", None, MOST_LEVELS, low=0)
    if unknown := [factor for factor in factors if factor not in {2**level for level in range(len(widths))}]:
        raise InvalidInputError(
            f"`{unet.name('attention_resolutions')}` has {unknown[0]}; a UNet of {len(widths)} levels attends where it "
            f"is smaller by 1 to {2 ** (len(widths) - 1)}, in powers of 2."
        )
    attends = [2**level in factors for level in range(len(widths))]
    return {
        "sample_size": unet.integer("image_size", model.values.get("image_size", 32)),
        "in_channels": unet.integer("in_channels"),
        "out_channels": unet.integer("out_channels"),
        "block_out_channels": widths,
        "layers_per_block": unet.integer("num_res_blocks", high=MOST_LAYERS),
        "down_block_types": ["CrossAttnDownBlock2D" if cross else "DownBlock2D" for cross in attends],
        "up_block_types": ["CrossAttnUpBlock2D" if cross else "UpBlock2D" for cross in reversed(attends)],
        "cross_attention_dim": unet.integer("context_dim"),
        "attention_head_dim": heads_of(unet, widths, attends),  # numbers of heads: diffusers' name for them
        "transformer_layers_per_block": unet.integer("transformer_depth", 1, high=MOST_LAYERS),
        "use_linear_projection": unet.flag("use_linear_in_transformer"),
        "resnet_time_scale_shift": "scale_shift" if unet.flag("use_scale_shift_norm") else "default",
    }


def heads_of(unet: Section, widths: list[int], attends: list[bool]) -> list[int]:
    """Numbers of heads of each level, which CompVis gives as such or by the channels of one head."""
    channels, heads = (unet.values.get(key, -1) for key in ("num_head_channels", "num_heads"))
    if channels != -1:
        size = unet.integer("num_head_channels")
        per_level = [width // size for width in widths]
    elif heads != -1:
        per_level = [unet.integer("num_heads")] * len(widths)
    else:
        raise InvalidInputError(f"`{unet.name('num_heads')}` and `num_head_channels` are missing; one has to be there.")
    for level, (width, number) in enumerate(zip(widths, per_level)):
        used = attends[level] or level == len(widths) - 1  # the middle attends in any case
        if used and (not number or width % number or (channels != -1 and width % channels)):
            raise InvalidInputError(
                f"`{unet.name('num_heads' if channels == -1 else 'num_head_channels')}` is "
                f"{heads if channels == -1 else channels}, which does not divide the {width} channels of level {level}."
            )
    return [max(number, 1) for number in per_level]


def vae_settings(model: Section) -> tuple[type[AutoencoderKL] | type[VQModel], Settings]:
    """Class and configuration of the first stage, without `scaling_factor`."""
    kind, stage = model.network("first_stage_config")
    autoencoder = AUTOENCODERS[check_choice(f"{model.name('first_stage_config')}.target", kind, AUTOENCODERS)]
    networks = stage.section("ddconfig")
    networks.check_known(AUTOENCODER_READ, AUTOENCODER_INDIFFERENT, AUTOENCODER_FIXED)
    widths = widths_of(networks, "ch", "ch_mult", (1, 2, 4, 8))
    resolution = networks.integer("resolution")
    attends = networks.integers("attn_resolutions", (), MOST_LEVELS, low=0)
    if found := [resolution // 2**level for level in range(len(widths)) if resolution // 2**level in attends]:
        raise InvalidInputError(
            f"`{networks.name('attn_resolutions')}` has {found[0]}; only autoencoders that attend in their middle "
            "alone, as those of factor 4, can be converted."
        )
    latents, embedded = networks.integer("z_channels"), stage.integer("embed_dim")
    if networks.flag("double_z", True) != (autoencoder is AutoencoderKL):
        raise InvalidInputError(
            f"`{networks.name('double_z')}` is {autoencoder is VQModel}; it is true for AutoencoderKL, which encodes "
            "mean and variance, and false for VQ models."
        )
    settings = {
        "sample_size": resolution,
        "in_channels": networks.integer("in_channels"),
        "out_channels": networks.integer("out_ch"),
        "block_out_channels": widths,
        "layers_per_block": networks.integer("num_res_blocks", high=MOST_LAYERS),
        "down_block_types": ["DownEncoderBlock2D"] * len(widths),
        "up_block_types": ["UpDecoderBlock2D"] * len(widths),
        "latent_channels": latents,
    }
    if autoencoder is VQModel:
        return VQModel, {
            **settings,
            "num_vq_embeddings": stage.integer("n_embed", high=2**24),
            "vq_embed_dim": embedded,
        }
    if embedded != latents:
        raise InvalidInputError(
            f"`{stage.name('embed_dim')}` is {embedded} and `ddconfig.z_channels` {latents}; for AutoencoderKL only "
            "the same can be converted."
        )
    return AutoencoderKL, settings


def widths_of(section: Section, base: str, factors: str, default: tuple[int, ...]) -> list[int]:
    """Channels of each level."""
    width, levels = section.integer(base), section.integers(factors, default, MOST_LEVELS)
    if levels[0] != 1 or width % NORM_GROUPS:
        raise InvalidInputError(
            f"`{section.name(base)}` is {width} and `{factors}` begins with {levels[0]}; the first has to be a "
            f"multiple of {NORM_GROUPS} and the second begin with 1 to be converted."
        )
    return [width * level for level in levels]


def scheduler_settings(model: Section) -> Settings:
    """Of a `DDIMScheduler` that samples as CompVis' own does: timesteps begin at 1, the last step ends at alpha_0, and
    nothing is clipped.
    """
    return {
        "num_train_timesteps": model.integer("timesteps", 1000),
        "beta_start": model.number("linear_start", 1e-4, 1e-9, 1),
        "beta_end": model.number("linear_end", 2e-2, 1e-9, 1),
        "beta_schedule": BETA_SCHEDULES[model.choice("beta_schedule", "linear", BETA_SCHEDULES)],
        "prediction_type": PARAMETERIZATIONS[model.choice("parameterization", "eps", PARAMETERIZATIONS)],
        "clip_sample": False,
        "set_alpha_to_one": False,
        "steps_offset": 1,
    }
