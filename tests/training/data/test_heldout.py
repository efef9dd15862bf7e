"""Contacts to evaluate on, against the encoders themselves."""

from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch.nn.functional import normalize

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.evaluation.controls import statistics
from unitouch_gen.evaluation.features import embed_all
from unitouch_gen.models.classifier import ContactClassifier
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.training.data import heldout, open_dataset
from unitouch_gen.training.data.contacts import SPLITS
from unitouch_gen.training.data.heldout import of_datasets, of_world, parts_of
from unitouch_gen.weights import TOUCH_CLASSIFIER

CLASSIFIER = ContactClassifier.from_pretrained(TOUCH_CLASSIFIER, dtype=torch.float32)


def test_a_world_is_split_by_objects_labelled_and_embedded(model, processor, cache: Path, monkeypatch):
    monkeypatch.setattr(heldout, "OBJECTS", 1)
    monkeypatch.setattr(heldout, "CONTACTS", 1)
    for number, sensor in enumerate(model.config.sensors):
        model.sensor_bank.set_prototype(sensor, torch.full((3, 32, 32), 0.3 + 0.2 * number))
    name, seed, splits = next(of_world(cache, processor, ["digit"], [1], 1, grasps=True))
    assert (name, seed, tuple(splits)) == ("digit", 1001, SPLITS)
    embed_all(model, processor, splits, CLASSIFIER)
    objects = [set(contacts.objects.tolist()) for contacts in splits.values()]
    assert not any(one & other for one, other in combinations(objects, 2))
    assert set(splits["val"].labels["grasp"].tolist()) <= {0, 1}
    test = splits["test"]
    assert {"touch", "image", "audio", "text", "gel", "untrained", "supervised"} < set(test.features)
    with torch.no_grad():
        touches = normalise_pixels(torch.from_numpy(np.array(test.touch)).float() / 255)
        expected = model.get_touch_features(touches, torch.ones(len(touches), dtype=torch.long))  # digit is the second
        clip = processor.sounds(test.sounds()[:1])
        heard = model.get_audio_features(clip)
    torch.testing.assert_close(test.features["touch"], expected, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(test.features["audio"][:1], heard, atol=1e-3, rtol=1e-2)  # kept in half precision
    assert not torch.allclose(test.features["untrained"], expected, atol=1e-2)
    relit = test.relit()
    pictures = torch.from_numpy(np.array(test.image)).float() / 255
    alike = torch.nn.functional.cosine_similarity(*(each.mean(1).flatten(1) for each in (relit, pictures)))
    assert relit.shape == pictures.shape
    assert alike.mean() > 0.9
    assert not torch.allclose(relit, pictures, atol=0.05)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Twelve touches of six objects with their untouched gel, of two hardnesses."""
    rng = np.random.default_rng(0)
    rows = ["touch,background,object,hardness,caption"]
    for number in range(12):
        for kind in ("peak", "bg"):
            Image.fromarray(rng.integers(0, 255, (32, 32, 3), dtype=np.uint8)).save(tmp_path / f"{number}_{kind}.png")
        rows.append(f"{number}_peak.png,{number}_bg.png,thing{number // 2},{number // 2 % 2},a thing of {number}")
    (tmp_path / "labels.csv").write_text("\n".join(rows))
    return tmp_path


def test_a_folder_is_embedded_with_all_that_it_has(folder, model, processor, tmp_path):
    for sensor in model.config.sensors:
        model.sensor_bank.set_prototype(sensor, torch.full((3, 32, 32), 0.3))
    data = open_dataset(folder)
    [(_, _, splits)] = of_datasets(tmp_path / "cache", processor, [data])
    embed_all(model, processor, splits, CLASSIFIER)
    assert [len(splits[split].objects) for split in SPLITS] == [8, 2, 2]
    test = splits["test"]
    record = parts_of(data)["test"].records[1]
    assert set(test.features) == {"touch", "untrained", "statistics", "supervised", "gel", "text"}
    assert test.labels["hardness"].tolist() == [record.labels["hardness"]] * 2
    touch, gel = (np.asarray(Image.open(folder / record.id.replace("peak", kind)), float) for kind in ("peak", "bg"))
    np.testing.assert_allclose(test.features["statistics"][1], statistics([touch - gel])[0], atol=1e-3)
    with torch.no_grad():
        told = model.get_text_features(**processor.text([record.caption]))
    torch.testing.assert_close(test.features["text"][1], normalize(told, dim=1)[0], atol=1e-5, rtol=1e-4)


def test_lists_without_a_split_to_validate_on_leave_it_objects_to_train_on(folder):
    data = open_dataset(folder)
    records = [replace(one, split="train" if one.object < "thing4" else "test") for one in data.records]
    parts = parts_of(replace(data, records=tuple(records)))
    objects = [{record.object for record in parts[split].records} for split in SPLITS]
    assert [len(part) for part in objects] == [3, 1, 2]
    assert len(set().union(*objects)) == 6
    with pytest.raises(InvalidInputError, match="neither splits nor objects"):
        parts_of(replace(data, apart="none"))


def test_a_share_to_validate_on_leaves_each_material_a_record_to_train_on(folder):
    data = open_dataset(folder)
    materials = [0] * 6 + [1] * 4 + [2]  # the last one of a single record
    records = [
        replace(record, split="train", labels={"material": material})
        for record, material in zip(data.records, materials, strict=False)
    ]
    records.append(replace(data.records[-1], split="test", labels={"material": 0}))
    parts = parts_of(replace(data, records=tuple(records), apart="none"))
    counts = {split: [record.labels["material"] for record in parts[split].records] for split in ("train", "val")}
    assert sorted(counts["val"]) == [0, 1]
    assert sorted(counts["train"]) == [0] * 5 + [1] * 3 + [2]
