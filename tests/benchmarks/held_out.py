"""The held-out contacts that figures are measured on."""

import torch

from unitouch_gen.world import COLLECTIONS, MATERIAL_NAMES, Scene, World, contacts

CONTACTS = 4
"""Contacts of each held-out object."""


def held_out(name: str, split: str, modalities: tuple[str, ...], sensors: tuple[str, ...] | None = None) -> Scene:
    """The held-out contacts of one collection, ordered by material.

    Args:
        name: Of the collection.
        split: "val" or "test".
        modalities: What is rendered.
        sensors: Whose touches; the collection's own when left out.
    """
    collection = COLLECTIONS[name]
    material, object_, contact = contacts(collection, split, CONTACTS)
    sensors = (collection.sensor,) if sensors is None else sensors
    return World().render(material, object_, contact, modalities=modalities, sensors=sensors, style=collection.style)


def some_of_each(material: torch.Tensor, per_material: int) -> torch.Tensor:
    """Rows of a few contacts of every material, spread over its objects.

    Args:
        material: Of all contacts, ordered, each as often as the others.
        per_material: At most as many as there are.
    """
    rows = torch.arange(len(material)).view(len(MATERIAL_NAMES), -1)
    chosen = torch.linspace(0, rows.shape[1] - 1, per_material).round().long()
    return rows[:, chosen].flatten()
