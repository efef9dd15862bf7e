"""Draws of objects and contacts: held apart by range and by scan, and described; soft things yield."""

import re

import pytest
import torch

from unitouch_gen.errors import InvalidTypeError
from unitouch_gen.evaluation.zero_shot import PROMPTS
from unitouch_gen.world import MATERIAL_NAMES, MATERIALS, MODALITIES, World
from unitouch_gen.world.captions import (
    BEGINNINGS,
    COLOURS,
    ROUGHNESS,
    colour_name,
    described,
    direction_word,
)
from unitouch_gen.world.drawn_sensors import draw_sensor
from unitouch_gen.world.draws import SHAPES, draw, split_of
from unitouch_gen.world.scene import _pressed
from unitouch_gen.world.surfaces import coloured_relief, pixel_axis, surfaces
from unitouch_gen.world.textures import Texture, TextureLibrary

SENSORS = draw_sensor(0, 2), draw_sensor(0, 9)


def scan(name: str, material: str) -> Texture:
    height = torch.randn(32, 32, generator=torch.Generator().manual_seed(len(name)))
    return Texture(name, material, torch.rand(3, 32, 32).half(), height.half(), {})


LIBRARY = TextureLibrary([scan(f"{kind}{n}", kind) for kind in ("wood", "metal", "brick", "rock") for n in range(4)])


def names(objects: range = range(24)) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    grid = torch.cartesian_prod(torch.arange(len(MATERIAL_NAMES)), torch.tensor(list(objects)))
    return grid[:, 0], grid[:, 1], torch.arange(len(grid)) % 3


@pytest.fixture(scope="module")
def gallery():
    world = World(0, textures=LIBRARY, image_size=32)
    return world.render(*names(range(4)), modalities=MODALITIES, sensors=SENSORS)


def test_all_of_a_scene_is_finite_and_in_range(gallery) -> None:
    for images in (gallery.image, *gallery.touch.values()):
        assert images.shape == (68, 3, 32, 32)
        assert torch.isfinite(images).all()
        assert images.min() >= 0.0
        assert images.max() <= 1.0
    for values in (*gallery.attributes.values(), gallery.audio, gallery.grasp.margin):
        assert torch.isfinite(values).all()
    assert len(gallery.text) == 68


@pytest.mark.parametrize("row", [0, 21, 44, 63])
def test_a_contact_alone_equals_the_same_contact_in_a_batch(gallery, row: int) -> None:
    world = World(0, textures=LIBRARY, image_size=32)
    name = (part[row : row + 1] for part in (gallery.material, gallery.object, gallery.contact))
    alone = world.render(*name, modalities=MODALITIES, sensors=SENSORS)
    torch.testing.assert_close(alone.image[0], gallery.image[row], rtol=0, atol=1e-4)
    for name in gallery.touch:
        torch.testing.assert_close(alone.touch[name][0], gallery.touch[name][row], rtol=0, atol=1e-3)
    torch.testing.assert_close(alone.audio[0], gallery.audio[row], rtol=0, atol=1e-5)
    assert alone.text == [gallery.text[row]]


def test_every_shape_occurs_and_most_are_faces() -> None:
    drawn = draw(0, *names(range(100)), LIBRARY)
    assert set(drawn.shape.tolist()) == set(range(len(SHAPES)))
    assert 0.75 < (drawn.shape == list(SHAPES).index("flat")).float().mean() < 0.85


RANGED = ("scale", "amplitude", "texture_side", "relief")


def test_objects_beyond_the_ranges_lie_outside_of_all_others() -> None:
    inside, outside = (draw(0, *names(objects)) for objects in (range(0, 120, 3), range(800, 840)))
    for number in RANGED:
        low, high = getattr(inside, number).min(), getattr(inside, number).max()
        assert not ((getattr(outside, number) > low) & (getattr(outside, number) < high)).any()


def test_objects_held_out_are_others_in_the_same_ranges() -> None:
    trained, heldout = (draw(0, *names(objects)) for objects in (range(60), range(600, 660)))
    for number in RANGED:
        first, second = getattr(trained, number), getattr(heldout, number)
        assert not torch.isin(second, first).any()
        spread = (first.log().max() - first.log().min()) / 100.0
        assert (first.log().aminmax().min - second.log().aminmax().min).abs() < spread
        assert (first.log().aminmax().max - second.log().aminmax().max).abs() < spread


def test_objects_of_a_split_have_scans_of_that_split() -> None:
    for objects in (range(60), range(500, 560), range(600, 660)):
        drawn = draw(0, *names(objects), LIBRARY)
        found = {LIBRARY.textures[number] for number in drawn.texture[drawn.texture >= 0].tolist()}
        assert found
        assert {LIBRARY.split_of(texture) for texture in found} == {split_of(objects.start)}
        for row in torch.nonzero(drawn.texture >= 0)[:, 0].tolist():
            assert LIBRARY.textures[int(drawn.texture[row])].material == MATERIAL_NAMES[int(drawn.material[row])]


def test_without_scans_there_are_none() -> None:
    assert not (draw(0, *names()).texture >= 0).any()


def test_a_soft_object_leaves_a_shallower_print_of_the_same_extent() -> None:
    world = World(0)
    drawn = world.draw(*(part[:2] for part in names()))
    drawn.indentation_depth[:], drawn.compliance[:] = 0.8, torch.tensor([0.0, 0.6])
    axis = torch.linspace(-16, 16, 128)
    ball = (-(axis[:, None] ** 2 + axis**2) / 16.0).expand(2, -1, -1)
    height, depth, compliance = _pressed(drawn, ball)
    prints = (height + depth[:, None, None]).clamp_min(0.0)
    assert torch.equal(prints[0] > 0, prints[1] > 0)
    torch.testing.assert_close(prints[1], 0.55 * prints[0])
    assert not compliance.any()  # the gel is not told once more


def test_a_body_is_nothing_beside_itself() -> None:
    drawn = draw(0, *names())
    built = surfaces(0, drawn, 128)
    balls = drawn.shape == list(SHAPES).index("ball")
    share = built.body[balls].mean(dim=(-2, -1))
    area = torch.pi * drawn.shape_radius[balls] ** 2 / 32.0**2
    whole = (drawn.shape_radius[balls] < 8.0) & (
        (drawn.shape_offset[balls].abs().amax(dim=1) + drawn.shape_radius[balls]) < 16.0
    )
    torch.testing.assert_close(share[whole], area[whole].clamp_max(1.0), rtol=0.05, atol=0.003)


# Captions -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("variant", [0, 1, 5])
def test_captions_name_the_material_or_how_it_feels_and_never_begin_as_the_prompts(variant: int) -> None:
    drawn = draw(0, *names(range(60)), LIBRARY)
    texts = described(drawn, LIBRARY, variant)
    rows = list(zip(drawn.material.tolist(), texts, strict=True))
    told = [MATERIAL_NAMES[index] in text for index, text in rows]
    assert 0.52 < sum(told) / len(told) < 0.68
    for (index, text), named, texture in zip(rows, told, drawn.texture.tolist(), strict=True):
        assert named or texture >= 0 or any(word in text for word in MATERIALS[index].feel)
    for prompt in PROMPTS.values():
        assert not any(text.startswith(prompt.format("")) for text in texts)
    assert len(set(texts)) > (0.6 if variant else 0.8) * len(texts)
    assert all(re.fullmatch(r"[a-z, ]+", text) for text in texts)
    assert {text.startswith(beginning) for text in texts for beginning in BEGINNINGS if beginning} == {True, False}


def test_captions_say_hard_of_what_is_hard_and_soft_of_what_is_soft() -> None:
    drawn = draw(0, *names(range(60)))
    ranges = {"hard": (0.0, 0.1), "firm": (0.1, 0.28), "yielding": (0.28, 0.5), "soft": (0.5, 1.0)}
    said = set()
    for variant in (0, 3):
        for text, compliance in zip(described(drawn, variant=variant), drawn.compliance.tolist(), strict=True):
            for word in ranges.keys() & set(re.split(r"[ ,]+", text)):
                said.add(word)
                assert ranges[word][0] <= compliance <= ranges[word][1]
    assert said == ranges.keys()


def test_roughness_is_that_of_the_reliefs() -> None:
    axis, rows = pixel_axis(128), torch.arange(32)
    for index, name in enumerate(MATERIAL_NAMES):
        drawn = draw(0, torch.full((32,), index), rows, torch.zeros(32, dtype=torch.int64))
        relief, _ = coloured_relief(0, drawn, index, rows, axis)
        deviation = (relief.flatten(1).std(dim=1) / drawn.amplitude).median()
        assert ROUGHNESS[name] == pytest.approx(deviation.item(), rel=0.2)


def test_textures_that_are_no_library_are_refused() -> None:
    with pytest.raises(InvalidTypeError, match="`textures` is 'scans'"):
        World(0, textures="scans")


@pytest.mark.parametrize(
    ("angle", "word"), [(0.05, "side to side"), (3.1, "side to side"), (1.5, "up and down"), (0.8, "down to the right"),
     (-0.8, "up to the right")]
)  # fmt: skip
def test_directions(angle: float, word: str) -> None:
    assert word in direction_word(angle)


@pytest.mark.parametrize("name", COLOURS)
def test_a_colour_word_names_its_own_colour(name: str) -> None:
    assert colour_name(torch.tensor(COLOURS[name])) == name


def test_a_colour_word_is_the_nearest() -> None:
    table = torch.tensor(list(COLOURS.values()))
    for rgb in torch.rand(50, 3, generator=torch.Generator().manual_seed(0)):
        assert colour_name(rgb) == list(COLOURS)[int((table - rgb).norm(dim=1).argmin())]
