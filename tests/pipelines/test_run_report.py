"""The report of a call: what ran, what was left out, and samples that broke."""

import json

import numpy as np
import pytest
import torch
from PIL import Image

from unitouch_gen.errors import NonFiniteError, NotConvergedError
from unitouch_gen.sampling import ReturnCode


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def count_calls(module: torch.nn.Module) -> list[int]:
    """The batch sizes that a network has seen, as they come."""
    batches: list[int] = []
    module.register_forward_pre_hook(lambda module, args: batches.append(len(args[0])))
    return batches


def break_sample(row: int, step: int, value: float = float("nan")):
    """A callback that writes `value` into one sample's latents after one step."""

    def callback(pipeline, index, timestep, tensors):
        latents = tensors["latents"].clone()
        if index == step:
            latents[row] = value
        return {"latents": latents}

    return callback


# What ran -------------------------------------------------------------------------------------------------------------


def test_the_report_counts_steps_and_evaluations(pipe, touch):
    batches = count_calls(pipe.unet)
    report = pipe(touch, num_inference_steps=3).report
    assert (report.steps, report.evaluations) == (3, 3) == (len(batches), len(batches))


def test_the_report_counts_both_evaluations_of_a_heun_step(pipe, touch):
    batches = count_calls(pipe.unet)
    report = pipe(touch, num_inference_steps=3, solver="heun").report
    assert report.evaluations == len(batches) == 2 * 3 - 1
    assert report.steps == 3


def test_the_report_names_the_solver(pipe, touch):
    assert pipe(touch).report.solver == "DDIMScheduler"
    assert pipe(touch, solver="unipc").report.solver == "unipc"


def test_the_report_has_guidance_and_codes(pipe, touch):
    report = pipe(touch, guidance_scale=3.5).report
    assert report.guidance_scale == 3.5
    assert report.codes == [ReturnCode.SUCCESS] * 2
    assert report.success
    assert not report.failed_at


def test_the_report_has_the_seconds_of_each_stage(pipe, touch):
    seconds = pipe(touch).report.seconds
    assert set(seconds) == {"touch", "prompt", "denoising", "decoding"}
    assert all(value > 0 for value in seconds.values())


def test_the_report_is_plain_values_for_json(pipe, touch):
    """Also where the call's numbers are numpy's."""
    report = pipe(touch, num_inference_steps=np.int64(2), guidance_scale=np.float32(2.5)).report
    assert json.loads(json.dumps(report.to_dict()))["guidance_scale"] == 2.5


# What was left out ----------------------------------------------------------------------------------------------------


def test_with_guidance_both_branches_share_a_batch(pipe, touch):
    batches = count_calls(pipe.unet)
    assert "unconditional branch" not in pipe(touch, guidance_scale=2.0).report.left_out
    assert set(batches) == {4}


@pytest.mark.parametrize("scale", [0.0, 1.0])
def test_without_guidance_the_unconditional_branch_is_left_out(pipe, touch, scale):
    batches = count_calls(pipe.unet)
    assert "unconditional branch" in pipe(touch, guidance_scale=scale).report.left_out
    assert set(batches) == {2}


def test_without_guidance_no_negative_prompt_is_encoded(pipe, touch):
    texts = []
    pipe.text_encoder.register_forward_hook(lambda module, args, output: texts.append(1))
    pipe(touch, guidance_scale=1.0)
    assert len(texts) == 1


def test_latents_leave_the_vae_out(pipe, touch):
    decoded = count_calls(pipe.vae.decoder)
    assert "VAE" in pipe(touch, output_type="latent").report.left_out
    assert not decoded


def test_given_embeddings_leave_the_touch_encoder_out(pipe):
    touches = count_calls(pipe.unitouch.touch_model)
    report = pipe(touch_embeds=torch.ones(1, 16)).report
    assert "touch encoder" in report.left_out
    assert report.sensors == []
    assert not touches


def test_of_a_whole_call_only_work_done_twice_is_left_out(pipe, touch):
    """Inside the UNet, exactly; every part and every branch runs."""
    left_out = pipe(touch).report.left_out
    assert left_out
    assert not [item for item in left_out if "encoder" in item or "VAE" in item or "unconditional" in item]


def test_leaving_out_changes_nothing(pipe, touch):
    """The UNet asked in whole, step by step, gives the latents of the pipeline."""
    options = {"output_type": "latent", "num_inference_steps": 3, "solver": "ddim"}
    without = pipe(touch, generator=seeded(), **options).images
    hook = pipe.unet.register_forward_hook(lambda *_: None)  # beside a hook of a user's nothing is left out
    whole = pipe(touch, generator=seeded(), **options)
    hook.remove()
    assert whole.report.left_out == ["bank of image embeddings", "VAE"]
    assert (without - whole.images).norm() <= 1e-5 * whole.images.norm()


# Samples that break ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_sample_that_breaks_raises_at_its_step(pipe, touch, value):
    with pytest.raises(NonFiniteError, match=r"Sample 1 is not finite after step 2.*`guidance_scale`"):
        pipe(touch, num_inference_steps=4, callback_on_step_end=break_sample(1, step=1, value=value))


@pytest.mark.parametrize("solver", [None, "dpm++2m", "heun"])
def test_without_throw_the_other_picture_comes_as_if_alone(pipe, touch, solver):
    options = {"num_inference_steps": 4, "output_type": "pt", "solver": solver}
    whole = pipe(touch, generator=seeded(), **options)
    output = pipe(touch, generator=seeded(), throw=False, callback_on_step_end=break_sample(0, step=1), **options)
    torch.testing.assert_close(output.images, whole.images[1:], atol=1e-5, rtol=0)
    assert output.report.codes == [ReturnCode.NON_FINITE, whole.report.codes[1]]
    assert output.report.failed_at[0] == (0 if solver == "heun" else 1)  # the second evaluation is in Heun's first step
    assert not output.report.success


@pytest.mark.parametrize(
    ("output_type", "shape"), [("pt", (0, 3, 16, 16)), ("np", (0, 16, 16, 3)), ("latent", (0, 4, 8, 8))]
)
def test_if_all_break_nothing_comes_back_in_the_kind_asked_for(pipe, touch, output_type, shape):
    nan = lambda pipeline, step, timestep, tensors: {"latents": tensors["latents"] * float("nan")}  # noqa: E731
    images = pipe(touch, throw=False, callback_on_step_end=nan, output_type=output_type).images
    assert isinstance(images, np.ndarray if output_type == "np" else torch.Tensor)
    assert tuple(images.shape) == shape


def test_if_all_break_the_list_of_pictures_is_empty(pipe, touch):
    nan = lambda pipeline, step, timestep, tensors: {"latents": tensors["latents"] * float("nan")}  # noqa: E731
    assert pipe(touch, throw=False, callback_on_step_end=nan).images == []


@pytest.fixture
def overflowing_vae(pipe):
    """A decoder that leaves the range of its dtype for the first picture."""

    def overflow(module, args, output):
        return torch.cat([output[:1] * 1e30 * 1e10, output[1:]])

    pipe.vae.decoder.register_forward_hook(overflow)
    return pipe


def test_a_picture_that_breaks_in_decoding_raises(overflowing_vae, touch):
    with pytest.raises(NonFiniteError, match="Sample 0 is not finite after decoding"):
        overflowing_vae(touch)


def test_latents_too_large_to_be_decoded_raise_before_they_are(pipe, touch):
    with pytest.raises(NotConvergedError, match=r"Sample 0 grew to .* in step 2.*`guidance_scale`"):
        pipe(touch, callback_on_step_end=break_sample(0, step=1, value=3e38))


def test_without_throw_a_picture_that_breaks_in_decoding_gets_its_code(overflowing_vae, touch):
    output = overflowing_vae(touch, throw=False)
    assert [type(image) for image in output.images] == [Image.Image]
    assert output.report.codes == [ReturnCode.NON_FINITE, ReturnCode.SUCCESS]
    assert output.report.failed_at == {0: 2}


@pytest.fixture
def overflowing(pipe):
    """Finite weights and touches, but the embedding of the brighter touch leaves float32's range."""
    mean = torch.nn.Parameter(torch.tensor([0.2, 0.8])[:, None, None].expand(2, 2, 16).clone())  # tokens by sensor
    pipe.unitouch.sensor_bank.tokens = mean

    def scale(module, args, output):
        bright = args[1].mean(dim=(1, 2)) > 0.5
        return torch.where(bright[:, None], output * 1e30 * 1e10, output)

    pipe.unitouch.touch_model.register_forward_hook(scale)
    return pipe


def test_an_embedding_that_overflows_is_no_mistake_of_the_user(overflowing, touch):
    for call in (overflowing, overflowing.encode_touch):
        with pytest.raises(NonFiniteError, match="embedding of touch 1 is not finite; run `unitouch` in float32"):
            call(touch)


def test_without_throw_an_embedding_that_overflows_breaks_its_own_sample(overflowing, touch):
    output = overflowing(touch, throw=False)
    assert len(output.images) == 1
    assert output.report.codes == [ReturnCode.SUCCESS, ReturnCode.NON_FINITE]
    assert output.report.failed_at == {1: 0}


def test_a_network_that_breaks_is_not_returned_as_a_black_picture(pipe, touch):
    pipe.unet.conv_out.bias.data.fill_(float("nan"))
    with pytest.raises(NonFiniteError, match="Sample 0 is not finite after step 1"):
        pipe(touch)


def test_a_call_that_broke_leaves_the_next_one_alone(pipe, touch):
    expected = pipe(touch, generator=seeded(), output_type="pt").images
    with pytest.raises(NonFiniteError):
        pipe(touch, callback_on_step_end=break_sample(0, step=0))
    assert torch.equal(pipe(touch, generator=seeded(), output_type="pt").images, expected)
