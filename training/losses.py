"""The losses that several stages share: InfoNCE of two views, and denoising of latents."""

from typing import Annotated

import torch
import torch.distributed as dist
import torch.nn.functional as F
from diffusers import DDPMScheduler, UNet2DConditionModel
from diffusers.training_utils import compute_snr
from pydantic import Field
from torch import Tensor
from torch.distributed.nn.functional import all_gather

from unitouch_gen.errors import InvalidInputError

SnrGamma = Annotated[float, Field(gt=0.0, allow_inf_nan=True)]  # bound of `denoising_losses`; .inf sets none


def info_nce(query: Tensor, key: Tensor, temperature: float | Tensor) -> Tensor:
    """Eq. 1 of the paper: - 1/B sum_i log softmax_j(q_i . k_j / tau)_i, of embeddings (B, D), normalised here.

    Cross-entropy of the similarity matrix against its diagonal; log B for unrelated views.
    """
    logits = F.normalize(query.float(), dim=-1) @ F.normalize(key.float(), dim=-1).T / temperature
    return F.cross_entropy(logits, torch.arange(len(logits), device=logits.device))


def symmetric_info_nce(a: Tensor, b: Tensor, temperature: float | Tensor) -> Tensor:
    """Eq. 2: L_{A -> B} + L_{B -> A}; of several processes, over the rows of all."""
    a, b = gathered(a), gathered(b)
    return info_nce(a, b, temperature) + info_nce(b, a, temperature)


def gathered(rows: Tensor) -> Tensor:
    """Rows (b, ...) of all W processes, (W b, ...) in the order of the batch; gradients go back to each."""
    several = dist.is_available() and dist.is_initialized() and dist.get_world_size() > 1
    return torch.cat(all_gather(rows)) if several else rows


def predict(
    unet: UNet2DConditionModel, noisy: Tensor, steps: Tensor, extra_channels: Tensor | None = None, **conditions: Tensor
) -> Tensor:
    """The network's prediction (B, C, h, w) for noisy latents of this shape, which extra channels are appended to."""
    inputs = noisy if extra_channels is None else torch.cat([noisy, extra_channels], dim=1)
    return unet(inputs, steps, **conditions).sample.float()


def denoising_losses(
    unet: UNet2DConditionModel, scheduler: DDPMScheduler, latents: Tensor, snr_gamma: float,
    extra_channels: Tensor | None = None, **conditions: Tensor,
) -> dict[str, Tensor]:  # fmt: skip
    """Mean squared error of the network's prediction at random steps, weighted by their signal-to-noise ratios (SNR).

    The weight of the error in x0 is the SNR, at most `snr_gamma` (min-SNR; Hang et al., 2023) and of a network that
    predicts v at least 1 (truncated SNR; Salimans & Ho, 2022): where there is hardly anything but noise, it learns what
    the condition alone tells, and at the weight of the SNR it hardly would.

    Args:
        unet: Called as `unet(noisy, steps, **conditions)`.
        scheduler: Predicting "epsilon" (Ho et al., 2020, Eq. 14) or "v_prediction" (Salimans & Ho, 2022, Section 4).
        latents: Clean and scaled, (B, C, h, w).
        snr_gamma: SNR above which all steps weigh the same; `inf` sets no bound.
        extra_channels: What the network is shown beside noisy latents, (B, C', h, w).

    Returns:
        `loss`, and `mse`, the unweighted error.
    """
    kind = scheduler.config.prediction_type
    if kind not in ("epsilon", "v_prediction"):
        raise InvalidInputError(f"`scheduler` predicts {kind!r}; it has to be 'epsilon' or 'v_prediction'.")
    steps = torch.randint(0, scheduler.config.num_train_timesteps, (len(latents),), device=latents.device)
    noise = torch.randn_like(latents)
    noisy = scheduler.add_noise(latents, noise, steps)
    target = noise if kind == "epsilon" else scheduler.get_velocity(latents, noise, steps)
    prediction = predict(unet, noisy, steps, extra_channels, **conditions)
    snr = compute_snr(scheduler, steps)
    bounded = snr.clamp(0.0 if kind == "epsilon" else min(1.0, snr_gamma), snr_gamma)
    weight = bounded / (snr if kind == "epsilon" else snr + 1.0)
    error = F.mse_loss(prediction, target, reduction="none").mean(dim=(1, 2, 3))
    return {"loss": (weight * error).mean(), "mse": error.mean().detach()}
