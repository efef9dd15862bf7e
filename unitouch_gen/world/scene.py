"""The world: renders the modalities of contacts by their names."""

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
from unitouch_gen.world.surfaces import Surfaces, pictures, surfaces

SCENE_MODALITIES: tuple[str, ...] = ("image", "touch", "depth", "audio", "text", "grasp", "attributes")

YIELD = 0.75  # share of an overlap by which an object as compliant as the gel is flattened


@dataclass
class Scene:
    """The rendered modalities of N contacts; the others are `None` or empty."""

    material: Tensor  # numbers of materials, objects and contacts, which name the N contacts, int64 (N,)
    object: Tensor
    contact: Tensor
    surface: list[str | None] = field(default_factory=list)  # names of scanned surfaces; `None` for drawn ones
    image: Tensor | None = None  # pictures in [0, 1], (N, 3, S, S)
    touch: dict[str, Tensor] = field(default_factory=dict)  # by sensor, touch images in [0, 1], (N, 3, S, S)
    depth: dict[str, Tensor] = field(default_factory=dict)  # by sensor, displacement of the gel in view, mm, (N, S, S)
    audio: Tensor | None = None  # impact sounds in [-1, 1] at 16 kHz, (N, T)
    recording: list[str | None] = field(default_factory=list)  # names of recorded hits; `None` for synthesised sounds
    text: list[str] | None = None  # N captions
    grasp: Tensor | None = None  # force that two fingers carry over the object's weight, (N,); above 1 they lift it
    attributes: dict[str, Tensor] = field(default_factory=dict)  # by sensor, (N, 13); see `ATTRIBUTES`
    left_out: list[str] = field(default_factory=list)  # what was not needed and not computed


class World:
    """A procedural visuo-tactile world, deterministic by seed.

    Args:
        seed: Of the whole world; other seeds have other objects.
        image_size: Side of pictures and touch images, pixels.
        scanned: Share of objects with a scanned surface in place of a drawn one, of materials that have some. At 1, all
            of these objects are scanned. Training objects have other surfaces than those held out.
        photographic: Share of pictures that look like photos by people; see `photographed`.
        recordings: Share of sounds that are recorded hits in place of synthesised ones, of materials that have some.
            Above 0, all sounds go through a file, too: some are clipped, some compressed.
        colours_alone: Whether scans without heights are used. They feel flat.

    Raises:
        InvalidInputError, InvalidTypeError: If a number is out of range.

    Example:
        >>> scene = World(seed=0).render([0, 4], object=[1, 1], contact=[0, 0], modalities=("touch", "text"))
        >>> scene.touch["gelsight"].shape, scene.image is None
        (torch.Size([2, 3, 128, 128]), True)
    """

    take = 0  # other numbers take other photos of the same contacts

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
        # Pixels along a side of surfaces: a multiple of the picture's, at least twice as many.
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
        """Renders N contacts in some modalities and sensors, and computes nothing else.

        Args:
            material: Indices into `MATERIAL_NAMES`, (N,).
            object: Number of the object within its material, >= 0, (N,).
            contact: Number of the contact on its object, >= 0, (N,).
            modalities: Some of "image", "touch", "depth", "audio", "text", "grasp", "attributes".
            sensors: Names in `SENSORS`, or sensors; used for touch, depth and attributes. Grasps use the first.

        Raises:
            InvalidTypeError: If names of contacts are no integers, modalities or sensors no list.
            InvalidInputError: If a modality, sensor or material is unknown, or names are not (N,), or not as many.
        """
        # 1. Check, and draw the numbers of the contacts.
        requested = {
            check_choice("modalities", name, SCENE_MODALITIES) for name in check_texts("modalities", modalities)
        }
        sensor_list = _sensors(sensors)
        material = _numbers("material", material, most=len(MATERIALS) - 1)
        object = _numbers("object", object, len(material))
        contact = _numbers("contact", contact, len(material))
        draws = self.draw(material, object, contact)
        scan_names = [scanned_surfaces()[number].name if number >= 0 else None for number in draws.surface.tolist()]
        scene = Scene(material, object, contact, surface=scan_names)
        scene.left_out = [name for name in SCENE_MODALITIES if name not in requested]

        # 2. Surfaces, their pictures, and gels.
        coloured = "image" in requested
        if requested - {"audio", "text"}:
            patches = surfaces(self.seed, draws, self.resolution, coloured=coloured)
            if coloured:
                scene.image = self._pictures(patches, draws)
            else:
                scene.left_out.append("colours of surfaces")
            self._press(scene, patches, draws, sensor_list, requested)
        else:
            scene.left_out.append("surfaces")

        # 3. Sounds and captions.
        if "audio" in requested:
            scene.audio = self._sounds(draws)
            hits = [recording_of(self.seed, name, self.recordings) for name in draws.names()]
            scene.recording = [hit.name if hit else None for hit in hits]
        if "text" in requested:
            scene.text = described(draws)
        return scene

    def _pictures(self, patches: Surfaces, draws: Draws) -> Tensor:
        """Pictures (N, 3, S, S), a share of them as photos."""
        images = pictures(
            patches,
            light=draws.light,
            gloss=draws.gloss,
            white=draws.white,
            side=draws.camera,
            resolution=self.image_size,
        )
        if self.photographic:
            return photographed(self.seed, draws.names(), images, share=self.photographic, take=self.take)
        return images

    def _press(self, scene: Scene, patches: Surfaces, draws: Draws, sensors: list[Sensor], requested: set[str]) -> None:
        """Adds the requested touch images, depths, attributes and grasps to a scene."""
        size = self.image_size
        # A soft object and the gel are two springs in series, so all of their overlap shrinks by one factor.
        stiffness = 1.0 - YIELD * draws.compliance
        height = patches.height * stiffness[:, None, None]
        depth = draws.indentation_depth * stiffness
        if requested & {"touch", "depth", "attributes"}:
            for sensor in sensors:
                indentation = gel_indentation(height, depth, sensor, size)
                if requested & {"touch", "depth"}:
                    displacement = gel_displacement(indentation, draws.dwell, sensor, size)
                if "touch" in requested:
                    scene.touch[sensor.name] = self._noisy(gel_image(displacement, sensor, size), draws, sensor)
                if "depth" in requested:
                    scene.depth[sensor.name] = in_view(displacement, size)
                if "attributes" in requested:
                    scene.attributes[sensor.name] = contact_attributes(
                        in_view(indentation, size), sensor.field_of_view, draws.compliance
                    )
        if "grasp" in requested:
            touched = in_view(gel_indentation(height, depth, sensors[0], size), size) > 0
            share = touched.float().mean(dim=(-2, -1))
            scene.grasp = grasp_margin(draws.of_material("friction"), draws.weight, depth, share)

    def draw(self, material: Tensor, object_: Tensor, contact: Tensor) -> Draws:
        """Numbers of N contacts named by three int64 tensors (N,)."""
        draws = draw(self.seed, material, object_, contact)
        if self.scanned:
            return with_scans(self.seed, draws, self.scanned, self.colours_alone)
        return draws

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

    By Coulomb's law two fingers carry 2 mu F, with a normal force F of 3 N for each mm of depth and full contact. Above
    1 they lift the object, which is so for about two of three contacts.
    """
    return 2.0 * friction * (3.0 * indentation_depth * share) / weight


def _sensors(sensors: Sequence[str | Sensor]) -> list[Sensor]:
    """Sensors by name, or as they are, without repeats."""
    resolved = list[Sensor]()
    for sensor in check_kind("sensors", sensors, list, tuple):
        if not isinstance(sensor, Sensor):
            sensor = SENSORS[check_choice("sensors", sensor, SENSORS)]
        resolved.append(sensor)
    by_name = {sensor.name: sensor for sensor in resolved}
    if not resolved or len(by_name) != len(set(resolved)):
        raise InvalidInputError("`sensors` is empty or holds two of one name; pass some, such as ['gelsight'].")
    return list(by_name.values())


def _numbers(label: str, values: Any, count: int | None = None, most: int = 2**63 - 1) -> Tensor:
    """One part of the names of contacts, int64 (N,), from 0 to `most`; N is `count`, or at least 1."""
    numbers = values.tolist() if hasattr(values, "tolist") else values
    if not isinstance(numbers, Sequence) or len(numbers) != (count or max(len(numbers), 1)):
        raise InvalidInputError(f"`{label}` is {describe(values)}; pass an integer for each contact, such as [3].")
    return torch.tensor([check_integer(label, number, 0, most) for number in numbers])
