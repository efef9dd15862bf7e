"""Error indicators at no evaluation, against true errors."""

import numpy as np
import pytest
import torch
from diffusers import DDPMScheduler, EulerAncestralDiscreteScheduler

from unitouch_gen.diffusion.estimate import Calibration, ErrorIndicator
from unitouch_gen.diffusion.report import RunReport
from unitouch_gen.diffusion.sampling import fixed_steps, integrate, prepare_steps
from unitouch_gen.diffusion.solvers import SOLVERS, make_scheduler
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.numerics.problems import make_problem
from unitouch_gen.numerics.reference import relative_rms

pytestmark = pytest.mark.filterwarnings("ignore:__array_wrap__ must accept context:DeprecationWarning")


def run(solver, steps, name="gaussian-guided", seed=0, scheduler=None):
    """(indicators, true errors) of eight samples."""
    problem = make_problem(name)
    noise = problem.noise(8, seed)
    scheduler = scheduler or make_scheduler(problem.scheduler(), solver)
    timesteps = prepare_steps(scheduler, steps, torch.device("cpu"))
    report = RunReport()
    made = fixed_steps(scheduler, timesteps, steps, noise)
    latents = integrate(problem.network(), made, lambda: problem.guidance, report)
    return np.asarray(report.error_indicator), relative_rms(latents, problem.solution(noise)).numpy()


def fitted(solver, counts, seeds):
    """Two constants by least squares of logarithms."""
    pairs = [run(solver, steps, seed=seed) for steps in counts for seed in seeds]
    indicators, errors = (np.log(np.concatenate(part)) for part in zip(*pairs, strict=True))
    power, offset = np.polyfit(indicators, errors, 1)
    return Calibration(float(np.exp(offset)), float(power))


@pytest.mark.parametrize("solver", ["heun", "dpm++2m", "unipc", "deis"])
def test_a_calibrated_estimate_is_near_the_true_error(solver):
    """Effectivity within 0.3 to 3 of at least nine runs in ten, on seeds apart from those of the fit."""
    calibration = fitted(solver, (6, 10, 16, 24, 40), seeds=(1, 2))
    for steps in (8, 12, 20, 32):
        indicators, errors = run(solver, steps, seed=3)
        estimates = calibration.factor * indicators**calibration.power
        effectivity = estimates / errors
        assert ((effectivity > 0.3) & (effectivity < 3.0)).mean() >= 0.9


def test_the_indicator_costs_no_evaluation():
    problem = make_problem("gaussian")
    calls, network = [], problem.network()

    def counting(state, timestep):
        calls.append(timestep)
        return network(state, timestep)

    scheduler = make_scheduler(problem.scheduler(), "dpm++2m")
    timesteps = prepare_steps(scheduler, 12, torch.device("cpu"))
    report = RunReport()
    integrate(counting, fixed_steps(scheduler, timesteps, 12, problem.noise(1)), lambda: problem.guidance, report)
    assert len(calls) == 12 and len(report.error_indicator) == 1


@pytest.mark.parametrize("solver", SOLVERS)
def test_more_steps_have_a_smaller_indicator(solver):
    indicators = [run(solver, steps)[0].mean() for steps in (8, 16, 32, 64)]
    assert indicators == sorted(indicators, reverse=True)


@pytest.mark.parametrize("scheduler", [DDPMScheduler, EulerAncestralDiscreteScheduler])
def test_schedulers_that_add_noise_have_none(scheduler):
    """They do not follow the flow, so there is nothing to be far from."""
    own = make_problem("gaussian").scheduler().config
    made = scheduler.from_config({key: own[key] for key in ("beta_start", "beta_end", "beta_schedule")})
    indicators, _ = run(None, 10, "gaussian", scheduler=made)
    assert len(indicators) == 0


def test_data_that_goes_straight_in_log_sigma_leaves_nothing_out():
    indicator = ErrorIndicator()
    for sigma in (8.0, 4.0, 2.0):
        indicator.add(sigma, torch.full((1, 1, 1, 1), 3.0))
    assert indicator.of(torch.ones(1, 1, 1, 1)).item() == 0.0


def test_a_calibration_goes_there_and_back():
    calibration = Calibration(0.3, 1.4)
    assert calibration.indicator(calibration.error(0.02)) == pytest.approx(0.02)


@pytest.mark.parametrize("constants", [(0.0, 1.0), (1.0, 0.0), (-1.0, 1.0), (float("nan"), 1.0)])
def test_constants_have_to_be_above_zero(constants):
    with pytest.raises(InvalidInputError, match=r"`factor`|`power`"):
        Calibration(*constants)
