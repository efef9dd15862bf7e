"""Tables of small encoders, on features whose answers are known by construction."""

import pytest
import torch

from unitouch_gen.evaluation.ablation import ALL, BOTH, CLAIMS, ONE, SAMPLING, TOKENS, ablation_table, sigma_table
from unitouch_gen.evaluation.contacts import Contacts, EvaluationSet

NAMES = ("brick", "grass", "leather", "wood")
KNOWING = {ONE: 0.6, ALL: 0.2, TOKENS: 0.5, SAMPLING: 0.5, BOTH: 1.0}
"""Shares of contacts whose material an encoder knows."""


def embed(texts):
    return torch.stack([torch.eye(8)[next(i for i, name in enumerate(NAMES) if name in text)] for text in texts])


def set_of(name: str, known: bool, seed: int, knowing: dict[str, float]) -> EvaluationSet:
    """Sixty touches of fifteen objects; pictures say the material, and so do shares of the touches."""
    generator = torch.Generator().manual_seed(seed)
    objects = torch.arange(60) // 4
    material = objects % 4
    corner = torch.eye(8)[material]
    noise = 0.01 * torch.randn(60, 8, generator=generator)
    wrong = torch.eye(8)[(material + 1) % 4]
    features = {
        row: torch.where((torch.arange(60) < share * 60)[:, None], corner, wrong) + noise
        for row, share in knowing.items()
    }
    contacts = Contacts({**features, "image": corner + noise}, {"material": material}, objects)
    return EvaluationSet(name, known, {"material": NAMES}, {"test": contacts}, seed)


def sets(knowing: dict[str, float]) -> list[EvaluationSet]:
    return [
        set_of(name, known, seed, knowing)
        for seed in (0, 1)
        for name, known in (("gelsight", True), ("digit", True), ("sensors drawn anew", False))
    ]


def test_each_row_is_what_its_encoder_knows() -> None:
    table = ablation_table(sets(KNOWING), list(KNOWING), embed, steps=7)
    for row, share in KNOWING.items():
        for where in ("gelsight", "all known sensors", "sensors drawn anew"):
            assert table.rows[row][f"material, {where}"] == pytest.approx([100.0 * share] * 2)
    assert table.rows["chance"]["material, gelsight"] == [25.0, 25.0]
    assert table.rows["chance"]["picture found, gelsight"][0] < table.rows[BOTH]["picture found, gelsight"][0]
    assert "7 steps" in table.notes[0] and table.paper[BOTH] == {"Touch and Go": 52.7}


def test_claims_of_the_paper_hold_or_do_not() -> None:
    notes = dict(zip(CLAIMS, ablation_table(sets(KNOWING), list(KNOWING), embed, steps=7).notes[1:], strict=True))
    assert all("holds in every seed" in note and "does not" not in note for note in notes.values())
    flat = ablation_table(sets({**KNOWING, TOKENS: 0.1}), list(KNOWING), embed, steps=7)
    [tokens] = [note for note in flat.notes if note.startswith("Sensor tokens help")]
    assert "does not hold in every seed for material, gelsight 10.0 against 20.0" in tokens and "holds" not in tokens


def test_the_best_sigma_is_named_with_the_spread() -> None:
    knowing = {"sigma = 0": 0.2, "sigma = 0.75": 0.8, "sigma = 1": 0.6}
    notes = sigma_table(sets(knowing), list(knowing), embed, steps=7).notes
    [best] = [note for note in notes if note.startswith("material, gelsight")]
    assert "sigma = 0.75 is best here, 80.0 against 20.0 at worst, beyond the spread" in best
