"""The world: names of contacts in, the modalities asked for out."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any
from zlib import crc32

import numpy as np
import torch
from torch import Tensor

from unitouch_gen.errors import (
    InvalidInputError,
    check_choice,
    check_integer,
    check_kind,
    check_number,
    check_texts,
    describe,
)
from unitouch_gen.world.attributes import contact_attributes
from unitouch_gen.world.cameras import photographed
from unitouch_gen.world.captions import described
from unitouch_gen.world.draws import SENSOR_STREAM, Draws, draw, generator
from unitouch_gen.world.gel import gel_displacement, gel_image, gel_indentation, in_view
from unitouch_gen.world.materials import MATERIALS
from unitouch_gen.world.recordings import as_files, recording_of, with_recordings
from unitouch_gen.world.reliefs import BASE_RESOLUTION
from unitouch_gen.world.scans import scanned_surfaces, with_scans
from unitouch_gen.world.sensors import SENSORS, Sensor
from unitouch_gen.world.sounds import impact_sounds, recorded
from unitouch_gen.world.surfaces import pictures, surfaces

MODALITIES: tuple[str, ...] = ("image", "touch", "depth", "audio", "text", "grasp", "attributes")

YIELD = 0.75  # share of an overlap that an object as compliant as the gel takes up: it is flattened


@dataclass
class Scene:
    """The modalities that were asked for; the others stay `None` or empty."""

    material: Tensor  # names of the N contacts, int64 (N,)
    object: Tensor
    contact: Tensor
    surface: list[str | None] = field(default_factory=list)  # names of scanned surfaces; `None` where objects are drawn
    image: Tensor | None = None  # pictures in [0, 1], (N, 3, S, S)
    touch: dict[str, Tensor] = field(default_factory=dict)  # by sensor, touch images in [0, 1], (N, 3, S, S)
    depth: dict[str, Tensor] = field(default_factory=dict)  # by sensor, displacement of the gel in view, mm, (N, S, S)
    audio: Tensor | None = None  # impact sounds in [-1, 1] at 16 kHz, (N, T)
    recording: list[str | None] = field(default_factory=list)  # names of recorded hits; `None` of synthesised sounds
    text: list[str] | None = None  # N captions
    grasp: Tensor | None = None  # force that two fingers carry over the object's weight, (N,): above 1 they lift it
    attributes: dict[str, Tensor] = field(default_factory=dict)  # by sensor, (N, 13); see `ATTRIBUTES`
    left_out: list[str] = field(default_factory=list)  # what the request did not need and was not computed


class World:
    """A procedural visuo-tactile world, deterministic by seed.

    Args:
        seed: Names the whole world; other seeds have other objects.
        image_size: Side of pictures and touch images, pixels.
        scanned: Share of objects that show a scanned surface in place of a drawn one, where their material has some.
            At 1, all of these do. Objects to train on show other surfaces than those held out.
        photographic: Share of pictures that are taken as people take photos: see `photographed`.
        recordings: Share of sounds that are recorded hits in place of synthesised ones, where their material has some.
            Above 0, all sounds are stored as files are, too: some clipped, some through a codec.
        colours_alone: Whether surfaces of which only colours are known are among the scanned. They feel flat.

    Raises:
        InvalidInputError, InvalidTypeError: On a number out of range.

    Example:
        >>> scene = World(seed=0).render([0, 4], object=[1, 1], contact=[0, 0], modalities=("touch", "text"))
        >>> scene.touch["gelsight"].shape, scene.image is None
        (torch.Size([2, 3, 128, 128]), True)
    """

    take = 0  # another number takes other photos of the same contacts

    def __init__(
        self,
        seed: int = 0,
        *,
        image_size: int = 128,
        scanned: float = 0.0,
        photographic: float = 0.0,
        recordings: float = 0.0,
        colours_alone: bool = False,
    ):
        self.seed = check_integer("seed", seed, 0)
        self.scanned = check_number("scanned", scanned, 0.0, 1.0)
        self.photographic = check_number("photographic", photographic, 0.0, 1.0)
        self.recordings = check_number("recordings", recordings, 0.0, 1.0)
        self.colours_alone = check_kind("colours_alone", colours_alone, bool)
        self.image_size = check_integer("image_size", image_size, 1, 4096)
        # Pixels a side of surfaces: a multiple of the picture's, twice as many at least.
        self.resolution = image_size * max(2, math.ceil(BASE_RESOLUTION / image_size))

    @torch.no_grad()
    def render(
        self,
        material: Sequence[int] | Tensor,
        object: Sequence[int] | Tensor,
        contact: Sequence[int] | Tensor,
        *,
        modalities: Sequence[str] = ("image", "touch", "audio", "text"),
        sensors: Sequence[str | Sensor] = ("gelsight",),
    ) -> Scene:
        """Renders N contacts in the modalities and sensors asked for, and computes nothing else.

        Args:
            material: Indices into `MATERIAL_NAMES`, (N,).
            object: Number of the object within its material, >= 0, (N,).
            contact: Number of the contact on its object, >= 0, (N,).
            modalities: Some of "image", "touch", "depth", "audio", "text", "grasp", "attributes".
            sensors: Names in `SENSORS`, or sensors; only read for touch, depth, attributes, and for grasp, which uses
                the first.

        Raises:
            InvalidTypeError: If names of contacts are no integers, modalities or sensors no list.
            InvalidInputError: On an unknown modality, sensor or material, or names that are not (N,), or not as many.
        """
        # 1. Check, and draw the numbers of the contacts.
        asked = {check_choice("modalities", name, MODALITIES) for name in check_texts("modalities", modalities)}
        by = _sensors(sensors)
        material = _numbers("material", material, most=len(MATERIALS) - 1)
        object = _numbers("object", object, len(material))
        contact = _numbers("contact", contact, len(material))
        draws = self.draw(material, object, contact)
        names = [scanned_surfaces()[number].name if number >= 0 else None for number in draws.surface.tolist()]
        scene = Scene(material, object, contact, names)
        scene.left_out = [name for name in MODALITIES if name not in asked]

        # 2. Surfaces and their pictures.
        coloured = "image" in asked
        size = self.image_size
        if asked - {"audio", "text"}:
            built = surfaces(self.seed, draws, self.resolution, coloured=coloured)
            # Soft objects yield as two springs in a row do: all of their overlap with the gel shrinks alike.
            stiff = 1.0 - YIELD * draws.compliance
            height = built.height * stiff[:, None, None]
            depth = draws.indentation_depth * stiff
            scene.left_out += [] if coloured else ["colours of surfaces"]
        else:
            scene.left_out.append("surfaces")
        if coloured:
            scene.image = pictures(built, draws.light, draws.gloss, draws.white, draws.camera, size)
            if self.photographic:
                scene.image = photographed(self.seed, draws.names(), scene.image, self.photographic, self.take)

        # 3. Gels.
        for sensor in by if asked & {"touch", "depth", "attributes"} else ():
            indentation = gel_indentation(height, depth, sensor, size)
            if asked & {"touch", "depth"}:
                displacement = gel_displacement(indentation, draws.dwell, sensor, size)
            if "touch" in asked:
                scene.touch[sensor.name] = self._noisy(gel_image(displacement, sensor, size), draws, sensor)
            if "depth" in asked:
                scene.depth[sensor.name] = in_view(displacement, size)
            if "attributes" in asked:
                pressed = in_view(indentation, size)
                view = sensor.field_of_view
                scene.attributes[sensor.name] = contact_attributes(pressed, view, draws.compliance)

        # 4. Grasps, sounds and captions.
        if "grasp" in asked:
            touched = in_view(gel_indentation(height, depth, by[0], size), size) > 0
            share = touched.float().mean(dim=(-2, -1))
            scene.grasp = grasp_margin(draws.of_material("friction"), draws.weight, depth, share)
        if "audio" in asked:
            scene.audio = self._sounds(draws)
            names = [recording_of(self.seed, name, self.recordings) for name in draws.names()]
            scene.recording = [recording.name if recording else None for recording in names]
        if "text" in asked:
            scene.text = described(draws)
        return scene

    def draw(self, material: Tensor, object_: Tensor, contact: Tensor) -> Draws:
        """Numbers of N contacts named by three int64 tensors (N,)."""
        draws = draw(self.seed, material, object_, contact)
        return with_scans(self.seed, draws, self.scanned, self.colours_alone) if self.scanned else draws

    def _sounds(self, draws: Draws) -> Tensor:
        """Sounds (N, T) through a microphone in a room."""
        sounds = impact_sounds(self.seed, draws)
        if not self.recordings:
            return recorded(self.seed, draws.names(), sounds)
        sounds = with_recordings(self.seed, draws, sounds, self.recordings)
        return as_files(self.seed, draws.names(), recorded(self.seed, draws.names(), sounds))

    def _noisy(self, images: Tensor, draws: Draws, sensor: Sensor) -> Tensor:
        """Touch images (N, 3, S, S) with the noise of the sensor's camera."""
        number = crc32(sensor.name.encode())
        for image, name in zip(images, draws.names(), strict=True):
            rng = generator(self.seed, SENSOR_STREAM, number, *name)
            image += sensor.noise * torch.from_numpy(rng.standard_normal(tuple(image.shape), dtype=np.float32))
        return images.clamp_(0.0, 1.0)


def grasp_margin(friction: Tensor, weight: Tensor, indentation_depth: Tensor, share: Tensor) -> Tensor:
    """Force that two fingers carry over the object's weight (N,), at a depth in mm and a share of the gel in contact.

    Coulomb: two fingers carry 2 mu F, with a normal force F that grows with depth and share. Above 1 they lift, as
    about two of three do at 3 N for each mm.
    """
    return 2.0 * friction * (3.0 * indentation_depth * share) / weight


def _sensors(sensors: Sequence[str | Sensor]) -> list[Sensor]:
    """Sensors by name, or as they are; each once."""
    given = check_kind("sensors", sensors, list, tuple)
    found = [one if isinstance(one, Sensor) else SENSORS[check_choice("sensors", one, SENSORS)] for one in given]
    named = {sensor.name: sensor for sensor in found}
    if len(named) != max(len(set(found)), 1):
        raise InvalidInputError("`sensors` is empty or holds two of one name; pass some, such as ['gelsight'].")
    return list(named.values())


def _numbers(label: str, values: Any, count: int | None = None, most: int = 2**63 - 1) -> Tensor:
    """One part of the names of N contacts, int64 (N,), from 0 to `most`."""
    given = values.tolist() if hasattr(values, "tolist") else values
    if not isinstance(given, Sequence) or len(given) != (count or max(len(given), 1)):
        raise InvalidInputError(f"`{label}` is {describe(values)}; pass an integer for each contact, such as [3].")
    return torch.tensor([check_integer(label, number, 0, most) for number in given])
