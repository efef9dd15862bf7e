"""A UNet without the work that a request does not need, against the same UNet with all of it."""

from pathlib import Path

import pytest
import torch
from diffusers import UNet2DConditionModel
from diffusers.models.attention_processor import AttnProcessor, AttnProcessor2_0, SlicedAttnProcessor
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

import unitouch_gen
from unitouch_gen.eliminate import Lean, eliminated
from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.numerics.problems import make_problem

SD_LIKE = {
    "sample_size": 8,
    "block_out_channels": (8, 16),
    "norm_num_groups": 4,
    "cross_attention_dim": 8,
    "attention_head_dim": 4,
    "layers_per_block": 1,
    "down_block_types": ("CrossAttnDownBlock2D", "DownBlock2D"),
    "up_block_types": ("UpBlock2D", "CrossAttnUpBlock2D"),
}
LATE = {  # the condition comes in later, as in the built-in family
    "down_block_types": ("DownBlock2D", "CrossAttnDownBlock2D"),
    "up_block_types": ("CrossAttnUpBlock2D", "UpBlock2D"),
}
SIMPLE = {  # Kandinsky's
    "down_block_types": ("ResnetDownsampleBlock2D", "SimpleCrossAttnDownBlock2D"),
    "up_block_types": ("SimpleCrossAttnUpBlock2D", "ResnetUpsampleBlock2D"),
    "mid_block_type": "UNetMidBlock2DSimpleCrossAttn",
}
VARIANTS = {
    "cross-attention first": {},
    "linear projection": {"use_linear_projection": True},
    "only cross-attention": {"only_cross_attention": True},
    "two blocks a transformer": {"transformer_layers_per_block": 2, "layers_per_block": 2},
    "cross-attention later": LATE,
    "cross-attention later, linear projection": {**LATE, "use_linear_projection": True},
    "cross-attention in the middle alone": {
        "down_block_types": ("DownBlock2D", "AttnDownBlock2D"),
        "up_block_types": ("AttnUpBlock2D", "UpBlock2D"),
    },
    "groups of the norm across the skip": {**LATE, "block_out_channels": (8, 20), "attention_head_dim": 2},
    "added keys and values": SIMPLE,
    "normed condition": {**SIMPLE, "cross_attention_dim": 16, "cross_attention_norm": "layer_norm"},
    "scale and shift by time": {**LATE, "resnet_time_scale_shift": "scale_shift"},
    "no middle": {"mid_block_type": None},
    "middle without attention to the condition": {"mid_block_type": "UNetMidBlock2D"},
    "projected condition": {"encoder_hid_dim": 6, "encoder_hid_dim_type": "text_proj"},
    "gated": {"attention_type": "gated"},
    "text in the time": {**LATE, "addition_embed_type": "text", "addition_embed_type_num_heads": 2},
    "labels": {**LATE, "num_class_embeds": 3},
    "labels that are times": {**LATE, "class_embed_type": "timestep"},
    "labels beside the time": {**LATE, "num_class_embeds": 3, "class_embeddings_concat": True},
    "frequencies drawn at random": {**LATE, "time_embedding_type": "fourier"},
}


class Loud(AttnProcessor2_0):
    """A processor of one's own."""

    def __call__(self, *inputs, **named) -> Tensor:
        return 2.0 * super().__call__(*inputs, **named)


SETTINGS = {
    "no scaled_dot_product_attention": lambda network: network.set_attn_processor(AttnProcessor()),
    "slices": lambda network: network.set_attn_processor(SlicedAttnProcessor(2)),
    "processors of one's own": lambda network: network.set_attn_processor(Loud()),
    "fused projections": UNet2DConditionModel.fuse_qkv_projections,
    "FreeU": lambda network: network.enable_freeu(s1=0.9, s2=0.2, b1=1.4, b2=1.6),
    "channels last": lambda network: network.to(memory_format=torch.channels_last),
}


def unet(**settings) -> UNet2DConditionModel:
    torch.manual_seed(0)
    network = UNet2DConditionModel(**{**SD_LIKE, **settings}).eval()
    for weight in network.parameters():
        if weight.ndim == 1:  # norms and biases are made as ones and zeros, which hide mistakes
            weight.data += 0.3 * torch.randn(weight.shape)
    return network


def built_in(name: str) -> UNet2DConditionModel:
    folder = Path(unitouch_gen.__file__).parent / "weights" / name / "unet"
    return UNet2DConditionModel.from_pretrained(folder, torch_dtype=torch.float32).eval()


def noise(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def guided(network: UNet2DConditionModel, samples: int, tokens: int) -> tuple[Tensor, Tensor, Tensor | None]:
    """Latents twice, a condition with zeros first, and labels: indices are the same in both halves."""
    config = network.config
    state = noise(samples, config.in_channels, config.sample_size, config.sample_size).repeat(2, 1, 1, 1)
    hidden = noise(samples, tokens, config.encoder_hid_dim or config.cross_attention_dim, seed=1)
    labels = None
    if config.class_embed_type == "projection":
        labels = noise(samples, config.projection_class_embeddings_input_dim, seed=2)
        labels = torch.cat([torch.zeros_like(labels), labels])
    elif network.class_embedding is not None:
        labels = torch.arange(samples).repeat(2)
    return state, torch.cat([torch.zeros_like(hidden), hidden]), labels


def distance(found: Tensor, expected: Tensor) -> float:
    return ((found - expected).norm() / expected.norm()).item()


def same(lean: Lean, network: UNet2DConditionModel, state, hidden, labels=None, timestep=500, **others) -> bool:
    """Whether a call gives what the whole network gives."""
    found = lean(state, timestep, hidden, labels, **others)
    return distance(found, network(state, timestep, hidden, class_labels=labels, **others).sample) < 1e-5


def flops(network: UNet2DConditionModel, state: Tensor, hidden: Tensor, labels: Tensor | None) -> int:
    with FlopCounterMode(display=False) as counter:
        network(state, 500, hidden, class_labels=labels)
    return counter.get_total_flops()


@pytest.fixture(scope="module")
def touch() -> UNet2DConditionModel:
    return built_in("x-to-touch")


@pytest.fixture
def small() -> UNet2DConditionModel:
    return unet(**LATE, num_class_embeds=3)


# Exact ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("samples", [1, 3])
@pytest.mark.parametrize(("name", "tokens"), [("x-to-touch", 1), ("touch-to-image", 77)])
@torch.no_grad()
def test_the_built_in_networks_predict_the_same(name, tokens, samples):
    network = built_in(name)
    state, hidden, labels = guided(network, samples, tokens)
    with eliminated(network, hidden, labels) as lean:
        assert all(same(lean, network, state, hidden, labels, timestep) for timestep in (900, 400))
        # Without guidance.
        assert same(lean, network, state[samples:], hidden[samples:], None if labels is None else labels[samples:])


@pytest.mark.parametrize("tokens", [1, 5])
@pytest.mark.parametrize("variant", VARIANTS)
@torch.no_grad()
def test_networks_of_other_shapes_predict_the_same(variant, tokens):
    network = unet(**VARIANTS[variant])
    state, hidden, labels = guided(network, 2, tokens)
    with eliminated(network, hidden, labels) as lean:
        assert all(same(lean, network, state, hidden, labels, timestep) for timestep in (900, 400))


@pytest.mark.parametrize("setting", SETTINGS)
@torch.no_grad()
def test_under_other_settings_networks_predict_the_same(small, setting):
    SETTINGS[setting](small)
    state, hidden, labels = guided(small, 2, 5)
    with eliminated(small, hidden, labels) as lean:
        assert all(same(lean, small, state, hidden, labels, timestep) for timestep in (900, 400))
        assert same(lean, small, state, hidden[:, :1], labels)


@torch.no_grad()
def test_in_half_precision_it_is_no_further_from_the_truth(touch):
    network = built_in("x-to-touch").bfloat16()
    state, hidden, labels = guided(touch, 1, 1)
    exact = touch(state, 500, hidden, class_labels=labels).sample
    rounded = network(state.bfloat16(), 500, hidden.bfloat16(), class_labels=labels).sample
    with eliminated(network, hidden.bfloat16(), labels) as lean:
        found = lean(state.bfloat16(), 500)
    assert found.dtype is torch.bfloat16
    assert distance(found.float(), exact) < 1.5 * distance(rounded.float(), exact) < 0.1


@torch.no_grad()
def test_nothing_is_kept_across_the_borders_of_autocast(small):
    state, hidden, labels = guided(small, 1, 5)
    with eliminated(small, hidden, labels) as lean:
        with torch.autocast("cpu", torch.bfloat16):
            lean(state, 500)
        assert same(lean, small, state, hidden, labels)


def test_in_inference_mode_it_predicts_the_same(small):
    with torch.inference_mode():
        state, hidden, labels = guided(small, 1, 1)
        with eliminated(small, hidden, labels) as lean:
            assert all(same(lean, small, state, hidden, labels) for _ in range(2))


# What changes within a request ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("tokens", [1, 5])
@torch.no_grad()
def test_conditions_passed_anew_count_from_then_on(small, tokens):
    state, hidden, labels = guided(small, 2, tokens)
    with eliminated(small, hidden, labels) as lean:
        assert same(lean, small, state, hidden, labels)
        assert same(lean, small, state, 2 * hidden, labels.flip(0))
        assert torch.equal(lean(state, 500), lean(state, 500, 2 * hidden, labels.flip(0)))


@torch.no_grad()
def test_conditions_changed_in_place_are_noticed(small):
    state, hidden, labels = guided(small, 2, 5)
    with eliminated(small, hidden, labels) as lean:
        lean(state, 500)
        hidden[3] *= 2
        labels[3] = 2
        found = lean(state, 500)
        assert distance(found, small(state, 500, hidden, class_labels=labels).sample) < 1e-5


@pytest.mark.parametrize("tokens", [1, 5])
@torch.no_grad()
def test_guidance_may_go_off_and_on(small, tokens):
    state, hidden, labels = guided(small, 2, tokens)
    with eliminated(small, hidden, labels) as lean:
        assert all(same(lean, small, state[-rows:], hidden[-rows:], labels[-rows:]) for rows in (4, 2, 2, 4))


@torch.no_grad()
def test_two_samples_are_not_taken_for_two_branches(small):
    state, hidden, labels = (tensor[2:] for tensor in guided(small, 2, 1))
    with eliminated(small, hidden, labels) as lean:
        assert same(lean, small, state, hidden, labels)
    assert not any("guidance branch" in line for line in lean.left_out)


@pytest.mark.parametrize(
    ("timestep", "labels"), [(500, [0, 2]), (torch.tensor([900, 100]), [1, 1]), (torch.tensor([900, 100]), [0, 2])]
)
@torch.no_grad()
def test_labels_and_times_may_differ_between_the_branches(small, timestep, labels):
    state, hidden, _ = guided(small, 1, 1)
    labels = torch.tensor(labels)
    with eliminated(small, hidden, labels) as lean:
        assert same(lean, small, state, hidden, labels, timestep)
    assert "one guidance branch in 3 layers that do not see the condition" in lean.left_out


@pytest.mark.parametrize("tokens", [1, 5])
@torch.no_grad()
def test_masks_and_what_a_control_network_adds_are_heeded(small, tokens):
    state, hidden, labels = guided(small, 1, tokens)
    mask = torch.tensor([[1, 1, 0, 0, 0], [1, 1, 1, 1, 0]])[:, :tokens]
    residuals = (noise(2, 8, 8, 8), noise(2, 8, 8, 8), noise(2, 8, 4, 4), noise(2, 16, 4, 4))
    control = {"down_block_additional_residuals": residuals, "mid_block_additional_residual": noise(2, 16, 4, 4)}
    with eliminated(small, hidden, labels) as lean:
        assert same(lean, small, state, hidden, labels, encoder_attention_mask=mask)
        assert same(lean, small, state, hidden, labels, **control)
    assert not lean.left_out


# What is left out -----------------------------------------------------------------------------------------------------


@torch.no_grad()
def test_of_attention_over_one_token_no_operation_is_left(small):
    """N pixels, C channels, a condition of width D: queries and output 4 N C^2, K and V 4 C D, attention 4 N C."""
    small.set_attn_processor(AttnProcessor())
    state, hidden, labels = (tensor[1:] for tensor in guided(small, 1, 1))
    N, C, D, layers = 4 * 4, 16, 8, 4
    saved = layers * (4 * N * C**2 + 4 * C * D + 4 * N * C) / flops(small, state, hidden, labels)
    with eliminated(small, hidden, labels) as lean:
        assert lean.share_left_out(state, 500) == pytest.approx(saved, rel=1e-6)


@torch.no_grad()
def test_of_a_prompt_keys_and_values_are_left_out(small):
    """4 T C D of T tokens."""
    state, hidden, labels = (tensor[1:] for tensor in guided(small, 1, 7))
    T, C, D, layers = 7, 16, 8, 4
    with eliminated(small, hidden, labels) as lean:
        share = lean.share_left_out(state, 500)
    assert share == pytest.approx(layers * 4 * T * C * D / flops(small, state, hidden, labels), rel=1e-6)


@torch.no_grad()
def test_with_guidance_the_built_in_network_is_spared_a_seventh(touch):
    state, hidden, labels = guided(touch, 1, 1)
    with eliminated(touch, hidden, labels) as lean:
        assert lean.share_left_out(state, 500) > 0.14
    with eliminated(touch, hidden, labels, halves_share_latents=False) as lean:
        assert 0.02 < lean.share_left_out(state, 500) < 0.04


@torch.no_grad()
def test_what_was_left_out_is_said_in_words(touch):
    state, hidden, labels = guided(touch, 1, 1)
    with eliminated(touch, hidden, labels) as lean:
        assert lean.left_out == []
        lean(state, 900)
        lean(state, 500)
    assert sorted(lean.left_out) == [
        "embedding of class labels after the first step",
        "embedding of the timestep for all rows but one",
        "norm, queries, keys and softmax of 7 cross-attentions over one token",
        "one guidance branch in 7 layers that do not see the condition",
        "one guidance branch of the skips in 6 convolutions",
    ]
    assert lean.left_alone == []


@pytest.mark.parametrize("setting", ["processors of one's own", "fused projections"])
@torch.no_grad()
def test_it_says_which_layers_are_left_alone(small, setting):
    SETTINGS[setting](small)
    state, hidden, labels = guided(small, 1, 1)
    with eliminated(small, hidden, labels) as lean:
        lean(state, 500)
    assert lean.left_alone == ["4 cross-attentions that are not plain ones"]
    assert not any("cross-attentions" in line for line in lean.left_out)


@pytest.mark.parametrize(
    ("settings", "layers"), [({"dual_cross_attention": True}, 8), ({"attention_type": "gated"}, 4)]
)
def test_transformers_that_do_more_are_left_alone(settings, layers):
    with eliminated(unet(**settings), noise(2, 77 + 257, 8)) as lean:
        assert lean.left_alone == [f"{layers} cross-attentions that are not plain ones"]


# Mistakes -------------------------------------------------------------------------------------------------------------


def test_another_network_is_called_as_it_is():
    problem = make_problem("mixture-3")
    network, state = problem.network(), problem.noise(2).repeat(2, 1, 1, 1)
    with eliminated(network, noise(4, 1, 8)) as lean:
        found = lean(state, torch.tensor(500), noise(4, 1, 8))
    assert torch.equal(found, network(state, torch.tensor(500)))
    assert lean.left_out == []


def test_a_condition_that_is_no_tensor_is_refused(small):
    with pytest.raises(InvalidTypeError, match="`encoder_hidden_states` is None"), eliminated(small, None):
        pass


@torch.no_grad()
def test_conditions_of_other_rows_are_refused(small):
    state, hidden, labels = guided(small, 1, 1)
    with eliminated(small, hidden, labels) as lean, pytest.raises(InvalidInputError, match="`state` has 1 rows"):
        lean(state[:1], 500)
