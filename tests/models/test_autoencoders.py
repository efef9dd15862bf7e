"""Between pixels and scaled latents, against diffusers' autoencoders themselves."""

import pytest
import torch
from diffusers import AutoencoderDC, AutoencoderKL, AutoencoderTiny, VQModel
from torch import Tensor

from unitouch_gen.models.autoencoders import decode, encode, scale_factor

BLOCKS = {
    "down_block_types": ("DownEncoderBlock2D",) * 3,
    "up_block_types": ("UpDecoderBlock2D",) * 3,
    "block_out_channels": (8, 8, 8),
    "norm_num_groups": 4,
}


@pytest.fixture
def kl() -> AutoencoderKL:
    torch.manual_seed(0)
    return AutoencoderKL(**BLOCKS, latent_channels=3, scaling_factor=0.5, shift_factor=0.25).eval()


@pytest.fixture
def vq() -> VQModel:
    torch.manual_seed(0)
    return VQModel(**BLOCKS, latent_channels=3, num_vq_embeddings=16, scaling_factor=0.5).eval()


@pytest.fixture
def dc() -> AutoencoderDC:
    torch.manual_seed(0)
    return AutoencoderDC(
        latent_channels=4, encoder_block_types="ResBlock", decoder_block_types="ResBlock",
        encoder_block_out_channels=(8, 8, 8), decoder_block_out_channels=(8, 8, 8), encoder_layers_per_block=(1, 1, 1),
        decoder_layers_per_block=(1, 1, 1), encoder_qkv_multiscales=((),) * 3, decoder_qkv_multiscales=((),) * 3,
        scaling_factor=0.5,
    ).eval()  # fmt: skip


@pytest.fixture
def tiny() -> AutoencoderTiny:
    torch.manual_seed(0)
    blocks = dict.fromkeys(("encoder_block_out_channels", "decoder_block_out_channels"), (8, 8, 8))
    counts = {"num_encoder_blocks": (0, 1, 1), "num_decoder_blocks": (1, 1, 0)}
    return AutoencoderTiny(latent_channels=4, **blocks, **counts, scaling_factor=0.5).eval()


@pytest.fixture
def pixels() -> Tensor:
    return 2 * torch.rand(2, 3, 32, 32, generator=torch.Generator().manual_seed(1)) - 1


@pytest.mark.parametrize("name", ["kl", "tiny", "vq", "dc"])
@torch.no_grad()
def test_a_latent_has_as_many_sides_as_the_factor_says(name: str, pixels: Tensor, request: pytest.FixtureRequest):
    vae = request.getfixturevalue(name)
    latents = encode(vae, pixels)
    assert latents.shape == (2, vae.config.latent_channels, 32 // scale_factor(vae), 32 // scale_factor(vae))
    assert decode(vae, latents).shape == pixels.shape


@torch.no_grad()
def test_a_kl_models_latents_are_its_mode_shifted_and_scaled(kl: AutoencoderKL, pixels: Tensor) -> None:
    torch.testing.assert_close(encode(kl, pixels), 0.5 * (kl.encode(pixels).latent_dist.mean - 0.25))


@pytest.mark.parametrize("name", ["kl", "tiny", "vq", "dc"])
@torch.no_grad()
def test_decoding_undoes_the_scale(name: str, pixels: Tensor, request: pytest.FixtureRequest) -> None:
    vae = request.getfixturevalue(name)
    raw = {"kl": lambda: vae.encode(pixels).latent_dist.mode(), "vq": lambda: vae.encode(pixels).latents,
           "tiny": lambda: vae.encode(pixels).latents, "dc": lambda: vae.encode(pixels).latent}[name]()  # fmt: skip
    torch.testing.assert_close(decode(vae, encode(vae, pixels)), vae.decode(raw).sample)


@torch.no_grad()
def test_pixels_are_float32_whatever_the_dtype_of_the_network(kl: AutoencoderKL, pixels: Tensor) -> None:
    kl.to(torch.bfloat16)
    latents = encode(kl, pixels)
    assert latents.dtype is torch.bfloat16 and decode(kl, latents).dtype is torch.float32
