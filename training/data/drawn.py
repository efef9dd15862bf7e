"""Contacts of the world, each under two sensors that see about as much of it: drawn anew, or the first by name."""

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any

import torch
from pydantic import AfterValidator, Field, PositiveInt
from torch import Tensor

from unitouch_gen.errors import check_choice
from unitouch_gen.training.recipe import Settings, Share
from unitouch_gen.world import FIRST_OBJECT, MATERIAL_NAMES, SENSORS, Sensor, World
from unitouch_gen.world.attributes import contact_maps
from unitouch_gen.world.captions import described
from unitouch_gen.world.draws import Draws
from unitouch_gen.world.gel import untouched_gel
from unitouch_gen.world.scans import COLLECTION, scanned_surfaces
from unitouch_gen.world.sensors import draw_sensor

GROUP = 16  # contacts to a pair of sensors


class Relit(World):
    """The same contacts, each under the lamp and white balance of the next one, in other photos."""

    take = 1

    def draw(self, material: Tensor, object_: Tensor, contact: Tensor) -> Draws:
        draws = super().draw(material, object_, contact)
        return draws.but(light=draws.light.roll(1, 0), white=draws.white.roll(1, 0))


@dataclass(frozen=True)
class DrawnContacts:
    """What to render for one sensor: the first of each pair, or `None` where both are drawn anew; see `DrawnConfig`.

    Objects are numbered from `number` thousands, so that no two sources share one. With `scanned` at 1, materials
    without scanned surfaces are left out.
    """

    number: int
    sensor: str | None
    objects: int
    contacts_per_object: int
    seed: int = 0
    held_out: int = 16  # objects of the other splits
    scanned: float = 0.0  # these are arguments of `World`
    photographic: float = 0.0
    recordings: float = 0.0
    colours_alone: bool = False

    @property
    def name(self) -> str:
        return f"drawn-{self.sensor or 'any'}"

    def world(self, size: int = 128, kind: type[World] = World) -> World:
        """The world that contacts are of, which renders images of a size."""
        return kind(
            self.seed,
            image_size=size,
            scanned=self.scanned,
            photographic=self.photographic,
            recordings=self.recordings,
            colours_alone=self.colours_alone,
        )

    def contacts(self, split: str) -> tuple[Tensor, Tensor, Tensor]:
        """Material, object and contact, int64 (N,), in an order in which neighbours have nothing in common."""
        first = 1000 * self.number + FIRST_OBJECT[split]
        count = self.objects if split == "train" else self.held_out
        contacts = {"train": self.contacts_per_object, "val": 2, "test": 5, "beyond": 5}[split]
        ranges = (range(len(MATERIAL_NAMES)), range(first, first + count), range(contacts))
        grid = torch.cartesian_prod(*map(torch.tensor, ranges))
        if self.scanned == 1.0:
            grid = grid[self.world().draw(*grid.unbind(1)).surface >= 0]
        order = torch.randperm(len(grid), generator=torch.Generator().manual_seed(self.seed))
        return grid[order, 0], grid[order, 1], grid[order, 2]

    def pair(self, split: str, group: int) -> tuple[Sensor, Sensor]:
        """The sensors of contacts 16 `group` to 16 `group` + 15."""
        number = 2 * group + 10**6 * (len(FIRST_OBJECT) * self.number + list(FIRST_OBJECT).index(split))
        first = draw_sensor(self.seed, number) if self.sensor is None else SENSORS[self.sensor]
        return first, draw_sensor(self.seed, number + 1, near=first.field_of_view)

    def rendered(
        self, split: str, size: int, *modalities: str, kind: type[World] = World
    ) -> Iterator[tuple[Any, tuple[Sensor, Sensor]]]:
        """Scenes of sixteen contacts each, with what was asked for, and their pairs of sensors."""
        world = self.world(size, kind)
        for group, names in enumerate(zip(*(part.split(GROUP) for part in self.contacts(split)), strict=True)):
            sensors = self.pair(split, group)
            yield world.render(*names, modalities=modalities, sensors=sensors), sensors

    def scenes(self, split: str, size: int) -> Iterator[tuple[Any, dict[str, Tensor]]]:
        """Scenes, with touch (n, 2, 3, S, S), attributes (n, 2, 13) and maps (n, 2, 4, 8, 8) of both sensors."""
        for scene, sensors in self.rendered(split, size, "touch", "depth", "audio", "attributes", "image", "text"):
            seen = {
                "touch": [scene.touch[sensor.name] for sensor in sensors],
                "attributes": [scene.attributes[sensor.name] for sensor in sensors],
                "maps": [contact_maps(scene.depth[sensor.name], sensor.field_of_view) for sensor in sensors],
            }
            yield scene, {name: torch.stack(pair, dim=1) for name, pair in seen.items()}

    def untouched(self, split: str, size: int) -> Tensor:
        """What the pair of sensors of each of G groups sees where nothing touches it, (G, 2, 3, S, S) in [0, 1]."""
        groups = range(-(-len(self.contacts(split)[0]) // GROUP))
        pairs = [self.pair(split, group) for group in groups]
        return torch.stack([torch.stack([untouched_gel(sensor, size) for sensor in pair]) for pair in pairs])

    def captions(self, variants: int) -> list[list[str]]:
        """As many captions of each contact to train on as asked for, the first of them that of its scene."""
        draws = self.world().draw(*self.contacts("train"))
        return [list(texts) for texts in zip(*(described(draws, one) for one in range(variants)), strict=True)]

    def surfaces(self, split: str) -> list[str | None]:
        """Names of the scanned surfaces of each contact; `None` of those that are drawn."""
        numbers = self.world().draw(*self.contacts(split)).surface.tolist()
        return [scanned_surfaces()[number].name if number >= 0 else None for number in numbers]

    def fingerprint(self, split: str) -> str:
        """Sixteen hexadecimal digits that change when what is rendered does: of names and some contacts."""
        asked = [self.number, self.sensor, self.objects, self.contacts_per_object, self.seed]
        # `None` stands where folders of scanned materials once did: what was cached then is found.
        digest = hashlib.sha256(json.dumps([split, *asked, None, self.held_out]).encode())
        if self.scanned or self.photographic or self.recordings:
            digest.update(json.dumps([self.scanned, self.photographic, self.recordings, self.colours_alone]).encode())
            digest.update((COLLECTION / "index.csv").read_bytes())
        scene, seen = next(self.scenes(split, 32))
        digest.update("\n".join(scene.text).encode())
        measured = ((seen[name], 1000) for name in ("attributes", "maps"))
        for values, levels in ((scene.image, 255), (seen["touch"], 255), (scene.audio, 32767), *measured):
            digest.update((values * levels).round().int().numpy().tobytes())
        return digest.hexdigest()[:16]

    @property
    def summary(self) -> dict[str, object]:
        """What a training run keeps on record of it."""
        return {
            "name": self.name,
            "objects": self.objects,
            "contacts_per_object": self.contacts_per_object,
            "scanned": self.scanned,
            "photographic": self.photographic,
            "recordings": self.recordings,
        }


SensorName = Annotated[str, AfterValidator(lambda name: check_choice("sensors", name, SENSORS))]


class DrawnConfig(Settings):
    """What to render of the world."""

    # Each by name has tokens of its own; null is for drawn ones.
    sensors: Annotated[list[SensorName | None], Field(min_length=1)] = [None]
    objects: Annotated[int, Field(ge=1, le=FIRST_OBJECT["val"])] = 160  # of each material and sensor
    contacts_per_object: PositiveInt = 5
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0  # of the world
    scanned: Share = 0.0  # of the objects, where their material has scanned surfaces
    photographic: Share = 0.0  # of pictures, which are taken as people take photos
    recordings: Share = 0.0  # of the sounds, which are recorded hits where their material has some
    colours_alone: bool = False  # whether scans without heights are among them: for stages that see no touch

    def sources(self) -> list[DrawnContacts]:
        """One for each sensor."""
        settings = self.model_dump(exclude={"sensors"})
        return [DrawnContacts(number, sensor, **settings) for number, sensor in enumerate(self.sensors)]
