"""Between pixels and the latents of denoising networks: one convention over diffusers' autoencoders.

Scaled latents are (raw - shift) * scaling_factor, of unit variance (Rombach et al., 2022, appendix G).
"""

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
    """The autoencoder that a stage left in a folder, in evaluation mode and frozen."""
    kind = autoencoder_class("vae", read_settings("vae", folder / "config.json").get("_class_name"))
    return read_network(kind, folder).requires_grad_(False)


def scale_factor(vae: Autoencoder) -> int:
    """Pixels along one side of a latent."""
    return 2 ** (len(vae.config.block_out_channels) - 1)


def encode_raw(vae: Autoencoder, pixels: Tensor) -> Tensor:
    """Pixels (B, 3, H, W) in [-1, 1] -> latents (B, C, h, w) as the autoencoder gives them; of a KL model the mode."""
    output = vae.encode(pixels)
    return output.latent_dist.mode() if isinstance(vae, AutoencoderKL) else output[0]


def encode(vae: Autoencoder, pixels: Tensor) -> Tensor:
    """Pixels (B, 3, H, W) in [-1, 1] -> scaled latents (B, C, h, w)."""
    raw = encode_raw(vae, pixels.to(vae.device, vae.dtype))
    return (raw - _shift(vae)) * vae.config.scaling_factor


def decode(vae: Autoencoder, latents: Tensor) -> Tensor:
    """Scaled latents (B, C, h, w) -> float32 pixels (B, 3, H, W), about [-1, 1]."""
    raw = (latents / vae.config.scaling_factor + _shift(vae)).to(vae.dtype)
    # On a CPU, channels-last convolutions take two thirds of the time, and parts of 8 stay in its caches.
    parts = raw.to(memory_format=torch.channels_last).split(8) if raw.device.type == "cpu" else [raw]
    pixels = torch.cat([vae.decode(part, return_dict=False)[0].float() for part in parts])
    return pixels.contiguous()  # users may call `view`


def _shift(vae: Autoencoder) -> float:
    return vae.config.get("shift_factor") or 0.0
