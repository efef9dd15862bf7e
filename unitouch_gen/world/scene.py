"""The world: names of contacts in, the modalities asked for out."""

import math
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from zlib import crc32

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from unitouch_gen.errors import (
    INTEGERS,
    InvalidInputError,
    InvalidTypeError,
    check_choice,
    check_choices,
    check_dense,
    check_integer,
    check_kind,
    first_line,
)
from unitouch_gen.world.attributes import contact_attributes
from unitouch_gen.world.captions import described
from unitouch_gen.world.draws import SENSOR_STREAM, Draws, draw, generator
from unitouch_gen.world.gel import DEFAULT_GRID, LARGEST_GRID, GelGrid
from unitouch_gen.world.grasps import Grasp, Outcome, grasp, outcome_captions, outcome_pictures
from unitouch_gen.world.materials import MATERIALS
from unitouch_gen.world.recordings import recorded
from unitouch_gen.world.sensors import (
    SENSORS,
    PressedGel,
    Sensor,
    contact_share,
    gel_indentation,
    images_of_gel,
    pressed_gel,
)
from unitouch_gen.world.sounds import impact_sounds
from unitouch_gen.world.surfaces import BASE_RESOLUTION, Surfaces, pictures, surfaces
from unitouch_gen.world.textures import TextureLibrary

MODALITIES: tuple[str, ...] = ("image", "touch", "depth", "audio", "text", "grasp", "outcome", "attributes")

PARTS: tuple[str, ...] = (
    "surfaces",
    "image",
    *(f"touch of {name}" for name in SENSORS),
    "depth",
    "attributes",
    "grasp",
    "outcome",
    "audio",
    "text",
)
"""What rendering consists of, in order."""

YIELD = 0.75
"""Share of an overlap that an object as compliant as the gel takes up: it is flattened where it is touched."""


@dataclass
class RenderReport:
    """What rendering a scene took, and what its request left out.

    Attributes:
        contacts: How many were rendered.
        seconds: Wall-clock time of each part, in the order in which they ran.
        left_out: Parts that the request did not need and that were not computed.
    """

    contacts: int = 0
    seconds: dict[str, float] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Adds the time spent inside to a part."""
        started = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - started

    def __str__(self) -> str:
        parts = ", ".join(f"{name} {1e3 * seconds:.0f} ms" for name, seconds in self.seconds.items())
        left_out = ", ".join(self.left_out) or "nothing"
        return f"{self.contacts} contacts in {sum(self.seconds.values()):.2f} s ({parts}); left out: {left_out}"


@dataclass
class Scene:
    """The modalities that were asked for; the others stay `None`.

    Attributes:
        material, object, contact: Names of the N contacts, int64 (N,).
        image: Pictures in [0, 1], (N, 3, S, S).
        touch: By sensor, touch images in [0, 1], (N, 3, S, S).
        depth: By sensor, how far the gel is displaced where its camera sees it, mm, (N, S, S).
        audio: Impact sounds in [-1, 1] at 16 kHz, (N, T).
        text: Captions, N strings.
        grasp: Whether grasps hold.
        outcome: Pictures and captions of what came of them.
        attributes: By sensor, what can be measured of the contact, (N, 13); see `ATTRIBUTES`.
        report: Seconds that each part took, and what was left out.
    """

    material: Tensor
    object: Tensor
    contact: Tensor
    image: Tensor | None = None
    touch: dict[str, Tensor] = field(default_factory=dict)
    depth: dict[str, Tensor] = field(default_factory=dict)
    audio: Tensor | None = None
    text: list[str] | None = None
    grasp: Grasp | None = None
    outcome: Outcome | None = None
    attributes: dict[str, Tensor] = field(default_factory=dict)
    report: RenderReport = field(default_factory=RenderReport)


class World:
    """A procedural visuo-tactile world, deterministic by seed, of scanned materials as well where there are some.

    Args:
        seed: Names the whole world; other seeds have other objects.
        textures: Scanned materials; 45 % of the objects whose class has some are of one.
        image_size: Side of pictures and touch images, pixels.
        resolution: Side of the height fields, pixels over 32 mm; a multiple of `image_size` and at least 128; if left
            out, the least from twice `image_size` on.
        gel: Grid on which gels are solved; finer touch images need a finer `resolution` and a finer gel.

    Raises:
        InvalidInputError, InvalidTypeError: On a number out of range, or what is none, or textures that are no library.

    Example:
        >>> scene = World(seed=0).render([0, 4], object=[1, 1], contact=[0, 0], modalities=("touch", "text"))
        >>> scene.touch["gelsight"].shape, scene.image is None
        (torch.Size([2, 3, 128, 128]), True)
    """

    def __init__(
        self,
        seed: int = 0,
        *,
        textures: TextureLibrary | None = None,
        image_size: int = 128,
        resolution: int | None = None,
        gel: GelGrid = DEFAULT_GRID,
    ):
        self.image_size = check_integer("image_size", image_size, 1, LARGEST_GRID)
        self.seed = check_integer("seed", seed, 0)
        self.textures = None if textures is None else check_kind("textures", textures, TextureLibrary)
        if resolution is None:
            resolution = min(image_size * max(2, math.ceil(BASE_RESOLUTION / image_size)), LARGEST_GRID)
        self.resolution = check_integer("resolution", resolution, BASE_RESOLUTION, LARGEST_GRID)
        if resolution % image_size:
            raise InvalidInputError(
                f"`resolution` is {resolution}; it has to be a multiple of `image_size` ({image_size})."
            )
        self.gel = check_kind("gel", gel, GelGrid)

    @torch.no_grad()
    def render(
        self,
        material: Sequence[int] | Tensor,
        object: Sequence[int] | Tensor,
        contact: Sequence[int] | Tensor,
        *,
        modalities: Iterable[str] = ("image", "touch", "audio", "text"),
        sensors: Sequence[str | Sensor] = ("gelsight",),
    ) -> Scene:
        """Renders N contacts in the modalities and sensors asked for, and computes nothing else.

        Args:
            material: Indices into `MATERIAL_NAMES`, (N,).
            object: Number of the object within its material, >= 0, (N,).
            contact: Number of the contact on its object, >= 0, (N,).
            modalities: Some of "image", "touch", "depth", "audio", "text", "grasp", "outcome", "attributes".
            sensors: Names in `SENSORS`, or sensors; only read for touch, depth, attributes, and for grasp and
                outcome, which use the first.

        Raises:
            InvalidTypeError: If names of contacts are no integers, modalities or sensors no list.
            InvalidInputError: On an unknown modality, sensor or material, or names that are not (N,), or not as many.
        """
        modalities, chosen = check_choices("modalities", modalities, MODALITIES), _sensors(sensors)
        names = [_numbers("material", material), _numbers("object", object), _numbers("contact", contact)]
        _check_names(names)
        report = RenderReport(contacts=len(names[0]))
        with report.part("draws"):
            draws = self.draw(*names)
        scene = Scene(material=draws.material, object=draws.object, contact=draws.contact, report=report)
        if set(modalities) - {"audio", "text"}:
            pictured, lifted = ({"image", "outcome"} & set(modalities), {"grasp", "outcome"} & set(modalities))
            with report.part("surfaces"):
                built = surfaces(self.seed, draws, self.resolution, self.textures, coloured=bool(pictured))
            if pictured:
                with report.part("image"):
                    picture = self._picture(draws, built)
                scene.image = picture if "image" in modalities else None
            met = _pressed(draws, built.height)
            in_gel = {"touch", "depth", "attributes"} & set(modalities)
            for sensor in chosen if in_gel else ():
                part = (
                    f"touch of {sensor.name}" if "touch" in in_gel else "depth" if "depth" in in_gel else "attributes"
                )
                with report.part(part):
                    indentation, seen = gel_indentation(*met, sensor, self.image_size, self.gel)
                if {"touch", "depth"} & in_gel:
                    with report.part(part):
                        gel = pressed_gel(indentation, draws.dwell, sensor, self.image_size, self.gel)
                        if "touch" in in_gel:
                            scene.touch[sensor.name] = self._touch(draws, gel, sensor)
                if "depth" in in_gel:
                    with report.part("depth"):
                        scene.depth[sensor.name] = self._pooled(gel.depth)
                if "attributes" in in_gel:
                    with report.part("attributes"):
                        scene.attributes[sensor.name] = contact_attributes(
                            indentation[:, seen, seen], sensor.field_of_view, draws.compliance
                        )
            if lifted:
                with report.part("grasp"):
                    share = contact_share(*met, chosen[0], self.image_size, self.gel)
                    grasps = grasp(draws.of_material("friction"), draws.weight, met[1], share)
                scene.grasp = grasps if "grasp" in modalities else None
            if "outcome" in modalities:
                with report.part("outcome"):
                    image = outcome_pictures(self.seed, draws, picture, grasps.held)
                    scene.outcome = Outcome(image, outcome_captions(draws, grasps.held, self.textures))
        if "audio" in modalities:
            with report.part("audio"):
                scene.audio = recorded(self.seed, draws.names(), impact_sounds(self.seed, draws))
        if "text" in modalities:
            with report.part("text"):
                scene.text = described(draws, self.textures)
        report.left_out = [part for part in PARTS if part not in report.seconds]
        if "surfaces" in report.seconds and "image" not in report.seconds:
            report.left_out.append("colours of surfaces")
        return scene

    def draw(self, material: Tensor, object_: Tensor, contact: Tensor) -> Draws:
        """Numbers of N contacts named by three int64 tensors (N,)."""
        return draw(self.seed, material, object_, contact, self.textures)

    def _picture(self, draws: Draws, built: Surfaces) -> Tensor:
        assert built.albedo is not None  # pictures are what surfaces are coloured for
        lit = (built.height, built.albedo, built.body, draws.light, draws.gloss)
        return pictures(*lit, self.image_size, draws.white, draws.camera)

    def _pooled(self, field: Tensor) -> Tensor:
        """A field over the gel's grid, (N, P, P), on pixels of the image."""
        return field if self.gel.refinement == 1 else F.avg_pool2d(field, self.gel.refinement)

    def _touch(self, draws: Draws, gel: PressedGel, sensor: Sensor) -> Tensor:
        """Touch images (N, 3, S, S) with the noise of the sensor's camera."""
        images = images_of_gel(gel, sensor, self.gel)
        if sensor.noise:
            shape = tuple(images.shape[1:])
            number = crc32(sensor.name.encode())
            for row, contact_name in enumerate(draws.names()):
                rng = generator(self.seed, SENSOR_STREAM, number, *contact_name)
                images[row] += sensor.noise * torch.from_numpy(rng.standard_normal(shape, dtype=np.float32))
        return images.clamp_(0.0, 1.0)


def _pressed(draws: Draws, height: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Heights (N, R, R), depths and compliances (N,) as gels meet them.

    Soft objects yield as two springs in a row do: all of their overlap with the gel shrinks alike.
    """
    stiff = 1.0 - YIELD * draws.compliance
    depth = draws.indentation_depth * stiff
    return height * stiff[:, None, None], depth, torch.zeros_like(depth)


def _sensors(sensors: Sequence[str | Sensor]) -> list[Sensor]:
    """Sensors by name, or as they are; every one once.

    Raises:
        InvalidInputError, InvalidTypeError: If there is none, a name is unknown, or two of one name differ.
    """
    if not isinstance(sensors, list | tuple) or not any(isinstance(sensor, Sensor) for sensor in sensors):
        found = [SENSORS[name] for name in check_choices("sensors", sensors, SENSORS)]
    else:
        named = [
            sensor if isinstance(sensor, Sensor) else SENSORS[check_choice("sensors", sensor, SENSORS)]
            for sensor in sensors
        ]
        found = list({sensor.name: sensor for sensor in named}.values())
        if len(found) < len(set(named)):
            raise InvalidInputError("`sensors` holds two sensors of one name; give each its own.")
    if not found:
        raise InvalidInputError("`sensors` is empty; name at least one, such as 'gelsight'.")
    return found


def _numbers(label: str, values: Sequence[int] | Tensor) -> Tensor:
    """One part of the contacts' names as int64 (N,)."""
    try:
        numbers = torch.as_tensor(values)
    except (TypeError, ValueError, RuntimeError) as error:
        raise InvalidTypeError(
            f"`{label}` cannot be read as integers ({first_line(error)}); pass one for each contact."
        ) from error
    if numbers.numel():
        check_dense(label, numbers, INTEGERS, "Pass one for each contact, such as [3].")
    if numbers.ndim != 1:
        raise InvalidInputError(
            f"`{label}` has shape {tuple(numbers.shape)}; it has to be (N,), one number for each contact, such as [3]."
        )
    return numbers.to(torch.int64)


def _check_names(names: list[Tensor]) -> None:
    lengths = [len(part) for part in names]
    if len(set(lengths)) != 1 or lengths[0] == 0:
        raise InvalidInputError(
            f"`material`, `object` and `contact` have {lengths} entries; they need the same number, at least one."
        )
    for label, part, last in zip(
        ("material", "object", "contact"), names, (len(MATERIALS) - 1, None, None), strict=True
    ):
        for end in (int(part.min()), int(part.max())):
            check_integer(label, end, 0, last)
