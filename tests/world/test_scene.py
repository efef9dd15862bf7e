"""Scenes: deterministic, finite, only what was asked for; grasps, captions, styles and requests that are refused."""

import math
import re
from collections.abc import Callable
from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from torch import Tensor

from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.world import (
    ATTRIBUTES,
    MATERIAL_NAMES,
    MATERIALS,
    MODALITIES,
    SENSORS,
    SHAPE_NAMES,
    Scene,
    Style,
    World,
    scene,
)
from unitouch_gen.world.draws import draw
from unitouch_gen.world.scene import COLOURS, DEEPEST, SHAPES, TEMPLATES, captions, colour_name, grasp
from unitouch_gen.world.surfaces import macro_shape, surfaces

TOUCH_AND_GO = (
    "concrete", "plastic", "glass", "wood", "metal", "brick", "tile", "leather", "synthetic fabric", "natural fabric",
    "rubber", "paper", "tree", "grass", "soil", "rock", "gravel", "sand", "plants", "others",
)  # fmt: skip
EVERY = {"modalities": MODALITIES, "sensors": tuple(SENSORS)}


def names_of_every_material_and_shape() -> tuple[Tensor, Tensor, Tensor]:
    """A contact of each of the materials on each of the five shapes, found by their draws."""
    candidates = 60
    material = torch.arange(len(MATERIALS)).repeat_interleave(candidates)
    contact = torch.arange(candidates).repeat(len(MATERIALS))
    shape = draw(0, material, torch.zeros_like(material), contact).shape.view(len(MATERIALS), candidates)
    chosen = torch.stack([(shape == kind).int().argmax(dim=1) for kind in range(len(SHAPE_NAMES))], dim=1).flatten()
    return torch.arange(len(MATERIALS)).repeat_interleave(len(SHAPE_NAMES)), torch.zeros_like(chosen), chosen


@pytest.fixture(scope="module")
def gallery() -> Scene:
    return World(0).render(*names_of_every_material_and_shape(), **EVERY)


def same(left: Scene, right: Scene) -> bool:
    assert left.grasp is not None
    assert right.grasp is not None
    return (
        torch.equal(left.image, right.image)
        and all(torch.equal(left.touch[name], right.touch[name]) for name in SENSORS)
        and torch.equal(left.audio, right.audio)
        and left.text == right.text
        and torch.equal(left.grasp.margin, right.grasp.margin)
    )


def never(*args: object, **kwargs: object) -> None:
    raise AssertionError("this was not asked for")


# Materials and ranges ---------------------------------------------------------------------------------------------


def test_distinct_materials_are_named_as_in_touch_and_go() -> None:
    assert len(set(MATERIAL_NAMES)) == len(MATERIAL_NAMES) == 17
    assert set(MATERIAL_NAMES) <= set(TOUCH_AND_GO)


def test_the_gallery_holds_every_material_on_every_shape(gallery: Scene) -> None:
    drawn = draw(0, gallery.material, gallery.object, gallery.contact)
    assert len(set(zip(drawn.material.tolist(), drawn.shape.tolist(), strict=True))) == len(MATERIALS) * len(
        SHAPE_NAMES
    )


def test_every_picture_is_finite_and_in_range(gallery: Scene) -> None:
    assert gallery.image.shape == (85, 3, 64, 64)
    assert torch.isfinite(gallery.image).all()
    assert gallery.image.min() >= 0.0
    assert gallery.image.max() <= 1.0


@pytest.mark.parametrize("sensor", SENSORS)
def test_every_touch_image_is_finite_and_in_range(gallery: Scene, sensor: str) -> None:
    images = gallery.touch[sensor]
    assert images.shape == (85, 3, 64, 64)
    assert torch.isfinite(images).all()
    assert images.min() >= 0.0
    assert images.max() <= 1.0


def test_no_picture_or_touch_image_is_blank(gallery: Scene) -> None:
    for images in (gallery.image, *gallery.touch.values()):
        assert images.flatten(1).std(dim=1).min() > 0.01


def test_surfaces_are_finite_with_albedo_and_body_in_range() -> None:
    built = surfaces(0, draw(0, *names_of_every_material_and_shape()), 128)
    assert torch.isfinite(built.height).all()
    assert built.albedo.min() >= 0.0
    assert built.albedo.max() <= 1.0
    assert built.body.min() >= 0.0
    assert built.body.max() <= 1.0


def test_macro_shapes_are_the_named_solids() -> None:
    drawn = draw(0, *(torch.zeros(5, dtype=torch.int64),) * 3)
    upright = {"shape_angle": torch.zeros(5), "shape_offset": torch.zeros(5, 2), "shape_radius": torch.full((5,), 20.0)}
    drawn = replace(drawn, shape=torch.arange(5), **upright)
    height, body = macro_shape(drawn, 128)
    axis = (torch.arange(128) + 0.5) * 0.25 - 16.0
    x, y = axis[None, :].expand(128, -1), axis[:, None].expand(-1, 128)
    flat, edge, corner, bump, cylinder = height
    assert torch.equal(flat, torch.zeros_like(flat))
    assert body[0].min() == 1.0
    assert edge[x < 2.0].max() == 0.0
    assert edge[x > 3.0].max() == -4.0
    assert corner[(x < 2.0) & (y < 2.0)].min() == 0.0
    assert corner[(x > 3.0) | (y > 3.0)].max() == -4.0
    near = x**2 + y**2 < 10.0**2
    torch.testing.assert_close(bump[near], (20.0**2 - x**2 - y**2)[near].sqrt() - 20.0, rtol=0, atol=1e-4)
    torch.testing.assert_close(cylinder, ((20.0**2 - x**2).sqrt() - 20.0).clamp_min(-8.0), rtol=0, atol=1e-4)


# Determinism ------------------------------------------------------------------------------------------------------


def test_the_same_seed_renders_the_same_scene() -> None:
    names = ([0, 8, 15], [3, 1, 2], [0, 5, 1])
    assert same(World(7).render(*names, **EVERY), World(7).render(*names, **EVERY))


def test_another_seed_has_other_objects() -> None:
    names = ([0, 8], [3, 1], [0, 5])
    assert not same(World(0).render(*names, **EVERY), World(1).render(*names, **EVERY))


def test_contacts_of_one_object_differ_but_share_its_draws() -> None:
    drawn = draw(0, torch.tensor([5, 5]), torch.tensor([2, 2]), torch.tensor([0, 1]))
    for of_object in (drawn.scale, drawn.amplitude, drawn.weight, drawn.pitch, drawn.cell_seed, drawn.colour):
        assert torch.equal(of_object[0], of_object[1])
    assert not torch.equal(drawn.offset[0], drawn.offset[1])


@pytest.mark.parametrize("row", [0, 7, 33, 52, 79])
def test_a_contact_alone_equals_the_same_contact_in_a_batch(gallery: Scene, row: int) -> None:
    alone = World(0).render(
        gallery.material[row : row + 1], gallery.object[row : row + 1], gallery.contact[row : row + 1], **EVERY
    )
    torch.testing.assert_close(alone.image[0], gallery.image[row], rtol=0, atol=1e-5)
    for name in SENSORS:
        torch.testing.assert_close(alone.touch[name][0], gallery.touch[name][row], rtol=0, atol=1e-4)
    torch.testing.assert_close(alone.audio[0], gallery.audio[row], rtol=0, atol=1e-5)
    assert alone.text == [gallery.text[row]]
    torch.testing.assert_close(alone.grasp.margin[0], gallery.grasp.margin[row])


def test_a_sensor_alone_equals_the_same_sensor_among_others(gallery: Scene) -> None:
    names = gallery.material[:4], gallery.object[:4], gallery.contact[:4]
    alone = World(0).render(*names, modalities=("touch",), sensors=("gelslim",))
    torch.testing.assert_close(alone.touch["gelslim"], gallery.touch["gelslim"][:4], rtol=0, atol=1e-4)


def test_refining_the_surface_changes_pictures_and_touches_only_a_little(gallery: Scene) -> None:
    names = gallery.material, gallery.object, gallery.contact
    fine = World(0, resolution=256).render(*names, modalities=("image", "touch"), sensors=("gelsight", "gelslim"))
    assert (fine.image - gallery.image).abs().mean(dim=(1, 2, 3)).max() < 0.015
    for name in ("gelsight", "gelslim"):
        assert (fine.touch[name] - gallery.touch[name]).abs().mean(dim=(1, 2, 3)).max() < 0.015


# Only what is asked for -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("modality", MODALITIES)
def test_only_the_modality_asked_for_is_in_the_scene(modality: str) -> None:
    made = World(0).render([1], [1], [1], modalities=(modality,))
    empty = {
        field.name for field in fields(Scene) if getattr(made, field.name) is None or getattr(made, field.name) == {}
    }
    assert empty == set(MODALITIES) - {modality}


def test_only_the_sensors_asked_for_are_in_the_scene() -> None:
    made = World(0).render([1], [1], [1], modalities=("touch",), sensors=("digit", "tacto"))
    assert set(made.touch) == {"digit", "tacto"}


@pytest.mark.parametrize(
    ("modalities", "unused"),
    [
        (("text",), ("surfaces", "pictures", "pressed_gel", "impact_sounds")),
        (("audio",), ("surfaces", "pictures", "pressed_gel", "captions")),
        (("image",), ("pressed_gel", "contact_share", "impact_sounds", "captions")),
        (("touch",), ("pictures", "contact_share", "impact_sounds", "captions")),
        (("grasp",), ("pictures", "pressed_gel", "impact_sounds", "captions")),
        (("depth",), ("pictures", "images_of_gel", "contact_share", "impact_sounds", "captions")),
    ],
)
def test_what_is_not_asked_for_is_not_computed(modalities, unused, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in unused:
        monkeypatch.setattr(scene, name, never)
    World(0).render([2], [0], [0], modalities=modalities)


def test_a_gel_that_spreads_nothing_is_as_deep_as_what_presses_it() -> None:
    still = replace(SENSORS["taxim"], correlation=0.0, blur=0.0, relaxation=0.0, thickness=1e6)
    names = [[0], [3], [1]]
    world = World(0, image_size=128, resolution=128)
    made = world.render(*names, modalities=("depth", "attributes"), sensors=(still,))
    deepest = ATTRIBUTES.index("depth")
    assert made.depth["taxim"].shape == (1, 128, 128)
    expected = made.attributes["taxim"][0, deepest].item()
    assert math.log(made.depth["taxim"].max().item() + 0.02) == pytest.approx(expected, abs=1e-3)


def test_a_grasp_takes_the_first_sensor_only(gallery: Scene) -> None:
    names = gallery.material, gallery.object, gallery.contact
    several = World(0).render(*names, modalities=("grasp",), sensors=("digit", "taxim", "gelslim")).grasp
    alone = World(0).render(*names, modalities=("grasp",), sensors=("digit",)).grasp
    assert torch.equal(several.contact, alone.contact)
    assert not torch.equal(alone.contact, gallery.grasp.contact)  # the gallery's first sensor is another


def test_a_grasp_alone_equals_the_same_grasp_among_other_modalities(gallery: Scene) -> None:
    alone = World(0).render(gallery.material, gallery.object, gallery.contact, modalities=("grasp",)).grasp
    assert torch.equal(alone.contact, gallery.grasp.contact)
    assert torch.equal(alone.margin, gallery.grasp.margin)


# Style and grasp --------------------------------------------------------------------------------------------------


def test_a_white_balance_darkens_its_channel_of_the_pictures_only() -> None:
    names = ([0, 3, 9], [0, 0, 0], [0, 0, 0])
    plain = World(0).render(*names)
    tinted = World(0).render(*names, style=Style(white=(1.0, 1.0, 0.5)))
    assert torch.equal(tinted.image[:, :2], plain.image[:, :2])
    assert (tinted.image[:, 2] < plain.image[:, 2]).float().mean() > 0.99
    assert torch.equal(tinted.touch["gelsight"], plain.touch["gelsight"])


def test_a_cast_tints_the_touch_images_only() -> None:
    names = ([0, 3, 9], [0, 0, 0], [0, 0, 0])
    plain = World(0).render(*names)
    tinted = World(0).render(*names, style=Style(cast=(0.5, 1.0, 1.0)))
    assert torch.equal(tinted.touch["gelsight"][:, 1:], plain.touch["gelsight"][:, 1:])
    assert (tinted.touch["gelsight"][:, 0].mean() < 0.6 * plain.touch["gelsight"][:, 0].mean()).all()
    assert torch.equal(tinted.image, plain.image)


def test_markers_show_on_a_gel_that_has_none() -> None:
    plain = World(0).render([2], [0], [0], modalities=("touch",))
    marked = World(0).render([2], [0], [0], modalities=("touch",), style=Style(markers=True))
    assert (marked.touch["gelsight"] < plain.touch["gelsight"] - 0.1).float().mean() > 0.01


def test_the_grasp_margin_grows_with_the_indentation_depth(gallery: Scene) -> None:
    names = gallery.material[::5], gallery.object[::5], gallery.contact[::5]
    margins = torch.stack(
        [
            World(0).render(*names, modalities=("grasp",), style=Style(indentation_depth=depth)).grasp.margin
            for depth in (0.4, 0.8, 1.2, 2.0)
        ]
    )
    assert (margins.diff(dim=0) > 0).all()


def test_the_grasp_margin_is_linear_in_the_friction() -> None:
    friction = torch.tensor([0.0, 0.2, 0.4, 0.8])
    margin = grasp(friction, *torch.tensor([[3.0], [1.1], [0.6]])).margin
    torch.testing.assert_close(margin, margin[3] * friction / 0.8)


def test_the_grasp_margin_falls_as_the_weight_grows() -> None:
    weight = torch.tensor([0.5, 1.0, 3.0, 12.0])
    margin = grasp(torch.tensor([0.7]), weight, *torch.tensor([[1.1], [0.6]])).margin
    torch.testing.assert_close(margin * weight, margin[1].expand(4))


def test_every_contact_follows_the_same_law_of_friction(gallery: Scene) -> None:
    drawn = draw(0, gallery.material, gallery.object, gallery.contact)
    friction = torch.tensor([MATERIALS[index].friction for index in gallery.material.tolist()])
    touching = gallery.grasp.contact > 0
    force = gallery.grasp.margin * drawn.weight / friction  # what two fingers press with
    stiffness = (force / (drawn.indentation_depth * gallery.grasp.contact))[touching]
    torch.testing.assert_close(stiffness, stiffness[:1].expand_as(stiffness))


def test_an_object_is_held_where_the_margin_exceeds_one(gallery: Scene) -> None:
    assert torch.equal(gallery.grasp.held, gallery.grasp.margin > 1.0)
    assert 0.05 < gallery.grasp.held.float().mean() < 0.95  # both outcomes occur


# Bad requests -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("request_", "named"),
    [
        ({"modalities": ("smell",)}, "modalities"),
        ({"sensors": ("braille",)}, "sensors"),
        ({"sensors": ()}, "sensors"),
        ({"sensors": "gelsight"}, "sensors"),
        ({"sensors": None}, "sensors"),
        ({"sensors": 3}, "sensors"),
        ({"sensors": [[]]}, "sensors"),
        ({"modalities": "image"}, "modalities"),
        ({"modalities": None}, "modalities"),
        ({"style": "matt"}, "style"),
        ({"style": {}}, "style"),
        ({"material": torch.ones(1, device="meta").long()}, "material"),
        ({"material": torch.ones(1).long().to_sparse()}, "material"),
        ({"material": [17]}, "material"),
        ({"material": [-1]}, "material"),
        ({"object": [-1]}, "object"),
        ({"contact": [-2]}, "contact"),
        ({"material": [1, 2]}, "material"),
        ({"material": [], "object": [], "contact": []}, "material"),
    ],
)
def test_a_bad_request_is_refused_by_name(request_: dict, named: str) -> None:
    with pytest.raises((InvalidInputError, InvalidTypeError), match=f"`{named}`"):
        World(0).render(**{"material": [1], "object": [1], "contact": [1], **request_})


@pytest.mark.parametrize("named", ["material", "object", "contact"])
@pytest.mark.parametrize(
    ("value", "error"),
    [
        ([1.7], TypeError),
        (torch.tensor([1.0]), TypeError),
        (np.array([1.0]), TypeError),
        ([True], TypeError),
        (["1"], TypeError),
        ([None], TypeError),
        ([2**70], TypeError),
        (1, ValueError),
        ([[1]], ValueError),
        (torch.ones(1, 1, dtype=torch.int64), ValueError),
    ],
)
def test_names_that_are_no_row_of_integers_are_refused(named: str, value: object, error: type[Exception]) -> None:
    with pytest.raises(error, match=f"`{named}`"):
        World(0).render(**{"material": [1], "object": [1], "contact": [1], named: value}, modalities=("text",))


@pytest.mark.parametrize("kind", [list, tuple, np.array, torch.tensor, lambda row: torch.tensor(row).to(torch.uint8)])
def test_names_may_come_in_any_row_of_integers(kind: Callable) -> None:
    expected = World(0).render([3, 4], [0, 1], [5, 6], modalities=("text",))
    made = World(0).render(kind([3, 4]), range(2), kind([5, 6]), modalities=("text",))
    assert made.text == expected.text
    assert torch.equal(made.material, expected.material)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({"resolution": 64}, "resolution"),
        ({"resolution": 200}, "resolution"),
        ({"image_size": 100}, "resolution"),
        ({"image_size": 0}, "image_size"),
        ({"image_size": -64}, "image_size"),
        ({"seed": -1}, "seed"),
        ({"seed": 1.5}, "seed"),
        ({"seed": True}, "seed"),
        ({"image_size": 64.0}, "image_size"),
        ({"image_size": "64"}, "image_size"),
        ({"resolution": None}, "resolution"),
        ({"resolution": 64 * 10**9}, "resolution"),
        ({"gel": None}, "gel"),
        ({"gel": 1.5}, "gel"),
    ],
)
def test_a_bad_world_is_refused_by_name(arguments: dict, named: str) -> None:
    with pytest.raises((InvalidInputError, InvalidTypeError), match=f"`{named}`"):
        World(**arguments)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"indentation_depth": float("nan")}, "indentation_depth"),
        ({"indentation_depth": -0.1}, "indentation_depth"),
        ({"white": (1.0, float("inf"), 1.0)}, "white"),
        ({"cast": (-1.0, 1.0, 1.0)}, "cast"),
        ({"indentation_depth": 100}, "indentation_depth"),
        ({"indentation_depth": 10**400}, "indentation_depth"),
        ({"indentation_depth": "deep"}, "indentation_depth"),
        ({"indentation_depth": (1.0, 2.0)}, "indentation_depth"),
        ({"white": 1.0}, "white"),
        ({"white": (1.0, 1.0)}, "white"),
        ({"white": "abc"}, "white"),
        ({"white": ("a", 1.0, 1.0)}, "white"),
        ({"white": (1j, 1.0, 1.0)}, "white"),
        ({"cast": 1.0}, "cast"),
        ({"cast": [[1.0, 1.0, 1.0]]}, "cast"),
        ({"cast": (1e300, 1.0, 1.0)}, "cast"),
        ({"markers": "yes"}, "markers"),
    ],
)
def test_a_bad_style_is_refused_by_name(options: dict, named: str) -> None:
    with pytest.raises((InvalidInputError, InvalidTypeError), match=f"`{named}`"):
        Style(**options)


def test_the_deepest_touch_still_shows_something() -> None:
    """Where a style that is deeper is refused: more than half of the contrast of one as deep as it comes."""
    names = list(range(16)), [0] * 16, [0] * 16
    plain, deepest = (
        World(0).render(*names, modalities=("touch",), style=Style(indentation_depth=depth)).touch["gelsight"]
        for depth in (1.0, DEEPEST)
    )
    assert deepest.flatten(1).std(dim=1).mean() > 0.5 * plain.flatten(1).std(dim=1).mean()


# Captions -------------------------------------------------------------------------------------------------------------

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
