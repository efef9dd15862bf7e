"""InfoNCE against the paper's sums written out, the denoising loss against closed forms, and cases that are known."""

import math

import numpy as np
import pytest
import torch
from diffusers import DDPMScheduler
from diffusers.models.unets.unet_2d_condition import UNet2DConditionOutput
from scipy.stats import kstest
from torch import Tensor, nn

from unitouch_gen.training.losses import denoising_loss, info_nce, symmetric_info_nce

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
    basis = torch.eye(6)
    aligned = math.log1p(5 * math.exp(-1.0 / tau))
    assert info_nce(basis, basis, tau).item() == pytest.approx(aligned, abs=1e-6)
    assert info_nce(basis, basis.roll(1, dims=0), tau).item() == pytest.approx(1.0 / tau + aligned, rel=1e-4)
    assert info_nce(basis, torch.ones(6, 6), tau).item() == pytest.approx(math.log(6), abs=1e-5)
    half, single = (info_nce(TOUCH.bfloat16().to(kind), IMAGE, tau) for kind in (torch.bfloat16, torch.float32))
    assert half.dtype == torch.float32
    assert torch.equal(half, single)


class Predicts(nn.Module):
    """A network that predicts a multiple of what it is given, and keeps the steps it was asked for."""

    def __init__(self, gain: float):
        super().__init__()
        self.gain = gain

    def forward(self, sample: Tensor, steps: Tensor) -> UNet2DConditionOutput:
        self.sample, self.steps = sample, steps
        return UNet2DConditionOutput(sample=self.gain * sample[:, :4])


def run(kind: str, power: float, gain: float = 0.0, beside: Tensor | None = None) -> tuple[float, Tensor, Predicts]:
    """The loss of 600 latents, the cumulative alphas of their steps, and the network."""
    torch.manual_seed(0)
    scheduler = DDPMScheduler(prediction_type=kind, clip_sample=False)
    network = Predicts(gain)
    loss = denoising_loss(network, scheduler, torch.randn(600, 4, 4, 4), power, beside)  # type: ignore[arg-type]
    return loss.item(), scheduler.alphas_cumprod[network.steps], network


@pytest.mark.parametrize("power", [1.0, 2.0])
@pytest.mark.parametrize("kind", ["epsilon", "v_prediction"])
def test_targets_have_unit_variance_and_steps_the_law_of_a_power(kind: str, power: float) -> None:
    loss, _, network = run(kind, power)
    assert loss == pytest.approx(1.0, abs=0.05)  # what a prediction of zero costs, of either target
    assert kstest(((network.steps + 0.5) / 1000).numpy() ** (1 / power), "uniform").pvalue > 0.01


def test_the_loss_is_of_the_noise_that_was_added() -> None:
    beside = torch.randn(600, 2, 4, 4, generator=torch.Generator().manual_seed(1))
    loss, alpha_bar, network = run("epsilon", 1.0, 1.0, beside)
    assert torch.equal(network.sample[:, 4:], beside)
    expected = (1 - 2 * (1 - alpha_bar).sqrt() + 1).mean().item()  # E (n - x_t)^2 of unit-variance latents
    assert loss == pytest.approx(expected, rel=0.06)
