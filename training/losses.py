"""Losses that several stages share: InfoNCE of two views, and denoising of latents."""

from typing import Annotated

import torch
import torch.distributed as dist
import torch.nn.functional as F
from diffusers import DDPMScheduler, UNet2DConditionModel
from pydantic import Field
from torch import Tensor
from torch.distributed.nn.functional import all_gather

from unitouch_gen.errors import InvalidInputError

StepPower = Annotated[float, Field(ge=1.0, le=10.0)]  # of `denoising_loss`


def info_nce(query: Tensor, key: Tensor, temperature: float | Tensor) -> Tensor:
    """Eq. 1 of the paper: - 1/B sum_i log softmax_j(q_i . k_j / tau)_i, of embeddings (B, D), normalised here.

    Cross-entropy of the similarity matrix against its diagonal; log B for unrelated views.
    """
    logits = F.normalize(query.float(), dim=-1) @ F.normalize(key.float(), dim=-1).T / temperature
    return F.cross_entropy(logits, torch.arange(len(logits), device=logits.device))


def symmetric_info_nce(a: Tensor, b: Tensor, temperature: float | Tensor) -> Tensor:
    """Eq. 2 of the paper: L_{A -> B} + L_{B -> A}, over the rows of all processes."""
    a = gathered(a)
    b = gathered(b)
    return info_nce(a, b, temperature) + info_nce(b, a, temperature)


def gathered(rows: Tensor) -> Tensor:
    """Rows (b, ...) of all W processes, (W b, ...) in the order of the batch. Gradients flow back to each process."""
    distributed = dist.is_available() and dist.is_initialized() and dist.get_world_size() > 1
    return torch.cat(all_gather(rows)) if distributed else rows


def predict(
    unet: UNet2DConditionModel, noisy: Tensor, steps: Tensor, extra_channels: Tensor | None = None, **conditions: Tensor
) -> Tensor:
    """The network's prediction (B, C, h, w) for noisy latents (B, C, h, w) with `extra_channels` appended."""
    inputs = noisy if extra_channels is None else torch.cat([noisy, extra_channels], dim=1)
    return unet(inputs, steps, **conditions).sample.float()


def denoising_loss(
    unet: UNet2DConditionModel,
    scheduler: DDPMScheduler,
    latents: Tensor,
    step_power: float,
    extra_channels: Tensor | None = None,
    **conditions: Tensor,
) -> Tensor:
    """Mean squared error of the network's prediction at random steps.

    Args:
        unet: Called as `unet(noisy, steps, **conditions)`.
        scheduler: Predicting "epsilon" (Ho et al., 2020, Eq. 14) or "v_prediction" (Salimans & Ho, 2022, Section 4).
        latents: Clean and scaled, (B, C, h, w).
        step_power: p of steps T u^p, u uniform in [0, 1). Above 1, more steps have little noise, where fine structure
            is drawn. Of uniform steps, 3 % are below a noise level of 0.17.
        extra_channels: Inputs beside the noisy latents, (B, C', h, w).
    """
    prediction_type = scheduler.config.prediction_type
    count = scheduler.config.num_train_timesteps
    if prediction_type not in ("epsilon", "v_prediction"):
        raise InvalidInputError(f"`scheduler` predicts {prediction_type!r}; it has to be 'epsilon' or 'v_prediction'.")
    steps = (torch.rand(len(latents), device=latents.device) ** step_power * count).long()
    noise = torch.randn_like(latents)
    noisy = scheduler.add_noise(latents, noise, steps)
    target = noise if prediction_type == "epsilon" else scheduler.get_velocity(latents, noise, steps)
    return F.mse_loss(predict(unet, noisy, steps, extra_channels, **conditions), target)
