"""A UNet without the work that a request does not need, beside hooks, offloading, compilation, saving and training."""

import pytest
import torch
from accelerate import cpu_offload, cpu_offload_with_hook
from accelerate.hooks import remove_hook_from_module
from diffusers import UNet2DConditionModel
from diffusers.models.attention_processor import AttnProcessor2_0
from torch import Tensor

from unitouch_gen.eliminate import eliminated

DRAW = torch.Generator().manual_seed(0)
STATE = torch.randn(1, 4, 8, 8, generator=DRAW).repeat(2, 1, 1, 1)  # of two guidance branches
TOKENS = torch.randn(2, 5, 8, generator=DRAW)
TOKEN = TOKENS[:, :1]
LABELS = torch.tensor([1, 1])


class Loud(AttnProcessor2_0):
    """A processor of one's own."""

    def __call__(self, *inputs, **named) -> Tensor:
        return 2.0 * super().__call__(*inputs, **named)


def make(**settings) -> UNet2DConditionModel:
    torch.manual_seed(0)
    defaults = {
        "sample_size": 8,
        "block_out_channels": (8, 16),
        "norm_num_groups": 4,
        "cross_attention_dim": 8,
        "attention_head_dim": 4,
        "layers_per_block": 1,
        "num_class_embeds": 3,
        "down_block_types": ("DownBlock2D", "CrossAttnDownBlock2D"),
        "up_block_types": ("CrossAttnUpBlock2D", "UpBlock2D"),
    }
    return UNet2DConditionModel(**{**defaults, **settings}).eval()


def whole(unet: UNet2DConditionModel, hidden: Tensor = TOKEN) -> Tensor:
    """What the UNet itself predicts."""
    return unet(STATE, 500, hidden, class_labels=LABELS).sample


def distance(found: Tensor, expected: Tensor) -> float:
    return ((found - expected).norm() / expected.norm()).item()


def traces(unet: UNet2DConditionModel) -> list[dict[str, int]]:
    """What each module holds, by identity."""
    return [{key: id(value) for key, value in module.__dict__.items()} for module in unet.modules()]


@pytest.fixture
def unet() -> UNet2DConditionModel:
    return make()


# Hooks and processors -------------------------------------------------------------------------------------------------


@torch.no_grad()
def test_a_processor_set_within_a_request_is_heeded(unet):
    with eliminated(unet, TOKEN, LABELS) as lean:
        before = lean(STATE, 500)
        unet.set_attn_processor(Loud())
        found = lean(STATE, 500)
        assert distance(found, whole(unet)) < 1e-5 and distance(found, before) > 1e-3


@torch.no_grad()
def test_hooks_see_what_they_always_see(unet):
    seen = []
    for name in ("conv_in", "down_blocks.0.resnets.0.conv1", "down_blocks.1.attentions.0.transformer_blocks.0.attn2"):
        unet.get_submodule(name).register_forward_hook(lambda module, _, output: seen.append(output.clone()))
    expected = whole(unet)
    with eliminated(unet, TOKEN, LABELS) as lean:
        assert distance(lean(STATE, 500), expected) < 1e-5
    torch.testing.assert_close(seen[:3], seen[3:])


@torch.no_grad()
def test_hooks_of_the_whole_network_are_heeded(unet):
    unet.register_forward_pre_hook(lambda module, inputs: (STATE + torch.arange(2.0).view(2, 1, 1, 1), *inputs[1:]))
    with eliminated(unet, TOKEN, LABELS) as lean:
        assert distance(lean(STATE, 500), whole(unet)) < 1e-5


# Offloading and compilation -------------------------------------------------------------------------------------------


@torch.no_grad()
def test_offloaded_layer_by_layer_it_predicts_the_same(unet):
    expected = whole(unet), whole(unet, TOKENS)
    cpu_offload(unet, execution_device=torch.device("cpu"))
    assert unet.conv_in.weight.is_meta
    before = traces(unet)
    with eliminated(unet, TOKEN, LABELS) as lean:
        assert distance(lean(STATE, 500), expected[0]) < 1e-5
        assert all(distance(lean(STATE, 500, TOKENS), expected[1]) < 1e-5 for _ in range(2))
    assert len(lean.left_out) == 5
    assert traces(unet) == before
    remove_hook_from_module(unet, recurse=True)
    assert distance(whole(unet), expected[0]) < 1e-5


@torch.no_grad()
def test_offloaded_as_a_whole_it_predicts_the_same(unet):
    expected = whole(unet)
    unet, _ = cpu_offload_with_hook(unet, execution_device="cpu")
    with eliminated(unet, TOKEN, LABELS) as lean:
        assert all(distance(lean(STATE, 500), expected) < 1e-5 for _ in range(2))
    assert len(lean.left_out) == 5


@torch.no_grad()
def test_a_compiled_network_is_traced_once_for_all_requests():
    graphs = []

    def backend(graph, inputs):
        graphs.append(graph)
        return graph.forward

    torch.compiler.reset()
    unet = make(block_out_channels=(8,), down_block_types=["DownBlock2D"], up_block_types=["UpBlock2D"])
    compiled = torch.compile(unet, backend=backend, fullgraph=True)
    for scale in (1.0, 2.0):
        with eliminated(compiled, scale * TOKEN, LABELS) as lean:
            found = [lean(STATE, torch.tensor(timestep)) for timestep in (900, 100, 500)]
        assert len(graphs) == 1 and len(lean.left_out) == 5
        assert distance(found[-1], whole(unet, scale * TOKEN)) < 1e-5


# As it was ------------------------------------------------------------------------------------------------------------


@torch.no_grad()
def test_afterwards_the_network_is_as_it_was(unet):
    before = traces(unet)
    with eliminated(unet, TOKEN, LABELS) as lean:
        lean(STATE, 500)
        assert traces(unet) != before
    assert traces(unet) == before


@torch.no_grad()
def test_after_an_error_the_network_is_as_it_was(unet):
    before = traces(unet)
    with pytest.raises(RuntimeError), eliminated(unet, TOKEN, LABELS) as lean:
        lean(STATE[:, :1], 500)
    assert traces(unet) == before


@torch.no_grad()
def test_within_a_request_the_network_itself_does_all_of_its_work(unet):
    expected = whole(unet, TOKENS)
    with eliminated(unet, TOKENS, LABELS) as lean:
        with pytest.raises(RuntimeError):
            lean(STATE[:, :1], 500)
        lean(STATE, 500, 2 * TOKENS)
        assert all(torch.equal(whole(unet, TOKENS), expected) for _ in range(2))


@torch.no_grad()
def test_requests_may_lie_in_one_another(unet):
    before = traces(unet)
    with eliminated(unet, TOKEN, LABELS) as outer:
        with eliminated(unet, TOKENS, LABELS) as inner:
            assert distance(inner(STATE, 500), whole(unet, TOKENS)) < 1e-5
        assert distance(outer(STATE, 500), whole(unet)) < 1e-5
    assert traces(unet) == before


@torch.no_grad()
def test_saving_works_within_a_request(unet, tmp_path):
    names, config = list(unet.state_dict()), dict(unet.config)
    with eliminated(unet, TOKEN, LABELS) as lean:
        expected = lean(STATE, 500)
        assert list(unet.state_dict()) == names and dict(unet.config) == config
        unet.save_pretrained(tmp_path)
    assert distance(whole(UNet2DConditionModel.from_pretrained(tmp_path).eval()), expected) < 1e-5


# Training -------------------------------------------------------------------------------------------------------------


def test_gradients_are_those_of_the_whole_network(unet):
    state = STATE.clone().requires_grad_()
    with eliminated(unet, TOKEN, LABELS) as lean:
        predictions = lean(state, 500), unet(state, 500, TOKEN, class_labels=LABELS).sample
    given = [state, unet.conv_in.weight, unet.mid_block.attentions[0].transformer_blocks[0].attn2.to_v.weight]
    found, expected = (torch.autograd.grad(output.square().sum(), given) for output in predictions)
    torch.testing.assert_close(found, expected)
    assert not lean.left_out


@torch.no_grad()
def test_in_training_mode_each_row_has_its_own_dropout():
    unet = make(dropout=0.5).train()
    torch.manual_seed(0)
    expected = whole(unet)
    torch.manual_seed(0)
    with eliminated(unet, TOKEN, LABELS) as lean:
        assert torch.equal(lean(STATE, 500), expected)
    assert not lean.left_out
