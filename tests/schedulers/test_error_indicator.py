"""Error indicators at no evaluation, against true errors."""

import numpy as np
import pytest
import torch
from diffusers import DDPMScheduler, EulerAncestralDiscreteScheduler, KDPM2DiscreteScheduler

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.numerics.problems import make_problem
from unitouch_gen.numerics.reference import relative_rms
from unitouch_gen.schedulers.exponential import UNCALIBRATED, Calibration, ErrorIndicator
from unitouch_gen.schedulers.solvers import SOLVERS

pytestmark = pytest.mark.filterwarnings("ignore:__array_wrap__ must accept context:DeprecationWarning")


def run(solver, steps, name="gaussian-guided", seed=0, scheduler=None):
    """(indicators, true errors) of eight samples."""
    problem = make_problem(name)
    noise = problem.noise(8, seed)
    latents, report = problem.run(noise, scheduler or solver, steps)
    return np.asarray(report.error_indicator), relative_rms(latents, problem.solution(noise)).numpy()


def test_the_indicator_costs_no_evaluation():
    problem = make_problem("gaussian")
    calls, network = [], problem.network()

    def counting(state, timestep):
        calls.append(timestep)
        return network(state, timestep)

    _, report = problem.run(problem.noise(1), "dpm++2m", 12, network=counting)
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


@pytest.mark.parametrize("steps", [1, 2])
def test_one_or_two_evaluations_say_nothing(steps):
    assert len(run("dpm++2m", steps)[0]) == 0


@pytest.mark.filterwarnings("ignore")
def test_levels_that_rise_again_are_no_division_by_zero():
    """diffusers' KDPM2 rounds every other timestep in Karras spacing, so that some of its steps go back."""
    own = make_problem("gaussian").scheduler().config
    indicators, errors = run(
        None, 50, "gaussian", scheduler=KDPM2DiscreteScheduler.from_config(own, use_karras_sigmas=True)
    )
    assert (indicators > 0).all() and (indicators < 0.5).all() and (errors < 0.5).all()


CALIBRATION = Calibration((1e-4, 1e-2, 1.0), (1e-5, 1e-2, 0.1))


@pytest.mark.parametrize(("indicator", "error"), [
    (1e-4, 1e-5), (1e-3, 10**-3.5), (1e-2, 1e-2), (0.1, 10**-1.5),  # on the line and between its points
    (1e-6, 1e-8), (100.0, 1.0),  # beyond: 1.5 decades a decade, and half of one
    (0.0, 0.0),
])  # fmt: skip
def test_a_calibration_is_a_line_in_logarithms(indicator, error):
    assert CALIBRATION.error(indicator) == pytest.approx(error)
    assert CALIBRATION.indicator(error) == pytest.approx(indicator)


def test_uncalibrated_an_estimate_is_the_indicator():
    assert UNCALIBRATED.error(0.0123) == pytest.approx(0.0123)


@pytest.mark.parametrize(("indicators", "errors", "match"), [
    ((1.0,), (1.0,), "`indicators`"), ((1.0, 1.0), (1.0, 2.0), "`indicators`"),
    ((0.0, 1.0), (1.0, 2.0), "`indicators`"),
    ((1.0, 2.0), (2.0, 1.0), "`errors`"), ((1.0, 2.0), (float("nan"), 1.0), "`errors`"),
    ((1.0, 2.0), (1.0, 2.0, 3.0), "`errors` holds 3 for 2"),
])  # fmt: skip
def test_points_have_to_rise(indicators, errors, match):
    with pytest.raises(InvalidInputError, match=match):
        Calibration(indicators, errors)
