"""Seven collections: held apart by object, confounded by style and sensor, unseen sensors kept for testing."""

import itertools

import pytest
import torch

from unitouch_gen.world import (
    COLLECTION_MATERIALS,
    COLLECTIONS,
    SENSORS,
    TRAINING_COLLECTIONS,
    TRAINING_SENSORS,
    UNSEEN_SENSORS,
    contacts,
)

SPLITS = ("train", "val", "test")


def objects_of(name: str, split: str) -> set[tuple[int, int]]:
    material, object_, _ = contacts(COLLECTIONS[name], split, 1)
    return set(zip(material.tolist(), object_.tolist(), strict=True))


@pytest.mark.parametrize("name", COLLECTIONS)
def test_splits_share_no_object(name: str) -> None:
    for left, right in itertools.combinations(SPLITS, 2):
        assert not objects_of(name, left) & objects_of(name, right)


def test_collections_share_no_object_in_any_split() -> None:
    every = [objects_of(name, split) for name in COLLECTIONS for split in SPLITS]
    assert len(set().union(*every)) == sum(map(len, every))


@pytest.mark.parametrize("name", COLLECTIONS)
@pytest.mark.parametrize("split", SPLITS)
def test_every_split_holds_every_material_equally_often(name: str, split: str) -> None:
    material, _, _ = contacts(COLLECTIONS[name], split, 2)
    counts = material.bincount()
    assert len(counts) == len(COLLECTIONS[name].materials)
    assert counts.min() == counts.max() > 0


def test_a_split_names_each_contact_once() -> None:
    collection = COLLECTIONS["world_gelsight"]
    names = torch.stack(contacts(collection, "train", 3), dim=1)
    assert len(names) == len(COLLECTION_MATERIALS) * collection.objects * 3 == len(names.unique(dim=0))


def test_four_collections_train_and_three_only_test() -> None:
    assert len(TRAINING_COLLECTIONS) == 4
    assert len(COLLECTIONS) == 7


def test_training_collections_use_training_sensors_only() -> None:
    assert {COLLECTIONS[name].sensor for name in TRAINING_COLLECTIONS} == set(TRAINING_SENSORS)


def test_unseen_sensors_occur_only_in_collections_that_test() -> None:
    users = {name for name, collection in COLLECTIONS.items() if collection.sensor in UNSEEN_SENSORS}
    assert users
    assert not users & set(TRAINING_COLLECTIONS)
    assert {COLLECTIONS[name].sensor for name in users} == set(UNSEEN_SENSORS)


def test_training_and_unseen_sensors_are_all_sensors() -> None:
    assert set(TRAINING_SENSORS) | set(UNSEEN_SENSORS) == set(SENSORS)
    assert not set(TRAINING_SENSORS) & set(UNSEEN_SENSORS)


def test_no_two_training_collections_look_alike() -> None:
    looks = [(COLLECTIONS[name].sensor, COLLECTIONS[name].style) for name in TRAINING_COLLECTIONS]
    assert len(set(looks)) == len(looks)


def test_an_unknown_split_is_refused_by_name() -> None:
    with pytest.raises(ValueError, match=r"`split` is 'dev'.*'train', 'val', 'test'"):
        contacts(COLLECTIONS["world_digit_unseen"], "dev", 1)


@pytest.mark.parametrize("count", [0, -3])
def test_fewer_than_one_contact_is_refused_by_name(count: int) -> None:
    with pytest.raises(ValueError, match="`contacts_per_object`"):
        contacts(COLLECTIONS["world_digit_unseen"], "test", count)
