"""InfoNCE against the paper's sums written out, and against what it has to be in cases that are known."""

import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from unitouch_gen.training.losses import info_nce, symmetric_info_nce

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
