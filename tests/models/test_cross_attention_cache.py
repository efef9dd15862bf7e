"""A UNet with what its cross-attentions make of the condition computed once, against the same UNet without."""

import copy
import logging
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch
from accelerate import cpu_offload
from diffusers import UNet2DConditionModel, UNet2DModel
from diffusers.models.attention_processor import AttnProcessor2_0
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

import unitouch_gen
from unitouch_gen.models.casting import compute_in
from unitouch_gen.models.cross_attention_cache import (
    CacheAttnProcessor,
    cache_arguments,
    cross_attention_cache,
    install_cache_processors,
)

SD_LIKE = {
    "sample_size": 8,
    "block_out_channels": (8, 16),
    "norm_num_groups": 4,
    "cross_attention_dim": 8,
    "attention_head_dim": 4,
    "layers_per_block": 1,
    "down_block_types": ("DownBlock2D", "CrossAttnDownBlock2D"),
    "up_block_types": ("CrossAttnUpBlock2D", "UpBlock2D"),
}
CACHED = {
    "cross-attention late": {},
    "linear projection": {"use_linear_projection": True},
    "only cross-attention": {"only_cross_attention": True},
    "two blocks a transformer": {"transformer_layers_per_block": 2, "layers_per_block": 2},
    "self-attention over pictures": {
        "down_block_types": ("DownBlock2D", "AttnDownBlock2D"),
        "up_block_types": ("AttnUpBlock2D", "UpBlock2D"),
    },
    "gated": {"attention_type": "gated"},
}
NOT_CACHED = {
    "projected condition": {"encoder_hid_dim": 6, "encoder_hid_dim_type": "text_proj"},
    "added keys and values": {
        "down_block_types": ("DownBlock2D", "SimpleCrossAttnDownBlock2D"),
        "up_block_types": ("SimpleCrossAttnUpBlock2D", "UpBlock2D"),
        "mid_block_type": "UNetMidBlock2DSimpleCrossAttn",
    },
}


def make_unet(**settings) -> UNet2DConditionModel:
    torch.manual_seed(0)
    unet = UNet2DConditionModel(**{**SD_LIKE, **settings}).eval()
    for weight in unet.parameters():
        if weight.ndim == 1:  # norms and biases are made as ones and zeros, which hide mistakes
            weight.data += 0.3 * torch.randn(weight.shape)
    return unet


def built_in(name: str) -> UNet2DConditionModel:
    folder = Path(unitouch_gen.__file__).parent / "weights" / name / "unet"
    return UNet2DConditionModel.from_pretrained(folder, torch_dtype=torch.float32).eval()


def cached(unet: UNet2DConditionModel) -> UNet2DConditionModel:
    unet = copy.deepcopy(unet)
    install_cache_processors(unet)
    return unet


def noise(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def guided(unet: UNet2DConditionModel, samples: int, tokens: int) -> tuple[Tensor, dict[str, Tensor]]:
    """Latents twice, and conditions with zeros first."""
    config = unet.config
    state = noise(samples, config.in_channels, config.sample_size, config.sample_size).repeat(2, 1, 1, 1)
    hidden = noise(samples, tokens, config.encoder_hid_dim or config.cross_attention_dim, seed=1)
    conditions = {"encoder_hidden_states": torch.cat([torch.zeros_like(hidden), hidden])}
    if config.class_embed_type == "projection":
        labels = noise(samples, config.projection_class_embeddings_input_dim, seed=2)
        conditions["class_labels"] = torch.cat([torch.zeros_like(labels), labels])
    elif config.num_class_embeds:
        conditions["class_labels"] = torch.ones(2 * samples, dtype=torch.long)
    return state, conditions


def distance(found: Tensor, expected: Tensor) -> float:
    return ((found - expected).norm() / expected.norm()).item()


@pytest.fixture
def plain() -> UNet2DConditionModel:
    return make_unet()


# Exact ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "tokens"), [("x-to-touch", 1), ("touch-to-image", 24)])
@torch.no_grad()
def test_the_built_in_networks_predict_the_same_with_guidance_and_without(name, tokens):
    plain = built_in(name)
    unet = cached(plain)
    state, conditions = guided(plain, 2, tokens)
    cache = cross_attention_cache(unet, conditions["encoder_hidden_states"])
    assert len(cache) == 7
    for timestep, rows in ((900, 4), (500, 2), (100, 4)):
        last = {key: value[-rows:] for key, value in conditions.items()}
        found = unet(state[-rows:], timestep, **last, **cache_arguments(cache, rows)).sample
        assert distance(found, plain(state[-rows:], timestep, **last).sample) < 1e-6


@pytest.mark.parametrize("tokens", [1, 5])
@pytest.mark.parametrize("variant", CACHED | NOT_CACHED)
@torch.no_grad()
def test_networks_of_other_shapes_predict_the_same_without_a_warning(variant, tokens, caplog):
    logging.getLogger("diffusers.models.attention_processor").addHandler(caplog.handler)
    plain = make_unet(**(CACHED | NOT_CACHED)[variant])
    unet = cached(plain)
    state, conditions = guided(plain, 2, tokens)
    cache = cross_attention_cache(unet, conditions["encoder_hidden_states"])
    assert bool(cache) == (variant in CACHED)
    found = unet(state, 500, **conditions, **cache_arguments(cache, 4)).sample
    assert distance(found, plain(state, 500, **conditions).sample) < 1e-6
    assert not caplog.records


@pytest.mark.parametrize("tokens", [1, 5])
@torch.no_grad()
def test_one_condition_serves_a_batch_of_any_size(plain, tokens):
    unet, state, hidden = cached(plain), noise(3, 4, 8, 8), noise(1, tokens, 8)
    arguments = cache_arguments(cross_attention_cache(unet, hidden), 3)
    hidden = hidden.expand(3, -1, -1)
    found = unet(state, 500, encoder_hidden_states=hidden, **arguments).sample
    assert distance(found, plain(state, 500, encoder_hidden_states=hidden).sample) < 1e-6


@torch.no_grad()
def test_without_a_cache_and_beside_masks_it_is_the_plain_network(plain):
    unet = cached(plain)
    state, conditions = guided(plain, 1, 5)
    arguments = cache_arguments(cross_attention_cache(unet, conditions["encoder_hidden_states"]), 2)
    assert torch.equal(unet(state, 500, **conditions).sample, plain(state, 500, **conditions).sample)
    conditions["encoder_attention_mask"] = torch.tensor([[1, 1, 0, 0, 0], [1, 1, 1, 1, 0]])
    assert torch.equal(unet(state, 500, **conditions, **arguments).sample, plain(state, 500, **conditions).sample)


@torch.no_grad()
def test_diffusers_puts_its_default_processors_in_their_place(plain):
    unet = cached(plain)
    unet.set_default_attn_processor()
    state, conditions = guided(plain, 1, 5)
    assert cross_attention_cache(unet, conditions["encoder_hidden_states"]) == {}
    assert distance(unet(state, 500, **conditions).sample, plain(state, 500, **conditions).sample) < 1e-6


@pytest.mark.parametrize("cast", ["layerwise casting of diffusers", "compute_in"])
@torch.no_grad()
def test_weights_that_are_cast_layer_by_layer_are_used_as_they_are_cast(cast):
    plain = make_unet().half()
    unet = cached(plain)
    if cast == "compute_in":
        compute_in(unet)
    else:
        unet.float().enable_layerwise_casting(torch.float16, torch.float32, skip_modules_pattern=())
    plain.float()
    state, conditions = guided(plain, 1, 1)
    cache = cross_attention_cache(unet, conditions["encoder_hidden_states"])
    assert len(cache) == 4
    found = unet(state, 500, **conditions, **cache_arguments(cache, 2)).sample
    assert distance(found, plain(state, 500, **conditions).sample) < 1e-5


@torch.no_grad()
def test_calls_that_share_a_network_have_caches_of_their_own(plain):
    unet, conditions = cached(plain), [noise(2, tokens, 8, seed=tokens) for tokens in (1, 5)]
    caches = [cross_attention_cache(unet, hidden) for hidden in conditions]

    @torch.no_grad()
    def predict(call: int) -> Tensor:
        arguments = cache_arguments(caches[call % 2], 2)
        return unet(noise(2, 4, 8, 8), 500, encoder_hidden_states=conditions[call % 2], **arguments).sample

    expected = [plain(noise(2, 4, 8, 8), 500, encoder_hidden_states=hidden).sample for hidden in conditions]
    with ThreadPoolExecutor(2) as pool:
        for call, found in enumerate(pool.map(predict, range(8))):
            assert distance(found, expected[call % 2]) < 1e-6


# What it saves --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tokens", [1, 7])
@torch.no_grad()
def test_it_saves_the_operations_on_the_condition(plain, tokens):
    """N pixels, C channels, a condition (T, D): keys and values 4 T C D, and of one token queries and output, 4 N C^2.

    The counter of torch leaves softmax(Q K) V on a CPU out.
    """
    N, C, D, layers = 4 * 4, 16, 8, 4
    unet, state, hidden = cached(plain), noise(1, 4, 8, 8), noise(1, tokens, 8)
    arguments = cache_arguments(cross_attention_cache(unet, hidden), 1)
    counted = []
    for others in ({}, arguments):
        with FlopCounterMode(display=False) as counter:
            unet(state, 500, encoder_hidden_states=hidden, **others)
        counted.append(counter.get_total_flops())
    queries_and_output = 4 * N * C**2 if tokens == 1 else 0
    assert counted[0] - counted[1] == layers * (4 * tokens * C * D + queries_and_output)


# Beside what users do to a network ------------------------------------------------------------------------------------


class Doubled(AttnProcessor2_0):
    """A processor of one's own."""

    def __call__(self, *inputs, **named) -> Tensor:
        return 2.0 * super().__call__(*inputs, **named)


def hook_keys(unet: UNet2DConditionModel) -> None:
    layer = unet.mid_block.attentions[0].transformer_blocks[0].attn2.to_k
    layer.register_forward_hook(lambda module, _, output: 2.0 * output)


SETTINGS = {
    "processors of one's own": lambda unet: unet.set_attn_processor(Doubled()),
    "slices": lambda unet: unet.set_attention_slice(2),
    "fused projections": UNet2DConditionModel.fuse_qkv_projections,
    "hooks": hook_keys,
    "offloading": lambda unet: cpu_offload(unet, execution_device=torch.device("cpu")),
    "blocks compiled one by one": lambda unet: unet.compile_repeated_blocks(fullgraph=True, backend="eager"),
    "training": UNet2DConditionModel.train,
}


@pytest.mark.parametrize("when", ["before", "after"])
@pytest.mark.parametrize("setting", SETTINGS)
@torch.no_grad()
def test_what_may_not_be_called_ahead_or_is_set_by_the_user_is_left_alone(plain, setting, when):
    torch.compiler.reset()
    state, conditions = guided(plain, 1, 1)
    unet = copy.deepcopy(plain) if when == "before" else cached(plain)
    SETTINGS[setting](unet)
    install_cache_processors(unet)
    SETTINGS[setting](plain)
    assert cross_attention_cache(unet, conditions["encoder_hidden_states"]) == {}
    assert distance(unet(state, 500, **conditions).sample, plain(state, 500, **conditions).sample) < 1e-6


def test_while_gradients_are_recorded_nothing_is_cached(plain):
    assert cross_attention_cache(cached(plain), noise(1, 1, 8)) == {}
    assert cache_arguments({}, 1) == {}


@torch.no_grad()
def test_another_network_is_left_alone():
    network = UNet2DModel(
        block_out_channels=(4,),
        down_block_types=["DownBlock2D"],
        up_block_types=["UpBlock2D"],
        norm_num_groups=2,
        attention_head_dim=2,
    )
    install_cache_processors(network)
    assert cross_attention_cache(network, noise(1, 1, 8)) == {}


@pytest.mark.parametrize("in_place", [True, False])
@torch.no_grad()
def test_a_compiled_network_is_traced_once_for_all_calls(plain, in_place):
    graphs = []

    def backend(graph, inputs):
        graphs.append(graph)
        return graph.forward

    torch.compiler.reset()
    unet = cached(plain)
    if in_place:
        unet.compile(backend=backend, fullgraph=True)
    else:
        unet = torch.compile(unet, backend=backend, fullgraph=True)
    state, conditions = guided(plain, 1, 1)
    for scale in (1.0, 2.0):
        hidden = scale * conditions["encoder_hidden_states"]
        cache = cross_attention_cache(unet, hidden)
        for timestep in (900, 100):
            arguments = {"encoder_hidden_states": hidden, **cache_arguments(cache, 2)}
            found = unet(state, torch.tensor(timestep), **arguments).sample
        assert len(cache) == 4 and len(graphs) == 1
        assert distance(found, plain(state, 100, hidden).sample) < 1e-5


def test_what_is_saved_is_the_plain_network(plain, tmp_path):
    unet = cached(plain)
    assert list(unet.state_dict()) == list(plain.state_dict()) and unet.config == plain.config
    unet.save_pretrained(tmp_path)
    found = UNet2DConditionModel.from_pretrained(tmp_path)
    assert not any(isinstance(processor, CacheAttnProcessor) for processor in found.attn_processors.values())
