"""What both latent diffusion models are trained with: the network they start from and the denoising loss."""

import math
import sys
from typing import Any

import torch
import torch.nn.functional as F
from diffusers import DDPMScheduler, UNet2DConditionModel
from diffusers.training_utils import compute_snr
from torch import Tensor

from unitouch_gen.errors import InvalidInputError, check_number
from unitouch_gen.training.recipe import read_section
from unitouch_gen.training.stages import Stage


def starting_unet(stage: Stage, **conditions: Any) -> UNet2DConditionModel:
    """The stage's network: random by its recipe and `conditions`, or the weights that were named to start from.

    Raises:
        InvalidInputError: If the recipe's `model` is none; see `read_section`.
    """
    if stage.init is None:
        return read_section(stage.recipe, "model", UNet2DConditionModel, **conditions)
    return UNet2DConditionModel.from_pretrained(stage.init, torch_dtype=torch.float32)


def check_snr_gamma(value: float) -> None:
    """Checks the bound of `denoising_losses`.

    Raises:
        InvalidInputError, InvalidTypeError: If it is neither above 0 nor infinite.
    """
    if value != math.inf:
        check_number("snr_gamma", value, sys.float_info.min, hint="It has to be above 0; .inf sets no bound.")


def denoising_losses(
    unet: UNet2DConditionModel, scheduler: DDPMScheduler, latents: Tensor, snr_gamma: float, **conditions: Tensor
) -> dict[str, Tensor]:
    """Mean squared error of the network's prediction at random steps, weighted by min-SNR (Hang et al., 2023).

    Args:
        unet: Called as `unet(noisy, steps, **conditions)`.
        scheduler: Schedule of the latents, predicting "epsilon" (Ho et al., 2020, Eq. 14) or "v_prediction" (Salimans &
            Ho, 2022, Section 4).
        latents: Clean and scaled, (B, C, h, w).
        snr_gamma: Signal-to-noise ratio above which all steps weigh the same; `inf` weighs as the prediction does.
        conditions: Of the network.

    Returns:
        `loss`, and `mse`, the unweighted error.

    Raises:
        InvalidInputError: If the schedule predicts something else.
    """
    kind = scheduler.config.prediction_type
    if kind not in ("epsilon", "v_prediction"):
        raise InvalidInputError(f"`scheduler` predicts {kind!r}; it has to be 'epsilon' or 'v_prediction'.")
    steps = torch.randint(0, scheduler.config.num_train_timesteps, (len(latents),), device=latents.device)
    noise = torch.randn_like(latents)
    noisy = scheduler.add_noise(latents, noise, steps)
    target = noise if kind == "epsilon" else scheduler.get_velocity(latents, noise, steps)
    prediction = unet(noisy, steps, **conditions).sample.float()
    snr = compute_snr(scheduler, steps)
    weight = snr.clamp(max=snr_gamma) / (snr if kind == "epsilon" else snr + 1.0)
    error = F.mse_loss(prediction, target, reduction="none").mean(dim=(1, 2, 3))
    return {"loss": (weight * error).mean(), "mse": error.mean().detach()}
