"""The world: names of contacts in, the modalities asked for out."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from unitouch_gen.world.captions import captions
from unitouch_gen.world.draws import SENSOR_STREAM, Draws, draw, generator
from unitouch_gen.world.fields import BASE_RESOLUTION
from unitouch_gen.world.gel import DEFAULT_GRID, GelGrid, contact_share
from unitouch_gen.world.materials import MATERIALS
from unitouch_gen.world.optics import pictures, touch_images
from unitouch_gen.world.report import RenderReport
from unitouch_gen.world.sensors import SENSORS
from unitouch_gen.world.sounds import impact_sounds
from unitouch_gen.world.surfaces import Surfaces, surfaces

MODALITIES: tuple[str, ...] = ("image", "touch", "audio", "text", "grasp")

PARTS: tuple[str, ...] = ("surfaces", "image", *(f"touch of {name}" for name in SENSORS), "grasp", "audio", "text")
"""What a request may leave out; only the draws are always made."""

NORMAL_FORCE = 12.0
"""Force on a gel in contact all over, N for each mm of depth: such that about two of three grasps hold."""


@dataclass(frozen=True)
class Style:
    """What a collection's own camera, room and gel add to every sample of it.

    Attributes:
        white: White balance of the pictures, factors on RGB.
        cast: Colour cast of the touch images, factors on RGB.
        markers: Whether the collection's gels carry printed markers.
        indentation_depth: Factor on the indentation depths of its contacts.

    Raises:
        ValueError: On a factor that is negative, NaN or infinite.
    """

    white: tuple[float, float, float] = (1.0, 1.0, 1.0)
    cast: tuple[float, float, float] = (1.0, 1.0, 1.0)
    markers: bool = False
    indentation_depth: float = 1.0

    def __post_init__(self) -> None:
        depth = (self.indentation_depth,)
        for label, factors in (("white", self.white), ("cast", self.cast), ("indentation_depth", depth)):
            if not all(0.0 <= factor < math.inf for factor in factors):
                raise ValueError(f"`{label}` is {getattr(self, label)}; factors have to be finite and at least 0.")


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
class Scene:
    """The modalities that were asked for; the others stay `None`.

    Attributes:
        material, object, contact: Names of the N contacts, int64 (N,).
        image: Pictures in [0, 1], (N, 3, S, S).
        touch: By sensor, touch images in [0, 1], (N, 3, S, S).
        audio: Impact sounds in [-1, 1] at 16 kHz, (N, T).
        text: Captions, N strings.
        grasp: Grasp outcomes.
        report: Seconds that each part took, and what was left out.
    """

    material: Tensor
    object: Tensor
    contact: Tensor
    image: Tensor | None = None
    touch: dict[str, Tensor] = field(default_factory=dict)
    audio: Tensor | None = None
    text: list[str] | None = None
    grasp: Grasp | None = None
    report: RenderReport = field(default_factory=RenderReport)


class World:
    """A procedural visuo-tactile world, deterministic by seed.

    Args:
        seed: Of the whole world; other seeds have other objects.
        image_size: Side of pictures and touch images, pixels.
        resolution: Side of the height fields, pixels over 32 mm; a multiple of `image_size` and at least 128.
        gel: On which grid gels are solved; finer touch images need a finer `resolution` and a finer gel.

    Example:
        >>> scene = World(seed=0).render([0, 4], object=[1, 1], contact=[0, 0], modalities=("touch", "text"))
        >>> scene.touch["gelsight"].shape, scene.image is None
        (torch.Size([2, 3, 64, 64]), True)
    """

    def __init__(
        self,
        seed: int = 0,
        *,
        image_size: int = 64,
        resolution: int = BASE_RESOLUTION,
        gel: GelGrid = DEFAULT_GRID,
    ):
        if image_size < 1:
            raise ValueError(f"`image_size` is {image_size}; it has to be at least 1.")
        if seed < 0:
            raise ValueError(f"`seed` is {seed}; it has to be at least 0.")
        if resolution < BASE_RESOLUTION or resolution % image_size:
            raise ValueError(
                f"`resolution` is {resolution}; it has to be at least {BASE_RESOLUTION} and a multiple of "
                f"`image_size` ({image_size})."
            )
        self.seed = seed
        self.image_size = image_size
        self.resolution = resolution
        self.gel = gel

    @torch.no_grad()
    def render(
        self,
        material: Sequence[int] | Tensor,
        object: Sequence[int] | Tensor,
        contact: Sequence[int] | Tensor,
        *,
        modalities: Iterable[str] = ("image", "touch", "audio", "text"),
        sensors: Sequence[str] = ("gelsight",),
        style: Style | None = None,
    ) -> Scene:
        """Renders N contacts in the modalities and sensors asked for, and computes nothing else.

        Args:
            material: Indices into `MATERIAL_NAMES`, (N,).
            object: Number of the object within its material, >= 0, (N,).
            contact: Number of the contact on its object, >= 0, (N,).
            modalities: Some of "image", "touch", "audio", "text", "grasp".
            sensors: Names in `SENSORS`; only read for touch and grasp (grasp uses the first).
            style: Of the collection; neutral when left out.

        Raises:
            TypeError: If the contacts' names are no integers.
            ValueError: On an unknown modality, sensor or material, or names that are not (N,) or differ in length.
        """
        modalities, style = tuple(modalities), style or Style()
        names = [_numbers("material", material), _numbers("object", object), _numbers("contact", contact)]
        _check_request(names, modalities, sensors)
        report = RenderReport(contacts=len(names[0]))
        scene = Scene(material=names[0], object=names[1], contact=names[2], report=report)
        with report.part("draws"):
            draws = draw(self.seed, *names)
            draws.indentation_depth = draws.indentation_depth * style.indentation_depth
        if {"image", "touch", "grasp"} & set(modalities):
            with report.part("surfaces"):
                built = surfaces(self.seed, draws, self.resolution, coloured="image" in modalities)
            if "image" in modalities:
                with report.part("image"):
                    scene.image = self._pictures(draws, built, style)
            if "touch" in modalities:
                for name in sensors:
                    with report.part(f"touch of {name}"):
                        scene.touch[name] = self._touch(draws, built, name, style)
            if "grasp" in modalities:
                with report.part("grasp"):
                    scene.grasp = self._grasp(draws, built, sensors[0])
        if "audio" in modalities:
            with report.part("audio"):
                scene.audio = impact_sounds(self.seed, draws)
        if "text" in modalities:
            with report.part("text"):
                scene.text = captions(draws)
        report.left_out = [part for part in PARTS if part not in report.seconds]
        if "surfaces" in report.seconds and "image" not in modalities:
            report.left_out.append("colours of surfaces")
        return scene

    def _pictures(self, draws: Draws, built: Surfaces, style: Style) -> Tensor:
        assert built.albedo is not None  # pictures are what surfaces are coloured for
        gloss = _of_material("gloss", draws)
        return pictures(
            built.height, built.albedo, built.body, draws.light, gloss, self.image_size, torch.tensor(style.white)
        )

    def _touch(self, draws: Draws, built: Surfaces, name: str, style: Style) -> Tensor:
        sensor = SENSORS[name]
        images = touch_images(
            built.height,
            draws.indentation_depth,
            draws.dwell,
            _of_material("compliance", draws),
            sensor,
            self.image_size,
            cast=torch.tensor(style.cast),
            markers=style.markers,
            grid=self.gel,
        )
        if sensor.noise:
            shape = tuple(images.shape[1:])
            number = list(SENSORS).index(name)
            for row, contact in enumerate(zip(*(part.tolist() for part in _names(draws)), strict=True)):
                rng = generator(self.seed, SENSOR_STREAM, number, *contact)
                images[row] += sensor.noise * torch.from_numpy(rng.standard_normal(shape, dtype=np.float32))
        return images.clamp_(0.0, 1.0)

    def _grasp(self, draws: Draws, built: Surfaces, name: str) -> Grasp:
        compliance = _of_material("compliance", draws)
        contact = contact_share(
            built.height, draws.indentation_depth, compliance, SENSORS[name], self.image_size, self.gel
        )
        return grasp(_of_material("friction", draws), draws.weight, draws.indentation_depth, contact)


def _names(draws: Draws) -> tuple[Tensor, Tensor, Tensor]:
    return draws.material, draws.object, draws.contact


def _of_material(number: str, draws: Draws) -> Tensor:
    """One number of each contact's material, (N,)."""
    return torch.tensor([getattr(MATERIALS[index], number) for index in draws.material.tolist()])


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
        raise TypeError(f"`{label}` cannot be read as integers ({error}); pass one for each contact.") from error
    if numbers.ndim != 1:
        raise ValueError(
            f"`{label}` has shape {tuple(numbers.shape)}; it has to be (N,), one number for each contact, such as [3]."
        )
    if len(numbers) and (numbers.is_floating_point() or numbers.is_complex() or numbers.dtype == torch.bool):
        raise TypeError(f"`{label}` holds {numbers.dtype} values; it has to hold integers, one for each contact.")
    return numbers.to(torch.int64)


def _check_request(names: list[Tensor], modalities: tuple[str, ...], sensors: Sequence[str]) -> None:
    lengths = [len(part) for part in names]
    if len(set(lengths)) != 1 or lengths[0] == 0:
        raise ValueError(
            f"`material`, `object` and `contact` have {lengths} entries; they need the same number, at least one."
        )
    for modality in modalities:
        if modality not in MODALITIES:
            raise ValueError(f"`modalities` holds {modality!r}; it may hold {', '.join(MODALITIES)}.")
    if isinstance(sensors, str) or not sensors:
        raise ValueError(f"`sensors` is {sensors!r}; it has to be a sequence of names such as {('gelsight',)!r}.")
    for name in sensors:
        if name not in SENSORS:
            raise ValueError(f"`sensors` holds {name!r}; the world has {', '.join(SENSORS)}.")
    if names[0].min() < 0 or names[0].max() >= len(MATERIALS):
        raise ValueError(f"`material` holds {names[0].tolist()}; indices run from 0 to {len(MATERIALS) - 1}.")
    for label, part in zip(("object", "contact"), names[1:], strict=True):
        if part.min() < 0:
            raise ValueError(f"`{label}` holds {part.min().item()}; numbers start at 0.")
