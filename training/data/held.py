"""Contacts that nothing was trained on, of a world or of a data set, for what is generated of them."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from unitouch_gen.models import UniTouchProcessor
from unitouch_gen.training.data.columns import DataConfig, Rendered, drawn, sound_of
from unitouch_gen.training.data.drawn import GROUP, DrawnConfig, DrawnContacts
from unitouch_gen.training.data.records import RecordSet
from unitouch_gen.world import ATTRIBUTES, SAMPLE_RATE, World

TOUCHED = 0.01
"""Share of the view from which on a contact is generated from: nothing else is to be told of the others."""


@dataclass
class Held:
    """Held-out contacts of one world, and how they came about."""

    source: DrawnContacts
    split: str
    seen: Rendered

    @property
    def seed(self) -> int:
        return self.source.seed

    def sensors_of(self, rows: Tensor) -> list[str | None]:
        return [self.source.sensor] * len(rows)

    @property
    def material(self) -> Tensor:
        return torch.from_numpy(np.asarray(self.seen.material))

    @property
    def attributes(self) -> Tensor:
        """(N, 2, 13) by either sensor."""
        return torch.from_numpy(np.array(self.seen.attributes))

    def some(self, each: int) -> Tensor:
        """Rows of a few contacts of every material that both sensors touch."""
        touched = (self.attributes[:, :, ATTRIBUTES.index("cover")] > TOUCHED).all(dim=1)
        rows = [torch.nonzero((self.material == number) & touched)[:each, 0] for number in self.material.unique()]
        return torch.cat(rows)

    def again(self, modality: str, world: World) -> Iterator[Any]:
        """A modality of all contacts, by chunks, from another world."""
        names = (part.split(GROUP) for part in self.source.contacts(self.split))
        for chunk in zip(*names, strict=True):
            yield getattr(world.render(*chunk, modalities=(modality,)), modality)

    def sounds(self) -> list[tuple[Tensor, int]]:
        return [(sound, SAMPLE_RATE) for part in self.again("audio", self.source.world(32)) for sound in part]

    def relit(self, size: int) -> Tensor:
        """Pictures (N, 3, S, S) of the same contacts, each under another one's lamp and white balance."""
        world = self.source.world(size)
        relit = Relit(self.source.seed, textures=world.textures, image_size=size)
        return torch.cat(list(self.again("image", relit)))


@dataclass
class HeldRecords:
    """The records of a split of a data set: `Held` without what a world alone can tell or show once more."""

    source: RecordSet
    split: str
    seen: Rendered
    seed: int = 0

    def sensors_of(self, rows: Tensor) -> list[str | None]:
        return [self.source[row].sensor for row in rows.tolist()]

    @property
    def material(self) -> Tensor:
        return torch.from_numpy(np.asarray(self.seen.material))

    def some(self, each: int) -> Tensor:
        """Rows of a few contacts of every material; see `spread`."""
        return spread(self.material, each)

    def sounds(self) -> list[Any]:
        return [sound_of(record, self.source) for record in self.source.records]


HeldOut = Held | HeldRecords


def spread(labels: Tensor, each: int) -> Tensor:
    """Rows of at most `each` samples of every class, as far apart as they come, as neighbours are often of one touch.

    Args:
        labels: int64 (N,); those of unknown class, -1, are one more.
        each: 1 or more.
    """
    classes = [torch.nonzero(labels == number)[:, 0] for number in labels.unique()]
    return torch.cat([rows[np.unique(np.linspace(0, len(rows) - 1, each).astype(int))] for rows in classes])


class Relit(World):
    """The same contacts, each under the next one's lamp and white balance."""

    def draw(self, material: Tensor, object_: Tensor, contact: Tensor) -> Any:
        draws = super().draw(material, object_, contact)
        return draws.but(light=draws.light.roll(1, 0), white=draws.white.roll(1, 0))


def held_of(cache: Path, processor: UniTouchProcessor, source: DrawnContacts, split: str) -> Held:
    """The contacts of a split, rendered once."""
    return Held(source, split, drawn(cache, source, split, DataConfig(drawn=DrawnConfig()), processor))


def float_pixels(values: Any) -> Tensor:
    """(N, 3, S, S) in [0, 1] of bytes."""
    return torch.from_numpy(np.array(values)).float() / 255
