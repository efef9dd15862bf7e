"""InfoNCE against the paper's sums written out, the denoising loss against closed forms, and cases that are known."""

import math

import numpy as np
import pytest
import torch
from diffusers import DDPMScheduler
from diffusers.models.unets.unet_2d_condition import UNet2DConditionOutput
from torch import Tensor, nn

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.training.losses import denoising_losses, info_nce, symmetric_info_nce

TOUCH, IMAGE = torch.randn(2, 7, 5, generator=torch.Generator().manual_seed(0))


def equation_1(touch: np.ndarray, image: np.ndarray, tau: float) -> float:
    """- 1/B sum_i log( exp(f_T(t_i) . f_V(v_i) / tau) / sum_j exp(f_T(t_i) . f_V(v_j) / tau) ), term by term."""
    unit_touch, unit_image = (
        [row / math.sqrt(sum(x * x for x in row)) for row in rows.astype(np.float64)] for rows in (touch, image)
    )
    total = 0.0
    for i in range(len(touch)):
        numerator = math.exp(float(np.dot(unit_touch[i], unit_image[i])) / tau)
        denominator = sum(math.exp(float(np.dot(unit_touch[i], unit_image[j])) / tau) for j in range(len(image)))
        total += math.log(numerator / denominator)
    return -total / len(touch)


@pytest.mark.parametrize("tau", [0.07, 2.0])
def test_info_nce_is_equation_1_and_has_its_closed_forms(tau: float) -> None:
    forth, back = (equation_1(a.numpy(), b.numpy(), tau) for a, b in ((TOUCH, IMAGE), (IMAGE, TOUCH)))
    assert info_nce(TOUCH, 40 * IMAGE, tau).item() == pytest.approx(forth, rel=1e-5)
    assert symmetric_info_nce(TOUCH, IMAGE, tau).item() == pytest.approx(forth + back, rel=1e-5)
    basis, aligned = torch.eye(6), math.log1p(5 * math.exp(-1.0 / tau))
    assert info_nce(basis, basis, tau).item() == pytest.approx(aligned, abs=1e-6)
    assert info_nce(basis, basis.roll(1, dims=0), tau).item() == pytest.approx(1.0 / tau + aligned, rel=1e-4)
    assert info_nce(basis, torch.ones(6, 6), tau).item() == pytest.approx(math.log(6), abs=1e-5)
    half, single = (info_nce(TOUCH.bfloat16().to(kind), IMAGE, tau) for kind in (torch.bfloat16, torch.float32))
    assert half.dtype == torch.float32 and torch.equal(half, single)


class Predicts(nn.Module):
    """A network that predicts a multiple of what it is given, and keeps the steps it was asked for."""

    def __init__(self, gain: float):
        super().__init__()
        self.gain = gain

    def forward(self, sample: Tensor, steps: Tensor) -> UNet2DConditionOutput:
        self.sample, self.steps = sample, steps
        return UNet2DConditionOutput(sample=self.gain * sample[:, :4])


def run(kind: str, gamma: float, gain: float = 0.0, beside: Tensor | None = None) -> tuple[dict, Tensor, Predicts]:
    """Losses of 600 latents, the cumulative alphas of their steps, and the network."""
    torch.manual_seed(0)
    scheduler, network = DDPMScheduler(prediction_type=kind, clip_sample=False), Predicts(gain)
    losses = denoising_losses(network, scheduler, torch.randn(600, 4, 4, 4), gamma, beside)  # type: ignore[arg-type]
    np.testing.assert_allclose(np.bincount(network.steps // 250, minlength=4) / 600, 0.25, atol=0.08)
    return losses, scheduler.alphas_cumprod[network.steps], network


@pytest.mark.parametrize("gamma", [0.5, 2.0])
@pytest.mark.parametrize(("kind", "divisor", "least"), [("epsilon", 0.0, 0.0), ("v_prediction", 1.0, 1.0)])
def test_weights_are_min_snr_and_of_v_truncated_snr(kind: str, divisor: float, least: float, gamma: float) -> None:
    losses, alpha_bar, _ = run(kind, gamma)
    # Noise and v = sqrt(abar) n - sqrt(1 - abar) x both have unit variance, which a prediction of zero costs.
    assert losses["mse"].item() == pytest.approx(1.0, abs=0.05)
    # Weights of the error in x0; that in noise is SNR times as large, that in v SNR + 1 times.
    snr = alpha_bar / (1 - alpha_bar)
    expected = torch.minimum(snr.clamp(min=least), torch.tensor(gamma)) / (snr + divisor)
    assert losses["loss"].item() == pytest.approx(expected.mean().item(), rel=0.05)


def test_without_a_bound_noise_weighs_the_same_at_all_steps() -> None:
    beside = torch.randn(600, 2, 4, 4, generator=torch.Generator().manual_seed(1))
    losses, alpha_bar, network = run("epsilon", math.inf, 1.0, beside)
    assert torch.equal(network.sample[:, 4:], beside)
    assert losses["loss"].item() == pytest.approx(losses["mse"].item(), rel=1e-5)
    expected = (1 - 2 * (1 - alpha_bar).sqrt() + 1).mean().item()  # E (n - x_t)^2 of unit-variance latents
    assert losses["mse"].item() == pytest.approx(expected, rel=0.06)
    with pytest.raises(InvalidInputError, match="`scheduler` predicts 'sample'"):
        run("sample", 5.0)
