"""Networks that keep their weights in float16 compute what they would after casting all of them up."""

import copy

import pytest
import torch
from diffusers import AutoencoderDC, UNet2DConditionModel
from torch import nn

from unitouch_gen.models.casting import compute_in


@pytest.fixture
def half() -> UNet2DConditionModel:
    torch.manual_seed(0)
    return UNet2DConditionModel(
        sample_size=8, in_channels=3, out_channels=3, block_out_channels=(8, 16), layers_per_block=1,
        down_block_types=("DownBlock2D", "CrossAttnDownBlock2D"), up_block_types=("CrossAttnUpBlock2D", "UpBlock2D"),
        cross_attention_dim=16, attention_head_dim=2, norm_num_groups=4, num_class_embeds=2,
    ).eval().half()  # fmt: skip


@pytest.fixture
def inputs() -> tuple[torch.Tensor, ...]:
    torch.manual_seed(1)
    return torch.randn(1, 3, 8, 8).repeat(2, 1, 1, 1), torch.tensor(500), torch.randn(2, 1, 16), torch.tensor([0, 0])


@torch.no_grad()
def test_the_numbers_are_those_of_all_weights_cast(half, inputs):
    state, timestep, hidden, labels = inputs
    expected = copy.deepcopy(half).float()(state, timestep, hidden, labels).sample
    assert torch.equal(compute_in(half)(state, timestep, hidden, labels).sample, expected)


@torch.no_grad()
def test_so_are_those_of_an_autoencoder():
    vae = AutoencoderDC(
        latent_channels=4, attention_head_dim=8, encoder_block_out_channels=(8, 16), decoder_block_out_channels=(8, 16),
        encoder_layers_per_block=(1, 1), decoder_layers_per_block=(1, 1), encoder_block_types="ResBlock",
        decoder_block_types="ResBlock", encoder_qkv_multiscales=((), ()), decoder_qkv_multiscales=((), ()),
        decoder_act_fns="silu", decoder_norm_types="rms_norm",
    ).eval().half()  # fmt: skip
    latents = torch.randn(1, 4, 4, 4)
    expected = copy.deepcopy(vae).float().decode(latents).sample
    assert torch.equal(compute_in(vae).decode(latents).sample, expected)


@torch.no_grad()
def test_weights_stay_small_and_where_they_are(half, inputs):
    layers = [layer for layer in half.modules() if type(layer) in (nn.Linear, nn.Conv2d)]
    places = [layer.weight.data_ptr() for layer in layers]
    state, timestep, hidden, labels = inputs
    compute_in(half)(state, timestep, hidden, labels)
    assert all(layer.weight.dtype == torch.float16 for layer in layers)
    assert [layer.weight.data_ptr() for layer in layers] == places


def test_the_network_says_what_it_computes_in(half):
    assert compute_in(half).dtype == torch.float32


def test_a_network_that_is_there_already_is_left_as_it_is(half):
    network = compute_in(half.float())
    assert not any(hasattr(layer, "_diffusers_hook") for layer in network.modules())


def test_twice_is_once(half, inputs):
    compute_in(compute_in(half))
    assert {len(layer._diffusers_hook.hooks) for layer in half.modules() if hasattr(layer, "_diffusers_hook")} == {1}
