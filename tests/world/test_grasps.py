"""Outcomes of grasps: where the object is, how large, in whose skin, and what is said of it."""

import pytest
import torch
from torch import Tensor

from unitouch_gen.evaluation.classification import GRASP_PROMPTS
from unitouch_gen.world import World
from unitouch_gen.world.draws import Draws
from unitouch_gen.world.grasps import FRAME_MM, OUTCOMES, outcome_captions, outcome_pictures, told_lifted

COUNT, SIZE = 34, 64
NAMES = torch.arange(COUNT) % 17, torch.arange(COUNT), torch.zeros(COUNT, dtype=torch.int64)


@pytest.fixture(scope="module")
def draws() -> Draws:
    return World(0).draw(*NAMES)


def object_in(draws: Draws, held: bool) -> Tensor:
    """How much of the object each pixel shows, (N, S, S), by painting it in two colours."""
    outcomes = torch.full((COUNT,), held)
    light, dark = (
        outcome_pictures(0, draws, torch.full((COUNT, 3, SIZE, SIZE), value), outcomes) for value in (0.9, 0.1)
    )
    return (light - dark).mean(dim=1) / 0.8


def height_of(seen: Tensor) -> Tensor:
    rows = torch.arange(SIZE) + 0.5
    return (seen.sum(dim=2) * rows).sum(dim=1) / seen.sum(dim=(1, 2)) / SIZE


def test_what_is_lifted_is_above_what_is_dropped(draws: Draws) -> None:
    assert (height_of(object_in(draws, True)) + 0.1 < height_of(object_in(draws, False))).all()


@pytest.mark.parametrize("held", [True, False])
def test_objects_are_as_wide_as_they_are_large(draws: Draws, held: bool) -> None:
    width = object_in(draws, held).amax(dim=1).sum(dim=1)
    torch.testing.assert_close(width, SIZE * draws.size.float() / FRAME_MM, rtol=0.0, atol=2.0)


def test_outcomes_differ_by_nothing_but_what_came_of_them(draws: Draws) -> None:
    skins = torch.rand(COUNT, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(0))
    held = torch.arange(COUNT) % 2 == 0
    mixed, lifted = (outcome_pictures(0, draws, skins, outcomes) for outcomes in (held, torch.ones_like(held)))
    assert torch.equal(mixed[held], lifted[held])
    assert (mixed[~held] - lifted[~held]).abs().amax(dim=(1, 2, 3)).min() > 0.2
    assert mixed.min() >= 0.0 and mixed.max() <= 1.0


def test_captions_say_what_came_of_it_in_other_sentences_than_the_prompts(draws: Draws) -> None:
    held = torch.arange(COUNT) % 3 > 0
    for variant in range(4):
        for lifted, text in zip(held.tolist(), outcome_captions(draws, held, variant=variant), strict=True):
            assert text.endswith(OUTCOMES[lifted]) and told_lifted(text) == lifted
            assert not any(prompt in text for prompt in GRASP_PROMPTS.values())


def test_variants_of_captions_differ(draws: Draws) -> None:
    one, other = (outcome_captions(draws, torch.ones(COUNT, dtype=torch.bool), variant=number) for number in (0, 1))
    assert sum(a != b for a, b in zip(one, other, strict=True)) > COUNT / 2


def test_a_scene_shows_the_outcome_of_its_grasp() -> None:
    world = World(0, image_size=SIZE)
    scene = world.render(*NAMES, modalities=("image", "grasp", "outcome"), sensors=("digit",))
    alone = world.render(*NAMES, modalities=("outcome",), sensors=("digit",)).outcome
    held = scene.grasp.held
    assert held.any() and not held.all()
    torch.testing.assert_close(scene.outcome.image, outcome_pictures(0, world.draw(*NAMES), scene.image, held))
    assert torch.equal(alone.image, scene.outcome.image) and alone.text == scene.outcome.text
