"""What all three pipelines have in common: outputs, sizes, random numbers, solvers, threads, dtypes, what ran."""

import json
from collections import Counter
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from diffusers import DPMSolverMultistepScheduler, EulerDiscreteScheduler, PNDMScheduler
from torch.testing import assert_close

from tests.helpers.calls import networks_of, seeded, watched
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.pipelines import UniTouchPipelineOutput
from unitouch_gen.sampling import SOLVERS

# Outputs and sizes ----------------------------------------------------------------------------------------------------


def test_every_output_type_is_the_decoded_latents(call):
    latents, tensor, array, pictures = (call(output_type=kind).images for kind in ("latent", "pt", "np", "pil"))
    with torch.no_grad():
        decoded = call.pipe.vae.decode(latents / call.pipe.vae.config.scaling_factor).sample
    assert_close((decoded / 2 + 0.5).clamp(0, 1), tensor, atol=1e-6, rtol=0)
    assert tensor.shape == (2, 3, 16, 16)
    np.testing.assert_array_equal(array, tensor.permute(0, 2, 3, 1).numpy())
    np.testing.assert_array_equal(np.stack([np.asarray(one) for one in pictures]), (array * 255).round())


def test_the_shift_of_a_vae_is_undone(pipe, touch):
    """As in diffusers' Stable Diffusion 3: latents / scaling_factor + shift_factor."""
    pipe.vae.register_to_config(shift_factor=0.3)
    latents, found = (pipe(touch, generator=seeded(), output_type=kind).images for kind in ("latent", "pt"))
    with torch.no_grad():
        decoded = pipe.vae.decode(latents / pipe.vae.config.scaling_factor + 0.3).sample
    assert_close((decoded / 2 + 0.5).clamp(0, 1), found, atol=1e-6, rtol=0)


def test_the_output_is_an_object_or_a_tuple(call):
    output = call()
    images, report = call(return_dict=False)
    assert isinstance(output, UniTouchPipelineOutput)
    assert torch.equal(images, output.images) and report.codes == output.report.codes


@pytest.mark.parametrize(("size", "shape"), [([8, 4], (16, 8)), (6, (12, 12))])
def test_pictures_are_as_large_as_the_unet_says_or_the_call(call, size, shape):
    call.pipe.unet.register_to_config(sample_size=size)
    assert call().images.shape == (2, 3, *shape)
    assert call(height=20).images.shape == (2, 3, 20, shape[1])
    assert call(height=24, width=8).images.shape == (2, 3, 24, 8)


def test_a_unet_without_a_size_needs_one_in_the_call(call):
    call.pipe.unet.register_to_config(sample_size=None)
    with pytest.raises(InvalidInputError, match="`width` has to be passed"):
        call(height=16)
    assert call(height=16, width=8).images.shape == (2, 3, 16, 8)


def test_pictures_of_one_input_stand_together(call):
    noise = torch.randn(1, *call.latents().shape[1:], generator=seeded()).expand(4, -1, -1, -1)
    images = call.latents(num_images_per_prompt=2, latents=noise)
    assert_close(images[::2], images[1::2], atol=1e-5, rtol=0)
    assert (images[0] - images[2]).abs().max() > 1e-3


# Random numbers -------------------------------------------------------------------------------------------------------


def test_a_seed_fixes_the_picture_and_leaves_the_global_one_alone(call):
    before = torch.random.get_rng_state()
    first, again, other = (call.latents(generator=seeded(seed), eta=1.0, solver="ddim") for seed in (1, 1, 2))
    assert torch.equal(first, again) and (first - other).abs().max() > 1e-3
    assert torch.equal(torch.random.get_rng_state(), before)


def test_given_latents_are_the_start_and_stay_as_they_were(call):
    noise = torch.randn(call.latents().shape, generator=seeded(1))
    kept, first = noise.clone(), call.latents(latents=noise)
    assert torch.equal(noise, kept)
    assert torch.equal(first, call.latents(latents=noise))
    assert not torch.allclose(first, call.latents(latents=-noise), atol=1e-3)


@pytest.mark.parametrize("options", [{}, {"eta": 1.0}, {"solver": "euler"}, {"solver": "dpm++2m"}])
def test_with_a_generator_each_a_picture_is_independent_of_its_neighbours(call, options):
    together = call.latents(generator=[seeded(1), seeded(2)], **options)
    alone = [call.one(row).latents(generator=seeded(row + 1), **options) for row in range(2)]
    assert_close(together, torch.cat(alone), atol=1e-4, rtol=0)


def test_with_a_generator_each_so_are_several_pictures_of_one_input(call):
    options = {} if call.pipe.text_encoder is None else {"noise_level": 500}
    one = call.one(0)
    together = one.latents(generator=[seeded(1), seeded(2)], num_images_per_prompt=2, **options)
    assert_close(
        together, torch.cat([one.latents(generator=seeded(seed), **options) for seed in (1, 2)]), atol=1e-4, rtol=0
    )


def test_threads_that_share_a_pipeline_get_what_serial_calls_get(call):
    asked = [
        {"num_inference_steps": 2 + number, "guidance_scale": 1.0 + number % 3, "solver": solver}
        for number, solver in enumerate((None, "heun", "dpm++2m", None, "unipc", "ddim"))
    ]
    expected = [call.latents(**options) for options in asked]
    with ThreadPoolExecutor(6) as pool:
        found = list(pool.map(lambda options: call.latents(**options), asked))
    assert all(torch.equal(one, other) for one, other in zip(found, expected, strict=True))


# Solvers --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", [None, *SOLVERS])
def test_every_solver_makes_finite_pictures_and_leaves_the_scheduler_as_it_was(call, solver):
    scheduler = call.pipe.scheduler
    config, timesteps = dict(scheduler.config), scheduler.timesteps.clone()
    output = call(solver=solver, num_inference_steps=4)
    assert torch.isfinite(output.images).all()
    assert output.report.solver == (solver or "DDIMScheduler") and output.report.steps == 4
    assert dict(scheduler.config) == config and torch.equal(scheduler.timesteps, timesteps)
    assert scheduler.num_inference_steps is None


@pytest.mark.parametrize("scheduler", [PNDMScheduler, DPMSolverMultistepScheduler])
def test_schedulers_with_a_memory_start_afresh(call, scheduler):
    call.pipe.scheduler = scheduler.from_config(call.pipe.scheduler.config)
    first = call.latents(num_inference_steps=4)
    assert torch.equal(call.latents(num_inference_steps=4), first)


def test_steps_that_are_chosen_make_the_picture_of_their_number(call):
    call.pipe.scheduler = scheduler = EulerDiscreteScheduler.from_config(call.pipe.scheduler.config)
    scheduler = EulerDiscreteScheduler.from_config(scheduler.config)
    scheduler.set_timesteps(4)  # of which each is a whole number
    expected = call.latents(num_inference_steps=4)
    for chosen in ({"timesteps": scheduler.timesteps.int().tolist()}, {"sigmas": scheduler.sigmas.tolist()}):
        assert_close(call.latents(**chosen), expected, atol=1e-4, rtol=1e-4)
    assert call(solver="euler", timesteps=[900, 500, 100]).report.steps == 3


# Networks' dtypes -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_precision_is_near_float32_on_a_float32_state(call, dtype):
    noise = torch.randn(call.latents().shape, generator=seeded())
    expected = call.latents(latents=noise)
    call.pipe.unet.to(dtype)
    found = call.latents(latents=noise)
    assert found.dtype == torch.float32
    assert (found - expected).norm() / expected.norm() < 0.05
    call.pipe.to(dtype)
    images = call().images
    assert images.dtype == torch.float32 and torch.isfinite(images).all()


def test_float64_makes_the_same_picture(call):
    noise = torch.randn(call.latents().shape, generator=seeded())
    expected = call.latents(latents=noise)
    call.pipe.to(torch.float64)
    # The noise on embeddings is float32's in any dtype.
    assert_close(call.latents(latents=noise), expected, atol=1e-4, rtol=0)


# What ran, and what was left out --------------------------------------------------------------------------------------

NEEDED = {
    "TouchToImagePipeline": {"touch encoder", "prompt encoder"},
    "TactileStylizationPipeline": {"touch encoder", "image encoder", "prompt encoder"},
    "XToTouchPipeline": {"image encoder"},
}


def test_only_what_a_call_needs_runs_and_the_report_says_what_was_left_out(call):
    ran, needed = watched(call.pipe), NEEDED[type(call.pipe).__name__]
    left_out = call().report.left_out
    assert {name for name, _ in ran} == {*needed, "UNet", "VAE decoder"}
    assert {rows for name, rows in ran if name == "UNet"} == {4}  # both branches in a batch
    assert not {*needed, "UNet", "VAE decoder", "unconditional branch"} & set(left_out)
    ran.clear()
    left_out = call(output_type="latent", guidance_scale=1.0).report.left_out
    assert {"VAE decoder", "unconditional branch"} <= set(left_out)
    assert not {name for name, _ in ran} & set(left_out)
    assert {rows for name, rows in ran if name == "UNet"} == {2}
    assert Counter(name for name, _ in ran)["prompt encoder"] == (1 if "prompt encoder" in needed else 0)


@pytest.mark.parametrize("interval", [(0.2, 0.8), (0.0, 1.0)])
def test_guidance_may_be_kept_to_an_interval(call, interval):
    ran = watched(call.pipe)
    report = call(num_inference_steps=8, guidance_scale=3.0, guidance_interval=interval).report
    rows = [rows for name, rows in ran if name == "UNet"]
    assert report.guided == rows.count(4) and report.evaluations == len(rows) == 8
    assert (0 < report.guided < 8) == (interval == (0.2, 0.8))
    assert any("unconditional branch in" in item for item in report.left_out) == (report.guided < 8)


def test_leaving_out_changes_nothing(call):
    """Without guidance, against a scale just above 1, which runs both branches; and embeddings, against inputs."""
    plain = call(guidance_scale=1.0, output_type="latent")
    whole = call.latents(guidance_scale=1.0 + 1e-6)
    assert_close(plain.images, whole, atol=1e-4, rtol=0)
    name = {"TouchToImagePipeline": "touch_embeds", "XToTouchPipeline": "condition_embeds"}.get(
        type(call.pipe).__name__
    )
    if name:
        ran = watched(call.pipe)
        options = {"guidance_scale": 1.0, "generator": seeded(), "output_type": "latent"}
        again = call.pipe(**{name: plain.embeds}, **options)
        assert torch.equal(again.images, plain.images)
        assert not {"touch encoder", "image encoder"} & {one for one, _ in ran}
        assert "touch encoder" in again.report.left_out


def test_the_report_counts_evaluations_and_seconds_and_is_plain_values(call):
    ran = watched(call.pipe)
    report = call(solver="heun", num_inference_steps=np.int64(3), guidance_scale=np.float32(2.5)).report
    assert report.evaluations == Counter(name for name, _ in ran)["UNet"] == 2 * 3 - 1
    assert all(seconds > 0 for seconds in report.seconds.values()) and {"denoising", "decoding"} < set(report.seconds)
    assert json.loads(json.dumps(report.to_dict()))["guidance_scale"] == 2.5


def test_every_network_is_watched(call):
    """Or the tests above would look away."""
    parts = [part for part in call.pipe.components.values() if isinstance(part, torch.nn.Module)]
    inside = {id(module) for network in networks_of(call.pipe).values() for module in network.modules()}
    quiet = {"image_normalizer", "embedding_bank"}
    for name, part in call.pipe.components.items():
        assert part not in parts or name in quiet or any(id(module) in inside for module in part.modules())
