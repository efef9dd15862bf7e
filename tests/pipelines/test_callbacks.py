"""`callback_on_step_end`: what it is given, and what it may change."""

import pytest
import torch
from diffusers.callbacks import MultiPipelineCallbacks, SDCFGCutoffCallback
from diffusers.models.attention_processor import AttnProcessor2_0
from torch.testing import assert_close

from tests.helpers.calls import seeded, watched
from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.sampling import ReturnCode

NAN = float("nan")


def set_scale(scale, at=0):
    """A callback that changes the scale of guidance after a step."""

    def change(pipe, step, timestep, tensors):
        pipe._guidance_scale = scale if step >= at else pipe._guidance_scale

    return change


def test_it_gets_the_latents_of_every_step_and_its_timestep(call):
    calls = []

    def note(pipe, step, timestep, tensors):
        calls.append((pipe.unet, pipe.num_timesteps, step, int(timestep), tensors["latents"].dtype, list(tensors)))

    scheduler = type(call.pipe.scheduler).from_config(call.pipe.scheduler.config)
    scheduler.set_timesteps(3)
    call(num_inference_steps=3, callback_on_step_end=note)
    unet = call.pipe.unet
    assert calls == [
        (unet, 3, step, int(at), torch.float32, ["latents"]) for step, at in enumerate(scheduler.timesteps)
    ]


def test_it_gets_only_what_was_asked_for(call):
    seen = []
    hidden = call.pipe._callback_tensor_inputs[1]
    for asked in ([], [hidden], ["latents", hidden]):
        call(
            callback_on_step_end=lambda pipe, step, timestep, tensors: seen.append(list(tensors)),
            callback_on_step_end_tensor_inputs=asked,
        )
        assert seen == [asked] * 2
        seen.clear()


def test_other_latents_take_the_place_of_the_state(call):
    zeros = lambda pipe, step, timestep, tensors: {"latents": torch.zeros_like(tensors["latents"]).bfloat16()}  # noqa: E731
    found = call.latents(callback_on_step_end=zeros)
    assert found.dtype == torch.float32 and not found.any()
    nothing = lambda *_: dict.fromkeys(call.pipe._callback_tensor_inputs)  # noqa: E731
    assert torch.equal(call.latents(callback_on_step_end=nothing), call.latents())


def test_it_may_interrupt_its_own_call(call):
    def stop(pipe, step, timestep, tensors):
        pipe._interrupt = step == 1

    output = call(num_inference_steps=5, callback_on_step_end=stop, output_type="latent")
    assert output.report.evaluations == 2 and torch.isfinite(output.images).all()
    assert output.report.codes == [ReturnCode.INTERRUPTED] * 2
    assert call(num_inference_steps=3).report.evaluations == 3


@pytest.mark.parametrize("asked", [True, False])
def test_hidden_states_that_it_returns_count_from_then_on(call, asked):
    """Whether it asked for those before or not; against a UNet for which nothing is cached."""
    name = call.pipe._callback_tensor_inputs[1]
    other = torch.randn(4, 1 if name == "condition_embeds" else 12, 16, generator=seeded())
    options = {
        "callback_on_step_end": lambda *_: {name: other},
        "callback_on_step_end_tensor_inputs": [name] if asked else [],
        "num_inference_steps": 3,
    }
    plain, found = call.latents(num_inference_steps=3), call.latents(**options)
    call.pipe.unet.set_attn_processor(AttnProcessor2_0())
    assert_close(found, call.latents(**options), atol=1e-5, rtol=1e-5)
    assert not torch.allclose(found, plain, atol=1e-4)


def test_a_new_scale_is_that_of_the_next_step_and_ends_with_its_call(call):
    states = []

    def note(pipe, step, timestep, tensors):
        states.append(tensors["latents"])

    options = {"num_inference_steps": 3, "solver": "ddim"}
    expected = call.latents(callback_on_step_end=note, guidance_scale=2.0, **options)
    back = lambda pipe, step, timestep, tensors: {"latents": states[0]} if step == 0 else {}  # noqa: E731
    strong = call.latents(callback_on_step_end=back, guidance_scale=7.0, **options)
    assert_close(call.latents(callback_on_step_end=set_scale(7.0), **options), strong, atol=1e-5, rtol=1e-5)
    assert torch.equal(call.latents(**options), expected)


def cut_off(pipe, step, timestep, tensors):
    """The callback of diffusers' documentation: no guidance after the second step."""
    if step == 1:
        pipe._guidance_scale = 0.0
        (name,) = tensors
        tensors[name] = tensors[name].chunk(2)[-1]
    return tensors


@pytest.mark.parametrize("kind", ["by hand", "of the documentation", "diffusers' own", "several"])
def test_guidance_may_be_turned_off(call, kind):
    """From the state that two guided steps left, a single branch goes on."""
    name, inputs = call.pipe._callback_tensor_inputs[1], []
    callback = set_scale(0.0, at=1)
    if kind == "of the documentation":
        callback, inputs = cut_off, [name]
    elif kind != "by hand":
        if name == "condition_embeds":
            pytest.skip("diffusers' callback names `prompt_embeds`")
        callback = SDCFGCutoffCallback(cutoff_step_ratio=None, cutoff_step_index=1)
        callback = MultiPipelineCallbacks([callback]) if kind == "several" else callback
        call = call.one(0)  # it keeps one row of the prompts
    options, states = {"num_inference_steps": 4, "solver": "ddim", "output_type": "latent"}, []
    note = lambda pipe, step, timestep, tensors: states.append(tensors["latents"])  # noqa: E731
    call(guidance_scale=5.0, callback_on_step_end=note, **options)
    go_on = lambda pipe, step, timestep, tensors: {"latents": states[1]} if step == 1 else {}  # noqa: E731
    expected = call(guidance_scale=1.0, callback_on_step_end=go_on, **options).images
    ran = watched(call.pipe)
    output = call(
        guidance_scale=5.0, callback_on_step_end=callback, callback_on_step_end_tensor_inputs=inputs, **options
    )
    assert_close(output.images, expected, atol=1e-5, rtol=1e-5)
    rows = [rows for name, rows in ran if name == "UNet"]
    assert rows == [2 * rows[-1]] * 2 + [rows[-1]] * 2
    assert output.report.guidance_scale == 5.0 and output.report.guided == 2


def test_guidance_that_never_was_cannot_be_turned_on(call):
    with pytest.raises(InvalidInputError, match="start with a `guidance_scale` above 1"):
        call(guidance_scale=1.0, callback_on_step_end=set_scale(4.0))


@pytest.mark.parametrize(
    ("returned", "named"),
    [
        ([1], "callback_on_step_end"),
        (3, "callback_on_step_end"),
        ({"latent": torch.zeros(2, 4, 8, 8)}, "latent"),
        ({"latents": [1]}, "latents"),
        ({"latents": torch.zeros(3, 4, 8, 8)}, "latents"),
        ({"latents": torch.zeros(2, 4, 8, 8).long()}, "latents"),
        ({"prompt_embeds": torch.tensor(1.0)}, "prompt_embeds"),
        ({"prompt_embeds": torch.zeros(4, 12, 3)}, "prompt_embeds"),
        ({"prompt_embeds": torch.zeros(3, 12, 16)}, "prompt_embeds"),
    ],
)
def test_what_it_may_not_return_is_refused_by_name(pipe, touch, returned, named):
    with pytest.raises((InvalidInputError, InvalidTypeError), match=named):
        pipe(touch, callback_on_step_end=lambda *_: returned)


@pytest.mark.parametrize("scale", ["much", None, NAN, 10**400])
def test_scales_that_it_may_not_set(call, scale):
    with pytest.raises((InvalidInputError, InvalidTypeError), match="_guidance_scale"):
        call(callback_on_step_end=set_scale(scale))


def test_to_a_tolerance_it_is_called_after_every_accepted_step(call):
    steps = []
    report = call(tolerance=0.2, callback_on_step_end=lambda pipe, step, *_: steps.append(step)).report
    assert len(steps) == report.steps > 0
