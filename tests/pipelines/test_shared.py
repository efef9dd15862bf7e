"""What all three pipelines share: outputs, random numbers, solvers, threads, dtypes, what ran, samples that break."""

import json
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

import numpy as np
import pytest
import torch
from diffusers import EulerDiscreteScheduler
from torch.testing import assert_close

from tests.helpers.calls import Call, quiet, seeded, watched
from tests.helpers.exact import ExactUNet
from unitouch_gen.errors import InvalidTypeError, NonFiniteError
from unitouch_gen.numerics.problems import PROBLEMS, relative_rms
from unitouch_gen.pipelines import TouchToImagePipeline
from unitouch_gen.pipelines.base import threads_for
from unitouch_gen.sampling import ReturnCode
from unitouch_gen.solvers import DIVERGED_RMS

NAN = float("nan")
INF = float("inf")


def noise_for(call, seed: int = 0) -> torch.Tensor:
    return torch.randn(2, call.pipe.unet.config.out_channels, 8, 8, generator=seeded(seed))


def test_every_output_type_is_the_decoded_latents(call):
    latents, tensor, array, pictures = (call(output_type=kind).images for kind in ("latent", "pt", "np", "pil"))
    with torch.no_grad():
        decoded = call.pipe.vae.decode(latents / call.pipe.vae.config.scaling_factor).sample
    assert_close((decoded / 2 + 0.5).clamp(0, 1), tensor, atol=1e-6, rtol=0)
    assert tensor.shape == (2, 3, 16, 16)
    np.testing.assert_array_equal(array, tensor.permute(0, 2, 3, 1).numpy())
    np.testing.assert_array_equal(np.stack([np.asarray(one) for one in pictures]), (array * 255).round())
    images, report = call(return_dict=False)
    assert torch.equal(images, tensor)
    assert report.success


@pytest.mark.parametrize(("size", "shape"), [([8, 4], (16, 8)), (None, None)])
def test_pictures_are_as_large_as_the_unet_says_or_the_call(call, size, shape):
    call.pipe.unet.register_to_config(sample_size=size)
    if size is None:
        with pytest.raises(InvalidTypeError, match="`width` is None"):
            call(height=16)
    else:
        assert call().images.shape == (2, 3, *shape)
        assert call(height=20).images.shape == (2, 3, 20, shape[1])
    assert call(height=24, width=8).images.shape == (2, 3, 24, 8)


def test_a_seed_fixes_the_picture_and_leaves_the_global_one_alone(call):
    before = torch.random.get_rng_state()
    first, again, other = (call.latents(generator=seeded(seed), eta=1.0, solver="ddim") for seed in (1, 1, 2))
    assert torch.equal(first, again)
    assert (first - other).abs().max() > 1e-3
    assert torch.equal(torch.random.get_rng_state(), before)


def test_given_latents_are_the_start_and_stay_as_they_were(call):
    noise = noise_for(call)
    first = call.latents(latents=noise)
    assert torch.equal(noise, noise_for(call))
    assert torch.equal(first, call.latents(latents=noise))
    assert not torch.allclose(first, call.latents(latents=-noise), atol=1e-3)
    images = call.latents(num_images_per_prompt=2, latents=noise[:1].expand(4, -1, -1, -1))
    assert_close(images[::2], images[1::2], atol=1e-5, rtol=0)  # pictures of one input stand together


@pytest.mark.parametrize("options", [{"eta": 1.0}, {"solver": "euler"}, {"num_images_per_prompt": 2}])
def test_with_a_generator_each_a_picture_is_independent_of_its_neighbours(call, options):
    """Also of other pictures of its touch, with their own noise on the embedding."""
    several = "num_images_per_prompt" in options
    noise = {"noise_level": 500} if "touch" in call.inputs else {}
    together = (call.one(0) if several else call).latents(generator=[seeded(1), seeded(2)], **noise, **options)
    options = noise if several else {**noise, **options}
    alone = [call.one(0 if several else row).latents(generator=seeded(row + 1), **options) for row in range(2)]
    assert_close(together, torch.cat(alone), atol=1e-4, rtol=1e-4)


def test_threads_that_share_a_pipeline_get_what_serial_calls_get(call):
    steps = enumerate((None, "heun", "dpm++2m", None), start=1)
    asked = [{"num_inference_steps": 1 + one, "guidance_scale": float(one), "solver": name} for one, name in steps]
    expected = [call.latents(**options) for options in asked]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda options: call.latents(**options), asked))
    assert all(torch.equal(one, other) for one, other in zip(found, expected, strict=True))


def test_calls_at_the_same_time_leave_the_number_of_threads_to_others_as_it_was(call):
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        with ThreadPoolExecutor(6) as pool:
            list(pool.map(lambda _: call.latents(), range(12)))
        with ThreadPoolExecutor(1) as pool:  # a new thread
            assert pool.submit(torch.get_num_threads).result() == torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize("solver", [None, "dpm++2m"])
def test_every_solver_makes_finite_pictures_and_leaves_the_scheduler_as_it_was(call, solver):
    scheduler = call.pipe.scheduler
    config = dict(scheduler.config)
    timesteps = scheduler.timesteps.clone()
    output = call(solver=solver, num_inference_steps=4)
    assert torch.isfinite(output.images).all()
    assert output.report.solver == (solver or "DDIMScheduler")
    assert output.report.steps == 4
    assert dict(scheduler.config) == config
    assert torch.equal(scheduler.timesteps, timesteps)
    assert scheduler.num_inference_steps is None


@pytest.mark.parametrize(("dtype", "near"), [(torch.bfloat16, 0.05), (torch.float64, 1e-4)])
def test_other_precisions_are_near_float32_on_a_float32_state(call, dtype, near):
    noise = noise_for(call)
    expected = call.latents(latents=noise)
    call.pipe.unet.to(dtype)
    found = call.latents(latents=noise)
    assert found.dtype == torch.float32
    assert (found - expected).norm() / expected.norm() < near
    call.pipe.to(dtype)  # the noise on embeddings is that of float32
    assert (call.latents(latents=noise) - expected).norm() / expected.norm() < 2 * near
    assert call().images.dtype == torch.float32


def test_only_what_a_call_needs_runs_and_the_report_says_what_was_left_out(call):
    ran = watched(call.pipe)
    needed = {f"{name} encoder" for name in ("image", "touch") if name in call.inputs}
    needed |= set() if call.pipe.text_encoder is None else {"prompt encoder"}
    left_out = call().report.left_out
    assert {name for name, _ in ran} == {*needed, "UNet", "VAE decoder"}
    assert {rows for name, rows in ran if name == "UNet"} == {4}  # both branches in a batch
    assert not {*needed, "UNet", "VAE decoder", "unconditional branch"} & set(left_out)
    ran.clear()
    left_out = call(output_type="latent", guidance_scale=1.0).report.left_out
    assert {"VAE decoder", "unconditional branch"} <= set(left_out)
    assert not {name for name, _ in ran} & set(left_out)
    assert {rows for name, rows in ran if name == "UNet"} == {2}
    assert [name for name, _ in ran].count("prompt encoder") == ("prompt encoder" in needed)


def test_what_a_call_leaves_out_changes_no_picture(call):
    """Without guidance, against a scale just above 1, which runs both branches; and embeddings, against inputs."""
    plain = call(guidance_scale=1.0, output_type="latent")
    assert_close(plain.images, call.latents(guidance_scale=1.0 + 1e-6), atol=1e-4, rtol=0)
    names = {"TouchToImagePipeline": "touch_embeds", "XToTouchPipeline": "condition_embeds"}
    if name := names.get(type(call.pipe).__name__):
        ran = watched(call.pipe)
        options = {"guidance_scale": 1.0, "generator": seeded(), "output_type": "latent"}
        again = call.pipe(**{name: plain.embeds}, **options)
        assert torch.equal(again.images, plain.images)
        assert "touch encoder" in again.report.left_out
        assert not {"touch encoder", "image encoder"} & {one for one, _ in ran}


def test_the_report_counts_evaluations_and_seconds_and_is_plain_values(call):
    ran = watched(call.pipe)
    report = call(solver="heun", num_inference_steps=np.int64(3), guidance_scale=np.float32(2.5)).report
    assert report.evaluations == [name for name, _ in ran].count("UNet") == 2 * 3 - 1
    assert all(seconds > 0 for seconds in report.seconds.values())
    assert {"denoising", "decoding"} < set(report.seconds)
    assert json.loads(json.dumps(report.to_dict()))["steps"] == 3


def put(value):
    """A callback that writes a value into all latents."""
    return lambda pipe, step, timestep, tensors: {"latents": torch.full_like(tensors["latents"], value)}


def test_if_all_break_nothing_comes_back_in_the_kind_asked_for_and_the_next_call_is_well(call):
    expected = call.latents()
    with pytest.raises(NonFiniteError, match="Sample 0 is not finite after step 1"):
        call(callback_on_step_end=put(INF))
    assert torch.equal(call.latents(), expected)
    for kind in ("pil", "pt", "np", "latent"):
        options = {"throw": False, "output_type": kind}
        images, whole = (call(callback_on_step_end=put(value), **options).images for value in (NAN, 0.0))
        assert type(images) is type(whole)
        assert len(images) == 0
        assert kind == "pil" or images.shape[1:] == whole.shape[1:]


def test_a_picture_that_breaks_in_decoding(call):
    """A decoder that leaves the range of its dtype for the first picture."""
    call.pipe.vae.decoder.register_forward_hook(lambda *args: torch.cat([args[-1][:1] * 1e30 * 1e10, args[-1][1:]]))
    with pytest.raises(NonFiniteError, match="Sample 0 is not finite after decoding"):
        call()
    output = call(throw=False)
    assert len(output.images) == 1
    assert output.report.failed_at == {0: 2}
    assert output.report.codes == [ReturnCode.NON_FINITE, ReturnCode.SUCCESS]


def test_an_embedding_that_leaves_the_range_of_float16(call):
    """With finite weights; in float32 the same embedding is finite. Then one of them alone."""
    joint = call.pipe.unitouch
    for weight in (joint.touch_model.projection.weight, joint.vision_model.visual_projection.weight):
        weight.data *= 3e4 / weight.abs().max()
    assert call().report.success
    joint.half()
    with pytest.raises(NonFiniteError, match=r"embedding of (touch|image) \d is not finite; run `unitouch` in float32"):
        call()
    joint.float()
    huge = torch.tensor([1.0, 1e30])[:, None] * 1e10
    for network in (joint.touch_model.projection, joint.vision_model.visual_projection):
        network.register_forward_hook(lambda *args: args[-1] * huge)
    output = call(throw=False)
    assert output.report.codes == [ReturnCode.SUCCESS, ReturnCode.NON_FINITE]
    assert len(output.images) == 1


def test_little_work_takes_one_thread_and_gives_the_others_back(pipe, touch):
    """More would wait for each other on a machine that does something else. Much work takes all there are."""
    seen = []
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        for stop in (False, True):

            def look(*_, stop=stop):
                seen.append(torch.get_num_threads())
                if stop:
                    raise KeyboardInterrupt
                return {}

            with suppress(KeyboardInterrupt):
                pipe(touch, callback_on_step_end=look)
            assert set(seen) == {1}
            assert torch.get_num_threads() == 3
        with threads_for(1e12):
            assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)


# What becomes of samples, with the pipeline's own scheduler and with solvers ------------------------------------------


@pytest.fixture
def exact(components, touch):
    """A pipeline whose network predicts exactly, of data that is Gaussian."""
    problem = PROBLEMS["gaussian"]
    components |= {"unet": ExactUNet.of(problem), "scheduler": problem.scheduler()}
    pipe = TouchToImagePipeline(**components, default_num_inference_steps=8, default_guidance_scale=2.0)
    return Call(quiet(pipe), {"touch": touch})


@pytest.mark.parametrize("steps", [{}, {"solver": "unipc"}, {"tolerance": 0.3}])
def test_a_sample_that_breaks_leaves_the_other_as_if_alone(exact, steps):
    evaluations = []

    def damage(unet, args, output):
        evaluations.append(unet)
        if len(evaluations) == 3:
            output[0][1::2] = INF  # of both branches
        return output

    whole = exact.latents(**steps)
    hook = exact.pipe.unet.register_forward_hook(damage)
    with pytest.raises(NonFiniteError, match=r"Sample 1 is not finite after step [123]"):
        exact(**steps)
    evaluations.clear()
    output = exact(throw=False, output_type="latent", **steps)
    hook.remove()
    assert output.report.codes == [ReturnCode.SUCCESS, ReturnCode.NON_FINITE]
    assert output.report.failed_at[1] in (0, 1, 2)
    if "tolerance" in steps:  # by which samples choose their steps together
        assert relative_rms(output.images, whole[:1]) < 0.3
    else:
        assert torch.equal(output.images, whole[:1])


@pytest.mark.parametrize("steps", [{}, {"solver": "heun"}, {"tolerance": 0.1}])
def test_a_sample_that_diverges_is_reported_at_its_step(exact, steps):
    def grow(pipe, step, timestep, tensors):
        if step == 1:
            tensors["latents"][0] = 2 * DIVERGED_RMS * tensors["latents"][0].sign()
        return tensors

    report = exact(callback_on_step_end=grow, **steps).report
    assert report.codes == [ReturnCode.DIVERGED, ReturnCode.SUCCESS]
    assert report.failed_at == {0: 1}


@pytest.mark.parametrize(("size", "code"), [(2.0, ReturnCode.DIVERGED), (0.5, ReturnCode.SUCCESS)])
def test_states_are_judged_as_networks_see_them(exact, size, code):
    """Of a diffusers scheduler that keeps x = z sqrt(1 + sigma^2)."""
    exact.pipe.scheduler = EulerDiscreteScheduler.from_config(exact.pipe.scheduler.config)
    shown = []
    exact.pipe.unet.register_forward_pre_hook(lambda unet, args: shown.append(args[0].square().mean().sqrt().item()))

    def grow(pipe, step, timestep, tensors):
        scale = size * DIVERGED_RMS / shown[-1] if step == 0 else 1.0
        return {"latents": scale * tensors["latents"]}

    report = exact(callback_on_step_end=grow, throw=False).report
    assert shown[1] > 0.8 * size * DIVERGED_RMS
    assert report.codes == [code] * 2


@pytest.mark.parametrize("steps", [{}, {"solver": "heun"}, {"tolerance": 0.3}])
def test_the_progress_bar_reaches_its_end(exact, steps, capsys):
    exact.pipe.set_progress_bar_config(disable=False)
    exact(**steps)
    assert "100%" in capsys.readouterr().err.splitlines()[-1]
