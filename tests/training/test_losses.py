"""InfoNCE against the paper's sums written out, the denoising loss against closed forms, and cases that are known."""

import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from diffusers import DDPMScheduler
from diffusers.models.unets.unet_2d_condition import UNet2DConditionOutput
from torch import Tensor, nn

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.training.losses import denoising_losses, info_nce, symmetric_info_nce

TAU = 0.07


def pairs(count: int = 7, width: int = 5, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    touch, image = torch.randn(2, count, width, generator=generator)
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
def test_info_nce_is_equation_1(tau: float) -> None:
    touch, image = pairs()
    assert info_nce(touch, image, tau).item() == pytest.approx(equation_1(touch.numpy(), image.numpy(), tau), rel=1e-5)


def test_symmetric_loss_is_the_sum_of_both_directions() -> None:
    touch, image = pairs()
    forth, back = (equation_1(a.numpy(), b.numpy(), TAU) for a, b in ((touch, image), (image, touch)))
    assert forth != pytest.approx(back, rel=1e-3)
    assert symmetric_info_nce(touch, image, TAU).item() == pytest.approx(forth + back, rel=1e-5)


def test_symmetric_loss_does_not_depend_on_the_order_of_the_modalities() -> None:
    touch, image = pairs()
    torch.testing.assert_close(symmetric_info_nce(touch, image, TAU), symmetric_info_nce(image, touch, TAU))


@pytest.mark.parametrize("count", [1, 2, 16])
def test_keys_that_a_query_cannot_tell_apart_cost_log_b(count: int) -> None:
    query, _ = pairs(count)
    key = torch.ones(count, query.shape[1])
    assert info_nce(query, key, TAU).item() == pytest.approx(math.log(count), abs=1e-5)


@pytest.mark.parametrize("tau", [0.07, 0.3, 2.0])
def test_orthogonal_pairs_in_line_have_the_closed_form(tau: float) -> None:
    basis = torch.eye(6)
    assert info_nce(basis, basis, tau).item() == pytest.approx(math.log1p(5 * math.exp(-1.0 / tau)), abs=1e-6)


def test_aligned_pairs_cost_nothing_as_the_temperature_falls() -> None:
    touch, _ = pairs()
    assert info_nce(touch, touch, 0.005).item() < 1e-6


def test_pairs_in_the_wrong_order_cost_one_over_the_temperature() -> None:
    basis = torch.eye(6)
    assert info_nce(basis, basis.roll(1, dims=0), TAU).item() == pytest.approx(1.0 / TAU, rel=1e-4)


def test_length_of_the_embeddings_does_not_matter() -> None:
    touch, image = pairs()
    scales = torch.logspace(-3, 3, len(touch))[:, None]
    torch.testing.assert_close(info_nce(scales * touch, image.flip(1) * 40, TAU), info_nce(touch, image.flip(1), TAU))


def test_gradients_reach_both_sides_and_the_temperature() -> None:
    touch, image = (x.requires_grad_() for x in pairs())
    log_tau = torch.tensor(math.log(TAU), requires_grad=True)
    symmetric_info_nce(touch, image, log_tau.exp()).backward()
    for leaf in (touch, image, log_tau):
        assert leaf.grad is not None and bool(torch.isfinite(leaf.grad).all()) and leaf.grad.abs().max() > 1e-4


def test_gradients_only_turn_an_embedding() -> None:
    touch, image = (x.requires_grad_() for x in pairs())
    info_nce(touch, image, TAU).backward()
    along = (touch.grad * touch).sum(dim=1) / touch.norm(dim=1)
    torch.testing.assert_close(along, torch.zeros_like(along), atol=1e-5, rtol=0.0)


def test_gradient_steps_bring_a_pair_together() -> None:
    touch, image = pairs()
    touch.requires_grad_()
    before = F.cosine_similarity(touch, image).mean()
    (gradient,) = torch.autograd.grad(symmetric_info_nce(touch, image, TAU), touch)
    assert F.cosine_similarity(touch - 0.05 * gradient, image).mean() > before


def test_half_precision_embeddings_are_compared_in_single_precision() -> None:
    touch, image = (x.bfloat16() for x in pairs())
    loss = info_nce(touch, image, TAU)
    assert loss.dtype == torch.float32
    torch.testing.assert_close(loss, info_nce(touch.float(), image.float(), TAU))


# Denoising ------------------------------------------------------------------------------------------------------------

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


@pytest.mark.parametrize("gamma", [0.5, 2.0])
@pytest.mark.parametrize(("kind", "divisor", "least"), [("epsilon", 0.0, 0.0), ("v_prediction", 1.0, 1.0)])
def test_weights_are_min_snr_and_of_v_truncated_snr(kind: str, divisor: float, least: float, gamma: float) -> None:
    losses, alpha_bar = run(kind, gamma)
    # Of the error in x0; that in noise is SNR times as large, that in v SNR + 1 times.
    snr = alpha_bar / (1 - alpha_bar)
    expected = torch.minimum(snr.clamp(min=least), torch.tensor(gamma)) / (snr + divisor)
    assert losses["loss"].item() == pytest.approx(expected.mean().item(), rel=0.05)


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
