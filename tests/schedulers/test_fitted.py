"""Steps that a checkpoint brings, against diffusers' multistep solver where their weights are its own."""

import math
from dataclasses import asdict

import pytest
import torch
from diffusers import DDIMScheduler

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.schedulers.fitted import Fit, FittedScheduler
from unitouch_gen.schedulers.solvers import ContinuousDPMSolverScheduler, make_scheduler

STEPS = 6


@pytest.fixture
def own() -> DDIMScheduler:
    return DDIMScheduler(beta_start=0.00085, beta_end=0.012, beta_schedule="scaled_linear", clip_sample=False)


def midpoint(sigmas: list[float], guidance_scale: float = 3.0) -> Fit:
    """DPM-Solver++(2M) (Lu et al., 2022, Algorithm 2): D moves on by half of what it moved over the step before.

    Its last step, to no noise, is of first order.
    """
    levels = [-math.log(sigma) for sigma in sigmas]
    rows: list[tuple[float, ...]] = []
    for number in range(len(sigmas)):
        row = [0.0] * number
        if 0 < number < len(sigmas) - 1:
            row[-1] = -0.5 * (levels[number + 1] - levels[number]) / (levels[number] - levels[number - 1])
        rows.append(tuple(row))
    return Fit(guidance_scale, tuple(sigmas), tuple(rows))


def fitted(own: DDIMScheduler, *fits: Fit, **settings) -> FittedScheduler:
    shared = {key: own.config[key] for key in ("beta_start", "beta_end", "beta_schedule", "prediction_type")}
    return FittedScheduler(**shared, fits=[asdict(fit) for fit in fits], **settings)


def bent(state: torch.Tensor, timestep: torch.Tensor) -> torch.Tensor:
    return torch.tanh(state + timestep / 500)


def run(scheduler, noise: torch.Tensor, steps: int = STEPS) -> torch.Tensor:
    scheduler.set_timesteps(steps)
    state = noise
    for timestep in scheduler.timesteps:
        state = scheduler.step(bent(state, timestep), timestep, state, return_dict=False)[0]
    return state


@pytest.mark.parametrize("prediction_type", ["epsilon", "v_prediction", "sample"])
def test_weights_of_dpm_solver_make_its_steps(own, prediction_type):
    own = DDIMScheduler.from_config(own.config, prediction_type=prediction_type)
    theirs = make_scheduler(own, "dpm++2m")
    assert isinstance(theirs, ContinuousDPMSolverScheduler)
    theirs.set_timesteps(STEPS)
    ours = fitted(own, midpoint(theirs.sigmas[:-1].tolist()))
    noise = torch.randn(2, 4, 8, 8, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(run(ours, noise), run(theirs, noise), rtol=2e-4, atol=2e-4)
    torch.testing.assert_close(ours.timesteps, theirs.timesteps, rtol=1e-4, atol=1e-2)


def test_saved_and_loaded_it_makes_the_same_steps(own, tmp_path):
    scheduler = fitted(own, midpoint([14.0, 2.0, 0.5, 0.1]), otherwise="unipc")
    scheduler.save_pretrained(tmp_path)
    loaded = FittedScheduler.from_pretrained(tmp_path)
    assert loaded.fits == scheduler.fits and loaded.config.otherwise == "unipc"
    noise = torch.ones(1, 4, 2, 2)
    assert torch.equal(run(loaded, noise, 4), run(scheduler, noise, 4))


def test_a_second_run_forgets_the_first(own):
    scheduler = fitted(own, midpoint([14.0, 2.0, 0.5, 0.1]))
    noise = torch.ones(1, 4, 2, 2)
    assert torch.equal(run(scheduler, noise, 4), run(scheduler, noise, 4))


def test_the_guidance_of_the_call_says_which_fit(own):
    scheduler = fitted(own, midpoint([14.0, 2.0, 0.5], 3.0), midpoint([14.0, 1.0, 0.5], 7.5))
    chosen = make_scheduler(scheduler, None, steps=3, guidance_scale=7.5)
    chosen.set_timesteps(3)
    assert chosen.fit == scheduler.fits[1]
    assert scheduler.fit is None  # the pipeline's own stays as it is


def test_between_two_guidances_levels_and_weights_lie_between(own):
    low, high = midpoint([14.0, 2.0, 0.5], 2.0), midpoint([16.0, 1.0, 0.25], 8.0)
    chosen = make_scheduler(fitted(own, low, high), None, steps=3, guidance_scale=4.0)
    chosen.set_timesteps(3)
    assert chosen.fit.guidance_scale == 4.0  # half way, as 4 = sqrt(2 8)
    assert chosen.fit.sigmas == pytest.approx([math.sqrt(14.0 * 16.0), math.sqrt(2.0), math.sqrt(0.125)])
    middle = [[(a + b) / 2 for a, b in zip(*rows, strict=True)] for rows in zip(low.weights, high.weights, strict=True)]
    assert [pytest.approx(row) for row in middle] == [list(row) for row in chosen.fit.weights]
    for outside in (1.0, 9.0):
        other = make_scheduler(fitted(own, low, high), None, steps=3, guidance_scale=outside)
        assert isinstance(other, ContinuousDPMSolverScheduler)


def test_guidance_that_is_off_is_one(own):
    scheduler = fitted(own, midpoint([14.0, 2.0, 0.5], 1.0), midpoint([14.0, 1.0, 0.5], 3.0))
    assert scheduler.find(3, 0.0) == scheduler.find(3, 1.0) == scheduler.fits[0]


@pytest.mark.parametrize("call", [
    {"steps": 4, "guidance_scale": 3.0}, {"steps": 3, "guidance_scale": 5.0},
    {"steps": 3, "guidance_scale": 3.0, "whole": False}, {},
])  # fmt: skip
def test_what_nothing_was_fitted_to_takes_the_other_solver(own, call):
    scheduler = fitted(own, midpoint([14.0, 2.0, 0.5]))
    assert isinstance(make_scheduler(scheduler, None, **call), ContinuousDPMSolverScheduler)


def test_a_solver_by_name_comes_before_fitted_steps(own):
    scheduler = fitted(own, midpoint([14.0, 2.0, 0.5]))
    chosen = make_scheduler(scheduler, "dpm++2m", steps=3, guidance_scale=3.0)
    assert isinstance(chosen, ContinuousDPMSolverScheduler)


def test_asked_for_by_name_they_say_what_there_is(own):
    scheduler = fitted(own, midpoint([14.0, 2.0, 0.5]), midpoint([14.0, 2.0], 7.5))
    with pytest.raises(
        InvalidInputError, match=r"4 steps at guidance 3.*2 steps at guidance 7.5, 3 steps at guidance 3"
    ):
        make_scheduler(scheduler, "fitted", steps=4, guidance_scale=3.0)
    with pytest.raises(InvalidInputError, match="one guidance"):
        make_scheduler(scheduler, "fitted", steps=3, guidance_scale=3.0, whole=False)
    with pytest.raises(InvalidInputError, match="brings no fitted steps"):
        make_scheduler(own, "fitted", steps=3, guidance_scale=3.0)


def test_steps_that_are_not_there_are_refused_as_by_diffusers(own):
    scheduler = fitted(own, midpoint([14.0, 2.0, 0.5]))
    with pytest.raises(ValueError, match="3 steps at guidance 3"):
        scheduler.set_timesteps(7)


def test_no_step_after_the_last(own):
    scheduler = fitted(own, midpoint([14.0]))
    state = run(scheduler, torch.ones(1, 4, 2, 2), 1)
    with pytest.raises(ValueError, match="no step left"):
        scheduler.step(state, 0, state)


@pytest.mark.parametrize(("sigmas", "weights"), [
    ((), ()), ((1.0, 2.0), ((), (0.1,))), ((2.0, 1.0), ((), ())), ((2.0, 1.0), ((),)), ((2.0, 0.0), ((), (0.1,))),
])  # fmt: skip
def test_a_fit_that_is_none_is_refused(sigmas, weights):
    with pytest.raises(InvalidInputError, match="falling"):
        Fit(1.0, sigmas, weights)


def test_schedulers_of_diffusers_can_take_its_place(own):
    """What they do not know they say in few words."""
    scheduler = fitted(own, midpoint([14.0, 2.0, 0.5]))
    other = DDIMScheduler.from_config(scheduler.config)
    assert torch.equal(other.alphas_cumprod, scheduler.alphas_cumprod)
    assert repr(scheduler.config["fits"]) == "<1 fits>"
