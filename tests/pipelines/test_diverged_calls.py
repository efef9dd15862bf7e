"""Calls of the built-in family whose latents grow beyond all pictures, and calls that are only bold."""

import pytest
import torch

import unitouch_gen
from unitouch_gen.errors import NotConvergedError
from unitouch_gen.models.autoencoders import encode
from unitouch_gen.sampling import DIVERGED_SIZE, ReturnCode
from unitouch_gen.world import World

SOLVERS = [None, "ddim", "heun", "dpm++2m"]


@pytest.fixture(scope="module")
def scene():
    return World().render([5, 9], [200, 200], [0, 0], modalities=("image", "touch"))


@pytest.fixture(scope="module", params=["touch-to-image", "x-to-touch"])
def call(request, scene):
    """A call of the built-in family with two inputs."""
    pipe = unitouch_gen.tiny(request.param)
    pipe.set_progress_bar_config(disable=True)
    given = {"touch": scene.touch["gelsight"]} if request.param == "touch-to-image" else {"image": scene.image}

    def run(**options):
        return pipe(**given, generator=torch.Generator().manual_seed(0), output_type="latent", **options)

    run.pipe = pipe
    return run


def largest(latents):
    return latents.square().mean(dim=(1, 2, 3)).sqrt().max().item()


def test_the_limit_is_far_from_the_latents_of_any_picture(call, scene):
    """Also of black-and-white noise, as no surface has it."""
    noise = torch.randint(2, (4, 3, 128, 128), generator=torch.Generator().manual_seed(0)) * 2.0 - 1.0
    with torch.no_grad():
        latents = encode(call.pipe.vae, torch.cat([noise, 2 * scene.image - 1, 2 * scene.touch["gelsight"] - 1]))
    assert largest(latents) < DIVERGED_SIZE / 4


@pytest.mark.parametrize("solver", SOLVERS)
def test_strong_guidance_for_fun_is_no_failure(call, solver):
    output = call(guidance_scale=20.0, num_inference_steps=15, solver=solver)
    assert output.report.success
    assert largest(output.images) < DIVERGED_SIZE / 3


@pytest.mark.parametrize("solver", SOLVERS)
def test_guidance_far_beyond_is_diverged_and_returned(call, solver):
    output = call(guidance_scale=1e5, num_inference_steps=10, solver=solver, throw=False)
    assert output.report.codes == [ReturnCode.DIVERGED] * 2
    assert len(output.images) == 2 and torch.isfinite(output.images).all()
    assert "diverged" in str(output.report)


def test_latents_a_hundred_times_too_large_raise(call):
    with pytest.raises(NotConvergedError, match=r"Sample \d grew to \S+ times .* in step \d\. .*`guidance_scale`"):
        call(guidance_scale=1e5, num_inference_steps=10, solver="dpm++2m")
