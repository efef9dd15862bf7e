"""The noise schedule as a curve, and predictions along it, against diffusers' own conversions, noise and steps."""

import numpy as np
import pytest
import torch
from diffusers import (
    DDIMScheduler,
    DPMSolverMultistepScheduler,
    UniPCMultistepScheduler,
)

from unitouch_gen.sampling import Guidance
from unitouch_gen.schedule import PREDICTION_TYPES, NoiseSchedule, to_denoised, to_prediction

CONFIGS = [
    {"beta_start": 0.00085, "beta_end": 0.012, "beta_schedule": "scaled_linear"},
    {"beta_schedule": "squaredcos_cap_v2"},
    {"num_train_timesteps": 50, "beta_start": 0.01, "beta_end": 0.3},
]


def draw(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("config", CONFIGS)
def test_levels_and_timesteps_between_them_are_those_of_diffusers(config):
    scheduler = DPMSolverMultistepScheduler(**config)
    schedule = NoiseSchedule.of(scheduler)
    levels = ((1 - scheduler.alphas_cumprod) / scheduler.alphas_cumprod) ** 0.5
    torch.testing.assert_close(schedule.sigma(torch.arange(len(levels))), levels.double(), rtol=1e-12, atol=0)
    sigmas = torch.linspace(np.log(schedule.sigma_min), np.log(schedule.sigma_max), 37, dtype=torch.float64).exp()
    expected = np.array([scheduler._sigma_to_t(sigma, schedule.log_sigmas.numpy()) for sigma in sigmas.numpy()])
    torch.testing.assert_close(schedule.timestep(sigmas), torch.from_numpy(expected), rtol=0, atol=1e-9)
    timesteps = torch.linspace(0, len(levels) - 1, 101, dtype=torch.float64)
    torch.testing.assert_close(schedule.timestep(schedule.sigma(timesteps)), timesteps, rtol=0, atol=1e-6)


def test_beyond_the_ends_is_at_the_ends():
    schedule = NoiseSchedule.of(DDIMScheduler())
    assert (schedule.timestep(1e-9), schedule.timestep(1e9)) == (0, 999)
    assert schedule.sigma(2000) == pytest.approx(schedule.sigma_max)


@pytest.mark.parametrize("steps", [1, 7, 300])
def test_spacings_are_those_of_diffusers(steps):
    trailing = DDIMScheduler(**CONFIGS[0], timestep_spacing="trailing")
    schedule = NoiseSchedule.of(trailing)
    trailing.set_timesteps(steps)
    found = schedule.timestep(torch.tensor(schedule.trailing(steps)))
    torch.testing.assert_close(found, trailing.timesteps.double(), rtol=0, atol=1e-6)
    if steps > 1:  # of which diffusers makes a single one at the smallest level
        last = max(schedule.sigma_min, 1 / steps)
        karras = UniPCMultistepScheduler(**CONFIGS[0], use_karras_sigmas=True, sigma_min=last)
        karras.set_timesteps(steps)
        torch.testing.assert_close(torch.tensor(schedule.karras(steps)), karras.sigmas[:-1], rtol=1e-5, atol=0)
    assert schedule.karras(steps)[0] == pytest.approx(schedule.sigma_max)


def test_zero_terminal_snr_has_a_finite_last_level():
    """At least that of diffusers' `EulerDiscreteScheduler`, and noisier than the one before."""
    assert 4095 < NoiseSchedule.of(DDIMScheduler(rescale_betas_zero_snr=True)).sigma_max < 1e6


@pytest.mark.parametrize("kind", PREDICTION_TYPES)
def test_any_output_is_read_as_a_ddim_step_of_diffusers_reads_it(kind):
    scheduler = DDIMScheduler(**CONFIGS[0], prediction_type=kind, clip_sample=False)
    scheduler.alphas_cumprod = scheduler.alphas_cumprod.double()
    scheduler.set_timesteps(10)
    output = draw(2, 4, 3, 3)
    z = draw(2, 4, 3, 3, seed=1)
    for timestep in (1, 501, 901):
        sigma = (1 / scheduler.alphas_cumprod[timestep].item() - 1) ** 0.5
        expected = scheduler.step(output, timestep, z).pred_original_sample
        torch.testing.assert_close(to_denoised(output, z, sigma, kind), expected, rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(to_prediction(expected, z, sigma, kind), output, rtol=1e-9, atol=1e-9)


def test_guiding_any_prediction_guides_the_data():
    both = draw(4, 4, 3, 3)
    z = draw(2, 4, 3, 3, seed=1)
    guidance = Guidance(7.5)
    for kind in PREDICTION_TYPES:
        expected = guidance.combine(to_denoised(both, torch.cat([z] * 2), 1.7, kind))
        torch.testing.assert_close(to_denoised(guidance.combine(both), z, 1.7, kind), expected, rtol=1e-9, atol=1e-9)
