"""Denoisers of Gaussian mixtures, against quadrature, densities of torch.distributions, and diffusers' own steps."""

import math

import numpy as np
import pytest
import torch
from diffusers import DDIMScheduler
from diffusers.models.unets.unet_2d_condition import UNet2DConditionOutput
from scipy.integrate import quad
from torch.distributions import Categorical, MixtureSameFamily, MultivariateNormal

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.numerics.exact import ExactNetwork, GaussianMixture, guided_denoise
from unitouch_gen.numerics.problems import random_rotation
from unitouch_gen.schedulers.schedule import PREDICTION_TYPES, NoiseSchedule, alpha

STABLE_DIFFUSION = {"beta_start": 0.00085, "beta_end": 0.012, "beta_schedule": "scaled_linear"}
CONFIGS = [STABLE_DIFFUSION, {"beta_schedule": "squaredcos_cap_v2"}, {"num_train_timesteps": 50, "beta_end": 0.3}]
SIGMAS = [1e-6, 1e-3, 0.3, 1.0, 14.6, 1e3, 1e6]


def draw(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def mixture(dimensions: int = 4, seed: int = 0) -> GaussianMixture:
    """Three components along rotated axes."""
    variances = draw(3, dimensions, seed=seed + 1).exp()
    weights, rotation = torch.tensor([0.2, 0.5, 0.3]), random_rotation(dimensions, seed)
    return GaussianMixture(draw(3, dimensions, seed=seed), variances, weights, rotation)


def schedule(**config) -> NoiseSchedule:
    return NoiseSchedule.of(DDIMScheduler(**config or STABLE_DIFFUSION))


# The best prediction of the data --------------------------------------------------------------------------------------


@pytest.mark.parametrize("sigma", [0.05, 0.7, 3.0])
@pytest.mark.parametrize("x", [-2.0, 0.1, 1.5])
def test_mean_of_the_posterior_by_quadrature(x, sigma):
    means, deviations, weights = [-1.0, 0.5, 2.0], [0.3, 0.1, 0.6], [0.2, 0.5, 0.3]
    data = GaussianMixture(
        torch.tensor(means, dtype=torch.float64)[:, None],
        torch.tensor(deviations, dtype=torch.float64)[:, None] ** 2,
        torch.tensor(weights, dtype=torch.float64),
    )

    def density(x: float, mean: float, deviation: float) -> float:
        return math.exp(-0.5 * ((x - mean) / deviation) ** 2) / deviation

    def joint(x0: float) -> float:
        return density(x, x0, sigma) * sum(w * density(x0, m, s) for w, m, s in zip(weights, means, deviations))

    options = {"points": [*means, x], "limit": 500, "epsabs": 1e-14, "epsrel": 1e-12}
    evidence = quad(joint, -8, 8, **options)[0]
    expected = quad(lambda x0: x0 * joint(x0), -8, 8, **options)[0] / evidence
    got = data.denoise(torch.tensor([[x]], dtype=torch.float64), sigma).item()
    assert got == pytest.approx(expected, rel=1e-8)


@pytest.mark.parametrize("sigma", [0.05, 0.7, 3.0, 50.0])
def test_tweedies_formula(sigma):
    """E[x_0 | x] = x + sigma^2 grad log p(x; sigma) (Robbins, 1956), by autograd of torch's own density."""
    data = mixture()
    covariances = data.rotation @ torch.diag_embed(data.variances + sigma**2) @ data.rotation.T
    density = MixtureSameFamily(Categorical(data.weights), MultivariateNormal(data.means, covariances))
    x = (draw(6, 4, seed=5) * (1 + sigma)).requires_grad_()
    (score,) = torch.autograd.grad(density.log_prob(x).sum(), x)
    x = x.detach()
    torch.testing.assert_close(data.denoise(x, sigma), x + sigma**2 * score, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(data.noise(x, sigma), -sigma * score, rtol=1e-9, atol=1e-9)


def test_mean_of_the_posterior_by_simulation():
    """Of data that were drawn, those weighted by how well they explain x."""
    data, sigma, n = mixture(2), 0.8, 400_000
    which = torch.multinomial(data.weights, n, replacement=True, generator=torch.Generator().manual_seed(0))
    axes = draw(n, 2, seed=3) * data.variances[which].sqrt()
    drawn = data.means[which] + axes @ data.rotation.T
    x = torch.tensor([[0.3, -0.5]], dtype=torch.float64)
    weights = (-0.5 * ((x - drawn) ** 2).sum(dim=1) / sigma**2).softmax(dim=0)
    torch.testing.assert_close(data.denoise(x, sigma)[0], weights @ drawn, rtol=0, atol=0.01)


def test_rotating_space_rotates_the_prediction():
    plain = GaussianMixture(draw(3, 4), draw(3, 4, seed=1).exp())
    rotation, x = random_rotation(4), draw(5, 4, seed=2)
    rotated = GaussianMixture(plain.means @ rotation.T, plain.variances, rotation=rotation)
    torch.testing.assert_close(rotated.denoise(x @ rotation.T, 0.7), plain.denoise(x, 0.7) @ rotation.T)


def test_shape_of_latents_is_kept_and_levels_go_by_row():
    data, x, sigma = mixture(8), draw(3, 2, 2, 2), torch.tensor([0.1, 1.0, 10.0], dtype=torch.float64)
    rows = [data.denoise(x[row : row + 1], sigma[row].item()) for row in range(3)]
    torch.testing.assert_close(data.denoise(x, sigma), torch.cat(rows))


def test_without_noise_the_state_is_the_data():
    x = draw(3, 4)
    torch.testing.assert_close(mixture().denoise(x, 0.0), x)
    assert (mixture().noise(x, 0.0) == 0).all()


def test_guidance_extrapolates_between_the_two():
    data, other, x = mixture(), mixture(seed=7), draw(3, 4)
    conditional, unconditional = data.denoise(x, 0.5), other.denoise(x, 0.5)
    torch.testing.assert_close(guided_denoise(data, other, 7.5, x, 0.5), 7.5 * conditional - 6.5 * unconditional)
    torch.testing.assert_close(guided_denoise(data, other, 1.0, x, 0.5), conditional)


# At the extremes ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sigma", SIGMAS)
@pytest.mark.parametrize("conditioning", [1.0, 1e2, 1e8, 1e12])
def test_ill_conditioned_gaussians_to_the_last_digits(conditioning, sigma):
    """(v x + sigma^2 m) / (v + sigma^2), in extended precision."""
    variances = torch.logspace(0, -math.log10(conditioning), 12, dtype=torch.float64)
    means, x = draw(1, 12), draw(3, 12, seed=1) * math.hypot(1, sigma)
    v, m, wide, tau = (np.asarray(value, dtype=np.longdouble) for value in (variances, means, x, sigma))
    tau = tau**2
    data = GaussianMixture(means, variances[None])
    np.testing.assert_allclose(
        data.denoise(x, sigma).numpy(), ((v * wide + tau * m) / (v + tau)).astype(float), rtol=1e-13, atol=1e-15
    )
    np.testing.assert_allclose(
        data.noise(x, sigma).numpy(), (np.sqrt(tau) * (wide - m) / (v + tau)).astype(float), rtol=1e-13
    )


@pytest.mark.parametrize("sigma", SIGMAS)
@pytest.mark.parametrize("deviation", [1e-6, 1.0, 1e3])
@pytest.mark.parametrize("distance", [1.0, 1e6])
def test_far_apart_and_narrow_modes_give_finite_predictions_within_reach(deviation, distance, sigma):
    """Each prediction lies between the modes, or between a mode and the state."""
    means = distance * torch.eye(3, 5, dtype=torch.float64)
    data = GaussianMixture(means, torch.full_like(means, deviation**2))
    x = draw(4, 5) * (distance + sigma)
    denoised, noise = data.posterior_means(x, sigma)
    assert torch.isfinite(denoised).all() and torch.isfinite(noise).all()
    assert (denoised.abs() <= torch.maximum(x.abs(), torch.tensor(distance)) * (1 + 1e-12)).all()
    torch.testing.assert_close(denoised + sigma * noise, x, rtol=1e-9, atol=1e-9 * (distance + sigma))


def test_near_a_mode_the_others_do_not_count():
    means = torch.tensor([[0.0, 0.0], [1e3, 0.0]])
    x = torch.tensor([[999.9, 0.05]], dtype=torch.float64)
    data = GaussianMixture(means, torch.full((2, 2), 1e-12))
    alone = GaussianMixture(means[1:], torch.full((1, 2), 1e-12))
    torch.testing.assert_close(data.denoise(x, 0.1), alone.denoise(x, 0.1), rtol=0, atol=0)


def test_in_much_noise_only_the_mean_of_the_data_is_left():
    data = mixture()
    expected = (data.weights @ data.means).expand(2, 4)
    torch.testing.assert_close(data.denoise(draw(2, 4), 1e6), expected, rtol=0, atol=1e-5)


# What is refused ------------------------------------------------------------------------------------------------------

ONES = torch.ones(2, 3)


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("means", (torch.ones(3), torch.ones(3))),
        ("means", (torch.full((2, 3), float("nan")), ONES)),
        ("variances", (ONES, torch.ones(3))),
        ("variances", (ONES, ONES * 0)),
        ("weights", (ONES, ONES, torch.ones(3))),
        ("weights", (ONES, ONES, torch.tensor([2.0, -1.0]))),
        ("weights", (ONES, ONES, torch.zeros(2))),
        ("rotation", (ONES, ONES, None, torch.eye(2))),
        ("rotation", (ONES, ONES, None, 2 * torch.eye(3))),
    ],
)
def test_no_mixture(name, arguments):
    with pytest.raises(InvalidInputError, match=f"`{name}`"):
        GaussianMixture(*arguments)


def test_states_of_another_size_are_refused():
    with pytest.raises(InvalidInputError, match="pass states with 4 values a row"):
        mixture().denoise(draw(2, 5), 1.0)


def test_weights_are_brought_to_one():
    torch.testing.assert_close(GaussianMixture(ONES, ONES, [1.0, 3.0]).weights, torch.tensor([0.25, 0.75]).double())


# As a network ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("prediction_type", PREDICTION_TYPES)
@pytest.mark.parametrize("config", CONFIGS)
def test_diffusers_reads_the_best_prediction_from_the_network(config, prediction_type):
    """What a DDIM step takes for x_0 is E[x_0 | x]."""
    scheduler = DDIMScheduler(**config, prediction_type=prediction_type, clip_sample=False)
    scheduler.alphas_cumprod = scheduler.alphas_cumprod.double()
    scheduler.set_timesteps(5)
    data, levels = mixture(), NoiseSchedule.of(DDIMScheduler(**config))
    network = ExactNetwork(data, levels, prediction_type)
    for timestep in scheduler.timesteps:
        z = draw(2, 4, 1, 1)
        got = scheduler.step(network(z, timestep), timestep, z).pred_original_sample
        sigma = levels.sigma(timestep)
        torch.testing.assert_close(got, data.denoise(z / alpha(sigma), sigma), rtol=1e-5, atol=1e-5)


def test_timesteps_between_levels():
    network, z = ExactNetwork(mixture(), schedule(), "sample"), draw(2, 4)
    sigma = math.sqrt(schedule().sigma(500).item() * schedule().sigma(501).item())
    torch.testing.assert_close(network(z, 500.5), mixture().denoise(z * math.hypot(1, sigma), sigma))


def test_timesteps_by_row():
    network, z = ExactNetwork(mixture(), schedule()), draw(2, 4)
    rows = [network(z[:1], 3), network(z[1:], 700)]
    torch.testing.assert_close(network(z, torch.tensor([3, 700])), torch.cat(rows))


def test_with_guidance_the_first_half_is_unconditional():
    data, other, z = mixture(), mixture(seed=7), draw(3, 4)
    network = ExactNetwork(data, schedule(), unconditional=other)
    expected = torch.cat([ExactNetwork(other, schedule())(z, 500), ExactNetwork(data, schedule())(z, 500)])
    torch.testing.assert_close(network(torch.cat([z, z]), 500), expected)
    network.guided = False
    torch.testing.assert_close(network(z, 500), expected[3:])


def test_with_guidance_an_odd_batch_is_refused():
    with pytest.raises(InvalidInputError, match="`sample` has 3 rows, but the network is `guided`"):
        ExactNetwork(mixture(), schedule(), unconditional=mixture())(draw(3, 4), 500)


@pytest.mark.parametrize(
    ("message", "options"),
    [
        ("`guided` is True without", {"guided": True}),
        ("`unconditional` has 5 dimensions and `data` 4", {"unconditional": mixture(5)}),
        ("`prediction_type` is 'noise'", {"prediction_type": "noise"}),
    ],
)
def test_no_network(message, options):
    with pytest.raises(InvalidInputError, match=message):
        ExactNetwork(mixture(), schedule(), **options)


def test_called_as_a_unet():
    network, z = ExactNetwork(mixture(), schedule()), draw(2, 4)
    conditions = {"encoder_hidden_states": draw(2, 1, 8), "class_labels": torch.zeros(2)}
    (prediction,) = network(z, 500, **conditions, return_dict=False)
    assert torch.equal(prediction, network(z, 500))
    output = network(z, 500, **conditions, return_dict=True)
    assert isinstance(output, UNet2DConditionOutput) and torch.equal(output.sample, prediction)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32])
def test_only_the_result_is_rounded(dtype):
    """Whatever the dtype of the states, and wherever `to` has put the network."""
    network, z = ExactNetwork(mixture(), schedule()), draw(2, 4).to(dtype)
    expected = network(z.double(), 500).to(dtype)
    got = network.to(dtype)(z, 500)
    assert network.dtype == dtype and torch.equal(got, expected)
