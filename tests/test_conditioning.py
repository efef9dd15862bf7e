"""From an embedding to the class labels of an unCLIP UNet and to stored images, against diffusers and closed forms."""

from pathlib import Path

import pytest
import torch
from diffusers import DDPMScheduler
from diffusers.pipelines.stable_diffusion.stable_unclip_image_normalizer import StableUnCLIPImageNormalizer
from torch.nn.functional import normalize

from tests.helpers.calls import diffusers_pipeline, seeded
from tests.helpers.components import D, make_components
from unitouch_gen.conditioning import EmbeddingBank, bridge_nearest, match_norm, noise_embeddings

BANK = normalize(torch.randn(40, D, generator=seeded()), dim=1)
EMBEDS = 5.0 * torch.randn(5, D, generator=seeded(1))
NOISE = torch.randn(5, D, generator=seeded(2))


def test_every_embedding_gets_the_norm_and_keeps_its_direction_and_zero_stays_zero():
    unit = normalize(EMBEDS, dim=1)
    for scale in (1e-12, 1.0, 1e12, 0.0):
        expected = (20.0 if scale else 0.0) * unit.view(5, 1, D)
        torch.testing.assert_close(match_norm(scale * EMBEDS.view(5, 1, D), 20.0), expected)


def test_noising_each_at_its_own_level_is_that_of_diffusers():
    pipe = diffusers_pipeline(make_components())
    levels = torch.tensor([0, 1, 250, 500, 999])
    found = noise_embeddings(EMBEDS, levels, NOISE, pipe.image_normalizer, pipe.image_noising_scheduler)
    each = [pipe.noise_image_embeddings(EMBEDS, noise_level=level, noise=NOISE) for level in levels.tolist()]
    expected = torch.stack([labels[row] for row, labels in enumerate(each)])
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize(("level", "signal", "sigma"), [(50, 0.996, 0.091), (250, 0.920, 0.393), (500, 0.702, 0.713)])
def test_signal_and_noise_have_the_shares_of_the_schedule(level, signal, sigma):
    """With a plain normaliser c = sqrt(abar) e + sqrt(1 - abar) n; the shares are those of SD 2.1 unCLIP."""
    plain = StableUnCLIPImageNormalizer(embedding_dim=D).requires_grad_(False)
    scheduler = DDPMScheduler(beta_schedule="squaredcos_cap_v2")
    unit = EMBEDS / 5.0
    for dtype in (torch.float16, torch.bfloat16, torch.float64, torch.float32):
        inputs = (unit.to(dtype), torch.full((5,), level), NOISE.to(dtype), plain, scheduler)
        found = noise_embeddings(*inputs)
        assert found.dtype == dtype
    torch.testing.assert_close(found[:, :D], signal * unit + sigma * NOISE, atol=5e-3, rtol=0)


@pytest.mark.parametrize(
    ("neighbours", "temperature", "share"), [(10, 0.05, 0.5), (5, 0.1, 0.0), (1, 0.1, 1.0), (50, 0.1, 0.5)]
)
def test_the_bridge_is_the_formula_of_the_papers_release(neighbours, temperature, share):
    found = bridge_nearest(EMBEDS, BANK, neighbours=neighbours, temperature=temperature, share=share)
    for row, embed in zip(found, EMBEDS, strict=True):
        unit = embed / embed.norm()
        nearest = sorted(range(40), key=lambda n: -float(unit @ BANK[n]))[:neighbours]
        weights = torch.softmax(torch.stack([unit @ BANK[n] for n in nearest]) / temperature, dim=0)
        prototype = sum(w * BANK[n] for w, n in zip(weights, nearest, strict=True))
        moved = (1 - share) * unit + share * prototype / prototype.norm()
        torch.testing.assert_close(row, embed.norm() * moved / moved.norm())


def test_the_bridge_leaves_stored_embeddings_and_zero_where_they_are():
    for embeds in (3.0 * BANK, torch.zeros(2, D)):
        found = bridge_nearest(embeds, BANK, neighbours=10, temperature=1e-3, share=1.0)
        torch.testing.assert_close(found, embeds, atol=1e-4, rtol=0.0)


def test_a_bank_bridges_as_it_is_configured_and_as_it_was_saved(tmp_path: Path):
    held = EmbeddingBank.of(7.0 * BANK, neighbours=3, temperature=0.2, share=0.7)
    torch.testing.assert_close(held.bridge(EMBEDS), bridge_nearest(EMBEDS, BANK, 3, 0.2, 0.7))
    held.save_pretrained(tmp_path)
    assert torch.equal(EmbeddingBank.from_pretrained(tmp_path).bridge(EMBEDS), held.bridge(EMBEDS))


def test_an_upload_is_as_private_as_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    asked = {}

    def push(self, repo_id, private=None, token=None, commit_message=None):
        asked.update(repo_id=repo_id, private=private, token=token, commit_message=commit_message)

    monkeypatch.setattr(EmbeddingBank, "push_to_hub", push)
    EmbeddingBank.of(BANK).save_pretrained(tmp_path, push_to_hub=True, repo_id="me/bank", private=True, token="secret")
    assert asked == {"repo_id": "me/bank", "private": True, "token": "secret", "commit_message": None}
