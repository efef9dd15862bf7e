"""Solvers by name: each a diffusers scheduler with the pipeline's noise schedule and the settings it needs."""

import pytest
import torch
from diffusers import (
    DDIMScheduler,
    EulerDiscreteScheduler,
    PNDMScheduler,
    UniPCMultistepScheduler,
)

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.schedulers import SOLVERS
from unitouch_gen.schedulers.solvers import make_scheduler


@pytest.fixture
def own() -> DDIMScheduler:
    """Nothing in its schedule is a default."""
    return DDIMScheduler(
        num_train_timesteps=500, beta_start=0.001, beta_end=0.02, beta_schedule="scaled_linear",
        prediction_type="v_prediction", clip_sample=True, thresholding=True, timestep_spacing="leading",
    )  # fmt: skip


@pytest.mark.parametrize("name", SOLVERS)
def test_a_solver_takes_over_the_schedule_and_the_kind_of_prediction(own, name):
    scheduler = make_scheduler(own, name)
    assert type(scheduler) is SOLVERS[name].scheduler
    assert torch.equal(scheduler.alphas_cumprod, own.alphas_cumprod)
    assert scheduler.config.prediction_type == "v_prediction"
    assert scheduler.config.num_train_timesteps == 500


@pytest.mark.parametrize("name", SOLVERS)
def test_a_solver_has_its_own_settings(own, name):
    config = make_scheduler(own, name).config
    assert {key: config[key] for key in SOLVERS[name].settings} == SOLVERS[name].settings


@pytest.mark.parametrize("name", SOLVERS)
def test_a_solver_does_not_clip_or_threshold_latents(own, name):
    """Both are for pictures in [-1, 1]."""
    config = make_scheduler(own, name).config
    assert not config.get("clip_sample", False)
    assert not config.get("thresholding", False)


@pytest.mark.parametrize("name", SOLVERS)
def test_a_schedule_given_as_numbers_is_taken_over(name):
    betas = torch.linspace(1e-4, 0.01, 300).tolist()
    scheduler = make_scheduler(DDIMScheduler(num_train_timesteps=300, trained_betas=betas), name)
    torch.testing.assert_close(scheduler.betas, torch.tensor(betas))


@pytest.mark.parametrize("name", SOLVERS)
def test_a_solver_starts_from_pure_noise(own, name):
    """The first timestep is the last of training, unlike with diffusers' "leading" spacing."""
    scheduler = make_scheduler(own, name)
    for steps in (2, 10, 50):
        scheduler.set_timesteps(steps)
        assert float(scheduler.timesteps[0]) == pytest.approx(499, abs=0.5)


@pytest.mark.parametrize("name", SOLVERS)
def test_a_solver_ends_without_noise(own, name):
    scheduler = make_scheduler(own, name)
    scheduler.set_timesteps(10)
    last = 1 - scheduler.final_alpha_cumprod if name == "ddim" else scheduler.sigmas[-1]
    assert float(last) == 0.0


@pytest.mark.parametrize("name", SOLVERS)
def test_a_solver_is_saved_and_read_again(own, name, tmp_path):
    make_scheduler(own, name).save_pretrained(tmp_path)
    again = SOLVERS[name].scheduler.from_pretrained(tmp_path)
    again.set_timesteps(10)
    assert again.config.prediction_type == "v_prediction"
    assert (again.timesteps >= 0).all()


@pytest.mark.parametrize("name", [None, *SOLVERS])
def test_every_call_gets_a_scheduler_of_its_own(own, name):
    first, second = make_scheduler(own, name), make_scheduler(own, name)
    before = own.timesteps.clone(), second.timesteps.clone()
    first.set_timesteps(3)
    assert torch.equal(own.timesteps, before[0])
    assert torch.equal(second.timesteps, before[1])


@pytest.mark.parametrize("scheduler", [DDIMScheduler, PNDMScheduler, EulerDiscreteScheduler, UniPCMultistepScheduler])
def test_no_name_is_the_same_scheduler_again(scheduler):
    own = scheduler(num_train_timesteps=321, beta_start=0.003, timestep_spacing="trailing")
    made = make_scheduler(own, None)
    assert type(made) is scheduler
    assert dict(made.config) == dict(own.config)
    for one in (own, made):
        one.set_timesteps(7)
    assert torch.equal(made.timesteps, own.timesteps)


@pytest.mark.parametrize("scheduler", [PNDMScheduler, EulerDiscreteScheduler, UniPCMultistepScheduler])
def test_a_solver_goes_with_any_scheduler_of_the_pipeline(scheduler):
    own = scheduler(beta_start=0.00085, beta_end=0.012, beta_schedule="scaled_linear")
    for name in SOLVERS:
        assert torch.equal(make_scheduler(own, name).alphas_cumprod, own.alphas_cumprod)


@pytest.mark.parametrize("name", SOLVERS)
def test_making_a_solver_says_nothing(own, name, caplog):
    """diffusers warns of settings that a scheduler does not know."""
    import diffusers.utils.logging

    diffusers.utils.logging.enable_propagation()
    try:
        make_scheduler(own, name)
    finally:
        diffusers.utils.logging.disable_propagation()
    assert not caplog.records


def test_unipc_has_the_variant_that_stays_finite():
    assert SOLVERS["unipc"].settings["solver_type"] == "bh2"


def test_no_solver_has_an_order_that_blows_up():
    assert max(solver.settings.get("solver_order", 0) for solver in SOLVERS.values()) == 2


@pytest.mark.parametrize("name", SOLVERS)
def test_zero_terminal_snr_is_kept_or_refused(name):
    """diffusers' multistep schedulers end in an index error there, and Heun and DEIS leave the rescaling out."""
    own = DDIMScheduler(rescale_betas_zero_snr=True, prediction_type="v_prediction")
    if SOLVERS[name].zero_snr:
        assert make_scheduler(own, name).alphas_cumprod[-1] < 1e-6
    else:
        with pytest.raises(InvalidInputError, match=rf"`solver` is '{name[:3]}.*use 'ddim', 'euler'"):
            make_scheduler(own, name)


def test_an_unknown_name_is_refused_with_the_nearest(own):
    with pytest.raises(InvalidInputError, match=r"`solver` is 'eulr'; .*'ddim'.* Did you mean 'euler'\?"):
        make_scheduler(own, "eulr")
