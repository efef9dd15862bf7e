"""Samples that leave the range of floating-point numbers, or grow beyond all pictures."""

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from unitouch_gen.errors import NonFiniteError, NotConvergedError
from unitouch_gen.sampling import ReturnCode

NAN, INF = float("nan"), float("inf")


def put(value, row=slice(None), step=0):
    """A callback that writes a value into the latents of a sample after a step."""

    def callback(pipe, index, timestep, tensors):
        latents = tensors["latents"].clone()
        if index == step:
            latents[row] = value
        return {"latents": latents}

    return callback


@pytest.mark.parametrize("value", [NAN, INF])
def test_a_sample_that_breaks_raises_at_its_step_and_leaves_the_next_call_alone(call, value):
    expected = call.latents()
    with pytest.raises(NonFiniteError, match="Sample 1 is not finite after step 2"):
        call(num_inference_steps=4, callback_on_step_end=put(value, row=1, step=1))
    assert torch.equal(call.latents(), expected)


@pytest.mark.parametrize("solver", [None, "dpm++2m", "heun"])
def test_without_throw_the_other_picture_comes_as_if_alone(call, solver):
    options = {"num_inference_steps": 4, "output_type": "latent", "solver": solver}
    whole = call(**options)
    output = call(throw=False, callback_on_step_end=put(NAN, row=0), **options)
    assert_close(output.images, whole.images[1:], atol=1e-5, rtol=1e-5)
    assert output.report.codes == [ReturnCode.NON_FINITE, whole.report.codes[1]]
    assert output.report.failed_at[0] == 0 and not output.report.success


@pytest.mark.parametrize(
    ("output_type", "shape"),
    [("pil", (0,)), ("pt", (0, 3, 16, 16)), ("np", (0, 16, 16, 3)), ("latent", (0, ..., 8, 8))],
)
def test_if_all_break_nothing_comes_back_in_the_kind_asked_for(call, output_type, shape):
    images = call(throw=False, callback_on_step_end=put(NAN), output_type=output_type).images
    assert isinstance(images, {"pil": list, "np": np.ndarray}.get(output_type, torch.Tensor))
    found = np.shape(images)
    assert len(found) == len(shape) and all(one in (other, ...) for other, one in zip(found, shape, strict=True))


def test_a_picture_that_breaks_in_decoding(call):
    """A decoder that leaves the range of its dtype for the first picture."""
    call.pipe.vae.decoder.register_forward_hook(lambda *args: torch.cat([args[-1][:1] * 1e30 * 1e10, args[-1][1:]]))
    with pytest.raises(NonFiniteError, match="Sample 0 is not finite after decoding"):
        call()
    output = call(throw=False)
    assert len(output.images) == 1
    assert output.report.codes == [ReturnCode.NON_FINITE, ReturnCode.SUCCESS] and output.report.failed_at == {0: 2}


def test_an_embedding_that_leaves_the_range_of_float16(call):
    """With finite weights; in float32 the same embedding is finite."""
    joint = call.pipe.unitouch
    for encoder in (joint.touch_model.projection, joint.vision_model.visual_projection):
        encoder.weight.data *= 3e4 / encoder.weight.abs().max()
    expected = call()
    assert expected.report.success
    joint.half()
    with pytest.raises(NonFiniteError, match=r"embedding of (touch|image) \d is not finite; run `unitouch` in float32"):
        call()
    report = call(throw=False).report
    assert set(report.codes) == {ReturnCode.NON_FINITE} and set(report.failed_at.values()) == {0}


def test_an_embedding_that_overflows_breaks_its_own_sample_alone(pipe, touch):
    expected = pipe(touch[:1], latents=torch.ones(1, 4, 8, 8), output_type="latent").images
    brighter = torch.tensor([1.0, 1e30 * 1e10])[:, None]
    pipe.unitouch.touch_model.register_forward_hook(lambda *args: args[-1] * brighter)
    with pytest.raises(NonFiniteError, match="embedding of touch 1 is not finite"):
        pipe(touch)
    output = pipe(touch, latents=torch.ones(2, 4, 8, 8), throw=False, output_type="latent")
    assert output.report.codes == [ReturnCode.SUCCESS, ReturnCode.NON_FINITE]
    assert output.images.shape == expected.shape and torch.isfinite(output.images).all()


def test_a_network_that_breaks_is_not_returned_as_a_black_picture(call):
    call.pipe.unet.conv_out.bias.data.fill_(NAN)
    with pytest.raises(NonFiniteError, match="Sample 0 is not finite after step 1"):
        call()


def test_latents_beyond_all_pictures(call):
    with pytest.raises(NotConvergedError, match=r"Sample 0 grew to .* in step 2.*`guidance_scale`"):
        call(callback_on_step_end=put(3e38, row=0, step=1))
    output = call(callback_on_step_end=put(50.0, row=0), throw=False, output_type="latent", num_inference_steps=3)
    assert output.report.codes == [ReturnCode.DIVERGED, ReturnCode.SUCCESS]
    assert len(output.images) == 2 and "diverged" in str(output.report)
