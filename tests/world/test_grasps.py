"""Grasps: Coulomb's law, and what is seen and said of its outcome."""

import pytest
import torch

from unitouch_gen.evaluation.tables import GRASP_PROMPTS
from unitouch_gen.world import World
from unitouch_gen.world.draws import draw
from unitouch_gen.world.grasps import FRAME_MM, OUTCOMES, grasp_margin, outcome_captions, outcome_pictures, told_lifted

COUNT, SIZE = 34, 64
NAMES = torch.arange(COUNT) % 17, torch.arange(COUNT), torch.zeros(COUNT, dtype=torch.int64)
DRAWS = draw(0, *NAMES)


def test_a_grasp_holds_by_coulombs_law_and_two_of_three_do() -> None:
    friction, weight, depth, share = torch.tensor([[0.5, 1.0], [3.0, 3.0], [1.5, 1.5], [0.4, 0.4]])
    force = 3.0 * depth * share  # of either finger, newton
    assert torch.equal(grasp_margin(friction, weight, depth, share) > 1.0, friction * force > weight / 2)
    names = torch.arange(17).repeat_interleave(30), torch.arange(30).repeat(17), torch.zeros(510, dtype=torch.int64)
    assert 0.5 < (World(1000, image_size=32).render(*names, modalities=("grasp",)).grasp > 1.0).float().mean() < 0.75


def object_in(lifted: bool) -> torch.Tensor:
    """How much of the object each pixel shows, (N, S, S), by painting it in two colours."""
    outcomes = torch.full((COUNT,), lifted)
    light, dark = (
        outcome_pictures(0, DRAWS, torch.full((COUNT, 3, SIZE, SIZE), value), outcomes) for value in (0.9, 0.1)
    )
    return (light - dark).mean(dim=1) / 0.8


def test_what_is_lifted_is_above_what_is_dropped_and_as_wide_as_it_is_large() -> None:
    heights, rows = [], torch.arange(SIZE) + 0.5
    for seen in (object_in(True), object_in(False)):
        heights.append((seen.sum(dim=2) * rows).sum(dim=1) / seen.sum(dim=(1, 2)) / SIZE)
        torch.testing.assert_close(seen.amax(dim=1).sum(dim=1), SIZE * DRAWS.size / FRAME_MM, rtol=0.0, atol=2.0)
    assert (heights[0] + 0.1 < heights[1]).all()


def test_a_scene_shows_the_outcome_of_its_grasp_by_its_first_sensor() -> None:
    world = World(0, image_size=SIZE)
    scene = world.render(*NAMES, modalities=("image", "grasp", "outcome"), sensors=("digit", "gelsight"))
    alone = world.render(*NAMES, modalities=("outcome",), sensors=("digit",)).outcome
    lifted = scene.grasp > 1.0
    assert lifted.any() and not lifted.all()
    torch.testing.assert_close(scene.outcome.image, outcome_pictures(0, DRAWS, scene.image, lifted))
    assert torch.equal(alone.image, scene.outcome.image) and alone.text == scene.outcome.text
    assert [told_lifted(text) for text in alone.text] == lifted.tolist()


@pytest.mark.parametrize("lifted", [True, False])
def test_captions_say_what_came_of_it_in_other_sentences_than_the_prompts(lifted: bool) -> None:
    told = [outcome_captions(DRAWS, torch.full((COUNT,), lifted), variant) for variant in range(3)]
    for text in (text for variant in told for text in variant):
        assert text.endswith(OUTCOMES[lifted]) and told_lifted(text) == lifted
        assert not any(prompt in text for prompt in GRASP_PROMPTS.values())
    assert sum(a != b for a, b in zip(told[0], told[1], strict=True)) > COUNT / 2
