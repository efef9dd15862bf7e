"""Contacts as evaluation takes them, against the encoders themselves."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch.nn.functional import normalize

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.evaluation.contacts import SPLITS, EvaluationSet
from unitouch_gen.evaluation.controls import UNTRAINED, statistics
from unitouch_gen.models import UniTouchModel, UniTouchProcessor
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.training.data import embedded, open_dataset
from unitouch_gen.training.data.drawn import GROUP
from unitouch_gen.training.data.embedded import (
    folder_set,
    record_splits,
    world_set,
    world_source,
    world_splits,
)
from unitouch_gen.training.data.held import spread


@pytest.fixture
def made(model: UniTouchModel, processor: UniTouchProcessor, cache: Path, monkeypatch: pytest.MonkeyPatch):
    """Makes the contacts of a world, few of them."""
    monkeypatch.setattr(embedded, "TRAIN_OBJECTS", 1)
    monkeypatch.setattr(embedded, "CONTACTS", 1)
    for number, sensor in enumerate(model.sensors):
        model.sensor_bank.set_prototype(sensor, torch.full((3, 32, 32), 0.3 + 0.2 * number))

    def make(sensor: str | None = "digit", **settings) -> EvaluationSet:
        splits = world_splits(cache, processor, world_source(sensor, 0, objects=1))
        return world_set(model, processor, splits, cache, **settings)

    return make


def test_a_world_is_split_by_objects_and_labelled(made):
    one = made(grasps=True)
    assert (one.name, one.known, tuple(one.splits)) == ("digit", True, SPLITS)
    assert one.classes["grasp"] == ("dropped", "lifted")
    objects = [set(contacts.objects.tolist()) for contacts in one.splits.values()]
    assert not (objects[0] & objects[1] or objects[0] & objects[2] or objects[1] & objects[2])
    for contacts in one.splits.values():
        assert len(contacts.labels["material"].unique()) == len(one.classes["material"])
        assert set(contacts.labels["grasp"].tolist()) <= {0, 1}
        assert {len(values) for values in contacts.features.values()} == {len(contacts)}
    assert not made(None).known


def test_features_are_the_encoders_own(made, model, cache):
    one = made()
    [file] = cache.glob(f"drawn-digit-test-{'-'.join(one.fingerprint.split('-')[-2:])}/touch.npy")
    touches = normalise_pixels(torch.from_numpy(np.load(file)).float() / 255)
    with torch.no_grad():
        expected = model.get_touch_features(touches, torch.ones(len(touches), dtype=torch.long))  # digit is the second
    torch.testing.assert_close(one.splits["test"].features["touch"], expected, atol=1e-5, rtol=1e-4)
    assert not torch.allclose(one.splits["test"].features["untrained"], expected, atol=1e-2)


def test_a_second_time_nothing_runs(made, model, monkeypatch):
    first = made()
    monkeypatch.setattr(model, "get_touch_features", None)
    monkeypatch.setattr(model, "get_image_features", None)
    again = made()
    for split in SPLITS:
        for name, values in first.splits[split].features.items():
            assert torch.equal(values, again.splits[split].features[name])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Twelve touches of six objects with their untouched gel, of two hardnesses."""
    rng, rows = np.random.default_rng(0), ["clip,object,hardness,caption"]
    for number in range(12):
        for kind in ("peak", "bg"):
            Image.fromarray(rng.integers(0, 255, (32, 32, 3), dtype=np.uint8)).save(tmp_path / f"{number}_{kind}.png")
        rows.append(f"{number},thing{number // 2},{number // 2 % 2},a thing of {number}")
    (tmp_path / "labels.csv").write_text("\n".join(rows))
    return tmp_path


def test_a_folder_is_embedded_with_all_that_it_has(folder, made, model, processor, tmp_path):
    patterns = {"touch": "{clip}_peak.png", "background": "{clip}_bg.png"}
    data = open_dataset(folder, patterns=patterns)
    one = folder_set(model, processor, data, tmp_path / "cache", splits=())
    contacts = one.splits["test"]
    untrained = contacts.by_seed("untrained")
    assert len(untrained) == UNTRAINED and not torch.allclose(untrained[0], untrained[1], atol=1e-2)
    names = {name for name in contacts.features if not name.startswith("untrained")}
    assert names == {"touch", "statistics", "relief", "gel", "text"}
    assert contacts.labels["hardness"].tolist() == [number // 2 % 2 for number in range(12)]
    assert len(contacts.objects.unique()) == 6 and not one.known
    touch, gel = (np.asarray(Image.open(folder / f"3_{kind}.png"), float) for kind in ("peak", "bg"))
    np.testing.assert_allclose(contacts.features["statistics"][3], statistics([touch - gel])[0], atol=1e-3)
    with torch.no_grad():
        told = model.get_text_features(**processor.text(["a thing of 3"]))
    torch.testing.assert_close(contacts.features["text"][3], normalize(told, dim=1)[0], atol=1e-5, rtol=1e-4)
    apart = folder_set(model, processor, data, tmp_path / "cache")
    assert [len(apart.splits[split]) for split in SPLITS] == [8, 2, 2]


def test_lists_without_a_split_to_validate_on_leave_it_objects_to_train_on(folder, processor, tmp_path):
    data = open_dataset(folder, patterns={"touch": "{clip}_peak.png"})
    tested = {"thing0", "thing3"}
    records = [replace(one, split="test" if one.object in tested else "train") for one in data.records]
    parts = record_splits(tmp_path / "cache", processor, replace(data, records=tuple(records)), SPLITS)
    assert [len(parts[split].seen) for split in SPLITS] == [6, 2, 4]
    objects = [{record.object for record in parts[split].source.records} for split in SPLITS]
    assert objects[2] == tested
    assert not (objects[0] & objects[1] or objects[0] & objects[2] or objects[1] & objects[2])


def test_too_few_objects_to_validate_on_are_refused_by_what_is_missing(folder, processor, tmp_path):
    data = open_dataset(folder, patterns={"touch": "{clip}_peak.png"})
    records = [replace(one, split="train" if one.object in ("thing0", "thing1") else "test") for one in data.records]
    with pytest.raises(InvalidInputError, match=r"lists no split 'val', and fewer than three objects to train on"):
        record_splits(tmp_path / "cache", processor, replace(data, records=tuple(records)), SPLITS)


def test_outcomes_of_grasps_are_embedded_as_pictures(made, model, processor):
    contacts = made(grasps=True).splits["test"]
    source = world_source("digit", 0, objects=1)
    groups = range(-(-len(source.contacts("test")[0]) // GROUP))
    scenes = [source.grasped("test", group, 32, "grasp", "outcome") for group in groups]
    pictures = torch.cat([scene.outcome.image for scene in scenes])
    with torch.no_grad():
        expected = model.get_image_features(normalise_pixels(pictures))
    torch.testing.assert_close(contacts.features["outcome"], expected, atol=1e-5, rtol=1e-4)
    assert torch.equal(contacts.labels["grasp"].bool(), torch.cat([scene.grasp > 1.0 for scene in scenes]))


def test_a_sensor_that_the_world_does_not_have_is_refused(made):
    with pytest.raises(InvalidInputError, match="`sensor` is 'skin'"):
        made("skin")


def test_a_few_of_each_class_are_spread_over_all_of_it():
    labels = torch.tensor([0] * 9 + [-1] + [2] * 2)
    assert spread(labels, 3).tolist() == [9, 0, 4, 8, 10, 11]  # of those of unknown class, too
    assert spread(labels, 1).tolist() == [9, 0, 10]
