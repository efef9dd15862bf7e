"""Steps fitted to a flow: against closed forms, and against named solvers on noise that was not fitted on."""

from itertools import pairwise

import pytest
import torch

from unitouch_gen.numerics.fitting import exact_path, fit_steps, noise_levels
from unitouch_gen.numerics.problems import make_problem
from unitouch_gen.numerics.reference import relative_rms
from unitouch_gen.sampling import RunReport, prepare_steps, sample
from unitouch_gen.schedulers.fitted import FittedScheduler
from unitouch_gen.schedulers.solvers import make_scheduler


def run(problem, scheduler, noise, steps: int) -> torch.Tensor:
    """Through the sampling loop."""
    network, report = problem.network(), RunReport()
    prepare_steps(scheduler, steps, noise.device)
    guidance = problem.guidance
    return sample(network_of(network), noise.float(), scheduler, report, guidance=guidance, throw=False)


def network_of(network):
    return lambda state, timestep: network(state, timestep)


@pytest.mark.parametrize("name", ["gaussian", "gaussian-guided"])
def test_the_path_is_the_closed_form(name):
    problem = make_problem(name)
    noise = problem.noise(4)
    path = exact_path(problem.flow, noise)
    for sigma in (10.0, 1.0, 0.1):
        assert relative_rms(path.at(sigma), problem.solution(noise, sigma)).max() < 1e-3
    assert relative_rms(path.end, problem.solution(noise)).max() < 1e-3


@pytest.fixture(scope="module")
def guided():
    """A guided mixture, and fits of it on 32 noises."""
    problem = make_problem("mixture-7.5")
    path = exact_path(problem.flow, problem.noise(32, seed=1))
    found = {steps: fit_steps(problem.flow, path, problem.guidance_scale, steps) for steps in (8, 12)}
    config = problem.scheduler().config
    shared = {key: config[key] for key in ("num_train_timesteps", "beta_start", "beta_end", "beta_schedule",
                                           "trained_betas", "prediction_type")}  # fmt: skip
    scheduler = FittedScheduler(**shared, fits=[fit.to_dict() for fit, _ in found.values()])
    return problem, found, scheduler


@pytest.mark.parametrize("steps", [8, 12])
def test_on_other_noise_fitted_steps_err_less_than_any_named_solver(guided, steps):
    problem, _, scheduler = guided
    noise = problem.noise(16, seed=2)
    truth = exact_path(problem.flow, noise, 400).end
    errors = {}
    for name in ("fitted", "dpm++2m", "unipc", "deis", "ddim"):
        own = make_scheduler(scheduler, name, steps=steps, guidance_scale=problem.guidance_scale)
        errors[name] = relative_rms(run(problem, own, noise, steps), truth).median().item()
    assert errors.pop("fitted") < 0.7 * min(errors.values())


def test_what_the_fit_promises_is_what_a_run_leaves(guided):
    """The same noise through the scheduler, in float32."""
    problem, found, scheduler = guided
    noise = problem.noise(32, seed=1)
    truth = exact_path(problem.flow, noise).end
    own = make_scheduler(scheduler, None, steps=8, guidance_scale=problem.guidance_scale)
    errors = relative_rms(run(problem, own, noise, 8), truth)
    assert errors.log().mean().exp().item() == pytest.approx(found[8][1], rel=0.02)


def test_more_steps_leave_less(guided):
    _, found, _ = guided
    assert found[12][1] < 0.6 * found[8][1]


def test_one_step_is_the_mean_of_the_data():
    """D at the largest level, as nothing came before it."""
    problem = make_problem("gaussian")
    noise = problem.noise(4)
    fit, _ = fit_steps(problem.flow, exact_path(problem.flow, noise, 60), 1.0, 1)
    assert fit.weights == ((),) and fit.sigmas[0] == pytest.approx(problem.schedule.sigma_max)


def test_levels_fall_from_the_first_of_training(guided):
    problem = guided[0]
    levels = noise_levels(problem.flow, 10, 4.0)
    assert levels[0] == pytest.approx(problem.schedule.sigma_max)
    assert all(high > low for high, low in pairwise(levels))
