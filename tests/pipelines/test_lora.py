"""LoRA weights, held to what diffusers' own unCLIP pipeline draws with them."""

import copy

import pytest
import torch
from diffusers.models.attention_processor import AttnProcessor2_0
from torch.testing import assert_close

from tests.pipelines.test_against_diffusers import diffusers_pipeline, draw
from unitouch_gen.errors import InvalidInputError

peft = pytest.importorskip("peft", reason="LoRA needs peft")
HALF, NONE = ({"cross_attention_kwargs": {"scale": scale}} for scale in (0.5, 0.0))


def close(one: torch.Tensor, other: torch.Tensor) -> bool:
    return torch.allclose(one, other, atol=2e-5, rtol=0)


def adapter(network, *targets: str) -> dict:
    """Gives a network an adapter of random weights, and returns these."""
    torch.manual_seed(0)
    config = peft.LoraConfig(r=4, lora_alpha=4, target_modules=list(targets), init_lora_weights=False)
    network.add_adapter(config, "made")
    return peft.get_peft_model_state_dict(network, adapter_name="made")


@pytest.fixture
def lora(tmp_path, components):
    """The folder of saved weights of both networks, and the picture that diffusers' own pipeline draws with them."""
    reference = diffusers_pipeline(copy.deepcopy(components))
    layers = {"unet_lora_layers": adapter(reference.unet, "to_q", "to_k", "to_v", "to_out.0")}
    type(reference).save_lora_weights(tmp_path / "unet", **layers)
    layers["text_encoder_lora_layers"] = adapter(reference.text_encoder, "q_proj", "v_proj")
    type(reference).save_lora_weights(tmp_path / "both", **layers)
    return tmp_path, draw(reference)


def test_weights_draw_what_they_draw_in_diffusers(lora, pipe):
    plain = draw(pipe)
    pipe.load_lora_weights(lora[0] / "both", adapter_name="bricks")
    assert close(draw(pipe), lora[1]) and not close(plain, lora[1])
    assert pipe.get_list_adapters() == {"unet": ["bricks"], "text_encoder": ["bricks"]}
    pipe.set_adapters("bricks", 0.0)
    assert close(draw(pipe), plain)
    pipe.set_adapters("bricks", 1.0)
    pipe.fuse_lora()
    assert_close(draw(pipe), lora[1], atol=1e-4, rtol=0)
    pipe.unfuse_lora()
    pipe.unload_lora_weights()
    assert_close(draw(pipe), plain, atol=1e-4, rtol=0)


@pytest.mark.parametrize("weights", ["unet", "both"])
def test_a_call_scales_weights_as_one_of_diffusers_does(lora, pipe, components, weights):
    plain = draw(pipe)
    pipe.load_lora_weights(lora[0] / weights)
    whole, expected = draw(pipe), draw(diffusers_pipeline(components), **HALF)  # on networks that both share
    assert close(draw(pipe, **HALF), expected) and not close(expected, plain) and not close(expected, whole)
    assert close(draw(pipe, **NONE), plain)
    if weights == "both":
        with torch.no_grad():
            states, _ = diffusers_pipeline(components).encode_prompt(["brick"], "cpu", 1, False, lora_scale=0.5)
            assert_close(pipe.encode_prompt(["brick"], lora_scale=0.5), states, atol=1e-6, rtol=0)
        handle = pipe.text_encoder.register_forward_hook(lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            draw(pipe, **HALF)
        handle.remove()
    assert torch.equal(draw(pipe), whole)  # the scale was the call's alone


def test_weights_of_each_pipeline_are_scaled_saved_and_loaded(call, tmp_path):
    plain = call.latents()
    layers = adapter(call.pipe.unet, "to_v", "to_out.0")
    half, whole = call.latents(**HALF), call.latents()
    assert close(call.latents(**NONE), plain) and not close(half, plain)
    call.pipe.set_adapters("made", 0.5)
    assert close(call.latents(), half)
    call.pipe.save_lora_weights(tmp_path, unet_lora_layers=layers)
    call.pipe.unload_lora_weights()
    assert close(call.latents(), plain)
    call.pipe.load_lora_weights(tmp_path)
    assert close(call.latents(), whole)


def test_weights_that_do_not_fit_or_are_a_pickle_are_refused(lora, x_to_touch, pipe, tmp_path):
    with pytest.raises(InvalidInputError, match="`pretrained_model_name_or_path_or_dict`"):
        x_to_touch.load_lora_weights(lora[0] / "both")
    (tmp_path / "pickle").mkdir()
    torch.save({"lora": torch.ones(1)}, tmp_path / "pickle" / "pytorch_lora_weights.bin")
    for place in (tmp_path / "pickle", tmp_path / "no" / "such"):
        with pytest.raises(InvalidInputError, match="`pretrained_model_name_or_path_or_dict`"):
            pipe.load_lora_weights(place, local_files_only=True)


class Note(AttnProcessor2_0):
    """Keeps what it is passed."""

    def __init__(self, notes: list) -> None:
        super().__init__()
        self.notes = notes

    def __call__(self, *args, note=None, **kwargs):
        self.notes.append(note)
        return super().__call__(*args, **kwargs)


@pytest.mark.parametrize("options", [{"num_inference_steps": 3}, {"tolerance": 0.1}])
def test_attention_processors_get_what_is_passed_in_every_evaluation(call, options):
    notes, passed = [], {"note": "rough", "scale": 1}
    layers = len(call.pipe.unet.attn_processors)
    call.pipe.unet.set_attn_processor(Note(notes))
    report = call(cross_attention_kwargs=passed, **options).report
    assert notes == ["rough"] * (layers * report.evaluations) and passed == {"note": "rough", "scale": 1}
