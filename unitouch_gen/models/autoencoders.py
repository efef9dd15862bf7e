"""Pixels to scaled latents and back, by any of diffusers' autoencoders.

Scaled latents are (raw - shift) * scaling_factor, of unit variance (Rombach et al., 2022, appendix G).
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeAlias

import torch
from diffusers import AutoencoderKL, AutoencoderTiny, VQModel
from torch import Tensor

from unitouch_gen.errors import check_choice
from unitouch_gen.files import read_network, read_settings

Autoencoder: TypeAlias = AutoencoderKL | AutoencoderTiny | VQModel

CLASSES: dict[str, Any] = {kind.__name__: kind for kind in (AutoencoderKL, AutoencoderTiny, VQModel)}


def autoencoder_class(argument: str, name: Any) -> Any:
    """The class of that name in diffusers' configurations; raises an `InvalidInputError` if there is none."""
    return CLASSES[check_choice(argument, name, CLASSES)]


def read_autoencoder(folder: Path) -> Autoencoder:
    """The autoencoder in a folder, frozen and in evaluation mode."""
    settings = read_settings("vae", folder / "config.json")
    kind = autoencoder_class("vae", settings.get("_class_name"))
    return read_network(kind, folder).requires_grad_(False)


def scale_factor(vae: Autoencoder) -> int:
    """Pixels along one side of a latent."""
    return 2 ** (len(vae.config.block_out_channels) - 1)


def encode_raw(vae: Autoencoder, pixels: Tensor) -> Tensor:
    """Pixels (B, 3, H, W) in [-1, 1] -> unscaled latents (B, C, h, w); the mode of an `AutoencoderKL`."""
    output = vae.encode(pixels)
    return output.latent_dist.mode() if isinstance(vae, AutoencoderKL) else output[0]


def encode(vae: Autoencoder, pixels: Tensor) -> Tensor:
    """Pixels (B, 3, H, W) in [-1, 1] -> scaled latents (B, C, h, w)."""
    raw = encode_raw(vae, pixels.to(vae.device, vae.dtype))
    return (raw - _shift(vae)) * vae.config.scaling_factor


def decode(vae: Autoencoder, latents: Tensor) -> Tensor:
    """Scaled latents (B, C, h, w) -> float32 pixels (B, 3, H, W), about [-1, 1]."""
    raw = (latents / vae.config.scaling_factor + _shift(vae)).to(vae.dtype)
    parts: Sequence[Tensor] = [raw]
    if raw.device.type == "cpu":
        # Channels-last convolutions take two thirds of the time, and 8 images fit in the cache.
        parts = raw.to(memory_format=torch.channels_last).split(8)
    pixels = torch.cat([vae.decode(part, return_dict=False)[0].float() for part in parts])
    return pixels.contiguous()  # users may call `view`


def _shift(vae: Autoencoder) -> float:
    return vae.config.get("shift_factor") or 0.0
