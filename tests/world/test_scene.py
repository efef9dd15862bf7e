"""Scenes: deterministic, in range, only what was asked for; soft things and grasps."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_iter

from tests.helpers.plain_sensor import touch_images
from unitouch_gen.world import SCENE_MODALITIES, SENSORS, Scene, World, draw_sensor
from unitouch_gen.world.scene import YIELD, grasp_margin
from unitouch_gen.world.surfaces import surfaces

MATERIAL = torch.arange(17).repeat_interleave(4)
NAMES = MATERIAL, torch.tensor([0, 3, 500, 800]).repeat(17), torch.arange(68) % 3
USED = ("gelsight", "digit", draw_sensor(0, 2))
EVERY = {"modalities": SCENE_MODALITIES, "sensors": USED}


def small(seed: int = 0) -> World:
    return World(seed, image_size=32)


@pytest.fixture(scope="module")
def gallery() -> Scene:
    return small().render(*NAMES, **EVERY)


def close(one: Scene, other: Scene, rows: slice = slice(None), atol: float = 1e-4) -> bool:
    pairs = [(getattr(one, name), getattr(other, name)[rows]) for name in ("image", "audio", "grasp")]
    for by_sensor in ("touch", "depth", "attributes"):
        pairs += [(values, getattr(other, by_sensor)[name][rows]) for name, values in getattr(one, by_sensor).items()]
    same = all(torch.allclose(a, b, rtol=0, atol=atol) for a, b in pairs)
    return same and one.text == other.text[rows]


def test_every_modality_is_finite_and_in_range(gallery: Scene) -> None:
    for images in (gallery.image, *gallery.touch.values()):
        assert images.shape == (68, 3, 32, 32)
        assert images.min() >= 0.0
        assert images.max() <= 1.0
    assert gallery.audio.abs().max() <= 1.0
    for values in (*gallery.depth.values(), *gallery.attributes.values(), gallery.audio, gallery.grasp):
        assert torch.isfinite(values).all()
    assert len(gallery.text) == 68


def test_a_scene_is_its_names_and_its_seed(gallery: Scene) -> None:
    for row, kind in ((0, list), (21, np.array), (63, tuple)):  # alone as in a batch, in any row of integers
        one = slice(row, row + 1)
        assert close(small().render(*(kind(part[one].tolist()) for part in NAMES), **EVERY), gallery, one, atol=1e-3)
    few = [part[:3] for part in NAMES]
    assert close(small(7).render(*few, **EVERY), small(7).render(*few, **EVERY), atol=0.0)
    assert not close(small(7).render(*few, **EVERY), gallery, slice(3))


@pytest.mark.parametrize("modality", SCENE_MODALITIES)
def test_a_modality_alone_is_the_same_and_all_that_there_is(gallery: Scene, modality: str) -> None:
    made = small().render(*(part[:5] for part in NAMES), modalities=(modality,), sensors=USED[:2])
    present = {name for name in SCENE_MODALITIES if getattr(made, name) not in (None, {})}
    assert present == {modality}
    surfaces = {"audio": ["surfaces"], "text": ["surfaces"], "image": []}
    others = [name for name in SCENE_MODALITIES if name != modality]
    assert made.left_out == others + surfaces.get(modality, ["colours of surfaces"])
    found = getattr(made, modality)
    expected = getattr(gallery, modality)
    for name, values in found.items() if isinstance(found, dict) else ():
        torch.testing.assert_close(values, expected[name][:5], rtol=0, atol=1e-3)
    if isinstance(found, torch.Tensor):
        torch.testing.assert_close(found, expected[:5], rtol=0, atol=1e-4)


def test_touch_images_are_of_surfaces_that_yield_and_have_the_noise_of_their_camera() -> None:
    world = small()
    quiet = replace(SENSORS["digit"], noise=0.0)
    drawn = world.draw(*NAMES)
    names = {"modalities": ("touch",)}
    stiff = 1.0 - YIELD * drawn.compliance
    height = surfaces(0, drawn, world.resolution).height * stiff[:, None, None]
    expected = touch_images(height, drawn.indentation_depth * stiff, drawn.dwell, quiet, 32)
    assert torch.equal(world.render(*NAMES, **names, sensors=(quiet,)).touch["digit"], expected)
    noisy = world.render(*NAMES, **names, sensors=("digit",)).touch["digit"]
    inside = (expected > 0.05) & (expected < 0.95)
    assert (noisy - expected)[inside].std().item() == pytest.approx(SENSORS["digit"].noise, rel=0.05)


def test_a_grasp_holds_by_coulombs_law_and_some_slip() -> None:
    friction, weight, depth, share = torch.tensor([[0.5, 1.0], [3.0, 3.0], [1.5, 1.5], [0.4, 0.4]])
    force = 3.0 * depth * share  # of either finger, newton
    assert torch.equal(grasp_margin(friction, weight, depth, share) > 1.0, friction * force > weight / 2)
    names = torch.arange(17).repeat_interleave(30), torch.arange(30).repeat(17), torch.zeros(510, dtype=torch.int64)
    holds = small(1000).render(*names, modalities=("grasp",)).grasp > 1.0
    assert holds.any()
    assert not holds.all()


class Elements(TorchDispatchMode):
    """Counts the elements that operations write."""

    count = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **kwargs or {})
        self.count += sum(part.numel() for part in tree_iter(result) if isinstance(part, torch.Tensor))
        return result


def test_rendering_one_modality_computes_less_than_all() -> None:
    index = torch.arange(2)
    counts = {}
    for names in (SCENE_MODALITIES, ("image",), ("touch",), ("audio",), ("text",), ("grasp",)):
        with Elements() as elements:
            World().render(index, 0 * index, 0 * index, modalities=names, sensors=tuple(SENSORS))
        counts[names] = elements.count
    everything = counts.pop(SCENE_MODALITIES)
    assert max(counts.values()) < 0.9 * everything
    assert counts["text",] < 0.01 * everything
