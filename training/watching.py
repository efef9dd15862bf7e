"""What there is to see of held-out data while a network trains: retrieval, and grids of pictures.

Of the averaged weights, every `watch_every` steps: figures go into the log and to the trackers, pictures into
`watched/`. The trainer keeps its random numbers apart, so training is the same with and without.
"""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
import torch.nn.functional as F
from diffusers import DDIMScheduler, DDPMScheduler
from PIL import Image
from torch import Tensor, nn

from unitouch_gen.models.autoencoders import Autoencoder, decode
from unitouch_gen.training.data import Rendered

Watch = Callable[[], Mapping[str, float | Image.Image]]
"""What to look at while a network trains, by name: figures, and pictures."""

GRID_ROWS = 8
SAMPLING_STEPS = 10


def pixels_of(splits: Sequence[Rendered], modality: str, count: int | None = None) -> Tensor:
    """uint8 (N, 3, S, S) of all splits, or of `count` samples spread over them."""
    pixels = torch.from_numpy(np.concatenate([getattr(split, modality) for split in splits]))
    return pixels if count is None else pixels[spread(len(pixels), count)]


def spread(size: int, count: int) -> Tensor:
    """At most `count` of `size` indices, from the first to the last."""
    return torch.linspace(0, size - 1, min(size, count)).round().long()


def on_device_of(network: nn.Module, *tensors: Tensor) -> list[Tensor]:
    """Tensors where a network's weights are."""
    device = next(network.parameters()).device
    return [tensor.to(device) for tensor in tensors]


def retrieval(query: Tensor, key: Tensor) -> dict[str, float]:
    """Shares of queries whose own key is the nearest, and among the five nearest, with what chance gives.

    Args:
        query, key: Embeddings of N pairs, (N, D).
    """
    query, key = (F.normalize(rows.float().cpu(), dim=-1) for rows in (query, key))
    count = len(query)
    order = (query @ key.T).argsort(dim=1, descending=True, stable=True)
    found = order == torch.arange(count)[:, None]
    return {
        name: share
        for k in (1, 5)
        for name, share in (
            (f"retrieval_top{k}", found[:, :k].any(dim=1).float().mean().item()),
            (f"chance_top{k}", min(k / count, 1.0)),
        )
    }


def grid(*columns: Tensor) -> Image.Image:
    """A picture with a row for each sample, of columns (N, 3, H, W) in [0, 1], all as large as the largest."""
    size = max(column.shape[-1] for column in columns)
    parts = [F.interpolate(column.float().cpu(), (size, size)) for column in columns]
    rows = torch.cat([F.pad(part, (1, 1, 1, 1), value=1.0) for part in parts], dim=3)
    pixels = torch.cat(list(rows), dim=1).nan_to_num(0.0).clamp(0.0, 1.0)
    return Image.fromarray((pixels * 255).round().byte().permute(1, 2, 0).numpy())


@torch.no_grad()
def denoised(
    unet: nn.Module, scheduler: DDPMScheduler, shape: Sequence[int], beside: Tensor | None = None, **conditions: Tensor
) -> Tensor:
    """Latents (B, C, h, w) by `SAMPLING_STEPS` of DDIM (Song et al., 2021), without guidance, of the same noise always.

    Args:
        unet: Called as `unet(noisy, step, **conditions)`.
        scheduler: What it was trained by.
        shape: (B, C, h, w).
        beside: What the network is shown as further channels, (B, C', h, w).
        conditions: The network's.
    """
    ddim = DDIMScheduler.from_config(scheduler.config, timestep_spacing="trailing")
    ddim.set_timesteps(SAMPLING_STEPS)
    latents = torch.randn(tuple(shape), generator=torch.Generator().manual_seed(0))
    (latents,) = on_device_of(unet, latents)
    for step in ddim.timesteps:
        shown = latents if beside is None else torch.cat([latents, beside.to(latents)], dim=1)
        prediction = unet(shown, step.to(latents.device), **conditions).sample.float()
        latents = ddim.step(prediction, step, latents).prev_sample
    return latents


def decoded(vae: Autoencoder, latents: Tensor) -> Tensor:
    """Pixels (B, 3, H, W) in [0, 1] of scaled latents."""
    (latents,) = on_device_of(vae, latents)
    return (decode(vae, latents) + 1.0) / 2.0
