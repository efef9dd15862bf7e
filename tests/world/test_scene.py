"""Scenes: deterministic, finite, only what was asked for; grasps, and requests that are refused."""

import math
from collections.abc import Callable
from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from scipy.stats import spearmanr
from sklearn.linear_model import LogisticRegression
from sklearn.model_selection import cross_val_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from torch import Tensor

from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.world import (
    ATTRIBUTES,
    MATERIAL_NAMES,
    MATERIALS,
    MODALITIES,
    SENSORS,
    Scene,
    World,
    scene,
)
from unitouch_gen.world.draws import draw
from unitouch_gen.world.grasps import grasp
from unitouch_gen.world.scene import YIELD
from unitouch_gen.world.surfaces import surfaces

TOUCH_AND_GO = (
    "concrete", "plastic", "glass", "wood", "metal", "brick", "tile", "leather", "synthetic fabric", "natural fabric",
    "rubber", "paper", "tree", "grass", "soil", "rock", "gravel", "sand", "plants", "others",
)  # fmt: skip
EVERY = {"modalities": MODALITIES, "sensors": tuple(SENSORS)}


def names_of_every_material() -> tuple[Tensor, Tensor, Tensor]:
    """Four contacts of each material, trained and held out."""
    material = torch.arange(len(MATERIALS)).repeat_interleave(4)
    return material, torch.tensor([0, 3, 500, 600]).repeat(len(MATERIALS)), torch.arange(len(material)) % 3


def small(seed: int = 0, **options) -> World:
    return World(seed, image_size=32, **options)


@pytest.fixture(scope="module")
def gallery() -> Scene:
    return small().render(*names_of_every_material(), **EVERY)


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


def test_every_picture_is_finite_and_in_range(gallery: Scene) -> None:
    assert gallery.image.shape == (68, 3, 32, 32)
    assert torch.isfinite(gallery.image).all()
    assert gallery.image.min() >= 0.0
    assert gallery.image.max() <= 1.0


@pytest.mark.parametrize("sensor", SENSORS)
def test_every_touch_image_is_finite_and_in_range(gallery: Scene, sensor: str) -> None:
    images = gallery.touch[sensor]
    assert images.shape == (68, 3, 32, 32)
    assert torch.isfinite(images).all()
    assert images.min() >= 0.0
    assert images.max() <= 1.0


def test_surfaces_are_finite_with_albedo_and_body_in_range() -> None:
    built = surfaces(0, draw(0, *names_of_every_material()), 128)
    assert torch.isfinite(built.height).all()
    assert built.albedo.min() >= 0.0
    assert built.albedo.max() <= 1.0
    assert built.body.min() >= 0.0
    assert built.body.max() <= 1.0


# Determinism ------------------------------------------------------------------------------------------------------


def test_the_same_seed_renders_the_same_scene() -> None:
    names = ([0, 8, 15], [3, 1, 2], [0, 5, 1])
    assert same(small(7).render(*names, **EVERY), small(7).render(*names, **EVERY))


def test_another_seed_has_other_objects() -> None:
    names = ([0, 8], [3, 1], [0, 5])
    assert not same(small(0).render(*names, **EVERY), small(1).render(*names, **EVERY))


def test_contacts_of_one_object_differ_but_share_its_draws() -> None:
    drawn = draw(0, torch.tensor([5, 5]), torch.tensor([2, 2]), torch.tensor([0, 1]))
    for of_object in (drawn.scale, drawn.amplitude, drawn.weight, drawn.pitch, drawn.cell_seed, drawn.colour):
        assert torch.equal(of_object[0], of_object[1])
    assert not torch.equal(drawn.offset[0], drawn.offset[1])


@pytest.mark.parametrize("row", [0, 21, 44, 63])
def test_a_contact_alone_equals_the_same_contact_in_a_batch(gallery: Scene, row: int) -> None:
    alone = small(0).render(
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
    alone = small(0).render(*names, modalities=("touch",), sensors=("gelsight_r15",))
    torch.testing.assert_close(alone.touch["gelsight_r15"], gallery.touch["gelsight_r15"][:4], rtol=0, atol=1e-4)


def test_refining_the_surface_changes_pictures_and_touches_only_a_little(gallery: Scene) -> None:
    names = gallery.material, gallery.object, gallery.contact
    fine = small(resolution=256).render(*names, modalities=("image", "touch"), sensors=("gelsight", "gelsight_r15"))
    assert (fine.image - gallery.image).abs().mean(dim=(1, 2, 3)).max() < 0.03
    for name in ("gelsight", "gelsight_r15"):
        assert (fine.touch[name] - gallery.touch[name]).abs().mean(dim=(1, 2, 3)).max() < 0.02


# Only what is asked for -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("modality", MODALITIES)
def test_only_the_modality_asked_for_is_in_the_scene(modality: str) -> None:
    made = small(0).render([1], [1], [1], modalities=(modality,))
    empty = {
        field.name for field in fields(Scene) if getattr(made, field.name) is None or getattr(made, field.name) == {}
    }
    assert empty == set(MODALITIES) - {modality}


def test_only_the_sensors_asked_for_are_in_the_scene() -> None:
    made = small(0).render([1], [1], [1], modalities=("touch",), sensors=("digit", "gelsight_r15"))
    assert set(made.touch) == {"digit", "gelsight_r15"}


@pytest.mark.parametrize(
    ("modalities", "unused"),
    [
        (("text",), ("surfaces", "pictures", "pressed_gel", "impact_sounds")),
        (("audio",), ("surfaces", "pictures", "pressed_gel", "described")),
        (("image",), ("pressed_gel", "contact_share", "impact_sounds", "described")),
        (("touch",), ("pictures", "contact_share", "impact_sounds", "described")),
        (("grasp",), ("pictures", "pressed_gel", "impact_sounds", "described", "outcome_pictures")),
        (("outcome",), ("pressed_gel", "impact_sounds", "described")),
        (("depth",), ("pictures", "images_of_gel", "contact_share", "impact_sounds", "described")),
    ],
)
def test_what_is_not_asked_for_is_not_computed(modalities, unused, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in unused:
        monkeypatch.setattr(scene, name, never)
    small(0).render([2], [0], [0], modalities=modalities)


def test_a_gel_that_spreads_nothing_is_as_deep_as_what_presses_it() -> None:
    still = replace(SENSORS["gelsight_objectfolder"], correlation=0.0, blur=0.0, relaxation=0.0, thickness=1e6)
    names = [[0], [3], [1]]
    world = World(0, resolution=128)
    made = world.render(*names, modalities=("depth", "attributes"), sensors=(still,))
    deepest = ATTRIBUTES.index("depth")
    assert made.depth["gelsight_objectfolder"].shape == (1, 128, 128)
    expected = made.attributes["gelsight_objectfolder"][0, deepest].item()
    assert math.log(made.depth["gelsight_objectfolder"].max().item() + 0.02) == pytest.approx(expected, abs=1e-3)


def test_a_grasp_takes_the_first_sensor_only(gallery: Scene) -> None:
    names = gallery.material, gallery.object, gallery.contact
    several = (
        small(0).render(*names, modalities=("grasp",), sensors=("digit", "gelsight_objectfolder", "gelsight_r15")).grasp
    )
    alone = small(0).render(*names, modalities=("grasp",), sensors=("digit",)).grasp
    assert torch.equal(several.contact, alone.contact)
    assert not torch.equal(alone.contact, gallery.grasp.contact)  # the gallery's first sensor is another


def test_a_grasp_alone_equals_the_same_grasp_among_other_modalities(gallery: Scene) -> None:
    alone = small(0).render(gallery.material, gallery.object, gallery.contact, modalities=("grasp",)).grasp
    assert torch.equal(alone.contact, gallery.grasp.contact)
    assert torch.equal(alone.margin, gallery.grasp.margin)


# Grasps ---------------------------------------------------------------------------------------------------------------


def test_density_and_size_tell_the_weight_and_size_is_heard() -> None:
    material = torch.arange(17).repeat_interleave(12)
    drawn = draw(0, material, torch.arange(12).repeat(17), torch.zeros_like(material))
    volume = (drawn.size / 100.0) ** 3  # dm^3
    solid = drawn.weight / (9.80665 * drawn.of_material("density") * volume)
    assert solid.min() > 0.79 and solid.max() < 1.26
    for number in range(17):
        pitch, size = drawn.pitch[material == number].mean(dim=1), drawn.size[material == number]
        assert spearmanr(pitch, size).statistic < -0.5  # small bodies are higher by another number


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
    depth = drawn.indentation_depth * (1.0 - YIELD * drawn.compliance)
    stiffness = (force / (depth * gallery.grasp.contact))[touching]
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
        small(0).render(**{"material": [1], "object": [1], "contact": [1], **request_})


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
        small(0).render(**{"material": [1], "object": [1], "contact": [1], named: value}, modalities=("text",))


@pytest.mark.parametrize("kind", [list, tuple, np.array, torch.tensor, lambda row: torch.tensor(row).to(torch.uint8)])
def test_names_may_come_in_any_row_of_integers(kind: Callable) -> None:
    expected = small(0).render([3, 4], [0, 1], [5, 6], modalities=("text",))
    made = small(0).render(kind([3, 4]), range(2), kind([5, 6]), modalities=("text",))
    assert made.text == expected.text
    assert torch.equal(made.material, expected.material)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({"resolution": 64}, "resolution"),
        ({"resolution": 200}, "resolution"),
        ({"image_size": 100, "resolution": 128}, "resolution"),
        ({"image_size": 0}, "image_size"),
        ({"image_size": -64}, "image_size"),
        ({"seed": -1}, "seed"),
        ({"seed": 1.5}, "seed"),
        ({"seed": True}, "seed"),
        ({"image_size": 64.0}, "image_size"),
        ({"image_size": "64"}, "image_size"),
        ({"resolution": "128"}, "resolution"),
        ({"resolution": 64 * 10**9}, "resolution"),
        ({"gel": None}, "gel"),
        ({"gel": 1.5}, "gel"),
    ],
)
def test_a_bad_world_is_refused_by_name(arguments: dict, named: str) -> None:
    with pytest.raises((InvalidInputError, InvalidTypeError), match=f"`{named}`"):
        World(**arguments)


def test_what_is_felt_alone_does_not_say_whether_a_grasp_holds_but_all_modalities_do() -> None:
    material, number = torch.arange(17).repeat_interleave(30), torch.arange(30).repeat(17)
    names = (material, number, torch.zeros_like(material))
    drawn, found = draw(1000, *names), small(1000).render(*names, modalities=("grasp",), sensors=("gelsight",)).grasp
    felt = [torch.log(found.contact + 1e-3), drawn.indentation_depth.log(), drawn.compliance]
    seen = [drawn.of_material(name).log() for name in ("friction", "density")]
    probe = make_pipeline(StandardScaler(), LogisticRegression(class_weight="balanced"))

    def right(*features: torch.Tensor) -> float:
        x = torch.stack(features, dim=1).numpy()
        return cross_val_score(probe, x, found.held.numpy(), cv=5, scoring="balanced_accuracy").mean()

    assert right(*felt) < 0.9 < 0.95 < right(*felt, *seen, drawn.size.log())
    assert 0.5 < found.held.float().mean() < 0.75
