"""The denoising loss of both latent diffusion models, against closed forms."""

import math

import numpy as np
import pytest
import torch
from diffusers import DDPMScheduler
from diffusers.models.unets.unet_2d_condition import UNet2DConditionOutput
from torch import Tensor, nn

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.training.diffusion import denoising_losses

COUNT = 600
PREDICTIONS = ("epsilon", "v_prediction")


class Predicts(nn.Module):
    """A network that predicts a multiple of what it is given, and keeps the steps it was asked for."""

    def __init__(self, gain: float):
        super().__init__()
        self.gain = gain

    def forward(self, sample: Tensor, steps: Tensor) -> UNet2DConditionOutput:
        self.steps = steps
        return UNet2DConditionOutput(sample=self.gain * sample)


def run(kind: str, gamma: float, gain: float = 0.0) -> tuple[dict[str, Tensor], Tensor]:
    """Losses, and the cumulative alphas of the steps."""
    torch.manual_seed(0)
    scheduler, network = DDPMScheduler(prediction_type=kind, clip_sample=False), Predicts(gain)
    losses = denoising_losses(network, scheduler, torch.randn(COUNT, 4, 4, 4), gamma)
    return losses, scheduler.alphas_cumprod[network.steps]


def test_all_steps_of_the_schedule_are_trained() -> None:
    torch.manual_seed(0)
    network = Predicts(0.0)
    denoising_losses(network, DDPMScheduler(), torch.zeros(COUNT, 1, 1, 1), 5.0)
    assert network.steps.min() >= 0 and network.steps.max() < 1000
    np.testing.assert_allclose(np.bincount(network.steps // 250, minlength=4) / COUNT, 0.25, atol=0.08)


@pytest.mark.parametrize("kind", PREDICTIONS)
def test_a_prediction_of_zero_costs_the_targets_variance(kind: str) -> None:
    losses, _ = run(kind, 5.0)  # noise and v = sqrt(abar) n - sqrt(1 - abar) x both have unit variance
    assert losses["mse"].item() == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize(("kind", "divisor"), [("epsilon", 0.0), ("v_prediction", 1.0)])
def test_weights_are_min_snr(kind: str, divisor: float) -> None:
    losses, alpha_bar = run(kind, 2.0)
    snr = alpha_bar / (1 - alpha_bar)  # Hang et al., 2023: min(SNR, gamma) / SNR, or / (SNR + 1) for v
    assert losses["loss"].item() == pytest.approx((snr.clamp(max=2.0) / (snr + divisor)).mean().item(), rel=0.05)


def test_without_a_bound_noise_weighs_the_same_at_all_steps() -> None:
    losses, _ = run("epsilon", math.inf)
    assert losses["loss"].item() == pytest.approx(losses["mse"].item(), rel=1e-5)


def test_the_best_linear_prediction_of_noise_is_found_best() -> None:
    # For unit-variance latents E[n | x_t] = sqrt(1 - abar) x_t, which leaves an error of abar on the average.
    losses, alpha_bar = run("epsilon", math.inf, gain=1.0)
    expected = (1 - 2 * (1 - alpha_bar).sqrt() + 1).mean().item()  # E (n - x_t)^2
    assert losses["mse"].item() == pytest.approx(expected, rel=0.06)


def test_a_schedule_of_another_prediction_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="`scheduler` predicts 'sample'"):
        denoising_losses(Predicts(0.0), DDPMScheduler(prediction_type="sample"), torch.zeros(2, 1, 2, 2), 5.0)
