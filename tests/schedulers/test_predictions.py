"""Conversions between predictions, against diffusers' own noise, velocities and steps."""

import pytest
import torch
from diffusers import DDIMScheduler, DDPMScheduler

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.sampling import Guidance
from unitouch_gen.schedulers.schedule import PREDICTION_TYPES, alpha, to_denoised, velocity_of

CONFIGS = [
    {"beta_start": 0.00085, "beta_end": 0.012, "beta_schedule": "scaled_linear"},
    {"beta_schedule": "squaredcos_cap_v2"},
    {"num_train_timesteps": 50, "beta_start": 0.01, "beta_end": 0.3},
]


def draw(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def noisy(config: dict, timestep: int):
    """(x_0, predictions of it by type, z, sigma), as diffusers makes them for training."""
    scheduler = DDPMScheduler(**config)
    scheduler.alphas_cumprod = scheduler.alphas_cumprod.double()
    data, noise, timesteps = draw(2, 4, 3, 3), draw(2, 4, 3, 3, seed=1), torch.tensor([timestep] * 2)
    z = scheduler.add_noise(data, noise, timesteps)
    predictions = {
        "epsilon": noise,
        "v_prediction": scheduler.get_velocity(data, noise, timesteps),
        "sample": data,
    }
    abar = scheduler.alphas_cumprod[timestep].item()
    return data, predictions, z, ((1 - abar) / abar) ** 0.5


@pytest.mark.parametrize("config", CONFIGS)
@pytest.mark.parametrize("timestep", [0, 20, 49])
@pytest.mark.parametrize("prediction_type", PREDICTION_TYPES)
def test_targets_of_diffusers_stand_for_the_data(config, timestep, prediction_type):
    data, predictions, z, sigma = noisy(config, timestep)
    denoised = to_denoised(predictions[prediction_type], z, sigma, prediction_type)
    torch.testing.assert_close(denoised, data, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("prediction_type", PREDICTION_TYPES)
def test_any_output_is_read_as_diffusers_reads_it(prediction_type):
    """A network's output is no exact target: its prediction of x_0 is that of a DDIM step."""
    scheduler = DDIMScheduler(**CONFIGS[0], prediction_type=prediction_type, clip_sample=False)
    scheduler.alphas_cumprod = scheduler.alphas_cumprod.double()
    scheduler.set_timesteps(10)
    abar = scheduler.alphas_cumprod[501].item()
    output, z = draw(2, 4, 3, 3), draw(2, 4, 3, 3, seed=1)
    expected = scheduler.step(output, 501, z).pred_original_sample
    got = to_denoised(output, z, ((1 - abar) / abar) ** 0.5, prediction_type)
    torch.testing.assert_close(got, expected, rtol=1e-9, atol=1e-9)


def test_velocity_of_data_and_noise():
    data, predictions, _, sigma = noisy(CONFIGS[0], 20)
    velocity = velocity_of(data, predictions["epsilon"], sigma)
    torch.testing.assert_close(velocity, predictions["v_prediction"], rtol=1e-9, atol=1e-9)


def test_variance_is_preserved():
    sigma = torch.logspace(-6, 6, 13, dtype=torch.float64)
    torch.testing.assert_close(alpha(sigma) ** 2 * (1 + sigma**2), torch.ones_like(sigma))


@pytest.mark.parametrize("prediction_type", PREDICTION_TYPES)
def test_guiding_any_prediction_guides_the_data(prediction_type):
    both, z, sigma, guidance = draw(4, 4, 3, 3), draw(2, 4, 3, 3, seed=1), 1.7, Guidance(7.5)
    guided = to_denoised(guidance.combine(both), z, sigma, prediction_type)
    expected = guidance.combine(to_denoised(both, torch.cat([z] * 2), sigma, prediction_type))
    torch.testing.assert_close(guided, expected, rtol=1e-9, atol=1e-9)


def test_one_noise_level_a_row():
    prediction, z = draw(2, 4, 3, 3), draw(2, 4, 3, 3, seed=1)
    sigma = torch.tensor([0.1, 3.0], dtype=torch.float64)
    together = to_denoised(prediction, z, sigma.view(2, 1, 1, 1), "v_prediction")
    alone = [to_denoised(prediction[row], z[row], sigma[row].item(), "v_prediction") for row in (0, 1)]
    torch.testing.assert_close(together, torch.stack(alone))


def test_unknown_type_is_refused():
    with pytest.raises(InvalidInputError, match="`prediction_type` is 'noise'"):
        to_denoised(draw(1, 1, 1, 1), draw(1, 1, 1, 1), 1.0, "noise")
