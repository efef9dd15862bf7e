"""The random numbers of objects and contacts, drawn from their identity alone.

A touch tells the material as a real one does: four of five contacts are at a face that fills the gel, and every
object wears its own material's relief or a scan of it. A contact is named by (material, object, contact). Its numbers
come from `numpy.random.SeedSequence` over that name and the world's seed, so a scene is the same alone, in a batch, on
another day and another machine.

Objects of the splits "val" and "test" are held out and in the ranges of those to train on; those of "beyond" have
lengths and heights outside of these ranges. Each split has scanned materials of its own.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.constants import g as STANDARD_GRAVITY
from torch import Tensor

from unitouch_gen.world.grids import PATCH_MM
from unitouch_gen.world.materials import MATERIALS
from unitouch_gen.world.textures import TextureLibrary

OBJECT_STREAM, CONTACT_STREAM, RELIEF_STREAM, SOUND_STREAM = range(4)
SENSOR_STREAM, DRAWN_SENSOR_STREAM, ROOM_STREAM, GRASP_STREAM = range(4, 8)
"""First numbers of the random streams' names."""

MODES = 14
"""Partials of each object's sound."""

SHAPES: dict[str, float] = {
    "flat": 0.80, "ball": 0.03, "rod": 0.04, "blob": 0.04, "edge": 0.03, "corner": 0.02, "box": 0.02, "coin": 0.01,
    "ring": 0.01,
}  # fmt: skip
"""Shapes that contacts are at, and how often."""

FIRST_OBJECT: dict[str, int] = {"train": 0, "val": 500, "test": 600, "beyond": 800}
"""The first object of each split, within each thousand. Those of "beyond" are larger or smaller, in every length and
height, than all others."""

TINGE = 0.1
"""Deviation of the logarithm of each of a colour's parts: dark rubber stays dark, and grass green."""


def generator(seed: int, *name: int) -> np.random.Generator:
    """The random stream that belongs to a name."""
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence((seed, *name))))


def log_uniform(rng: np.random.Generator, low: float, high: float, beyond: bool = False) -> float:
    """A number uniform in its logarithm, or up to 1.5 times beyond the range."""
    if not beyond:
        return float(np.exp(rng.uniform(math.log(low), math.log(high))))
    out = float(np.exp(rng.uniform(0.05, math.log(1.5))))
    return high * out if rng.uniform() < 0.5 else low / out


@dataclass
class Draws:
    """Numbers of N contacts; every tensor has N as its first dimension."""

    material: Tensor  # the contacts' names, int64
    object: Tensor
    contact: Tensor
    texture: Tensor  # index of the scanned material in the library, -1 for the material's own relief
    texture_side: Tensor  # millimetres that its maps stand for, along a side
    relief: Tensor  # standard deviation of its heights, mm
    shade: Tensor  # three numbers in [0, 1) that shade its colours, (N, 3)
    scale: Tensor  # the object's factor on lengths of its material's relief
    amplitude: Tensor  # and on heights
    compliance: Tensor  # 0 for rigid, 1 for as soft as the gel
    gloss: Tensor  # weight of the highlight
    colour: Tensor  # linear RGB of the object, (N, 3)
    size: Tensor  # side of a cube of the object's volume, mm
    weight: Tensor  # newton: its material and its size, which its pitch tells in part, say most of it
    cell_seed: Tensor  # seeds the cells of the relief
    angle: Tensor  # direction of the grain in the picture, radians
    offset: Tensor  # place on the object where it is touched, mm, (N, 2)
    shape: Tensor  # index into `SHAPES`
    shape_angle: Tensor  # pose of the body, radians
    shape_offset: Tensor  # and mm, (N, 2)
    shape_radius: Tensor  # its size, mm
    proportions: Tensor  # three numbers in [0, 1) that pick the body's, (N, 3)
    tilt: Tensor  # slopes of the object's face against the gel, (N, 2)
    indentation_depth: Tensor  # depth that the sensor is pushed beyond first contact, mm
    dwell: Tensor  # time between contact and exposure, s
    light: Tensor  # direction toward the light, unit vectors, (N, 3)
    white: Tensor  # white balance of the picture, factors on RGB, (N, 3)
    camera: Tensor  # side of what it shows, mm
    pitch: Tensor  # the object's factors on its modal frequencies, (N, 14)
    inharmonicity: Tensor  # as a `Material` has it, and so the next four
    decay: Tensor
    noise: Tensor
    noise_centre: Tensor
    grains: Tensor
    strike: Tensor  # hardness of the impact that sounds, [0, 1]
    place: Tensor  # where on the object it falls, [0, 1)
    wording: Tensor  # picks the caption's words, (N, 2) in [0, 1)

    def __len__(self) -> int:
        return len(self.material)

    def names(self) -> list[tuple[int, int, int]]:
        """(material, object, contact) of each."""
        return list(zip(self.material.tolist(), self.object.tolist(), self.contact.tolist(), strict=True))

    def of_material(self, number: str) -> Tensor:
        """A field of `Material`, such as "friction", of each contact, float32 (N,)."""
        return torch.tensor([getattr(MATERIALS[index], number) for index in self.material.tolist()])


def split_of(object_: int) -> str:
    """The split that an object's number puts it in."""
    return [split for split, first in FIRST_OBJECT.items() if object_ % 1000 >= first][-1]


def draw(
    seed: int, material: Tensor, object_: Tensor, contact: Tensor, textures: TextureLibrary | None = None
) -> Draws:
    """Draws the numbers of N contacts named by three int64 tensors (N,)."""
    names = zip(material.tolist(), object_.tolist(), contact.tolist(), strict=True)
    scans = {} if textures is None else textures.by_split
    scans = {**scans, "beyond": scans.get("test", {})}
    rows = [_draw_one(seed, *name, scans.get(split_of(name[1]), {})) for name in names]
    columns = {key: torch.from_numpy(np.stack([row[key] for row in rows])) for key in rows[0]}
    return Draws(material=material, object=object_, contact=contact, **columns)


def _draw_one(seed: int, material: int, object_: int, contact: int, scans: dict[str, list[int]]) -> dict[str, Any]:
    spec = MATERIALS[material]
    of_object = generator(seed, OBJECT_STREAM, material, object_)
    of_contact = generator(seed, CONTACT_STREAM, material, object_, contact)
    beyond = split_of(object_) == "beyond"
    scanned = scans.get(spec.name, [])
    texture, which = -1, of_object.integers(1 << 30)
    if scanned and of_object.uniform() < 0.45:
        texture = scanned[which % len(scanned)]
    base = np.asarray(spec.colours[of_object.integers(len(spec.colours))])
    colour = base * of_object.uniform(0.65, 1.35) * np.exp(of_object.normal(0.0, TINGE, 3))
    tilt, turn = of_contact.uniform(0.35, 1.2), of_contact.uniform(-np.pi, np.pi)
    row: dict[str, Any] = {
        "texture": texture,
        "texture_side": log_uniform(of_object, 20.0, 60.0, beyond),
        "relief": log_uniform(of_object, 0.1, 0.4, beyond),
        "shade": of_object.uniform(size=3),
        "scale": log_uniform(of_object, 0.7, 1.45, beyond),
        "amplitude": log_uniform(of_object, 0.85, 1.8, beyond),
        "compliance": np.clip(spec.compliance + of_object.normal(0.0, 0.1), 0.0, 0.9),
        "gloss": np.clip(spec.gloss * of_object.uniform(0.5, 1.3), 0.0, 1.0),
        "colour": np.clip(colour, 0.02, 0.98),
        "weight": of_object.uniform(0.8, 1.25),  # of what density and size make
        "cell_seed": of_object.integers(1, 4096),
        "angle": of_object.uniform(-np.pi, np.pi) + of_contact.uniform(-np.pi, np.pi),
        "offset": of_contact.uniform(-60.0, 60.0, 2),
        "shape": of_contact.choice(len(SHAPES), p=np.array(list(SHAPES.values())) / sum(SHAPES.values())),
        "shape_angle": of_contact.uniform(-np.pi, np.pi),
        "shape_offset": of_contact.uniform(-3.5, 3.5, 2),
        "shape_radius": log_uniform(of_contact, 3.0, 12.0),
        "proportions": of_contact.uniform(size=3),
        "tilt": of_contact.uniform(-0.012, 0.012, 2),
        "indentation_depth": log_uniform(of_contact, 0.8, 2.5),
        "dwell": of_contact.uniform(0.15, 1.0),
        "light": np.asarray([np.cos(turn) * np.cos(tilt), np.sin(turn) * np.cos(tilt), np.sin(tilt)]),
        "white": of_contact.uniform(0.87, 1.15, 3),
        "place": of_contact.uniform(),
        "wording": of_contact.uniform(size=2),
    }
    # Whole bodies sound as high as they are small.
    radius = None if list(SHAPES)[row["shape"]] in ("flat", "edge", "corner") else row["shape_radius"]
    framed = of_contact.uniform(2.5, 5.0)  # how many of its radii a picture of a body is wide
    row["camera"] = PATCH_MM * framed / 5.0 if radius is None else np.clip(radius * framed, 12.0, PATCH_MM)
    row |= _draw_sound(seed, (material, object_, contact), row["compliance"], radius)
    row["weight"] *= spec.density * STANDARD_GRAVITY * (row["size"] / 100.0) ** 3  # a dm is 100 mm
    whole = {"texture": np.int64, "shape": np.int64}
    return {key: np.asarray(value, dtype=whole.get(key, np.float32)) for key, value in row.items()}


def _draw_sound(seed: int, name: tuple[int, int, int], compliance: float, radius: float | None) -> dict[str, Any]:
    """How a contact sounds: as its material on the whole, but sizes, hardness and build of objects differ more.

    How much each number varies is chosen, not measured. Large objects sound lower, as the frequencies of bodies of one
    shape are as one over their size; small bodies sound higher, and soft ones duller and shorter.
    """
    spec = MATERIALS[name[0]]
    of_object, of_contact = generator(seed, ROOM_STREAM, *name[:2]), generator(seed, ROOM_STREAM, *name)
    softer = compliance - spec.compliance
    pitch = log_uniform(of_object, 0.6, 1.6)
    size = 50.0 / pitch  # side of a cube, mm
    if radius is not None:
        pitch *= (6.0 / radius) ** 0.2
    pitch = min(max(pitch, 40.0 / spec.fundamental), 5000.0 / spec.fundamental)  # fundamentals of 40 to 5000 Hz
    share = of_object.normal(math.log((spec.noise + 0.02) / (1.02 - spec.noise)), 0.5)
    return {
        "size": size,
        "pitch": pitch * np.exp(of_object.normal(0.0, 0.04, MODES)),
        "inharmonicity": np.clip(spec.inharmonicity + of_object.normal(0.0, 0.12), 1.0, 2.3),
        # The loss factor is the material's, so what sounds higher fades faster (Wildes and Richards, 1988).
        "decay": spec.decay * pitch * log_uniform(of_object, 0.6, 1.7) * math.exp(2.0 * softer),
        "noise": 1.0 / (1.0 + math.exp(-share)),
        "noise_centre": np.clip(spec.noise_centre * log_uniform(of_object, 0.65, 1.5), 200.0, 7000.0),
        "grains": spec.grains * log_uniform(of_object, 0.5, 2.0),
        "strike": of_contact.uniform(0.15, 1.0) * (1.0 - 0.5 * compliance),
    }
