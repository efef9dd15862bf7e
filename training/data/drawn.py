"""Contacts of the world as training data, each under a pair of sensors with about the same field of view.

The first sensor of a pair is a named one, or drawn at random like the second.
"""

import hashlib
import json
import math
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
RENDERED = ("touch", "depth", "audio", "attributes", "image", "text")  # modalities that stages are trained on


class Relit(World):
    """The same contacts, each in another photo, under the lamp and white balance of the next contact."""

    take = 1

    def draw(self, material: Tensor, object_: Tensor, contact: Tensor) -> Draws:
        draws = super().draw(material, object_, contact)
        return draws.but(light=draws.light.roll(1, 0), white=draws.white.roll(1, 0))


@dataclass(frozen=True)
class DrawnContacts:
    """Contacts to render for one sensor. With `scanned` at 1, materials without scanned surfaces are left out.

    The last four fields are arguments of `World`.
    """

    number: int  # of the source; its objects are numbered from 1000 `number`, so that no two sources share one
    sensor: str | None  # the first sensor of each pair; `None` draws one for each pair
    objects: int  # of each material
    contacts_per_object: int
    seed: int = 0
    held_out: int = 16  # objects of each material in the other splits
    scanned: float = 0.0
    photographic: float = 0.0
    recordings: float = 0.0
    colours_alone: bool = False

    @property
    def name(self) -> str:
        return f"drawn-{self.sensor or 'any'}"

    def world(self, size: int = 128, kind: type[World] = World) -> World:
        """The world of these contacts, which renders images of side `size`."""
        return kind(
            self.seed,
            image_size=size,
            scanned=self.scanned,
            photographic=self.photographic,
            recordings=self.recordings,
            colours_alone=self.colours_alone,
        )

    def contacts(self, split: str) -> tuple[Tensor, Tensor, Tensor]:
        """Numbers of material, object and contact, int64 (N,), in random order."""
        first = 1000 * self.number + FIRST_OBJECT[split]
        count = self.objects if split == "train" else self.held_out
        contacts = {"train": self.contacts_per_object, "val": 2, "test": 5, "beyond": 5}[split]
        grid = torch.cartesian_prod(
            torch.arange(len(MATERIAL_NAMES)),
            torch.arange(first, first + count),
            torch.arange(contacts),
        )
        if self.scanned == 1.0:
            is_scanned = self.world().draw(*grid.unbind(1)).surface >= 0
            grid = grid[is_scanned]
        order = torch.randperm(len(grid), generator=torch.Generator().manual_seed(self.seed))
        return grid[order, 0], grid[order, 1], grid[order, 2]

    def pair(self, split: str, group: int) -> tuple[Sensor, Sensor]:
        """The sensors of contacts 16 `group` to 16 `group` + 15."""
        split_number = len(FIRST_OBJECT) * self.number + list(FIRST_OBJECT).index(split)
        number = 10**6 * split_number + 2 * group
        first = draw_sensor(self.seed, number) if self.sensor is None else SENSORS[self.sensor]
        second = draw_sensor(self.seed, number + 1, near=first.field_of_view)
        return first, second

    def rendered(
        self, split: str, size: int, *modalities: str, kind: type[World] = World
    ) -> Iterator[tuple[Any, tuple[Sensor, Sensor]]]:
        """Scenes of sixteen contacts each, with some modalities, and their pairs of sensors."""
        world = self.world(size, kind)
        groups = zip(*(numbers.split(GROUP) for numbers in self.contacts(split)), strict=True)
        for group, contacts in enumerate(groups):
            sensors = self.pair(split, group)
            yield world.render(*contacts, modalities=modalities, sensors=sensors), sensors

    def scenes(self, split: str, size: int) -> Iterator[tuple[Any, dict[str, Tensor]]]:
        """Scenes, with touch (n, 2, 3, S, S), attributes (n, 2, 13) and maps (n, 2, 4, 8, 8) of both sensors."""
        for scene, sensors in self.rendered(split, size, *RENDERED):
            by_sensor = {
                "touch": [scene.touch[sensor.name] for sensor in sensors],
                "attributes": [scene.attributes[sensor.name] for sensor in sensors],
                "maps": [contact_maps(scene.depth[sensor.name], sensor.field_of_view) for sensor in sensors],
            }
            yield scene, {name: torch.stack(pair, dim=1) for name, pair in by_sensor.items()}

    def untouched(self, split: str, size: int) -> Tensor:
        """Untouched images of both sensors of each of G groups, (G, 2, 3, S, S) in [0, 1]."""
        material, _, _ = self.contacts(split)
        pairs = list[Tensor]()
        for group in range(math.ceil(len(material) / GROUP)):
            first, second = self.pair(split, group)
            pairs.append(torch.stack([untouched_gel(first, size), untouched_gel(second, size)]))
        return torch.stack(pairs)

    def captions(self, variants: int) -> list[list[str]]:
        """Captions of each training contact in `variants` wordings, the first of them that of its scene."""
        draws = self.world().draw(*self.contacts("train"))
        by_variant = [described(draws, variant) for variant in range(variants)]
        return [list(captions) for captions in zip(*by_variant, strict=True)]

    def surfaces(self, split: str) -> list[str | None]:
        """The name of each contact's scanned surface; `None` if its surface is drawn."""
        numbers = self.world().draw(*self.contacts(split)).surface.tolist()
        return [scanned_surfaces()[number].name if number >= 0 else None for number in numbers]

    def fingerprint(self, split: str) -> str:
        """Sixteen hexadecimal digits, a hash of the settings and of the first rendered contacts."""
        numbers = [self.number, self.sensor, self.objects, self.contacts_per_object, self.seed]
        # `None` is in the place of a removed setting, so that older caches stay valid.
        digest = hashlib.sha256(json.dumps([split, *numbers, None, self.held_out]).encode())
        if self.scanned or self.photographic or self.recordings:
            shares = [self.scanned, self.photographic, self.recordings, self.colours_alone]
            digest.update(json.dumps(shares).encode())
            digest.update((COLLECTION / "index.csv").read_bytes())
        scene, of_sensors = next(self.scenes(split, 32))
        digest.update("\n".join(scene.text).encode())
        for values, levels in (
            (scene.image, 255),
            (of_sensors["touch"], 255),
            (scene.audio, 32767),
            (of_sensors["attributes"], 1000),
            (of_sensors["maps"], 1000),
        ):
            digest.update((values * levels).round().int().numpy().tobytes())
        return digest.hexdigest()[:16]

    @property
    def summary(self) -> dict[str, object]:
        """The entry of this source in the record of a training run."""
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
    """Contacts of the world to render."""

    # Each named sensor has tokens of its own; null draws a sensor for every 16 contacts.
    sensors: Annotated[list[SensorName | None], Field(min_length=1)] = [None]
    objects: Annotated[int, Field(ge=1, le=FIRST_OBJECT["val"])] = 160  # of each material and sensor
    contacts_per_object: PositiveInt = 5
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0  # of the world
    scanned: Share = 0.0  # share of scanned objects, of materials that have scanned surfaces
    photographic: Share = 0.0  # share of pictures that are photos as people take them
    recordings: Share = 0.0  # share of recorded sounds, of materials that have recordings
    colours_alone: bool = False  # also scans without heights, for stages that use no touch

    def sources(self) -> list[DrawnContacts]:
        """The contacts of each sensor."""
        settings = self.model_dump(exclude={"sensors"})
        return [DrawnContacts(number, sensor, **settings) for number, sensor in enumerate(self.sensors)]
