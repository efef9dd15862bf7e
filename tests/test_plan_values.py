"""The plan of a request: what it leaves out, in words, and where guidance has one branch or two."""

import pytest
import torch

from unitouch_gen.plan import Plan, guidance_of

ALL = ("image", "text", "audio", "touch")


def test_what_is_not_needed_is_left_out_in_words():
    plan = Plan(modalities=("text",), known_modalities=ALL, embedding_bank=False, guidance=None, vae=False)
    assert plan.left_out == [
        "image encoder", "audio encoder", "touch encoder", "bank of image embeddings", "unconditional branch", "VAE",
    ]  # fmt: skip


def test_a_part_that_the_pipeline_has_not_is_not_left_out():
    assert Plan(modalities=ALL, known_modalities=ALL).left_out == []


def test_components_follow_from_the_parts():
    plan = Plan(modalities=(), known_modalities=("touch",), text_encoder=True, vae=False)
    assert plan.components == {
        "unitouch": False, "processor": False, "tokenizer": True, "text_encoder": True, "vae": False,
    }  # fmt: skip


def test_a_plan_needs_more_than_another_where_that_left_something_out():
    small, large = (
        Plan(modalities=modalities, known_modalities=ALL, embedding_bank=True)
        for modalities in (("text",), ("text", "touch"))
    )
    assert large.beyond(small) == ["touch encoder"]
    assert small.beyond(large) == []


def test_guidance_needs_no_weights():
    off, on = (Plan(modalities=("text",), known_modalities=ALL, guidance=guidance) for guidance in (None, (0.0, 1.0)))
    assert on.beyond(off) == []


@pytest.mark.parametrize(
    ("scale", "interval", "expected"),
    [
        (None, None, (0.0, 1.0)),
        (4.0, None, (0.0, 1.0)),
        (4.0, (0.2, 0.8), (0.2, 0.8)),
        (1.0, (0.2, 0.8), None),
        (0, None, None),
        ("four", "wide", (0.0, 1.0)),
    ],
)
def test_guidance_is_on_above_one_and_within_its_interval(scale, interval, expected):
    assert guidance_of(scale, interval) == expected


def test_branches_are_two_within_the_interval_with_its_ends():
    plan = Plan(modalities=(), known_modalities=ALL, guidance=(0.2, 0.5))
    timesteps = torch.tensor([999.0, 500.0, 499.5, 300.0, 199.8, 100.0], dtype=torch.float64)
    assert plan.branches(timesteps, 999) == [1, 1, 2, 2, 2, 1]
    assert Plan(modalities=(), known_modalities=ALL, guidance=None).branches(timesteps, 999) == [1] * 6
