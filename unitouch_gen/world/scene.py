"""The world: names of contacts in, the modalities asked for out."""

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
    check_flag,
    check_integer,
    check_kind,
    check_number,
    describe,
    first_line,
)
from unitouch_gen.world.attributes import contact_attributes
from unitouch_gen.world.draws import SENSOR_STREAM, Draws, draw, generator
from unitouch_gen.world.gel import DEFAULT_GRID, LARGEST_GRID, GelGrid
from unitouch_gen.world.materials import MATERIALS, SHAPE_NAMES
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

MODALITIES: tuple[str, ...] = ("image", "touch", "depth", "audio", "text", "grasp", "attributes")

PARTS: tuple[str, ...] = (
    "surfaces",
    "image",
    *(f"touch of {name}" for name in SENSORS),
    "depth",
    "attributes",
    "grasp",
    "audio",
    "text",
)
"""What rendering consists of, in order."""

NORMAL_FORCE = 12.0
"""Force on a gel in contact all over, N for each mm of depth: such that about two of three grasps hold."""


DEEPEST = 5.0
"""Factor on indentation depths that leaves three quarters of the contrast; 10 leaves a third, and 20 nothing, as a gel
is as thick as it is, and pressed flat all over."""

BRIGHTEST = 1e3
"""Factor on a colour; at a tenth of it, all but black is white."""


@dataclass(frozen=True)
class Style:
    """What a collection's own camera, room and gel add to every sample of it.

    Attributes:
        white: White balance of the pictures, factors on RGB.
        cast: Colour cast of the touch images, factors on RGB.
        markers: Whether the collection's gels carry printed markers.
        indentation_depth: Factor on the indentation depths of its contacts, up to 5: deeper, less is to be seen.

    Raises:
        InvalidInputError, InvalidTypeError: On a factor that is negative, NaN, infinite or too large, or what is none.
    """

    white: tuple[float, float, float] = (1.0, 1.0, 1.0)
    cast: tuple[float, float, float] = (1.0, 1.0, 1.0)
    markers: bool = False
    indentation_depth: float = 1.0

    def __post_init__(self) -> None:
        for label in ("white", "cast"):
            factors = getattr(self, label)
            if not isinstance(factors, list | tuple) or len(factors) != 3:
                raise InvalidTypeError(f"`{label}` is {describe(factors)}; it has to be three factors, on RGB.")
            colour = tuple(check_number(label, factor, 0.0, BRIGHTEST) for factor in factors)
            object.__setattr__(self, label, colour)
        check_flag("markers", self.markers)
        depth = check_number("indentation_depth", self.indentation_depth, 0.0, DEEPEST)
        object.__setattr__(self, "indentation_depth", depth)


@dataclass
class Grasp:
    """Whether a two-finger grasp at the contact lifts the object.

    Attributes:
        held: True where friction carries the weight, (N,).
        contact: Share of the gel in contact, (N,).
        margin: Carried over needed force; above 1 the object is held, (N,).
    """

    held: Tensor
    contact: Tensor
    margin: Tensor


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
        grasp: Grasp outcomes.
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
    attributes: dict[str, Tensor] = field(default_factory=dict)
    report: RenderReport = field(default_factory=RenderReport)


class World:
    """A procedural visuo-tactile world, deterministic by seed.

    Args:
        seed: Names the whole world; other seeds have other objects.
        image_size: Side of pictures and touch images, pixels.
        resolution: Side of the height fields, pixels over 32 mm; a multiple of `image_size` and at least 128.
        gel: Grid on which gels are solved; finer touch images need a finer `resolution` and a finer gel.

    Raises:
        InvalidInputError, InvalidTypeError: On a number out of range, or what is none.

    Example:
        >>> scene = World(seed=0).render([0, 4], object=[1, 1], contact=[0, 0], modalities=("touch", "text"))
        >>> scene.touch["gelsight"].shape, scene.image is None
        (torch.Size([2, 3, 64, 64]), True)
    """

    def __init__(
        self, seed: int = 0, *, image_size: int = 64, resolution: int = BASE_RESOLUTION, gel: GelGrid = DEFAULT_GRID
    ):
        self.image_size = check_integer("image_size", image_size, 1, LARGEST_GRID)
        self.seed = check_integer("seed", seed, 0)
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
        style: Style | None = None,
    ) -> Scene:
        """Renders N contacts in the modalities and sensors asked for, and computes nothing else.

        Args:
            material: Indices into `MATERIAL_NAMES`, (N,).
            object: Number of the object within its material, >= 0, (N,).
            contact: Number of the contact on its object, >= 0, (N,).
            modalities: Some of "image", "touch", "depth", "audio", "text", "grasp", "attributes".
            sensors: Names in `SENSORS`, or sensors; only read for touch, depth, attributes and grasp (which uses the
                first).
            style: What a collection adds; nothing when left out.

        Raises:
            InvalidTypeError: If names of contacts are no integers, modalities or sensors no list, or the style is none.
            InvalidInputError: On an unknown modality, sensor or material, or names that are not (N,), or not as many.
        """
        style = Style() if style is None else check_kind("style", style, Style)
        modalities, chosen = check_choices("modalities", modalities, MODALITIES), _sensors(sensors)
        names = [_numbers("material", material), _numbers("object", object), _numbers("contact", contact)]
        _check_names(names)
        report = RenderReport(contacts=len(names[0]))
        with report.part("draws"):
            draws = self.draw(*names)
            draws.indentation_depth = draws.indentation_depth * style.indentation_depth
        scene = Scene(material=draws.material, object=draws.object, contact=draws.contact, report=report)
        if {"image", "touch", "depth", "grasp", "attributes"} & set(modalities):
            with report.part("surfaces"):
                built = self._surfaces(draws, coloured="image" in modalities)
            if "image" in modalities:
                with report.part("image"):
                    scene.image = self._picture(draws, built, style)
            met = self._pressed(draws, built.height)
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
                            scene.touch[sensor.name] = self._touch(draws, gel, sensor, style)
                if "depth" in in_gel:
                    with report.part("depth"):
                        scene.depth[sensor.name] = self._pooled(gel.depth)
                if "attributes" in in_gel:
                    with report.part("attributes"):
                        scene.attributes[sensor.name] = contact_attributes(
                            indentation[:, seen, seen], sensor.field_of_view, draws.number("compliance")
                        )
            if "grasp" in modalities:
                with report.part("grasp"):
                    share = contact_share(*met, chosen[0], self.image_size, self.gel)
                    scene.grasp = grasp(draws.number("friction"), draws.weight, met[1], share)
        if "audio" in modalities:
            with report.part("audio"):
                scene.audio = self._sounds(draws)
        if "text" in modalities:
            with report.part("text"):
                scene.text = self._captions(draws)
        report.left_out = [part for part in PARTS if part not in report.seconds]
        if "surfaces" in report.seconds and "image" not in modalities:
            report.left_out.append("colours of surfaces")
        return scene

    def draw(self, material: Tensor, object_: Tensor, contact: Tensor) -> Draws:
        """Numbers of N contacts named by three int64 tensors (N,)."""
        return draw(self.seed, material, object_, contact)

    def _surfaces(self, draws: Draws, *, coloured: bool) -> Surfaces:
        return surfaces(self.seed, draws, self.resolution, coloured=coloured)

    def _pressed(self, draws: Draws, height: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Heights (N, R, R), depths and compliances (N,) as gels meet them."""
        return height, draws.indentation_depth, draws.number("compliance")

    def _picture(self, draws: Draws, built: Surfaces, style: Style) -> Tensor:
        assert built.albedo is not None  # pictures are what surfaces are coloured for
        gloss, white, side = self._look(draws)
        white = torch.tensor(style.white) * white
        return pictures(built.height, built.albedo, built.body, draws.light, gloss, self.image_size, white, side)

    def _look(self, draws: Draws) -> tuple[Tensor, Tensor, Tensor | None]:
        """Gloss (N,) of the objects, the camera's white balance, (3,) or (N, 3), and the side of what it sees, mm,
        (N,), if that is not all of the surface."""
        return draws.number("gloss"), torch.ones(3), None

    def _sounds(self, draws: Draws) -> Tensor:
        return impact_sounds(self.seed, draws)

    def _captions(self, draws: Draws) -> list[str]:
        return captions(draws)

    def _pooled(self, field: Tensor) -> Tensor:
        """A field over the gel's grid, (N, P, P), on pixels of the image."""
        return field if self.gel.refinement == 1 else F.avg_pool2d(field, self.gel.refinement)

    def _touch(self, draws: Draws, gel: PressedGel, sensor: Sensor, style: Style) -> Tensor:
        """Touch images (N, 3, S, S) with the noise of the sensor's camera."""
        images = images_of_gel(gel, sensor, self.gel, cast=torch.tensor(style.cast), markers=style.markers)
        if sensor.noise:
            shape = tuple(images.shape[1:])
            names = list(SENSORS)
            number = names.index(sensor.name) if sensor.name in names else crc32(sensor.name.encode())
            for row, contact_name in enumerate(draws.names()):
                rng = generator(self.seed, SENSOR_STREAM, number, *contact_name)
                images[row] += sensor.noise * torch.from_numpy(rng.standard_normal(shape, dtype=np.float32))
        return images.clamp_(0.0, 1.0)


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


def grasp(friction: Tensor, weight: Tensor, indentation_depth: Tensor, contact: Tensor) -> Grasp:
    """Coulomb: two fingers carry 2 mu F, with a normal force F that grows with depth (mm) and contact share."""
    force = NORMAL_FORCE * indentation_depth * contact
    margin = 2.0 * friction * force / weight
    return Grasp(held=margin > 1.0, contact=contact, margin=margin)


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


# Captions -------------------------------------------------------------------------------------------------------------

TEMPLATES: tuple[str, ...] = (
    "a photo of {feel} {colour} {material}, {shape}",
    "{feel} {colour} {material}, {shape}",
    "a picture of {colour} {material} that feels {feel}",
    "this feels like {feel} {material}",
    "{colour} {material}, {size} and {feel}, {shape}",
    "this looks like {colour} {material}",
    "touch of {feel} {material}",
    "{material}",
)

COLOURS: dict[str, tuple[float, float, float]] = {
    "black": (0.08, 0.08, 0.08), "dark grey": (0.25, 0.25, 0.25), "grey": (0.5, 0.5, 0.5), "white": (0.9, 0.9, 0.9),
    "red": (0.75, 0.18, 0.15), "orange": (0.8, 0.5, 0.2), "yellow": (0.9, 0.8, 0.2), "green": (0.3, 0.5, 0.15),
    "teal": (0.25, 0.55, 0.55), "blue": (0.18, 0.3, 0.75), "pink": (0.75, 0.25, 0.45), "brown": (0.4, 0.25, 0.14),
    "beige": (0.78, 0.68, 0.5), "pale blue": (0.62, 0.74, 0.86),
}  # fmt: skip

SHAPES: dict[str, str] = {
    "flat": "a flat face", "edge": "an edge", "corner": "a corner", "bump": "a round bump", "cylinder": "a cylinder",
}  # fmt: skip


def colour_name(rgb: Tensor) -> str:
    """The nearest of the fourteen colour words to a linear RGB triple."""
    value = rgb.tolist()
    return min(COLOURS, key=lambda name: sum((a - b) ** 2 for a, b in zip(COLOURS[name], value, strict=True)))


def captions(draws: Draws) -> list[str]:
    """One sentence a contact, worded by what the draws say."""
    return [_caption(draws, row) for row in range(len(draws))]


def _caption(draws: Draws, row: int) -> str:
    material = MATERIALS[int(draws.material[row])]
    which_template, which_feel = draws.wording[row].tolist()
    scale = draws.scale[row].item()
    return TEMPLATES[int(which_template * len(TEMPLATES))].format(
        material=material.name,
        feel=material.feel[int(which_feel * len(material.feel))],
        colour=colour_name(draws.colour[row]),
        size="fine" if scale < 0.95 else "coarse" if scale > 1.08 else "medium",
        shape=SHAPES[SHAPE_NAMES[int(draws.shape[row])]],
    )
