"""Between pixels and scaled latents, against diffusers' autoencoders themselves."""

import pytest
import torch
from diffusers import AutoencoderKL, AutoencoderTiny, VQModel

from unitouch_gen.models.autoencoders import Autoencoder, decode, encode, scale_factor

BLOCKS = {
    "down_block_types": ("DownEncoderBlock2D",) * 3,
    "up_block_types": ("UpDecoderBlock2D",) * 3,
    "block_out_channels": (8, 8, 8),
    "norm_num_groups": 4,
    "scaling_factor": 0.5,
}
MADE = {
    "kl": lambda: AutoencoderKL(**BLOCKS, latent_channels=3, shift_factor=0.25),
    "vq": lambda: VQModel(**BLOCKS, latent_channels=3, num_vq_embeddings=16),
    "tiny": lambda: AutoencoderTiny(
        latent_channels=4,
        encoder_block_out_channels=(8, 8, 8),
        decoder_block_out_channels=(8, 8, 8),
        num_encoder_blocks=(0, 1, 1),
        num_decoder_blocks=(1, 1, 0),
        scaling_factor=0.5,
    ),
}


@pytest.fixture(params=MADE)
def vae(request: pytest.FixtureRequest) -> Autoencoder:
    torch.manual_seed(0)
    return MADE[request.param]().eval()


@torch.no_grad()
def test_latents_are_shifted_and_scaled_and_decoding_undoes_it(vae: Autoencoder) -> None:
    pixels = 2 * torch.rand(9, 3, 32, 32) - 1
    given = vae.encode(pixels)
    latents = encode(vae, pixels)
    raw = given.latent_dist.mode() if isinstance(vae, AutoencoderKL) else next(iter(given.values()))
    torch.testing.assert_close(latents, 0.5 * (raw - (0.25 if isinstance(vae, AutoencoderKL) else 0.0)))
    assert latents.shape == (9, vae.config.latent_channels, 32 // scale_factor(vae), 32 // scale_factor(vae))
    torch.testing.assert_close(decode(vae, latents), vae.decode(raw).sample)
    assert decode(vae, latents).shape == pixels.shape
    assert decode(vae, latents).is_contiguous()
