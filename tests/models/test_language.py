"""The language bridge: its equation, every way to generate, and a language model that stays as it was."""

import pytest
import torch
import torch.nn.functional as F
from torch.testing import assert_close
from transformers import AutoConfig, AutoModelForCausalLM

from tests.helpers.components import LLAMA, D, make_language_parts
from unitouch_gen.models.language import LanguageBridge

IDS = torch.randint(3, 250, (3, 6), generator=torch.Generator().manual_seed(0))
EMBEDS = torch.randn(3, D, generator=torch.Generator().manual_seed(1))
TOKENS = {"pad_token_id": 0, "bos_token_id": 1, "eos_token_id": 2, "vocab_size": 280}
MODES = {
    "greedy": {"do_sample": False},
    "sampling": {"do_sample": True, "temperature": 0.7, "top_p": 0.9},
    "beams": {"num_beams": 3, "num_return_sequences": 2},
    "beam sampling": {"num_beams": 2, "do_sample": True},
    "several": {"do_sample": True, "num_return_sequences": 3},
    "no cache": {"use_cache": False},
    "static cache": {"cache_implementation": "static"},
    "guidance": {"guidance_scale": 2.0},
}


def model_of(kind, **sizes):
    return AutoModelForCausalLM.from_config(AutoConfig.for_model(kind, **sizes)).eval()


@pytest.fixture
def parts():
    made = make_language_parts()
    return made["language_bridge"], made["language_model"]


def generate(model, rows=slice(None), **options):
    torch.manual_seed(0)
    mask = torch.ones_like(IDS[rows])
    return model.generate(IDS[rows], attention_mask=mask, max_new_tokens=6, min_new_tokens=6, **options)


@torch.no_grad()
def test_the_language_bridge_adds_the_gated_value_of_an_adapter_token(parts):
    """By an adapter key and value in the attention itself, whose softmax over one token is 1."""
    bridge, model = parts
    seen = {}
    attention = model.model.layers[0].self_attn
    attention.o_proj.register_forward_hook(lambda module, inputs, output: seen.update(states=inputs[0]))
    model(IDS)
    before = seen["states"]
    with bridge.attach(model, EMBEDS):
        model(IDS)
    x = bridge.projection(EMBEDS / EMBEDS.norm(dim=1, keepdim=True))
    for block in bridge.blocks:
        n = block.norm.weight * x / (x.square().mean(dim=1, keepdim=True) + 1e-6).sqrt()
        x = x + block.w2(F.silu(block.w1(n)) * block.w3(n))
    value = (attention.v_proj.weight @ (x + bridge.queries[0]).T).T.view(3, 4, 8)
    added = torch.tanh(bridge.gates[0])[:, None] * value
    assert_close(seen["states"] - before, added.flatten(1)[:, None].expand(-1, 6, -1), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("mode", MODES)
@torch.no_grad()
def test_closed_gates_and_closing_leave_every_bit_and_open_gates_do_not(parts, mode, dtype):
    bridge, model = (part.to(dtype) for part in parts)
    before = generate(model, **MODES[mode])
    logits = model(IDS).logits
    with bridge.attach(model, EMBEDS):
        assert not torch.equal(model(IDS).logits, logits)
        open_ = generate(model, **MODES[mode])
    bridge.gates.zero_()
    attached = bridge.attach(model, EMBEDS)
    assert torch.equal(generate(model, **MODES[mode]), before)
    assert torch.equal(model(IDS).logits, logits)
    attached.close()
    assert torch.equal(model(IDS).logits, logits)
    assert not torch.equal(open_, before)
    assert not any(module._forward_pre_hooks for module in model.modules())


@pytest.mark.parametrize("mode", ["greedy", "beams", "no cache", "static cache"])
@torch.no_grad()
def test_inputs_of_a_batch_get_what_each_gets_alone(parts, mode):
    bridge, model = parts
    with bridge.attach(model, EMBEDS):
        together = generate(model, **MODES[mode])
    for row in range(3):
        with bridge.attach(model, EMBEDS[row : row + 1]):
            alone = generate(model, slice(row, row + 1), **MODES[mode])
        assert torch.equal(alone, together[row * len(alone) : (row + 1) * len(alone)])


@pytest.mark.parametrize("kind", ["llama", "qwen2", "qwen3", "phi3", "gemma2", "mixtral"])
@torch.no_grad()
def test_any_attention_that_ends_in_o_proj_takes_a_bridge(kind):
    torch.manual_seed(0)
    sizes = {"llama": {"head_dim": 12}, "qwen3": {"head_dim": 8, "num_key_value_heads": 1}, "gemma2": {"head_dim": 8}}
    model = model_of(kind, **{**LLAMA, **TOKENS, "num_key_value_heads": 2, **sizes.get(kind, {})})
    bridge = LanguageBridge.for_model(model, D, intermediate_size=24).eval()
    before = model(IDS).logits
    with bridge.attach(model, EMBEDS):
        assert torch.equal(model(IDS).logits, before)
    torch.nn.init.ones_(bridge.gates)
    with bridge.attach(model, EMBEDS):
        assert (model(IDS).logits - before).abs().max() > 1e-4


@pytest.mark.parametrize("checkpointed", [False, True])
def test_gradients_reach_all_of_the_bridge_and_it_alone(parts, checkpointed):
    bridge, model = parts
    if checkpointed:
        model.train().activation_checkpointing_enable()
    model.requires_grad_(False)
    with bridge.attach(model, EMBEDS):
        model(input_ids=IDS, labels=IDS, use_cache=False).loss.backward()
    assert all(bool(parameter.grad.any()) for parameter in bridge.parameters())
    assert all(parameter.grad is None for parameter in model.parameters())
