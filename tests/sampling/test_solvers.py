"""Flat solvers against diffusers' schedulers, step by step, and against flows that are known; steps to a tolerance."""

import itertools
import math

import diffusers
import pytest
import torch
from scipy.integrate import quad

from unitouch_gen.errors import NotConvergedError
from unitouch_gen.numerics.problems import PROBLEMS, STABLE_DIFFUSION, relative_rms
from unitouch_gen.sampling import ReturnCode
from unitouch_gen.schedule import alpha
from unitouch_gen.solvers import SOLVERS, denoised_at_zero, exponential_integral, sample_ddim

MIXTURE = PROBLEMS["mixture"]
GAUSSIAN = PROBLEMS["gaussian"]
NOISE = MIXTURE.noise(3).float()
KARRAS = {**STABLE_DIFFUSION, "use_karras_sigmas": True, "timestep_spacing": "linspace"}
THEIRS = {
    "euler": diffusers.EulerDiscreteScheduler(**KARRAS),
    "heun": diffusers.HeunDiscreteScheduler(**KARRAS),
    "dpm++2m": diffusers.DPMSolverMultistepScheduler(**KARRAS, solver_order=2),
    "unipc": diffusers.UniPCMultistepScheduler(**KARRAS, solver_order=2, solver_type="bh2"),
}


def by_diffusers(scheduler, steps: int, start: torch.Tensor, **options) -> torch.Tensor:
    """Where diffusers' scheduler arrives at the smallest level, variance-preserving.

    It rounds the timesteps of noise levels; here the exact denoiser is asked at the level itself.
    """
    scheduler.set_timesteps(steps)
    variance_exploding = scheduler.init_noise_sigma != 1.0
    sigmas = scheduler.sigmas.double()
    x = start * math.hypot(1.0, sigmas[0]) if variance_exploding else start
    for sigma, timestep in list(zip(sigmas.tolist(), scheduler.timesteps, strict=False))[:-1]:
        z = scheduler.scale_model_input(x, timestep)
        epsilon = MIXTURE.data.posterior_means(z / alpha(sigma), sigma)[1].float()
        x = scheduler.step(epsilon, timestep, x, return_dict=False, **options)[0]
    return x * alpha(sigmas[sigmas > 0].min().item()) if variance_exploding else x


@pytest.mark.parametrize("name", THEIRS)
def test_solver_steps_are_those_of_diffusers(name):
    """But for the last one, of second order here, and UniPC's first corrector, which is simplified there."""
    THEIRS["euler"].set_timesteps(11)
    sigmas = THEIRS["euler"].sigmas.tolist()
    seen = []
    SOLVERS[name].sample(
        lambda x, sigma: seen.append(x * alpha(sigma)) or MIXTURE.denoise(x, sigma).float(),
        NOISE * math.hypot(1.0, sigmas[0]),
        sigmas,
    )
    torch.testing.assert_close(by_diffusers(THEIRS[name], 11, NOISE), seen[-1], rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize(("eta", "steps"), [(0.0, 1), (0.0, 25), (0.5, 25), (1.0, 4)])
def test_ddim_is_that_of_diffusers(eta, steps):
    scheduler = diffusers.DDIMScheduler(**STABLE_DIFFUSION, clip_sample=False, timestep_spacing="trailing")
    scheduler.set_timesteps(steps)
    z = NOISE
    network = MIXTURE.network(3)
    for timestep in scheduler.timesteps:
        generator = torch.Generator().manual_seed(int(timestep))
        z = scheduler.step(network(z, timestep), timestep, z, eta=eta, generator=generator, return_dict=False)[0]
    schedule = MIXTURE.schedule
    sigmas = MIXTURE.schedule.trailing(steps)
    left = iter(schedule.timestep(torch.tensor(sigmas)).round().int().tolist())
    draw = lambda x: torch.randn(x.shape, generator=torch.Generator().manual_seed(next(left)))  # noqa: E731
    x = NOISE * math.hypot(1.0, sigmas[0])
    found = sample_ddim(lambda x, sigma: MIXTURE.denoise(x, sigma).float(), x, [*sigmas, 0.0], eta=eta, draw=draw)
    torch.testing.assert_close(found, z, rtol=1e-4, atol=1e-4)


# Against flows that are known -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("problem", [GAUSSIAN, PROBLEMS["mixture-3"]], ids=lambda problem: problem.name)
@pytest.mark.parametrize("solver", SOLVERS)
def test_differences_fall_at_the_order_of_the_solver(problem, solver):
    """Between runs of N and 2 N steps; all end with the same last step, which cancels."""
    counts = (80, 160, 320) if solver == "ddim" else (36, 72, 144)
    found = [problem.run(problem.noise(2), solver, num_inference_steps=count)[0] for count in counts]
    coarse, fine = (relative_rms(one, other).median() for one, other in itertools.pairwise(found))
    assert math.log2(coarse / fine) == pytest.approx(SOLVERS[solver].order, abs=0.35)


def test_one_step_goes_all_the_way_and_no_noise_stays():
    x = torch.full((1, 1, 2, 2), 15.0)
    sigmas = GAUSSIAN.schedule.karras(20)
    for solver, levels in itertools.product(SOLVERS.values(), ([sigmas[0], 0.0], [*sigmas, 0.0])):
        assert solver.sample(lambda x, sigma: torch.zeros_like(x), x, levels).abs().max() < 1e-6


@pytest.mark.parametrize("nodes", [[1.0], [1.5, 1.0], [1.0, 0.4], [2.0, 1.0, 0.4]])
def test_integrals_are_exact_for_polynomials_through_the_nodes(nodes):
    for target, power in itertools.product([0.99, 0.7, 0.1, 0.002], range(len(nodes))):
        step = -math.log(target)
        exact, _ = quad(lambda tau: math.exp(tau - step) * tau**power, 0.0, step)  # noqa: B023
        levels = [(sigma, torch.tensor((-math.log(sigma)) ** power, dtype=torch.float64)) for sigma in nodes]
        assert exponential_integral(levels, 1.0, target).item() == pytest.approx(exact, abs=1e-10)


def test_the_last_step_continues_data_that_goes_with_sigma_squared_from_levels_that_are_apart():
    levels = [(sigma, torch.tensor([3.0 + 4.0 * sigma**2])) for sigma in (0.9, 0.5, 0.2, 0.1)]
    torch.testing.assert_close(denoised_at_zero(levels), torch.tensor([3.0]))
    torch.testing.assert_close(denoised_at_zero(levels[:1]), levels[0][1])
    rough = [(0.03 * 1.01**power, torch.zeros(1)) for power in range(200, 0, -1)]
    assert 1.0 < denoised_at_zero([*rough, (0.03, torch.ones(1))]).item() < 1.81  # two neighbours would make it 50


# Steps to a tolerance -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["gaussian", "gaussian-guided", "gaussian-cosine", "mixture-7.5"])
def test_the_result_is_within_tolerance_for_more_evaluations_the_tighter(name):
    """Within twice of it: the constant is measured, not proved."""
    problem = PROBLEMS[name]
    evaluations = []
    noise = problem.noise(8)
    truth = problem.solution(noise)
    for tolerance in (0.1, 1e-2, 1e-3):
        latents, report = problem.run(noise, tolerance=tolerance)
        assert relative_rms(latents, truth).max() < 2 * tolerance
        assert report.codes == [ReturnCode.SUCCESS] * 8
        assert report.evaluations >= report.steps
        evaluations.append(report.evaluations)
    assert evaluations == sorted(evaluations)
    assert evaluations[-1] < 80


def test_the_last_step_ends_at_the_last_level_itself():
    for problem, tolerance in itertools.product([MIXTURE, GAUSSIAN], [0.2, 0.1, 0.07, 0.05, 0.03, 0.02, 0.015, 0.01]):
        network = problem.network(2)
        asked = []
        noted = lambda z, timestep: asked.append(float(timestep)) or network(z, timestep)  # noqa: E731, B023
        problem.run(problem.noise(2), tolerance=tolerance, network=noted)
        assert asked[-1] == 0.0
        assert all(one != other for one, other in itertools.pairwise(asked))


def test_a_network_that_turns_sharply_gets_steps_refused():
    problem = PROBLEMS["gaussian-50-levels"]  # predicts data
    network = problem.network(4)
    turning = lambda z, timestep: network(z, timestep) + 2.0 * (timestep < 25)  # noqa: E731
    _, report = problem.run(problem.noise(4), tolerance=0.03, network=turning)
    assert report.evaluations > report.steps


def test_too_few_evaluations_raise_or_return_the_last_prediction():
    noise = GAUSSIAN.noise(2)
    with pytest.raises(NotConvergedError, match=r"Stopped after 7 evaluations.*max_evaluations"):
        GAUSSIAN.run(noise, tolerance=0.01, max_evaluations=7)
    latents, report = GAUSSIAN.run(noise, tolerance=0.01, max_evaluations=7, throw=False)
    assert report.codes == [ReturnCode.MAX_EVALUATIONS] * 2
    assert report.evaluations == 7
    assert latents.abs().max() < 2 * GAUSSIAN.solution(noise).abs().max()  # rather than the noise of the state


def test_a_network_that_is_rough_on_every_scale_is_given_up():
    generator = torch.Generator().manual_seed(0)
    rough = lambda z, timestep: 10 * torch.randn(z.shape, generator=generator)  # noqa: E731
    _, report = GAUSSIAN.run(GAUSSIAN.noise(2), tolerance=1e-5, network=rough, throw=False)
    assert report.codes == [ReturnCode.MAX_EVALUATIONS] * 2
