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
from unitouch_gen.training.watching import retrieval

TAU = 0.07


def pairs(count: int = 7, width: int = 5) -> tuple[Tensor, Tensor]:
    touch, image = torch.randn(2, count, width, generator=torch.Generator().manual_seed(0))
    return touch, image


def equation_1(touch: np.ndarray, image: np.ndarray, tau: float) -> float:
    """- 1/B sum_i log( exp(f_T(t_i) . f_V(v_i) / tau) / sum_j exp(f_T(t_i) . f_V(v_j) / tau) ), term by term."""
    unit_touch = [row / math.sqrt(sum(x * x for x in row)) for row in touch.astype(np.float64)]
    unit_image = [row / math.sqrt(sum(x * x for x in row)) for row in image.astype(np.float64)]
    total = 0.0
    for i in range(len(touch)):
        numerator = math.exp(float(np.dot(unit_touch[i], unit_image[i])) / tau)
        denominator = sum(math.exp(float(np.dot(unit_touch[i], unit_image[j])) / tau) for j in range(len(image)))
        total += math.log(numerator / denominator)
    return -total / len(touch)


@pytest.mark.parametrize("tau", [0.07, 0.5, 1.0])
def test_info_nce_is_equation_1_and_its_symmetric_form_the_sum_of_both_directions(tau: float) -> None:
    touch, image = pairs()
    forth, back = (equation_1(a.numpy(), b.numpy(), tau) for a, b in ((touch, image), (image, touch)))
    assert info_nce(touch, image, tau).item() == pytest.approx(forth, rel=1e-5)
    assert symmetric_info_nce(touch, image, tau).item() == pytest.approx(forth + back, rel=1e-5)


@pytest.mark.parametrize("tau", [0.07, 0.3, 2.0])
def test_cases_with_a_closed_form(tau: float) -> None:
    basis = torch.eye(6)
    assert info_nce(basis, torch.ones(6, 6), tau).item() == pytest.approx(math.log(6), abs=1e-5)
    assert info_nce(basis, basis, tau).item() == pytest.approx(math.log1p(5 * math.exp(-1.0 / tau)), abs=1e-6)
    wrong = 1.0 / tau + math.log1p(5 * math.exp(-1.0 / tau))
    assert info_nce(basis, basis.roll(1, dims=0), tau).item() == pytest.approx(wrong, rel=1e-4)


def test_gradients_reach_both_sides_and_the_temperature_and_only_turn_an_embedding() -> None:
    touch, image = (x.requires_grad_() for x in pairs())
    log_tau = torch.tensor(math.log(TAU), requires_grad=True)
    symmetric_info_nce(touch, image, log_tau.exp()).backward()
    for leaf in (touch, image, log_tau):
        assert leaf.grad is not None and bool(leaf.grad.isfinite().all()) and leaf.grad.abs().max() > 1e-4
    along = (touch.grad * touch).sum(dim=1) / touch.norm(dim=1)
    torch.testing.assert_close(along, torch.zeros_like(along), atol=1e-5, rtol=0.0)


def test_half_precision_embeddings_are_compared_in_single_precision() -> None:
    touch, image = (x.bfloat16() for x in pairs())
    loss = info_nce(touch, image, TAU)
    assert loss.dtype == torch.float32
    torch.testing.assert_close(loss, info_nce(touch.float(), image.float(), TAU))


def test_retrieval_counts_own_keys_among_the_nearest() -> None:
    found = retrieval(torch.eye(10), torch.eye(10))
    assert (found["retrieval_top1"], found["retrieval_top5"], found["chance_top5"]) == (1.0, 1.0, 0.5)
    angles = torch.arange(10) * 0.1
    circle = torch.stack([angles.cos(), angles.sin()], dim=1)
    turned = retrieval(circle, circle.roll(-1, 0))  # own keys are the next ones' twins, the last one's is the first
    assert turned["retrieval_top1"] == 0.0 and turned["retrieval_top5"] == pytest.approx(0.9)
    same = retrieval(torch.ones(20, 8), torch.ones(20, 8))
    assert same["retrieval_top1"] == pytest.approx(same["chance_top1"]) == pytest.approx(0.05)


# Denoising ------------------------------------------------------------------------------------------------------------

COUNT = 600


class Predicts(nn.Module):
    """A network that predicts a multiple of what it is given, and keeps the steps it was asked for."""

    def __init__(self, gain: float):
        super().__init__()
        self.gain = gain

    def forward(self, sample: Tensor, steps: Tensor) -> UNet2DConditionOutput:
        self.sample, self.steps = sample, steps
        return UNet2DConditionOutput(sample=self.gain * sample[:, :4])


def run(kind: str, gamma: float, gain: float = 0.0) -> tuple[dict[str, Tensor], Tensor]:
    """Losses, and the cumulative alphas of the steps."""
    torch.manual_seed(0)
    scheduler, network = DDPMScheduler(prediction_type=kind, clip_sample=False), Predicts(gain)
    losses = denoising_losses(network, scheduler, torch.randn(COUNT, 4, 4, 4), gamma)
    assert network.steps.min() >= 0 and network.steps.max() < 1000
    np.testing.assert_allclose(np.bincount(network.steps // 250, minlength=4) / COUNT, 0.25, atol=0.08)
    return losses, scheduler.alphas_cumprod[network.steps]


@pytest.mark.parametrize("gamma", [0.5, 2.0])
@pytest.mark.parametrize(("kind", "divisor", "least"), [("epsilon", 0.0, 0.0), ("v_prediction", 1.0, 1.0)])
def test_weights_are_min_snr_and_of_v_truncated_snr(kind: str, divisor: float, least: float, gamma: float) -> None:
    losses, alpha_bar = run(kind, gamma)
    # Noise and v = sqrt(abar) n - sqrt(1 - abar) x both have unit variance, which a prediction of zero costs.
    assert losses["mse"].item() == pytest.approx(1.0, abs=0.05)
    # Weights of the error in x0; that in noise is SNR times as large, that in v SNR + 1 times.
    snr = alpha_bar / (1 - alpha_bar)
    expected = torch.minimum(snr.clamp(min=least), torch.tensor(gamma)) / (snr + divisor)
    assert losses["loss"].item() == pytest.approx(expected.mean().item(), rel=0.05)


def test_without_a_bound_noise_weighs_the_same_at_all_steps() -> None:
    losses, alpha_bar = run("epsilon", math.inf, gain=1.0)
    assert losses["loss"].item() == pytest.approx(losses["mse"].item(), rel=1e-5)
    expected = (1 - 2 * (1 - alpha_bar).sqrt() + 1).mean().item()  # E (n - x_t)^2 of unit-variance latents
    assert losses["mse"].item() == pytest.approx(expected, rel=0.06)


def test_what_is_shown_beside_latents_are_further_channels() -> None:
    network, beside = Predicts(0.0), torch.randn(3, 2, 4, 4)
    denoising_losses(network, DDPMScheduler(), torch.zeros(3, 4, 4, 4), 5.0, beside)
    assert torch.equal(network.sample[:, 4:], beside)


def test_a_schedule_of_another_prediction_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="`scheduler` predicts 'sample'"):
        denoising_losses(Predicts(0.0), DDPMScheduler(prediction_type="sample"), torch.zeros(2, 4, 2, 2), 5.0)
