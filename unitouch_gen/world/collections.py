"""Seven collections, as many as the paper has data sets: four to train on, three that only test.

As real ones, they are confounded: each has its own objects, white balance, gel colour and indentation depths, and one
sensor. All hold the same materials, because a missing material would teach the sensor tokens a label prior.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from unitouch_gen.errors import check_choice, check_integer, check_kind
from unitouch_gen.world.materials import MATERIAL_NAMES
from unitouch_gen.world.scene import Style

COLLECTION_MATERIALS: tuple[str, ...] = MATERIAL_NAMES[:16]
"""Materials of the collections, which are those that the built-in models know."""


@dataclass(frozen=True)
class Collection:
    """One data set of the world.

    Attributes:
        name: By its sensor, and what sets it apart from another collection of that sensor.
        sensor: Its only sensor.
        style: What its camera, room and gel add.
        objects: Number of training objects of each material.
        training: Whether the touch encoder may be trained on it.
        first_object: Objects are numbered from here, so no two collections share one.
    """

    name: str
    sensor: str
    style: Style
    objects: int
    training: bool
    first_object: int

    @property
    def materials(self) -> tuple[str, ...]:
        """Names of its materials, by number."""
        return COLLECTION_MATERIALS


COLLECTIONS: dict[str, Collection] = {
    collection.name: collection
    for collection in (
        Collection("world_gelsight", "gelsight", Style((1.00, 0.97, 0.92), (1.06, 0.98, 0.92)), 160, True, 0),
        Collection("world_gelsight_markers", "gelsight",
                   Style((0.93, 1.0, 1.05), (0.93, 1.0, 1.08), True, 0.9), 100, True, 1000),
        Collection("world_digit", "digit", Style((1.04, 1.0, 0.95), (1.0, 1.0, 1.0), False, 0.95), 120, True, 2000),
        Collection("world_taxim", "taxim", Style(), 120, True, 3000),
        Collection("world_tacto", "tacto", Style(), 40, False, 4000),
        Collection("world_gelslim", "gelslim", Style((1.02, 0.98, 1.0)), 40, False, 5000),
        Collection("world_digit_unseen", "digit",
                   Style((0.97, 1.0, 1.02), (0.95, 1.04, 1.0), False, 1.05), 40, False, 6000),
    )
}  # fmt: skip

TRAINING_COLLECTIONS: tuple[str, ...] = tuple(c.name for c in COLLECTIONS.values() if c.training)

SPLITS: dict[str, tuple[int, int | None]] = {"train": (0, None), "val": (500, 8), "test": (600, 16)}
"""First object (after the collection's own first) and objects a material; `None` stands for the collection's size."""


def contacts(collection: Collection, split: str, contacts_per_object: int) -> tuple[Tensor, Tensor, Tensor]:
    """Names of all contacts of one split, held apart by object: (material, object, contact), int64 (N,).

    Raises:
        InvalidInputError, InvalidTypeError: On an unknown split, or a number of contacts that is none from 1 to 10,000.
    """
    check_kind("collection", collection, Collection), check_choice("split", split, SPLITS)
    check_integer("contacts_per_object", contacts_per_object, 1, 10_000)
    start, count = SPLITS[split]
    first = collection.first_object + start
    objects = torch.arange(first, first + (collection.objects if count is None else count))
    grid = torch.cartesian_prod(torch.arange(len(COLLECTION_MATERIALS)), objects, torch.arange(contacts_per_object))
    return grid[:, 0], grid[:, 1], grid[:, 2]
