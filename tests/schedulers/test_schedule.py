"""The noise schedule as a curve, against diffusers' own conversions."""

import numpy as np
import pytest
import torch
from diffusers import DDIMScheduler, DPMSolverMultistepScheduler

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.schedulers.schedule import NoiseSchedule

CONFIGS = [
    {"beta_start": 0.00085, "beta_end": 0.012, "beta_schedule": "scaled_linear"},
    {"beta_schedule": "squaredcos_cap_v2"},
    {"num_train_timesteps": 50, "beta_start": 0.01, "beta_end": 0.3},
]


@pytest.mark.parametrize("config", CONFIGS)
def test_levels_are_those_of_diffusers(config):
    scheduler = DPMSolverMultistepScheduler(**config)
    schedule = NoiseSchedule.of(scheduler)
    expected = ((1 - scheduler.alphas_cumprod) / scheduler.alphas_cumprod) ** 0.5
    torch.testing.assert_close(schedule.sigma(torch.arange(len(expected))), expected.double(), rtol=1e-12, atol=0)


@pytest.mark.parametrize("config", CONFIGS)
def test_timesteps_between_levels_are_those_of_diffusers(config):
    scheduler = DPMSolverMultistepScheduler(**config)
    schedule = NoiseSchedule.of(scheduler)
    sigmas = torch.linspace(np.log(schedule.sigma_min), np.log(schedule.sigma_max), 37, dtype=torch.float64).exp()
    expected = np.array([scheduler._sigma_to_t(sigma, schedule.log_sigmas.numpy()) for sigma in sigmas.numpy()])
    torch.testing.assert_close(schedule.timestep(sigmas), torch.from_numpy(expected), rtol=0, atol=1e-9)


@pytest.mark.parametrize("config", CONFIGS)
def test_there_and_back(config):
    schedule = NoiseSchedule.of(DDIMScheduler(**config))
    timesteps = torch.linspace(0, len(schedule.log_sigmas) - 1, 101, dtype=torch.float64)
    torch.testing.assert_close(schedule.timestep(schedule.sigma(timesteps)), timesteps, rtol=0, atol=1e-6)


def test_beyond_the_ends_is_at_the_ends():
    schedule = NoiseSchedule.of(DDIMScheduler())
    assert schedule.timestep(1e-9) == 0
    assert schedule.timestep(1e9) == 999
    assert schedule.sigma(2000) == pytest.approx(schedule.sigma_max)


@pytest.mark.parametrize(
    "config",
    [
        {"beta_start": 1e-8, "beta_end": 0.02, "beta_schedule": "linear"},
        {"beta_start": 1e-4, "beta_end": 0.999, "beta_schedule": "linear"},
        {"num_train_timesteps": 1, "trained_betas": [0.9]},
    ],
)
def test_levels_that_do_not_rise_in_float32_are_refused(config):
    with pytest.raises(InvalidInputError, match=r"`scheduler` is DDIMScheduler .* that do not rise in float32"):
        NoiseSchedule.of(DDIMScheduler(**config))


def test_zero_terminal_snr_has_a_finite_last_level():
    """At least that of diffusers' `EulerDiscreteScheduler`, and noisier than the one before."""
    schedule = NoiseSchedule.of(DDIMScheduler(rescale_betas_zero_snr=True))
    assert 4095 < schedule.sigma_max < 1e6
