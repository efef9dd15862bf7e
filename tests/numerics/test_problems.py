"""Exact problems and references, against densities of torch.distributions, closed forms and scipy."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.distributions import Categorical, Independent, MixtureSameFamily, Normal

from unitouch_gen.numerics.problems import PROBLEMS, GaussianMixture, Problem, relative_rms, solve_flow
from unitouch_gen.schedule import PREDICTION_TYPES, alpha, to_denoised

MIXTURE = PROBLEMS["mixture"]
GUIDED = PROBLEMS["gaussian-guided"]


def draw(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def mixture(dimensions: int = 4, seed: int = 0) -> GaussianMixture:
    return GaussianMixture(draw(3, dimensions, seed=seed), draw(3, dimensions, seed=seed + 1).exp())


# The best prediction of the data --------------------------------------------------------------------------------------


@pytest.mark.parametrize("sigma", [0.05, 50.0])
def test_tweedies_formula(sigma):
    """E[x_0 | x] = x + sigma^2 grad log p(x; sigma) (Robbins, 1956), by autograd of torch's own density."""
    data = mixture()
    x = (draw(6, 4, seed=5) * (1 + sigma)).requires_grad_()
    parts = Independent(Normal(data.means, (data.variances + sigma**2).sqrt()), 1)
    density = MixtureSameFamily(Categorical(torch.ones(3, dtype=torch.float64)), parts)
    (score,) = torch.autograd.grad(density.log_prob(x).sum(), x)
    denoised, noise = data.posterior_means(x.detach(), sigma)
    torch.testing.assert_close(denoised, x.detach() + sigma**2 * score, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(noise, -sigma * score, rtol=1e-9, atol=1e-9)


def test_ill_conditioned_gaussians_to_the_last_digits():
    """(v x + sigma^2 m) / (v + sigma^2), in extended precision."""
    variances = torch.logspace(0, -12, 12, dtype=torch.float64)
    means = draw(1, 12)
    for sigma in (1e-6, 1e-3, 0.3, 1.0, 14.6, 1e3, 1e6):
        x = draw(3, 12, seed=1) * math.hypot(1, sigma)
        v, m, wide, tau = (np.asarray(value, dtype=np.longdouble) for value in (variances, means, x, sigma))
        expected = ((v * wide + tau**2 * m) / (v + tau**2), tau * (wide - m) / (v + tau**2))
        found = GaussianMixture(means, variances[None]).posterior_means(x, sigma)
        for one, other in zip(found, expected, strict=True):
            np.testing.assert_allclose(one.numpy(), other.astype(float), rtol=1e-11, atol=1e-13)


@pytest.mark.parametrize(("sigma", "deviation"), [(1e-6, 1e-6), (1e-3, 1e3), (1.0, 1e-6), (1e6, 1.0)])
def test_far_apart_and_narrow_modes_give_predictions_within_reach(deviation, sigma):
    """Each prediction lies between the modes, or between a mode and the state."""
    means = 1e6 * torch.eye(3, 5, dtype=torch.float64)
    x = draw(4, 5) * (1e6 + sigma)
    denoised, noise = GaussianMixture(means, torch.full_like(means, deviation**2)).posterior_means(x, sigma)
    assert (denoised.abs() <= torch.maximum(x.abs(), torch.tensor(1e6)) * (1 + 1e-12)).all()
    torch.testing.assert_close(denoised + sigma * noise, x, rtol=1e-9, atol=1e-9 * (1e6 + sigma))


@pytest.mark.parametrize("kind", PREDICTION_TYPES)
@pytest.mark.parametrize("name", ["mixture-3", "gaussian-cosine"])
def test_networks_predict_what_the_data_says(kind, name):
    problem = replace(PROBLEMS[name], prediction_type=kind)
    sigma = problem.schedule.sigma(321.5).item()
    noise = problem.noise(2)
    x = noise * math.hypot(1.0, sigma)
    rows = 4 if problem.guidance.active else 2
    prediction = problem.network(2)(torch.cat([noise] * (rows // 2)), torch.tensor(321.5))
    guided = problem.guidance.combine(prediction) if rows == 4 else prediction
    torch.testing.assert_close(to_denoised(guided, x * alpha(sigma), sigma, kind), problem.denoise(x, sigma))


# Flows ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "rtol"), [("gaussian", 1e-5), ("conditioning-1e6", 1e-9), ("near-delta", 1e-9), ("gaussian-cosine", 1e-9)]
)
def test_references_come_to_the_closed_form(name, rtol):
    problem = PROBLEMS[name]
    noise = problem.noise(2)
    ends = [problem.schedule.sigma_max, 1e-4 * problem.smallest_deviation]
    start, expected = problem.path(noise, ends)
    assert relative_rms(solve_flow(problem.denoise, start, ends, rtol)[1], expected).max() < rtol


def test_a_guided_flow_of_gaussians_is_that_of_its_linear_equation():
    """Along an axis of N(m_u, v) and N(m_c, v): x - m goes as sqrt(v + tau), m = m_u + g (m_c - m_u) shifts with it."""
    wide = GaussianMixture(torch.full((1, 16), 0.2).double(), torch.linspace(0.1, 1.0, 16).double()[None])
    narrow = GaussianMixture(wide.means + 0.3, wide.variances)
    problem = Problem("", narrow, wide, guidance_scale=3.0)
    noise = draw(2, 4, 2, 2)
    mean = 0.2 + 3.0 * 0.3
    v = wide.variances[0]
    first = problem.schedule.sigma_max
    start = noise.flatten(1) * math.hypot(1.0, first)
    expected = mean + (v / (v + first**2)).sqrt() * (start - mean)
    torch.testing.assert_close(problem.solution(noise).flatten(1), expected, rtol=1e-6, atol=1e-7)


def test_one_hard_sample_among_easy_ones_keeps_its_tolerance():
    """However many others there are: here the others rest where they are."""
    noise = torch.zeros(64, *GUIDED.shape, dtype=torch.float64)
    noise[0] = GUIDED.noise(1)[0]

    def denoise(x: torch.Tensor, sigma: float) -> torch.Tensor:
        return torch.cat([GUIDED.denoise(x[:1], sigma), x[1:] / (sigma**2 + 1)])

    ends = [GUIDED.schedule.sigma_max, 1e-4 * GUIDED.smallest_deviation]
    found = solve_flow(denoise, noise * math.hypot(1.0, ends[0]), ends, rtol=1e-7)[1][:1]
    assert relative_rms(found, GUIDED.path(noise[:1], ends)[1]).item() < 1e-6
