"""The bridge between the modalities, against a plain transcription of its formula, limits and diffusers' own saving."""

from pathlib import Path

import pytest
import torch
from torch import Tensor

from unitouch_gen.conditioning import EmbeddingBank, bridge_nearest

N, D = 40, 8


@pytest.fixture
def embedding_bank() -> Tensor:
    return torch.nn.functional.normalize(torch.randn(N, D, generator=torch.Generator().manual_seed(0)), dim=1)


@pytest.fixture
def embeds() -> Tensor:
    return 5.0 * torch.randn(3, D, generator=torch.Generator().manual_seed(1))


def test_the_formula_of_the_papers_release(embeds: Tensor, embedding_bank: Tensor) -> None:
    found = bridge_nearest(embeds, embedding_bank, neighbours=10, temperature=0.05, share=0.5)
    for row, embed in zip(found, embeds, strict=True):
        unit = embed / embed.norm()
        nearest = sorted(range(N), key=lambda n: -float(unit @ embedding_bank[n]))[:10]
        weights = torch.softmax(20 * torch.stack([unit @ embedding_bank[n] for n in nearest]), dim=0)
        prototype = sum(w * embedding_bank[n] for w, n in zip(weights, nearest, strict=True))
        moved = 0.5 * unit + 0.5 * prototype / prototype.norm()
        torch.testing.assert_close(row, embed.norm() * moved / moved.norm())


def test_a_share_of_zero_changes_nothing(embeds: Tensor, embedding_bank: Tensor) -> None:
    torch.testing.assert_close(bridge_nearest(embeds, embedding_bank, neighbours=5, temperature=0.1, share=0.0), embeds)


def test_a_share_of_one_with_one_neighbour_is_the_neighbour(embeds: Tensor, embedding_bank: Tensor) -> None:
    found = bridge_nearest(embeds, embedding_bank, neighbours=1, temperature=0.1, share=1.0)
    nearest = embedding_bank[(embeds @ embedding_bank.T).argmax(dim=1)]
    torch.testing.assert_close(found / found.norm(dim=1, keepdim=True), nearest)


def test_what_is_in_the_bank_stays_where_it_is(embedding_bank: Tensor) -> None:
    found = bridge_nearest(3.0 * embedding_bank, embedding_bank, neighbours=10, temperature=1e-3, share=1.0)
    torch.testing.assert_close(found, 3.0 * embedding_bank, atol=1e-4, rtol=0.0)


def test_a_bank_smaller_than_the_neighbourhood_is_used_whole(embeds: Tensor, embedding_bank: Tensor) -> None:
    few = embedding_bank[:4]
    torch.testing.assert_close(
        bridge_nearest(embeds, few, neighbours=10, temperature=0.1, share=0.5),
        bridge_nearest(embeds, few, neighbours=4, temperature=0.1, share=0.5),
    )


def test_zero_stays_zero(embedding_bank: Tensor) -> None:
    assert not bridge_nearest(torch.zeros(2, D), embedding_bank, neighbours=5, temperature=0.1, share=0.5).any()


def test_a_bank_bridges_as_it_is_configured_and_as_it_was_saved(embeds, embedding_bank, tmp_path: Path) -> None:
    held = EmbeddingBank.of(7.0 * embedding_bank, neighbours=3, temperature=0.2, share=0.7)
    torch.testing.assert_close(held.bridge(embeds), bridge_nearest(embeds, embedding_bank, 3, 0.2, 0.7))
    held.save_pretrained(tmp_path)
    assert torch.equal(EmbeddingBank.from_pretrained(tmp_path).bridge(embeds), held.bridge(embeds))
