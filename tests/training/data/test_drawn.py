"""Drawn contacts: rendered as the world renders them, two sensors to each, splits apart; cached once."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from unitouch_gen.models import UniTouchProcessor
from unitouch_gen.training.data import Contacts, DataConfig, DrawnConfig, columns_of, sensor_numbers
from unitouch_gen.training.data.drawn import GROUP
from unitouch_gen.world import SAMPLE_RATE, SENSORS, World, contact_maps

CONFIG = DataConfig(drawn=DrawnConfig(sensors=[None, "digit"], objects=1, contacts_per_object=1))
SOURCES = CONFIG.sources()


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("drawn")


@pytest.fixture(scope="module")
def splits(place: Path, _processor: UniTouchProcessor) -> list[Contacts]:
    return columns_of(SOURCES, place, CONFIG, _processor, ("image", "touch", "sensor"))


def test_drawn_columns_are_what_the_world_renders(splits: list[Contacts], processor: UniTouchProcessor) -> None:
    assert [source.name for source in SOURCES] == ["drawn-any", "drawn-digit"]
    for split, source in zip(splits, SOURCES, strict=True):
        names = source.contacts("train")
        pair = source.pair("train", 0)
        modalities = ("touch", "depth", "audio", "attributes", "image", "text")
        few = [part[:GROUP] for part in names]
        scene = World(source.seed, image_size=32).render(*few, modalities=modalities, sensors=pair)
        assert split.text[:GROUP] == scene.text
        np.testing.assert_allclose(split.image[:GROUP] / 255.0, scene.image, atol=0.5 / 255 + 1e-6)
        for column, sensor in ((split.touch, pair[0]), (split.second, pair[1])):
            np.testing.assert_allclose(column[:GROUP] / 255.0, scene.touch[sensor.name], atol=0.5 / 255 + 1e-6)
        attributes = torch.stack([scene.attributes[sensor.name] for sensor in pair], dim=1)
        np.testing.assert_allclose(split.attributes[:GROUP], attributes, rtol=1e-5, atol=1e-5)
        maps = [contact_maps(scene.depth[sensor.name], sensor.field_of_view) for sensor in pair]
        np.testing.assert_allclose(split.maps[:GROUP], torch.stack(maps, dim=1), rtol=2e-3, atol=1e-3)  # float16
        clips = processor.sounds([(sound, SAMPLE_RATE) for sound in scene.audio])
        np.testing.assert_allclose(split.audio[:GROUP], clips[:, 0], rtol=1e-3, atol=1e-2)
        np.testing.assert_array_equal(split.material, names[0])
    assert sensor_numbers(splits, ["digit"]).tolist() == [-1] * 17 + [0] * 17


def test_every_contact_has_captions_of_its_own(splits: list[Contacts]) -> None:
    told = [texts for source in SOURCES for texts in source.captions(3)]
    assert [captions[0] for captions in told] == [caption for split in splits for caption in split.text]
    assert all(len(captions) == 3 for captions in told)
    assert sum(len(set(captions)) for captions in told[:34]) > 2.5 * 34


def test_no_two_splits_or_sources_share_an_object_or_a_drawn_sensor() -> None:
    objects = []
    drawn = []
    for source in DrawnConfig(sensors=[None, "digit", "gelsight"], objects=500).sources():
        for split in ("train", "val", "test"):
            material, object_, _ = source.contacts(split)
            assert len(set(material[:GROUP].tolist())) > 6  # neighbours have nothing in common
            objects.append(set(object_.tolist()))
            pairs = [source.pair(split, group) for group in range(20)]
            drawn.append({sensor.name for pair in pairs for sensor in pair} - set(SENSORS))
            if source.sensor is not None:
                assert {first for first, _ in pairs} == {SENSORS[source.sensor]}
    for sets in (objects, drawn):
        assert len(set.union(*sets)) == sum(map(len, sets))


def test_a_fingerprint_is_of_one_world_and_names_its_cache() -> None:
    first, second = SOURCES
    prints = [source.fingerprint("train") for source in (first, second, replace(first, seed=1), first)]
    assert len({*prints, first.fingerprint("val")}) == 4
    assert prints[0] == prints[-1]


def test_cached_columns_are_mapped_and_the_same(splits, place, processor, tmp_path: Path) -> None:
    files = {path: path.stat().st_mtime_ns for path in place.rglob("*.npy")}
    [again] = columns_of(SOURCES[:1], place, CONFIG, processor, ())
    assert {path: path.stat().st_mtime_ns for path in place.rglob("*.npy")} == files
    [fresh] = columns_of(SOURCES[:1], tmp_path, CONFIG, processor, ())
    assert again.text == fresh.text == splits[0].text
    assert again.fingerprint == fresh.fingerprint
    for name in ("image", "touch", "second", "audio", "attributes", "maps"):
        assert name == "attributes" or isinstance(getattr(again, name), np.memmap)
        np.testing.assert_array_equal(getattr(again, name), getattr(fresh, name))


def test_other_sizes_and_sounds_are_rendered_anew(splits, place: Path, processor: UniTouchProcessor) -> None:
    processor.image_size = 16
    [small] = columns_of(SOURCES[:1], place, CONFIG, processor, ())
    assert small.touch.shape[-1] == 16
    before = processor.audio
    processor.image_size = 32
    processor.audio = replace(before, mean=before.mean + 1.0)
    [heard] = columns_of(SOURCES[:1], place, CONFIG, processor, ())
    np.testing.assert_allclose(heard.audio, splits[0].audio - 1.0 / before.std, atol=1e-2)
    assert len({small.fingerprint, heard.fingerprint, splits[0].fingerprint}) == 3


def test_scanned_objects_are_those_of_their_split_and_named(place: Path, processor: UniTouchProcessor) -> None:
    config = DataConfig(drawn=DrawnConfig(sensors=["digit"], objects=2, contacts_per_object=1, scanned=0.5))
    [source] = config.drawn.sources()
    [seen] = columns_of([source], place, config, processor, ("image", "touch"))
    names = source.contacts("train")
    scene = World(0, image_size=32, scanned=0.5).render(*(part[:GROUP] for part in names), modalities=("image", "text"))
    assert seen.text[:GROUP] == scene.text
    assert source.surfaces("train")[:GROUP] == scene.surface
    np.testing.assert_allclose(seen.image[:GROUP] / 255.0, scene.image, atol=0.5 / 255 + 1e-6)
    assert {name is None for name in source.surfaces("train")} == {True, False}
    every = replace(source, scanned=1.0, held_out=4)
    held_out = every.contacts("test")
    shown = every.surfaces("test")
    assert None not in shown
    assert len(shown) == 15 * 4 * 5
    assert not {*shown} & {*source.surfaces("train")}
    assert len({*held_out[0].tolist()}) == 15
    prints = [
        replace(source, **changes).fingerprint("test") for changes in ({}, {"scanned": 0.0}, {"photographic": 1.0})
    ]
    assert len({*prints}) == 3
