"""Captions: they say the material, in words from one small vocabulary, and the colour word nearest to the albedo."""

import re

import numpy as np
import pytest
import torch

from unitouch_gen.world import MATERIALS, SHAPE_NAMES
from unitouch_gen.world.captions import COLOURS, SHAPES, TEMPLATES, captions, colour_name
from unitouch_gen.world.draws import draw

COUNT = 40
MATERIAL = torch.arange(len(MATERIALS)).repeat_interleave(COUNT)
DRAWS = draw(0, MATERIAL, torch.arange(COUNT).repeat(len(MATERIALS)), torch.zeros_like(MATERIAL))
CAPTIONS = captions(DRAWS)


def words(text: str) -> set[str]:
    return set(re.findall(r"[a-z]+", text.lower()))


def test_there_is_one_caption_for_each_contact() -> None:
    assert len(CAPTIONS) == len(DRAWS)


def test_every_caption_names_its_material() -> None:
    for material, caption in zip(MATERIAL.tolist(), CAPTIONS, strict=True):
        assert re.search(rf"\b{MATERIALS[material].name}\b", caption)


def test_captions_hold_known_words_only() -> None:
    known = words("fine medium coarse")
    known |= words(" ".join(re.sub(r"{\w+}", "", template) for template in TEMPLATES))
    known |= words(" ".join([*COLOURS, *SHAPES.values()]))
    for material in MATERIALS:
        known |= words(" ".join([material.name, *material.feel]))
    assert words(" ".join(CAPTIONS)) <= known


def test_every_template_is_used() -> None:
    shapes = "|".join(map(re.escape, SHAPES.values()))
    for template in TEMPLATES:
        pattern = re.sub(
            r"\\{(\w+)\\}", lambda gap: f"({shapes})" if gap[1] == "shape" else r"[a-z ]+", re.escape(template)
        )
        assert any(re.fullmatch(pattern, caption) for caption in CAPTIONS)


def test_a_shape_named_is_the_shape_drawn() -> None:
    for shape, caption in zip(DRAWS.shape.tolist(), CAPTIONS, strict=True):
        if ", " in caption and caption.rsplit(", ", 1)[1] in SHAPES.values():
            assert caption.endswith(SHAPES[SHAPE_NAMES[shape]])


def test_an_adjective_is_one_of_the_materials_own() -> None:
    for material, caption in zip(MATERIAL.tolist(), CAPTIONS, strict=True):
        if caption.startswith("touch of "):
            assert (
                caption.removeprefix("touch of ").removesuffix(f" {MATERIALS[material].name}")
                in MATERIALS[material].feel
            )


def test_captions_repeat() -> None:
    assert captions(DRAWS) == CAPTIONS


@pytest.mark.parametrize("name", COLOURS)
def test_a_colour_word_names_its_own_colour(name: str) -> None:
    assert colour_name(torch.tensor(COLOURS[name])) == name


def test_a_colour_word_is_the_nearest() -> None:
    table = np.array(list(COLOURS.values()))
    for rgb in torch.rand(50, 3, generator=torch.Generator().manual_seed(0)):
        nearest = np.linalg.norm(table - rgb.numpy(), axis=1).argmin()
        assert colour_name(rgb) == list(COLOURS)[nearest]
