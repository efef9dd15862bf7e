"""UniPC's updates with floats, against diffusers' own."""

import pytest
import torch
from diffusers import UniPCMultistepScheduler

from unitouch_gen.schedulers.solvers import FloatUpdates


class WithFloats(FloatUpdates, UniPCMultistepScheduler):
    pass


def run(kind: type, count: int, **settings) -> torch.Tensor:
    """The end of a run of `count` steps on a network that bends what it gets."""
    scheduler = kind(
        beta_start=0.00085, beta_end=0.012, beta_schedule="scaled_linear", timestep_spacing="linspace", **settings
    )
    scheduler.set_timesteps(count)
    state = torch.randn(2, 3, 8, 8, generator=torch.Generator().manual_seed(0))
    for timestep in scheduler.timesteps:
        state = scheduler.step(0.7 * torch.tanh(2 * state), timestep, state).prev_sample
    return state


@pytest.mark.parametrize("order", [1, 2, 3])
@pytest.mark.parametrize("prediction_type", ["epsilon", "v_prediction", "sample"])
@pytest.mark.parametrize("count", [1, 2, 3, 20])
def test_runs_end_where_those_of_diffusers_do(order, prediction_type, count):
    settings = {"solver_order": order, "prediction_type": prediction_type, "use_karras_sigmas": True,
                "final_sigmas_type": "zero"}  # fmt: skip
    expected = run(UniPCMultistepScheduler, count, **settings)
    torch.testing.assert_close(run(WithFloats, count, **settings), expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    "settings",
    [
        {"solver_type": "bh1", "final_sigmas_type": "sigma_min"},
        {"predict_x0": False, "final_sigmas_type": "sigma_min"},
        {"final_sigmas_type": "sigma_min"},
        {"lower_order_final": False, "final_sigmas_type": "sigma_min"},
        {"disable_corrector": [0, 3]},
        {"thresholding": True},
    ],
    ids=str,
)
def test_other_settings_are_as_in_diffusers(settings):
    expected = run(UniPCMultistepScheduler, 10, **settings)
    torch.testing.assert_close(run(WithFloats, 10, **settings), expected, rtol=1e-4, atol=1e-5)
