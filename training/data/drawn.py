"""Contacts of the world under sensors drawn anew, two for each contact, so that no sensor is worth knowing.

Sixteen contacts share a pair of sensors, which see about as much of them. The first of a pair may be a sensor by name.
"""

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Annotated, ClassVar

import torch
from pydantic import AfterValidator, Field, NonNegativeInt, PositiveInt
from torch import Tensor

from unitouch_gen.errors import check_choice
from unitouch_gen.training.recipe import Settings
from unitouch_gen.world import (
    FIRST_OBJECT,
    MATERIAL_NAMES,
    SENSORS,
    Scene,
    Sensor,
    TextureLibrary,
    World,
    contact_maps,
    draw_sensor,
    untouched_gel,
)
from unitouch_gen.world.captions import described
from unitouch_gen.world.draws import Draws
from unitouch_gen.world.grasps import outcome_captions, told_lifted

GROUP = 16
"""Contacts to a pair of sensors."""

HELD_OUT_CONTACTS = {"val": 2, "test": 5, "beyond": 5}
"""Contacts of each object that is held out."""

MODALITIES = ("touch", "depth", "audio", "attributes")


@dataclass(frozen=True)
class DrawnContacts:
    """What is to be rendered for one sensor, the first of each pair, or for none but drawn ones; see `DrawnConfig`.

    Objects are numbered from `number` thousands, so that no two sources share one.
    """

    number: int
    sensor: str | None
    objects: int
    contacts_per_object: int
    seed: int = 0
    textures: str | None = None
    held_out: int = 16

    asked: ClassVar[tuple[str, ...]] = (*MODALITIES, "image", "text")
    materials: ClassVar[tuple[str, ...]] = MATERIAL_NAMES

    @property
    def name(self) -> str:
        return f"drawn-{self.sensor or 'any'}"

    def contacts(self, split: str) -> tuple[Tensor, Tensor, Tensor]:
        """Material, object and contact, int64 (N,), in an order in which neighbours have nothing in common."""
        first = 1000 * self.number + FIRST_OBJECT[split]
        count = self.objects if split == "train" else self.held_out
        contacts = HELD_OUT_CONTACTS.get(split, self.contacts_per_object)
        ranges = (range(len(self.materials)), range(first, first + count), range(contacts))
        grid = torch.cartesian_prod(*map(torch.tensor, ranges))
        order = torch.randperm(len(grid), generator=torch.Generator().manual_seed(self.seed))
        return grid[order, 0], grid[order, 1], grid[order, 2]

    def pair(self, split: str, group: int) -> tuple[Sensor, Sensor]:
        """The sensors of contacts 16 `group` to 16 `group` + 15."""
        number = 2 * group + 10**6 * (len(FIRST_OBJECT) * self.number + list(FIRST_OBJECT).index(split))
        first = draw_sensor(self.seed, number) if self.sensor is None else SENSORS[self.sensor]
        return first, draw_sensor(self.seed, number + 1, near=first.field_of_view)

    def world(self, size: int) -> World:
        """What it is rendered from, in pictures and touches of `size` pixels."""
        return World(self.seed, textures=library(self.textures), image_size=size)

    def scenes(self, split: str, size: int) -> Iterator[tuple[slice, Scene, dict[str, Tensor]]]:
        """Rows, their scene, and touch (n, 2, 3, S, S), attributes (n, 2, 13), maps (n, 2, 4, 8, 8) of both sensors."""
        names, world = self.contacts(split), self.world(size)
        for start in range(0, len(names[0]), GROUP):
            rows = slice(start, min(start + GROUP, len(names[0])))
            sensors = self.pair(split, start // GROUP)
            scene = world.render(*(part[rows] for part in names), modalities=self.asked, sensors=sensors)
            seen = {
                "touch": [scene.touch[sensor.name] for sensor in sensors],
                "attributes": [scene.attributes[sensor.name] for sensor in sensors],
                "maps": [contact_maps(scene.depth[sensor.name], sensor.field_of_view) for sensor in sensors],
            }
            yield rows, scene, {name: torch.stack(pair, dim=1) for name, pair in seen.items()}

    def grasped(self, split: str, group: int, size: int, *modalities: str) -> Scene:
        """What can be asked for of grasps at contacts 16 `group` to 16 `group` + 15, by the first of their sensors."""
        rows = (part[group * GROUP : (group + 1) * GROUP] for part in self.contacts(split))
        return self.world(size).render(*rows, modalities=modalities, sensors=self.pair(split, group)[:1])

    def captions(self, split: str, variants: int, told: Sequence[str]) -> list[list[str]]:
        """As many captions of each contact of a split as asked for, the first of them `told`, that of its scene."""
        world = self.world(32)
        draws = world.draw(*self.contacts(split))
        captions = (self._described(draws, world.textures, variant, told) for variant in range(variants))
        return [list(texts) for texts in zip(*captions, strict=True)]

    def _described(self, draws: Draws, textures: TextureLibrary | None, variant: int, told: Sequence[str]) -> list[str]:
        return described(draws, textures, variant)

    def untouched(self, split: str, size: int, group: int) -> Tensor:
        """The gels of a pair of sensors where nothing touches them, (2, 3, S, S) in [0, 1]."""
        return torch.stack([untouched_gel(sensor, size) for sensor in self.pair(split, group)])

    def fingerprint(self, split: str) -> str:
        """Sixteen hexadecimal digits that change when what is rendered does: of names, scans, and some contacts."""
        digest = hashlib.sha256(json.dumps([split, *vars(self).values()]).encode())
        scans = library(self.textures)
        for texture in scans.textures if scans else ():
            digest.update(f"{texture.name} {texture.height.double().sum():.3f}".encode())
        _, scene, seen = next(self.scenes(split, 32))
        assert scene.image is not None and scene.text is not None and scene.audio is not None
        digest.update("\n".join(scene.text).encode())
        measured = ((seen[name], 1000) for name in ("attributes", "maps"))
        for values, levels in ((scene.image, 255), (seen["touch"], 255), (scene.audio, 32767), *measured):
            digest.update((values * levels).round().int().numpy().tobytes())
        return digest.hexdigest()[:16]

    @property
    def summary(self) -> dict[str, object]:
        """What a record says of it."""
        return {"name": self.name, "objects": self.objects, "contacts_per_object": self.contacts_per_object}

    @property
    def scans(self) -> dict[str, dict[str, str]]:
        """Every scanned material by its name: its files, and where each is from."""
        scans = library(self.textures)
        return {texture.name: texture.files for texture in scans.textures} if scans else {}


class DrawnGrasps(DrawnContacts):
    """Touches before an object is lifted, with pictures and captions of what comes of it."""

    asked: ClassVar[tuple[str, ...]] = (*MODALITIES, "outcome")

    @property
    def name(self) -> str:
        return f"grasps-{self.sensor or 'any'}"

    def scenes(self, split: str, size: int) -> Iterator[tuple[slice, Scene, dict[str, Tensor]]]:
        for rows, scene, seen in super().scenes(split, size):
            assert scene.outcome is not None
            yield rows, replace(scene, **scene.outcome._asdict()), seen

    def _described(self, draws: Draws, textures: TextureLibrary | None, variant: int, told: Sequence[str]) -> list[str]:
        held = torch.tensor([told_lifted(caption) for caption in told])  # as it was rendered, whatever the size
        return outcome_captions(draws, held, textures, variant)


def _known(name: str | None) -> str | None:
    return name if name is None else check_choice("sensors", name, SENSORS)


SensorName = Annotated[str | None, AfterValidator(_known)]
"""A sensor of the world, or null for drawn ones."""


class DrawnConfig(Settings):
    """What to render of the world.

    Attributes:
        sensors: Names in `SENSORS`, each to have tokens of its own, and null for drawn sensors alone.
        objects: Of each material and sensor; those that follow are held out.
        contacts_per_object: Contacts of each.
        textures: Folder of scanned materials; null trains on the world alone.
        seed: Of the world.
        held_out: Objects of each material that are held out to validate on.
    """

    sensors: Annotated[list[SensorName], Field(min_length=1)] = [None]
    objects: Annotated[int, Field(ge=1, le=FIRST_OBJECT["val"])] = 160
    contacts_per_object: PositiveInt = 5
    textures: str | None = None
    seed: NonNegativeInt = 0
    held_out: Annotated[int, Field(ge=1, le=FIRST_OBJECT["test"] - FIRST_OBJECT["val"])] = 16

    def sources(self, grasps: Sequence[str | None] = ()) -> list[DrawnContacts]:
        """One for each sensor, and behind them one for each sensor that grasps are felt by."""
        kinds = [*((DrawnContacts, sensor) for sensor in self.sensors), *((DrawnGrasps, sensor) for sensor in grasps)]
        rest = (self.objects, self.contacts_per_object, self.seed, self.textures, self.held_out)
        return [kind(number, sensor, *rest) for number, (kind, sensor) in enumerate(kinds)]


@cache
def library(folder: str | None) -> TextureLibrary | None:
    """The scanned materials of a folder, read once."""
    return None if folder is None else TextureLibrary.from_folder(Path(folder))
