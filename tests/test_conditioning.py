"""From an embedding to the class labels of an unCLIP UNet, against diffusers' own pipeline and closed forms."""

import pytest
import torch
from diffusers import AutoencoderKL, DDIMScheduler, DDPMScheduler, StableUnCLIPImg2ImgPipeline, UNet2DConditionModel
from diffusers.models.embeddings import get_timestep_embedding
from diffusers.pipelines.stable_diffusion.stable_unclip_image_normalizer import StableUnCLIPImageNormalizer

from unitouch_gen.conditioning import match_norm, noise_embeddings

D = 16


@pytest.fixture
def scheduler() -> DDPMScheduler:
    return DDPMScheduler(beta_schedule="squaredcos_cap_v2")


@pytest.fixture
def normalizer() -> StableUnCLIPImageNormalizer:
    torch.manual_seed(0)
    normalizer = StableUnCLIPImageNormalizer(embedding_dim=D).requires_grad_(False)
    normalizer.mean.normal_()
    normalizer.std.uniform_(0.5, 1.5)
    return normalizer


@pytest.fixture
def embeds() -> torch.Tensor:
    return torch.randn(5, D, generator=torch.Generator().manual_seed(1))


# Norm -----------------------------------------------------------------------------------------------------------------


def test_every_embedding_gets_the_norm_and_keeps_its_direction(embeds):
    unit = embeds / embeds.norm(dim=-1, keepdim=True)
    for scale in (1e-12, 1.0, 1e12):
        torch.testing.assert_close(match_norm(scale * embeds.view(5, 1, D), 20.0), 20.0 * unit.view(5, 1, D))


def test_the_zero_vector_stays_zero(embeds):
    embeds[2] = 0.0
    matched = match_norm(embeds, 20.0)
    assert not matched[2].any() and torch.isfinite(matched).all()


# Noising --------------------------------------------------------------------------------------------------------------


@pytest.fixture
def reference(normalizer, scheduler) -> StableUnCLIPImg2ImgPipeline:
    """diffusers' pipeline; of its components only the normaliser and the noising scheduler matter here."""
    unet = UNet2DConditionModel(
        sample_size=8, block_out_channels=(4,), layers_per_block=1, down_block_types=("DownBlock2D",),
        up_block_types=("UpBlock2D",), mid_block_type=None, norm_num_groups=2, cross_attention_dim=4,
    )  # fmt: skip
    vae = AutoencoderKL(block_out_channels=(4,), norm_num_groups=2)
    return StableUnCLIPImg2ImgPipeline(
        None, None, normalizer, scheduler, None, None, unet, DDIMScheduler(steps_offset=1), vae
    )


def test_noising_is_that_of_diffusers(reference, normalizer, scheduler, embeds):
    noise = torch.randn(5, D, generator=torch.Generator().manual_seed(2))
    for level in (0, 1, 250, 500, 999):
        expected = reference.noise_image_embeddings(embeds, noise_level=level, noise=noise)
        got = noise_embeddings(embeds, torch.full((5,), level), noise, normalizer, scheduler)
        torch.testing.assert_close(got, expected, atol=1e-6, rtol=0)


def test_levels_are_each_embeddings_own(normalizer, scheduler, embeds):
    noise, levels = torch.randn(5, D), torch.tensor([0, 10, 250, 500, 999])
    together = noise_embeddings(embeds, levels, noise, normalizer, scheduler)
    rows = [slice(i, i + 1) for i in range(5)]
    alone = [noise_embeddings(embeds[i], levels[i], noise[i], normalizer, scheduler) for i in rows]
    torch.testing.assert_close(together, torch.cat(alone))


@pytest.mark.parametrize(("level", "signal", "sigma"), [(50, 0.996, 0.091), (250, 0.920, 0.393), (500, 0.702, 0.713)])
def test_signal_and_noise_have_the_shares_of_the_schedule(scheduler, embeds, level, signal, sigma):
    """With a plain normaliser c = sqrt(abar) e + sqrt(1 - abar) n; the shares are those of SD 2.1 unCLIP."""
    plain = StableUnCLIPImageNormalizer(embedding_dim=D).requires_grad_(False)
    noise = torch.randn(5, D)
    got = noise_embeddings(embeds, torch.full((5,), level), noise, plain, scheduler)[:, :D]
    torch.testing.assert_close(got, signal * embeds + sigma * noise, atol=5e-3, rtol=0)


def test_the_mean_embedding_without_noise_stays_the_mean(normalizer, scheduler):
    mean = normalizer.mean.detach()
    got = noise_embeddings(mean, torch.tensor([700]), torch.zeros(1, D), normalizer, scheduler)
    torch.testing.assert_close(got[:, :D], mean)


def test_the_second_half_is_the_sinusoid_of_the_level(normalizer, scheduler, embeds):
    levels = torch.tensor([0, 10, 250, 500, 999])
    got = noise_embeddings(embeds, levels, torch.randn(5, D), normalizer, scheduler)
    torch.testing.assert_close(
        got[:, D:], get_timestep_embedding(levels, D, flip_sin_to_cos=True, downscale_freq_shift=0)
    )
    torch.testing.assert_close(got[:, D], levels.float().cos())  # the cosine of the highest frequency comes first


def test_labels_keep_the_dtype_of_the_embeddings_and_inputs_stay_as_they_were(normalizer, scheduler, embeds):
    for dtype in (torch.float16, torch.bfloat16, torch.float64, torch.float32):
        inputs = (embeds.to(dtype), torch.full((5,), 100), torch.randn(5, D, dtype=dtype), normalizer.mean)
        kept = [values.clone() for values in inputs]
        assert noise_embeddings(*inputs[:3], normalizer, scheduler).dtype == dtype
        assert all(torch.equal(one, other) for one, other in zip(inputs, kept, strict=True))
