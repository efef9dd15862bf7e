"""Steps to a tolerance, on every pipeline."""

import pytest
import torch
from diffusers.callbacks import MultiPipelineCallbacks, SDCFGCutoffCallback

import unitouch_gen
from unitouch_gen.errors import InvalidInputError, InvalidTypeError, NotConvergedError
from unitouch_gen.sampling import ReturnCode
from unitouch_gen.world import World

CALLS = {
    "touch-to-image": lambda scene: {"touch": scene.touch["gelsight"]},
    "stylization": lambda scene: {"touch": scene.touch["gelsight"], "image": scene.image, "init_strength": 1.0},
    "x-to-touch": lambda scene: {"image": scene.image},
}


@pytest.fixture(scope="module")
def scene():
    return World().render([5, 9], [200, 200], [0, 0], modalities=("image", "touch"))


@pytest.fixture(scope="module", params=sorted(CALLS))
def built_in(request, scene):
    """(pipeline, arguments) of the built-in family."""
    pipe = unitouch_gen.tiny(request.param)
    pipe.set_progress_bar_config(disable=True)
    return pipe, CALLS[request.param](scene)


def latents(built_in, **options):
    pipe, arguments = built_in
    generator = torch.Generator().manual_seed(0)
    return pipe(**arguments, generator=generator, output_type="latent", **options)


def test_a_loose_tolerance_is_kept_on_trained_networks(built_in):
    """Against four times as many steps of another solver."""
    found, reference = latents(built_in, tolerance=0.1), latents(built_in, solver="heun", num_inference_steps=60)
    difference = (found.images - reference.images).flatten(1).norm(dim=1) / reference.images.flatten(1).norm(dim=1)
    assert difference.min() < 0.1 and difference.mean() < 0.15  # a guided sample may tip over to another mode
    assert found.report.evaluations < 40
    assert (found.report.solver, found.report.tolerance) == ("adaptive", 0.1)


def test_too_few_evaluations_raise_or_return_what_there_is(built_in):
    with pytest.raises(NotConvergedError, match="Stopped after 3 evaluations"):
        latents(built_in, tolerance=1e-3, max_evaluations=3)
    output = latents(built_in, tolerance=1e-3, max_evaluations=3, throw=False)
    assert output.report.codes == [ReturnCode.MAX_EVALUATIONS] * 2
    assert output.images.shape[0] == 2 and torch.isfinite(output.images).all()


@pytest.mark.parametrize("tolerance", [0, -1.0, float("nan"), 1e-6, 2.0, float("inf")])
def test_a_tolerance_that_cannot_be_reached_is_refused(built_in, tolerance):
    with pytest.raises(InvalidInputError, match="`tolerance` is"):
        latents(built_in, tolerance=tolerance)


def test_a_tolerance_is_a_number(built_in):
    with pytest.raises(InvalidTypeError, match="`tolerance` is 'tight'"):
        latents(built_in, tolerance="tight")


@pytest.mark.parametrize("option", [{"solver": "heun"}, {"num_inference_steps": 10}, {"eta": 0.5}])
def test_a_tolerance_and_fixed_steps_are_refused_together(built_in, option):
    with pytest.raises(InvalidInputError, match=f"`{next(iter(option))}` is .* but `tolerance` came"):
        latents(built_in, tolerance=0.1, **option)


def test_a_bound_on_evaluations_without_tolerance_is_refused(built_in):
    with pytest.raises(InvalidInputError, match="`max_evaluations` is 5, but no `tolerance` came"):
        latents(built_in, max_evaluations=5)


def test_guidance_can_be_kept_to_an_interval(built_in):
    """The whole interval is guidance as ever; an empty stretch of it at either end leaves one branch out there."""
    plain = latents(built_in, num_inference_steps=8)
    whole = latents(built_in, num_inference_steps=8, guidance_interval=(0.0, 1.0))
    part = latents(built_in, num_inference_steps=8, guidance_interval=(0.2, 0.8))
    assert torch.equal(plain.images, whole.images)
    assert 0 < part.report.guided < part.report.evaluations == plain.report.guided
    assert any(f"in {8 - part.report.guided} of 8 evaluations" in item for item in part.report.left_out)
    assert not torch.equal(plain.images, part.images)


def test_an_interval_of_one_evaluation_is_in_between_on_and_off(built_in):
    """What is guided in the first evaluation alone differs from both."""
    off = latents(built_in, num_inference_steps=4, guidance_scale=1.0)
    first = latents(built_in, num_inference_steps=4, guidance_interval=(0.99, 1.0))
    assert first.report.guided == 1 and off.report.guided == 0
    assert not torch.equal(first.images, off.images)


@pytest.mark.parametrize("interval", [(0.8, 0.2), (0.5, 0.5), (-0.1, 0.5), (0.5, 1.1), (float("nan"), 1.0)])
def test_an_interval_has_to_rise_within_its_range(built_in, interval):
    with pytest.raises(InvalidInputError, match="`guidance_interval` is"):
        latents(built_in, guidance_interval=interval)


@pytest.mark.parametrize("interval", [0.5, "all", (0.1,), (0.1, 0.2, 0.3)])
def test_an_interval_is_two_numbers(built_in, interval):
    with pytest.raises(InvalidTypeError, match=r"`guidance_interval` is .*two numbers"):
        latents(built_in, guidance_interval=interval)


def test_callbacks_are_called_after_every_accepted_step(built_in):
    seen = []

    def on_step(pipe, step, timestep, tensors):
        seen.append(tensors["latents"].shape)
        return {}

    report = latents(built_in, tolerance=0.2, callback_on_step_end=on_step).report
    assert len(seen) == report.steps and set(seen) == {latents(built_in, tolerance=0.2).images.shape}


@pytest.mark.parametrize("several", [False, True])
def test_callbacks_that_count_steps_are_refused_with_a_tolerance(built_in, several):
    """They would wait for a step that does not come, or is another one each time."""
    callback = SDCFGCutoffCallback(cutoff_step_ratio=None, cutoff_step_index=2)
    callback = MultiPipelineCallbacks([callback]) if several else callback
    with pytest.raises(InvalidInputError, match=r"`callback_on_step_end` is .*, which counts steps, but `tolerance`"):
        latents(built_in, tolerance=0.1, callback_on_step_end=callback)


def test_a_photo_s_own_latents_can_be_the_start(scene):
    pipe = unitouch_gen.tiny("stylization")
    pipe.set_progress_bar_config(disable=True)
    call = {"image": scene.image, "touch": scene.touch["gelsight"], "tolerance": 0.1, "output_type": "pt"}
    kept = pipe(**call, init_strength=0.05, generator=torch.Generator().manual_seed(0))
    free = pipe(**call, init_strength=1.0, generator=torch.Generator().manual_seed(0))
    assert (kept.images - scene.image).abs().mean() < 0.5 * (free.images - scene.image).abs().mean()
    assert kept.report.evaluations < free.report.evaluations
