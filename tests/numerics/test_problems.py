"""Exact problems: denoisers of mixtures, flows of Gaussians, the problems by name, and their networks.

Against quadrature, densities of torch.distributions, scipy on dense covariances, and diffusers' own steps.
"""

import math

import numpy as np
import pytest
import torch
from diffusers import DDIMScheduler
from scipy.integrate import quad, solve_ivp
from torch.distributions import Categorical, MixtureSameFamily, MultivariateNormal

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.numerics.problems import (
    PROBLEMS,
    STABLE_DIFFUSION,
    ExactNetwork,
    GaussianMixture,
    Problem,
    all_problems,
    make_problem,
    random_rotation,
)
from unitouch_gen.numerics.reference import relative_rms, solve_reference
from unitouch_gen.numerics.targets import ProblemTarget
from unitouch_gen.pipelines.tiny import tiny
from unitouch_gen.schedulers.schedule import PREDICTION_TYPES, NoiseSchedule, alpha

# numpy 2 on diffusers' DEIS.
pytestmark = pytest.mark.filterwarnings("ignore:__array_wrap__ must accept context:DeprecationWarning")

CONFIGS = [STABLE_DIFFUSION, {"beta_schedule": "squaredcos_cap_v2"}, {"num_train_timesteps": 50, "beta_end": 0.3}]
SIGMAS = [1e-6, 1e-3, 0.3, 1.0, 14.6, 1e3, 1e6]


def draw(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def mixture(dimensions: int = 4, seed: int = 0) -> GaussianMixture:
    """Three components along rotated axes."""
    variances = draw(3, dimensions, seed=seed + 1).exp()
    weights, rotation = torch.tensor([0.2, 0.5, 0.3]), random_rotation(dimensions, seed)
    return GaussianMixture(draw(3, dimensions, seed=seed), variances, weights, rotation)


def network(data: GaussianMixture, prediction_type: str = "epsilon", **settings) -> ExactNetwork:
    return Problem("", "", (4, 1, 1), data, prediction_type=prediction_type, **settings).network()


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
    torch.testing.assert_close(data.posterior_means(x, sigma)[1], -sigma * score, rtol=1e-9, atol=1e-9)


def test_mean_of_the_posterior_by_simulation():
    """The data that were drawn, those weighted by how well they explain x."""
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
    assert (mixture().posterior_means(x, 0.0)[1] == 0).all()


def test_guidance_extrapolates_between_the_two():
    data, other, x = mixture(), mixture(seed=7), draw(3, 4)
    conditional, unconditional = data.denoise(x, 0.5), other.denoise(x, 0.5)
    strong, plain = (Problem("", "", (4, 1, 1), data, other, scale) for scale in (7.5, 1.0))
    torch.testing.assert_close(strong.denoise(x, 0.5), 7.5 * conditional - 6.5 * unconditional)
    torch.testing.assert_close(plain.denoise(x, 0.5), conditional)


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
        data.posterior_means(x, sigma)[1].numpy(), (np.sqrt(tau) * (wide - m) / (v + tau)).astype(float), rtol=1e-13
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


# The flow of Gaussian data --------------------------------------------------------------------------------------------

AXES = random_rotation(3)


def gaussian(variances: list[float], seed: int = 0, axes: torch.Tensor | None = AXES) -> GaussianMixture:
    return GaussianMixture(draw(1, len(variances), seed=seed), torch.tensor([variances]), rotation=axes)


def guided(data: GaussianMixture, other: GaussianMixture | None = None, scale: float = 1.0) -> Problem:
    return Problem("", "", (3, 1, 1), data, other, scale)


def solved(data: GaussianMixture, other: GaussianMixture, scale: float, x: torch.Tensor, high: float, low: float):
    """scipy's answer, with E[x_0 | x] = m + C (C + sigma^2 I)^-1 (x - m) by linear algebra."""

    def denoise(gaussian: GaussianMixture, x: np.ndarray, sigma: float) -> np.ndarray:
        mean = gaussian.means[0].numpy()
        covariance = (gaussian.rotation * gaussian.variances[0] @ gaussian.rotation.T).numpy()
        return mean + covariance @ np.linalg.solve(covariance + sigma**2 * np.eye(3), x - mean)

    def slope(u: float, x: np.ndarray) -> np.ndarray:
        conditional, unconditional = (denoise(one, x, math.exp(u)) for one in (data, other))
        return x - unconditional - scale * (conditional - unconditional)

    options = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-12}
    rows = [solve_ivp(slope, (math.log(high), math.log(low)), row.numpy(), **options).y[:, -1] for row in x]
    return torch.from_numpy(np.stack(rows))


@pytest.mark.parametrize("scale", [1.0, 2.5, 7.5])
def test_as_scipy_solves_it(scale):
    """Narrower along one axis, wider along another, the same along the third; the means apart."""
    data, other = gaussian([0.1, 1.5, 0.4]), gaussian([0.9, 0.5, 0.4], seed=1)
    x = draw(2, 3, seed=2) * 14
    got = guided(data, other, scale).follow(x, 14.0, 0.05)
    torch.testing.assert_close(got, solved(data, other, scale, x, 14.0, 0.05), rtol=1e-9, atol=1e-9)


def test_distance_in_deviations_is_conserved():
    """Without guidance the flow takes N(m, C + sigma^2 I) to N(m, C), so (x - m) / deviation stays along every axis."""
    data, x = gaussian([1e-12, 0.3, 100.0]), draw(4, 3, seed=1) * 20
    end = guided(data).follow(x, 20.0)
    before = data.to_axes(x - data.means) / (data.variances + 400.0).sqrt()
    after = data.to_axes(end - data.means) / data.variances.sqrt()
    torch.testing.assert_close(after[:, 1:], before[:, 1:], rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(after[:, 0], before[:, 0], rtol=0, atol=1e-9)  # 1e-6 beside means of 1: digits are lost


@pytest.mark.parametrize("scale", [1.0, 7.5, 30.0])
def test_two_parts_of_the_way_are_the_whole(scale):
    data, other, x = gaussian([0.01, 1.0, 0.3]), gaussian([0.5, 0.2, 0.3], seed=1), draw(2, 3, seed=2) * 20
    follow = guided(data, other, scale).follow
    torch.testing.assert_close(follow(follow(x, 20.0, 0.7), 0.7), follow(x, 20.0), rtol=1e-11, atol=1e-11)


def test_the_slope_is_that_of_the_ode():
    """dx/dsigma = (x - D) / sigma at sigma = 0.5, by central differences."""
    data, other, x = gaussian([0.01, 1.0, 0.3]), gaussian([0.5, 0.2, 0.3], seed=1), draw(2, 3, seed=2)
    follow = guided(data, other, 3.0).follow
    start, ahead, behind = (follow(x, 0.6, 0.5 + step) for step in (0.0, 1e-5, -1e-5))
    denoised = 3 * data.denoise(start, 0.5) - 2 * other.denoise(start, 0.5)
    torch.testing.assert_close((ahead - behind) / 2e-5, (start - denoised) / 0.5, rtol=1e-6, atol=1e-6)


def test_no_way_to_go():
    data, other, x = gaussian([0.01, 1.0, 0.3]), gaussian([0.5, 0.2, 0.3], seed=1), draw(2, 3, seed=2)
    got = guided(data, other, 3.0).follow(x, 0.5, 0.5)
    torch.testing.assert_close(got, x, rtol=1e-14, atol=1e-14)


def test_guidance_of_one_is_none():
    data, x = gaussian([0.01, 1.0, 0.3]), draw(2, 3, seed=2)
    other = gaussian([0.5, 0.2, 0.3], seed=1)
    assert torch.equal(guided(data, other, 1.0).follow(x, 5.0), guided(data).follow(x, 5.0))


@pytest.mark.parametrize("scale", [1.0, 30.0, 300.0])
def test_extremes_are_finite(scale):
    data, other = gaussian([1e-12, 1e-3, 1.0]), gaussian([1e-12, 2e-3, 1.0], seed=1)
    x = draw(2, 3, seed=2) * 1e6
    assert torch.isfinite(guided(data, other, scale).follow(x, 1e6)).all()


def test_the_flow_keeps_the_shape_of_latents():
    x = draw(2, 3, 1, 1)
    assert guided(gaussian([0.1, 1.0, 2.0])).follow(x, 5.0).shape == x.shape


# Flows that are refused -----------------------------------------------------------------------------------------------

MIXTURE = GaussianMixture(draw(2, 3), torch.ones(2, 3))


@pytest.mark.parametrize(
    ("data", "other"),
    [
        (MIXTURE, None),
        (gaussian([1.0, 1.0, 2.0], axes=None), MIXTURE),
        (gaussian([1.0, 1.0, 2.0]), gaussian([1.0, 1.0, 2.0], axes=None)),
        (gaussian([1.0, 1.0, 2.0]), gaussian([1.0, 1.0, 2.0], axes=random_rotation(3, seed=1))),
    ],
)
def test_no_closed_form(data, other):
    problem = guided(data, other, 1.0 if other is None else 2.0)
    assert not problem.has_solution
    with pytest.raises(InvalidInputError, match="no closed form; solve it with `solve_reference`"):
        problem.follow(draw(1, 3), 1.0)


@pytest.mark.parametrize(("name", "levels"), [("sigma_from", (1.0, 2.0)), ("sigma_to", (1.0, -1.0))])
def test_flows_to_levels_out_of_range(name, levels):
    with pytest.raises(InvalidInputError, match=f"`{name}`"):
        guided(gaussian([1.0, 1.0, 2.0])).follow(draw(1, 3), *levels)


NAMES = list(PROBLEMS)
GAUSSIAN = GaussianMixture(torch.zeros(1, 4), torch.ones(1, 4))


def by_loop(problem: Problem, noise: torch.Tensor, solver: str, steps: int) -> torch.Tensor:
    """Latents of the loop that every pipeline runs."""
    return problem.run(noise, solver, steps)[0]


# The registry ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_problems_are_as_they_say(name):
    problem = make_problem(name)
    assert problem.name == name and problem.description and "\n" not in problem.description
    assert problem.noise(2).shape == (2, *problem.shape)
    assert problem.guidance.active == problem.network().guided


def test_problems_differ():
    assert len({ProblemTarget(problem).identity for problem in all_problems()}) == len(NAMES)


def test_unknown_name():
    with pytest.raises(InvalidInputError, match="Did you mean 'gaussian'"):
        make_problem("gausian")


@pytest.mark.parametrize(
    ("message", "options"),
    [
        ("`shape` is", {"shape": (1, 2, 3)}),
        ("without `unconditional`", {"guidance_scale": 3.0}),
        ("`guidance_scale` is nan", {"guidance_scale": float("nan")}),
        ("`prediction_type` is 'noise'", {"prediction_type": "noise"}),
        ("`unconditional` has 3 dimensions and `data` 4", {"unconditional": mixture(3)}),
    ],
)
def test_no_problem(message, options):
    with pytest.raises(InvalidInputError, match=message):
        Problem(**{"name": "", "description": "", "shape": (4, 1, 1), "data": GAUSSIAN} | options)


# Noise and answers ----------------------------------------------------------------------------------------------------


def test_noise_is_the_same_in_any_batch():
    problem = make_problem("mixture")
    assert torch.equal(problem.noise(5)[:2], problem.noise(2))
    assert not torch.equal(problem.noise(2), problem.noise(2, seed=1))


def test_solvers_in_float32_start_from_the_same_noise():
    noise = make_problem("mixture").noise(3)
    assert noise.dtype == torch.float64 and torch.equal(noise.float().double(), noise)


@pytest.mark.parametrize("name", ["gaussian", "gaussian-guided-30", "pure-noise"])
def test_the_flow_starts_at_the_noise(name):
    problem = make_problem(name)
    noise, largest = problem.noise(2), problem.schedule.sigma_max
    torch.testing.assert_close(problem.solution(noise, largest), noise * (1 + largest**2) ** 0.5)


# In the sampling loop -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "solver"),
    [
        ("gaussian", "dpm++2m"),
        ("gaussian-guided", "dpm++2m"),
        ("gaussian-cosine", "deis"),
        ("gaussian-50-levels", "deis"),
        ("conditioning-1e4", "dpm++2m"),
    ],
)
def test_the_loop_comes_to_the_closed_form(name, solver):
    problem = make_problem(name)
    noise = problem.noise(2)
    error = relative_rms(by_loop(problem, noise, solver, 80), problem.solution(noise))
    assert (error < 0.02).all()


@pytest.mark.parametrize("name", ["mixture", "mixture-3", "mixture-7.5"])
def test_the_loop_comes_to_the_reference(name):
    problem = make_problem(name)
    noise = problem.noise(4)
    reference = solve_reference(problem.flow, noise, rtol=1e-6, end="zero")
    coarse, fine = (relative_rms(by_loop(problem, noise, "dpm++2m", n), reference.latents).max() for n in (10, 40))
    assert fine < 0.02 and fine < coarse / 2


def test_in_place_of_a_pipelines_unet():
    """The data of both branches is Gaussian: the picture's latents are those of the closed form."""
    pipe = tiny("x-to-touch")
    pipe.set_progress_bar_config(disable=True)
    unet = pipe.unet.config
    shape = (unet.out_channels, unet.sample_size, unet.sample_size)
    size = torch.Size(shape).numel()
    variances = torch.logspace(0, -1, size, dtype=torch.float64)[None]
    problem = Problem(
        "pipeline",
        "Latents of a pipeline",
        shape,
        GaussianMixture(torch.full((1, size), 0.3), variances),
        GaussianMixture(torch.zeros(1, size), variances * 2),
        guidance_scale=3.0,
        prediction_type=pipe.scheduler.config.prediction_type,
    )
    network = problem.network()
    network.config = unet
    pipe.unet = network
    noise = problem.noise(1)
    output = pipe(text="rough brick", latents=noise, guidance_scale=3.0, num_inference_steps=40, output_type="latent")
    assert relative_rms(output.images, problem.solution(noise)).item() < 0.02


# As a network ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("prediction_type", PREDICTION_TYPES)
@pytest.mark.parametrize("config", CONFIGS)
def test_diffusers_reads_the_best_prediction_from_the_network(config, prediction_type):
    """What a DDIM step takes for x_0 is E[x_0 | x]."""
    scheduler = DDIMScheduler(**config, prediction_type=prediction_type, clip_sample=False)
    scheduler.alphas_cumprod = scheduler.alphas_cumprod.double()
    scheduler.set_timesteps(5)
    data, levels = mixture(), NoiseSchedule.of(DDIMScheduler(**config))
    exact = network(data, prediction_type, schedule_config=config)
    for timestep in scheduler.timesteps:
        z = draw(2, 4, 1, 1)
        got = scheduler.step(exact(z, timestep), timestep, z).pred_original_sample
        sigma = levels.sigma(timestep)
        torch.testing.assert_close(got, data.denoise(z / alpha(sigma), sigma), rtol=1e-5, atol=1e-5)


def test_timesteps_between_levels():
    exact, z = network(mixture(), "sample"), draw(2, 4)
    sigma = math.sqrt(exact.schedule.sigma(500).item() * exact.schedule.sigma(501).item())
    torch.testing.assert_close(exact(z, 500.5), mixture().denoise(z * math.hypot(1, sigma), sigma))


def test_timesteps_by_row():
    exact, z = network(mixture()), draw(2, 4)
    rows = [exact(z[:1], 3), exact(z[1:], 700)]
    torch.testing.assert_close(exact(z, torch.tensor([3, 700])), torch.cat(rows))


def test_with_guidance_the_first_half_is_unconditional():
    data, other, z = mixture(), mixture(seed=7), draw(3, 4)
    exact = network(data, unconditional=other, guidance_scale=2.0)
    expected = torch.cat([network(other)(z, 500), network(data)(z, 500)])
    torch.testing.assert_close(exact(torch.cat([z, z]), 500), expected)
    exact.guided = False
    torch.testing.assert_close(exact(z, 500), expected[3:])


def test_with_guidance_an_odd_batch_is_refused():
    with pytest.raises(InvalidInputError, match="`sample` has 3 rows, but the network is `guided`"):
        network(mixture(), unconditional=mixture(), guidance_scale=2.0)(draw(3, 4), 500)


def test_called_as_a_unet():
    exact, z = network(mixture()), draw(2, 4)
    conditions = {"encoder_hidden_states": draw(2, 1, 8), "class_labels": torch.zeros(2)}
    (prediction,) = exact(z, 500, **conditions, return_dict=False)
    assert torch.equal(prediction, exact(z, 500))


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32])
def test_only_the_result_is_rounded(dtype):
    """Whatever the dtype of the states, and wherever `to` has put the network."""
    exact, z = network(mixture()), draw(2, 4).to(dtype)
    expected = exact(z.double(), 500).to(dtype)
    got = exact.to(dtype)(z, 500)
    assert exact.dtype == dtype and torch.equal(got, expected)
