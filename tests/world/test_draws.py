"""Draws of objects and contacts, held apart by range; captions that are true of them."""

import re

import pytest
import torch

from tests.helpers.chances import has_chance
from unitouch_gen.evaluation.zero_shot import PROMPTS
from unitouch_gen.world import MATERIAL_NAMES, MATERIALS
from unitouch_gen.world.captions import BEGINNINGS, COLOURS, HARDNESS_WORDS, colour_name, described, direction_word
from unitouch_gen.world.draws import Draws, draw


def drawn(objects: range) -> Draws:
    grid = torch.cartesian_prod(torch.arange(17), torch.tensor(list(objects)))
    return draw(0, grid[:, 0], grid[:, 1], torch.arange(len(grid)) % 3)


def test_contacts_of_one_object_differ_but_share_its_draws() -> None:
    made = draw(0, torch.tensor([5, 5]), torch.tensor([2, 2]), torch.tensor([0, 1]))
    for of_object in (made.scale, made.amplitude, made.weight, made.pitch, made.cell_seed, made.colour):
        assert torch.equal(of_object[0], of_object[1])
    assert not torch.equal(made.offset[0], made.offset[1])


@pytest.mark.parametrize("number", ["scale", "amplitude"])
def test_held_out_objects_are_in_the_ranges_and_those_beyond_outside_of_them(number: str) -> None:
    trained, held_out, beyond = (
        getattr(drawn(objects), number).log() for objects in (range(60), range(600, 660), range(800, 840))
    )
    low, high = trained.aminmax()
    assert not torch.isin(held_out, trained).any()
    near = {"rtol": 0, "atol": (high - low) / 99}
    torch.testing.assert_close(torch.stack(held_out.aminmax()), torch.stack((low, high)), **near)
    assert not ((beyond > low) & (beyond < high)).any()


@pytest.mark.parametrize("variant", [0, 1, 5])
def test_captions_name_the_material_or_how_it_feels_and_never_begin_as_the_prompts(variant: int) -> None:
    made = drawn(range(60))
    texts = described(made, variant)
    told = [MATERIAL_NAMES[index] in text for index, text in zip(made.material.tolist(), texts, strict=True)]
    assert has_chance(sum(told), len(told), 0.6)
    rows = zip(made.material.tolist(), texts, told, strict=True)
    assert all(named or any(word in text for word in MATERIALS[row].feel) for row, text, named in rows)
    assert not any(text.startswith(prompt.format("")) for prompt in PROMPTS.values() for text in texts)
    assert len(set(texts)) > (0.6 if variant else 0.8) * len(texts)
    assert all(re.fullmatch(r"[a-z, ]+", text) for text in texts)
    assert {text.startswith(beginning) for text in texts for beginning in BEGINNINGS if beginning} == {True, False}


def test_captions_say_hard_of_what_is_hard_and_soft_of_what_is_soft() -> None:
    made = drawn(range(60))
    bounds = [0.0, *HARDNESS_WORDS.values()]
    said = set()
    for text, compliance in zip(described(made), made.compliance.tolist(), strict=True):
        for place, word in enumerate(HARDNESS_WORDS):
            if word in re.split(r"[ ,]+", text):
                said.add(word)
                assert bounds[place] <= compliance <= bounds[place + 1]
    assert said == HARDNESS_WORDS.keys()


def test_words_of_directions_and_colours() -> None:
    for angle, word in (
        (0.05, "side to side"),
        (3.1, "side to side"),
        (1.5, "up and down"),
        (0.8, "down to the right"),
        (-0.8, "up to the right"),
    ):
        assert word in direction_word(angle)
    assert [colour_name(torch.tensor(rgb)) for rgb in COLOURS.values()] == [*COLOURS]
