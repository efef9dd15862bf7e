"""`callback_on_step_end`: what it is given, and what it may change."""

import pytest
import torch
from diffusers.callbacks import MultiPipelineCallbacks, SDCFGCutoffCallback
from torch.testing import assert_close

from tests.helpers.calls import seeded, watched
from unitouch_gen.sampling import ReturnCode


def set_scale(scale, at=0):
    """A callback that changes the scale of guidance after a step."""
    return lambda pipe, step, *_: setattr(pipe, "_guidance_scale", scale) if step >= at else None


def put(latents, at):
    """A callback that puts latents in the place of the state after a step."""
    return lambda pipe, step, timestep, tensors: {"latents": latents[step]} if step == at else {}


def states_of(call, **options) -> list[torch.Tensor]:
    """The latents after each step."""
    states: list[torch.Tensor] = []
    call(callback_on_step_end=lambda pipe, step, timestep, tensors: states.append(tensors["latents"]), **options)
    return states


def test_a_callback_gets_the_tensors_asked_for_after_every_step(call):
    names = list(call.pipe._callback_tensor_inputs)
    calls = []

    note = lambda pipe, *given: calls.append((pipe.unet, pipe.num_timesteps, *given[:2], list(given[2])))  # noqa: E731
    scheduler = type(call.pipe.scheduler).from_config(call.pipe.scheduler.config)
    scheduler.set_timesteps(3)
    for asked in ([], names[1:], names):
        calls.clear()
        call(num_inference_steps=3, callback_on_step_end=note, callback_on_step_end_tensor_inputs=asked)
        assert calls == [(call.pipe.unet, 3, step, int(at), asked) for step, at in enumerate(scheduler.timesteps)]
    assert {state.dtype for state in states_of(call)} == {torch.float32}
    steps = []
    report = call(tolerance=0.2, callback_on_step_end=lambda pipe, step, *_: steps.append(step)).report
    assert len(steps) == report.steps > 0


def test_latents_of_a_callback_replace_the_state(call):
    zeros = lambda pipe, step, timestep, tensors: {"latents": torch.zeros_like(tensors["latents"]).bfloat16()}  # noqa: E731
    found = call.latents(callback_on_step_end=zeros)
    assert found.dtype == torch.float32
    assert not found.any()
    in_place = lambda pipe, step, timestep, tensors: {"latents": tensors["latents"].zero_()}  # noqa: E731
    assert not call.latents(callback_on_step_end=in_place).any()


STEPS = [{"num_inference_steps": 5}, {"num_inference_steps": 5, "solver": "unipc"}, {"tolerance": 0.1}]


@pytest.mark.parametrize("steps", STEPS)
def test_a_callback_may_interrupt_its_own_call(call, steps):
    """Before the next evaluation, and without an error, whatever the other samples became."""

    def stop(pipe, step, timestep, tensors):
        pipe._interrupt = step == 1
        if broken and step == 0:
            tensors["latents"][0] = torch.nan
        return tensors

    broken = False
    output = call(callback_on_step_end=stop, output_type="latent", **steps)
    assert output.report.evaluations in (2, 3)  # a tolerance and UniPC begin with one more
    assert torch.isfinite(output.images).all()
    assert output.report.codes == [ReturnCode.INTERRUPTED] * 2
    assert call.pipe.interrupt
    broken = True
    report = call(callback_on_step_end=stop, throw=False, **steps).report
    assert report.codes == [ReturnCode.NON_FINITE, ReturnCode.INTERRUPTED]
    assert call(num_inference_steps=3).report.evaluations == 3


@pytest.mark.parametrize("steps", STEPS)
def test_an_interrupt_is_of_its_own_call_alone(call, steps):
    """Not of another one that runs at the same time; here it runs within an evaluation of that."""
    expected = call.latents(**steps)

    def stop(pipe, step, timestep, tensors):
        pipe._interrupt = True
        return {}

    def run_another(unet, args, output):
        hook.remove()
        assert call(callback_on_step_end=stop).report.codes == [ReturnCode.INTERRUPTED] * 2

    hook = call.pipe.unet.register_forward_hook(run_another)
    assert torch.equal(call.latents(**steps), expected)


@pytest.mark.parametrize("steps", STEPS)
def test_a_callback_that_changes_nothing_changes_no_bit(call, steps):
    nothing = lambda pipe, step, timestep, tensors: tensors  # noqa: E731
    assert torch.equal(call.latents(callback_on_step_end=nothing, **steps), call.latents(**steps))


def test_hidden_states_of_a_callback_count_from_then_on(call):
    name = call.pipe._callback_tensor_inputs[1]
    options = {"num_inference_steps": 3}
    other = torch.randn(4, 1 if name == "condition_embeds" else 12, 16, generator=seeded())
    change = {"callback_on_step_end": lambda *_: {name: other}}
    one, two = (call.latents(callback_on_step_end_tensor_inputs=asked, **change, **options) for asked in ([], [name]))
    assert torch.equal(one, two)
    assert not torch.allclose(one, call.latents(**options), atol=1e-4)


def test_a_guidance_scale_of_a_callback_holds_from_the_next_step_to_the_end_of_its_call(call):
    options = {"num_inference_steps": 3, "solver": "ddim"}
    states = states_of(call, **options)
    expected = call.latents(**options)
    strong = call.latents(callback_on_step_end=put(states, at=0), guidance_scale=7.0, **options)
    assert_close(call.latents(callback_on_step_end=set_scale(7.0), **options), strong, atol=1e-5, rtol=1e-5)
    assert torch.equal(call.latents(**options), expected)


def cut_off(pipe, step, timestep, tensors):
    """The callback of diffusers' documentation: no guidance after the second step."""
    if step == 1:
        pipe._guidance_scale = 0.0
        (name,) = tensors
        tensors[name] = tensors[name].chunk(2)[-1]
    return tensors


@pytest.mark.parametrize("kind", ["of the documentation", "several"])
def test_guidance_may_be_turned_off(call, kind):
    """From the state that two guided steps left, a single branch goes on."""
    name = call.pipe._callback_tensor_inputs[1]
    callback = cut_off
    inputs = [name]
    if kind == "several":
        if name == "condition_embeds":
            pytest.skip("diffusers' callback names `prompt_embeds`")
        callback = MultiPipelineCallbacks([SDCFGCutoffCallback(cutoff_step_ratio=None, cutoff_step_index=1)])
        call = call.one(0)  # it keeps one row of the prompts
        inputs = []
    options = {"num_inference_steps": 4, "solver": "ddim", "output_type": "latent"}
    states = states_of(call, guidance_scale=5.0, **options)
    expected = call(guidance_scale=1.0, callback_on_step_end=put(states, at=1), **options).images
    ran = watched(call.pipe)
    options["guidance_scale"] = 5.0
    output = call(callback_on_step_end=callback, callback_on_step_end_tensor_inputs=inputs, **options)
    assert_close(output.images, expected, atol=1e-5, rtol=1e-5)
    rows = [rows for name, rows in ran if name == "UNet"]
    assert rows == [2 * rows[-1]] * 2 + [rows[-1]] * 2
    assert output.report.guided == 2
