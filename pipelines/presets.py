"""Full-size models by name, with random weights: to load checkpoints into, to train, and to measure."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch

from unitouch_gen.errors import check_choice, check_device, check_dtype, check_integer
from unitouch_gen.files import LOADING
from unitouch_gen.models import MODALITIES, UniTouchConfig, UniTouchModel
from unitouch_gen.models.config import FULL_SIZES
from unitouch_gen.models.presets import (
    embedding_noise,
    touch_ldm_networks,
    touch_ldm_scheduler,
    unclip_networks,
    unclip_scheduler,
)
from unitouch_gen.pipelines.touch_to_image import TouchToImagePipeline
from unitouch_gen.pipelines.x_to_touch import XToTouchPipeline

PRESETS: dict[str, str] = {
    "unitouch-vit-l": "the paper's touch encoder, a ViT-L with tokens of three sensors",
    "imagebind-huge": "image, text and audio of ImageBind, and touch beside them",
    "sd21-unclip": "Stable Diffusion 2.1 unCLIP: 768 x 768 pictures",
    "touch-ldm-f4": "latent diffusion of touch on a VQ-f4 autoencoder: 256 x 256 touches",
}
"""Names of full-size models, and what each is."""


def preset(
    name: str, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32, seed: int = 0
) -> UniTouchModel | TouchToImagePipeline | XToTouchPipeline:
    """A model of the published size, with random weights.

    "unitouch-vit-l" and "imagebind-huge" are `UniTouchModel`s, the first with its touch encoder alone. "sd21-unclip" is
    a `TouchToImagePipeline` and "touch-ldm-f4" an `XToTouchPipeline`, both without joint space and tokenizer: they take
    embeddings. `TouchToImagePipeline.from_pipe(pipe, unitouch=...)` adds a joint space.

    Args:
        name: One of `PRESETS`.
        device: Where it is made; "meta" takes no memory, and tells names and shapes.
        dtype: Of the weights, which are drawn in it: none are ever there in another.
        seed: Of the weights; torch's own generator stays as it is.

    Raises:
        InvalidInputError: If there is no such model or device.
        InvalidTypeError: If `dtype` is not one of floating-point numbers, or `seed` no integer.

    Example:
        >>> pipe = preset("sd21-unclip", device="meta")
        >>> pipe.unet.config.cross_attention_dim
        1024
    """
    check_choice("name", name, PRESETS)
    with made_in(device, dtype, seed):
        if name == "sd21-unclip":
            unclip: dict[str, Any] = unclip_networks()
            noise = {"scheduler": unclip_scheduler(), "image_noising_scheduler": embedding_noise()}
            return TouchToImagePipeline(**unclip, **noise)
        if name == "touch-ldm-f4":
            touch_ldm: dict[str, Any] = touch_ldm_networks()
            return XToTouchPipeline(**touch_ldm, scheduler=touch_ldm_scheduler())
        modalities = ("touch",) if name == "unitouch-vit-l" else MODALITIES
        return UniTouchModel(UniTouchConfig(**FULL_SIZES[name]), modalities=modalities).eval()


@contextmanager
def made_in(device: torch.device | str, dtype: torch.dtype, seed: int) -> Iterator[None]:
    """Networks that are built meanwhile are built on a device, in a dtype, and with the weights of a seed.

    Raises:
        InvalidInputError: If there is no such device.
        InvalidTypeError: If `dtype` is not one of floating-point numbers, or `seed` no integer.
    """
    dtype = check_dtype("dtype", dtype)
    seed = check_integer("seed", seed, 0, 2**63 - 1)
    device = check_device("device", device)
    before = torch.get_default_dtype()
    with LOADING, torch.random.fork_rng(devices=[device] if device.type == "cuda" else []), device:
        torch.manual_seed(seed)
        torch.set_default_dtype(dtype)
        try:
            yield
        finally:
            torch.set_default_dtype(before)
