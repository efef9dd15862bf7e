"""What goes wrong with diffusers' own schedulers is shown with diffusers' own loop, and then refused.

The data is Gaussian, so what should come out is known.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from diffusers import (
    DDIMScheduler,
    DDPMScheduler,
    DEISMultistepScheduler,
    DPMSolverMultistepScheduler,
    EulerDiscreteScheduler,
    HeunDiscreteScheduler,
    PNDMScheduler,
    UniPCMultistepScheduler,
)

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.numerics.problems import STABLE_DIFFUSION, make_problem
from unitouch_gen.sampling import prepare_steps
from unitouch_gen.schedulers.defects import DEFECTS, check_scheduler
from unitouch_gen.schedulers.schedule import NoiseSchedule
from unitouch_gen.schedulers.solvers import SOLVERS, make_scheduler

# numpy 2 on diffusers' DEIS, and UniPC's last step to sigma = 0.
pytestmark = [
    pytest.mark.filterwarnings("ignore:__array_wrap__ must accept context:DeprecationWarning"),
    pytest.mark.filterwarnings("ignore:(divide by zero|invalid value):RuntimeWarning"),
    pytest.mark.filterwarnings("ignore:To copy construct from a tensor:UserWarning"),
]

CPU = torch.device("cpu")
PROBLEM = make_problem("gaussian-cosine")  # its data on whatever schedule
NOISE = PROBLEM.noise(2).float()

LEADING = {"timestep_spacing": "leading", "steps_offset": 1}
ZERO_SNR = {"rescale_betas_zero_snr": True}
TRAILING = {"timestep_spacing": "trailing"}
KARRAS = {"use_karras_sigmas": True}
MULTISTEP = (DPMSolverMultistepScheduler, UniPCMultistepScheduler, DEISMultistepScheduler)


def make(kind: Any, **settings: Any) -> Any:
    """A scheduler of Stable Diffusion's noise levels."""
    usual = {DDIMScheduler: {"clip_sample": False}, PNDMScheduler: {"skip_prk_steps": True}}
    return kind(**STABLE_DIFFUSION, **{**usual.get(kind, {}), **settings})


def error(scheduler: Any, steps: int) -> float:
    """Error of what diffusers makes of it, relative to the exact flow."""
    scheduler.set_timesteps(steps)
    schedule = NoiseSchedule.of(scheduler)
    network = replace(PROBLEM, prediction_type=scheduler.config.prediction_type).network()
    network.schedule = schedule
    state = NOISE * scheduler.init_noise_sigma
    for timestep in scheduler.timesteps:
        prediction = network(scheduler.scale_model_input(state, timestep), timestep)
        state = scheduler.step(prediction, timestep, state, return_dict=False)[0]
        if not torch.isfinite(state).all():
            return math.nan
    largest, variances = schedule.sigma_max, PROBLEM.data.variances
    mean = PROBLEM.data.axis_means
    start = PROBLEM.data.to_axes(NOISE) * math.hypot(1.0, largest)
    exact = mean + (variances / (variances + largest**2)).sqrt() * (start - mean)
    return ((PROBLEM.data.to_axes(state) - exact).norm() / exact.norm()).item()


def refused(defect: str, scheduler: Any, steps: int) -> None:
    """For this reason and no other, with what to do."""
    with pytest.raises(InvalidInputError) as caught:
        prepare_steps(scheduler, steps, CPU)
    message = str(caught.value)
    assert message.startswith(f"`num_inference_steps` is {steps}, with which {type(scheduler).__name__} ")
    assert message.endswith(f"; {DEFECTS[defect].remedy}.")


# Each of them in diffusers, and here ----------------------------------------------------------------------------------


@pytest.mark.parametrize("steps", [1, 5, 20])
def test_unipc_of_kind_bh1_is_not_finite_where_the_noise_ends(steps):
    def own() -> UniPCMultistepScheduler:
        return make(UniPCMultistepScheduler, solver_type="bh1", final_sigmas_type="zero")

    assert math.isnan(error(own(), steps))
    refused("divides by no noise", own(), steps)


def test_unipc_of_kind_bh1_may_end_at_the_smallest_level():
    own = make(UniPCMultistepScheduler, solver_type="bh1", final_sigmas_type="sigma_min")
    assert error(own, 20) < 0.2
    prepare_steps(own, 20, CPU)


@pytest.mark.parametrize("kind", MULTISTEP)
def test_as_many_steps_as_levels_have_one_twice(kind):
    assert math.isnan(error(make(kind, timestep_spacing="linspace"), 1000))
    refused("repeats a level", make(kind, timestep_spacing="linspace"), 1000)


@pytest.mark.parametrize("kind", MULTISTEP)
def test_beta_spacing_ends_in_an_error_that_a_known_beginning_mends(kind):
    with pytest.raises((IndexError, AssertionError)):
        error(make(kind, use_beta_sigmas=True), 60)
    own = make(kind, use_beta_sigmas=True)
    prepare_steps(own, 60, CPU)
    own.set_timesteps = lambda *_, **__: None  # they are set
    assert error(own, 60) < 0.05


@pytest.mark.parametrize("kind", MULTISTEP)
@pytest.mark.parametrize(("steps", "first"), [(50, 951), (200, 801)])
def test_leading_spacing_does_not_start_at_the_noise(kind, steps, first):
    own = make(kind, **LEADING)
    own.set_timesteps(steps)
    assert own.timesteps[0] == first
    refused("starts too low", own, steps)


def test_leading_spacing_gets_worse_with_more_steps():
    assert error(make(DEISMultistepScheduler, **LEADING), 200) > error(make(DEISMultistepScheduler, **LEADING), 50)


@pytest.mark.parametrize("kind", [DDIMScheduler, PNDMScheduler])
def test_more_than_half_as_many_steps_as_levels_start_half_way(kind):
    own = make(kind, **LEADING)
    own.set_timesteps(501)
    assert own.timesteps.max() == 501
    refused("starts too low", own, 501)


@pytest.mark.parametrize("kind", [DDIMScheduler, PNDMScheduler])
def test_leading_spacing_with_an_offset_steps_out_of_the_schedule(kind):
    with pytest.raises(IndexError):
        error(make(kind, **LEADING), 1000)
    refused("starts beyond the schedule", make(kind, **LEADING), 1000)


@pytest.mark.parametrize("spacing", ["linspace", "trailing"])
@pytest.mark.parametrize("kind", [DDIMScheduler, PNDMScheduler])
def test_stepping_back_by_a_whole_number_misses_the_next_timestep(kind, spacing):
    """300 does not divide 1000, and 200 does."""
    own = make(kind, timestep_spacing=spacing)
    assert error(own, 300) > 1.5 * error(own, 200)
    refused("misses the next timestep", make(kind, timestep_spacing=spacing), 300)


@pytest.mark.parametrize("steps", [2, 10, 50, 200])
def test_linspace_never_fits_the_steps_of_ddim(steps):
    refused("misses the next timestep", make(DDIMScheduler, timestep_spacing="linspace"), steps)


@pytest.mark.parametrize("settings", [LEADING, {"timestep_spacing": "linspace"}])
@pytest.mark.parametrize("kind", [DDIMScheduler, PNDMScheduler, EulerDiscreteScheduler, HeunDiscreteScheduler])
def test_one_step_near_the_end_returns_the_noise(kind, settings):
    assert error(make(kind, **settings), 1) > 0.9
    refused("starts near the end", make(kind, **settings), 1)


def test_one_step_from_half_way_is_refused():
    own = make(DPMSolverMultistepScheduler, **LEADING)
    own.set_timesteps(1)
    assert own.timesteps.tolist() == [501]
    refused("starts near the end", own, 1)


def test_deis_of_order_three_gets_worse_with_more_steps():
    def own() -> DEISMultistepScheduler:
        return make(DEISMultistepScheduler, solver_order=3, **KARRAS)

    assert error(own(), 300) > 2 * error(own(), 100)
    refused("is unstable", own(), 160)
    prepare_steps(own(), 100, CPU)


def test_ddim_is_not_finite_from_pure_noise_if_noise_is_predicted():
    assert math.isnan(error(make(DDIMScheduler, **TRAILING, **ZERO_SNR), 10))
    refused("cannot tell data from noise", make(DDIMScheduler, **TRAILING, **ZERO_SNR), 10)
    velocity = make(DDIMScheduler, **TRAILING, **ZERO_SNR, prediction_type="v_prediction")
    assert error(velocity, 10) < 0.5
    prepare_steps(velocity, 10, CPU)


def test_ddim_by_name_is_refused_there_as_well():
    """Without a division by zero the result would be finite, and the network's error many times over."""
    refused("cannot tell data from noise", make_scheduler(make(DDIMScheduler, **ZERO_SNR), "ddim"), 10)
    prepare_steps(make_scheduler(make(DDIMScheduler, **ZERO_SNR), "euler"), 10, CPU)


@pytest.mark.parametrize("kind", [DPMSolverMultistepScheduler, UniPCMultistepScheduler])
def test_karras_levels_of_pure_noise_are_wrong_or_an_error(kind):
    settings = {**ZERO_SNR, "prediction_type": "v_prediction"}
    assert error(make(kind, **settings, **KARRAS), 5) > 1.5 * error(make(kind, **settings, **TRAILING), 5)
    with pytest.raises((IndexError, AssertionError)):
        error(make(kind, **settings, **KARRAS), 50)
    for steps in (5, 50):
        refused("rounds pure noise", make(kind, **settings, **KARRAS), steps)


def test_levels_below_what_float32_holds_have_no_timesteps():
    own = EulerDiscreteScheduler(beta_start=1e-8, beta_end=0.02, **KARRAS)
    own.set_timesteps(20)
    assert not own.timesteps.isfinite().all()
    refused("is undefined", own, 20)


@pytest.mark.parametrize(
    "config",
    [
        {"beta_start": 1e-4, "beta_end": 0.999, "beta_schedule": "linear"},  # the largest beyond float32
        {"num_train_timesteps": 1, "trained_betas": [0.9]},
    ],
)
@pytest.mark.parametrize("name", ["euler", "dpm++2m"])
@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # of diffusers, on what cannot be
def test_schedules_that_float32_cannot_hold_are_refused_by_their_steps(config, name):
    with pytest.raises(InvalidInputError, match="`num_inference_steps` is 1000, "):
        prepare_steps(make_scheduler(DDIMScheduler(**config), name), 1000, CPU)


@pytest.mark.parametrize("kind", [DDIMScheduler, DPMSolverMultistepScheduler])
def test_levels_of_another_number_are_an_error_or_a_start_half_way(kind):
    """diffusers does not look at the number of `trained_betas`."""
    own = kind(num_train_timesteps=100, trained_betas=[0.01] * 50, timestep_spacing="trailing")
    refused("has other levels", own, 20)


# What is in order -----------------------------------------------------------------------------------------------------

ORDINARY: list[tuple[Callable[[], Any], tuple[int, ...]]] = [
    (lambda: make(DDIMScheduler, **LEADING, set_alpha_to_one=False), (2, 10, 20, 25, 30, 50, 100, 150, 200, 300, 500)),
    (lambda: make(PNDMScheduler, **LEADING), (10, 20, 25, 50, 100, 200)),
    (lambda: make(PNDMScheduler, **LEADING, skip_prk_steps=False), (10, 20, 50, 200)),
    (lambda: make(DDIMScheduler), (1000,)),
    (lambda: make(DDIMScheduler, **TRAILING), (1, 2, 4, 10, 50, 200, 1000)),
    (lambda: make(DDPMScheduler), (10, 50, 1000)),
    (lambda: make(EulerDiscreteScheduler), (2, 10, 50, 1000)),
    (lambda: make(EulerDiscreteScheduler, **TRAILING), (1, 2, 4)),
    (lambda: make(EulerDiscreteScheduler, timestep_spacing="leading"), (10, 20, 50)),
    (lambda: make(DPMSolverMultistepScheduler), (1, 2, 20, 50, 200, 999)),
    (lambda: make(DPMSolverMultistepScheduler, **KARRAS), (1, 2, 20, 50, 200, 1000)),
    (lambda: make(DPMSolverMultistepScheduler, **LEADING), (10, 20, 25, 30)),
    (lambda: make(UniPCMultistepScheduler), (1, 20, 50, 999)),
    (lambda: make(DEISMultistepScheduler), (20, 50, 200)),
]  # fmt: skip


@pytest.mark.parametrize(("own", "numbers"), ORDINARY)
def test_ordinary_settings_pass(own, numbers):
    for steps in numbers:
        prepare_steps(own(), steps, CPU)


@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize("own", [{}, {"prediction_type": "v_prediction"}, {"num_train_timesteps": 50}])
def test_solvers_by_name_pass(name, own):
    levels = own.get("num_train_timesteps", 1000)
    for steps in (2, 3, 10, 20, 50, 160, 200, 999, 1000):
        if steps <= levels:
            prepare_steps(make_scheduler(make(DDIMScheduler, **own), name), steps, CPU)


@pytest.mark.parametrize("name", [name for name, solver in SOLVERS.items() if solver.zero_snr])
def test_solvers_that_cope_with_pure_noise_pass(name):
    own = make(DDIMScheduler, **ZERO_SNR, prediction_type="v_prediction")
    for steps in (2, 10, 50, 1000):
        prepare_steps(make_scheduler(own, name), steps, CPU)


def test_a_beginning_that_is_known_changes_nothing_else():
    """Where diffusers finds its first timestep by itself, the result is the same to the bit."""
    own = make(DPMSolverMultistepScheduler)
    alone = error(own, 20)
    prepare_steps(own, 20, CPU)
    own.set_timesteps = lambda *_, **__: None
    assert error(own, 20) == alone


def test_the_check_says_nothing_of_what_is_in_order():
    own = make(DDIMScheduler, **TRAILING)
    own.set_timesteps(10)
    check_scheduler(own, 10)
