"""The random numbers of objects and contacts, functions of their names alone.

A contact is named by (material, object, contact). Its numbers come from `numpy.random.SeedSequence` over that name and
the world's seed, so a scene is the same alone, in a batch, on another day and another machine.

Objects of the splits "val" and "test" are held out; their numbers are in the ranges of the training split. Objects of
"beyond" have lengths and heights outside of these ranges.
"""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from scipy.constants import g as STANDARD_GRAVITY
from torch import Tensor

from unitouch_gen.world.grids import PATCH_MM
from unitouch_gen.world.materials import MATERIALS

OBJECT_STREAM, CONTACT_STREAM, RELIEF_STREAM, SOUND_STREAM = range(4)  # first numbers of the streams' names
SENSOR_STREAM, DRAWN_SENSOR_STREAM, ROOM_STREAM = range(4, 7)
SCAN_STREAM, CAMERA_STREAM, RECORDING_STREAM = range(7, 10)

MODES = 14  # partials of an object's sound

SHAPES: dict[str, float] = {
    "flat": 0.80,
    "ball": 0.03,
    "rod": 0.04,
    "blob": 0.04,
    "edge": 0.03,
    "corner": 0.02,
    "box": 0.02,
    "coin": 0.01,
    "ring": 0.01,
}
"""Frequencies of shapes. Four of five contacts are on a face that fills the gel, as real touches are."""

FIRST_OBJECT: dict[str, int] = {"train": 0, "val": 500, "test": 600, "beyond": 800}
"""The first object of each split, in each thousand of objects."""


def generator(seed: int, *name: int) -> np.random.Generator:
    """The random stream of a name."""
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence((seed, *name))))


def log_uniform(rng: np.random.Generator, low: float, high: float, beyond: bool = False) -> float:
    """A number uniform in its logarithm, or with `beyond` up to a factor of 1.5 outside of the range."""
    if not beyond:
        return float(np.exp(rng.uniform(math.log(low), math.log(high))))
    factor = float(np.exp(rng.uniform(0.05, math.log(1.5))))
    return high * factor if rng.uniform() < 0.5 else low / factor


class Draws(SimpleNamespace):
    """Numbers of N contacts, each a tensor with N as its first dimension.

    `material`, `object` and `contact`, int64, are the contacts' names. `surface` is the number of the scanned surface
    of an object, -1 for a drawn one; see `with_scans`. `_draw_one` describes the others and how they vary.
    """

    def __len__(self) -> int:
        return len(self.material)

    def but(self, **changes: Tensor) -> "Draws":
        """A copy with other values of some numbers."""
        return Draws(**vars(self) | changes)

    def names(self) -> list[tuple[int, int, int]]:
        """(material, object, contact) of each contact."""
        return list(zip(self.material.tolist(), self.object.tolist(), self.contact.tolist(), strict=True))

    def of_material(self, number: str) -> Tensor:
        """A field of `Material`, such as "friction", of each contact, float32 (N,)."""
        return torch.tensor([getattr(MATERIALS[index], number) for index in self.material.tolist()])


def draw(seed: int, material: Tensor, object_: Tensor, contact: Tensor) -> Draws:
    """Draws the numbers of N contacts named by three int64 tensors (N,)."""
    names = zip(material.tolist(), object_.tolist(), contact.tolist(), strict=True)
    rows = [_draw_one(seed, *name) for name in names]
    columns = {key: torch.from_numpy(np.stack([row[key] for row in rows])) for key in rows[0]}
    surface = torch.full_like(material, -1)
    return Draws(material=material, object=object_, contact=contact, surface=surface, **columns)


def _draw_one(seed: int, material: int, object_: int, contact: int) -> dict[str, Any]:
    spec = MATERIALS[material]
    of_object = generator(seed, OBJECT_STREAM, material, object_)
    of_contact = generator(seed, CONTACT_STREAM, material, object_, contact)
    beyond = object_ % 1000 >= FIRST_OBJECT["beyond"]
    of_object.integers(1 << 30)  # an unused draw, kept so that released worlds reproduce
    base = np.asarray(spec.colours[of_object.integers(len(spec.colours))])
    colour = base * of_object.uniform(0.65, 1.35) * np.exp(of_object.normal(0.0, 0.1, 3))  # keeps dark colours dark
    of_object.uniform(size=7 if beyond else 5)  # unused draws, kept so that released worlds reproduce
    tilt = of_contact.uniform(0.35, 1.2)
    turn = of_contact.uniform(-np.pi, np.pi)
    row: dict[str, Any] = {
        "scale": log_uniform(of_object, 0.7, 1.45, beyond),  # factor on lengths of the material's relief
        "amplitude": log_uniform(of_object, 0.85, 1.8, beyond),  # factor on its heights
        "compliance": np.clip(spec.compliance + of_object.normal(0.0, 0.1), 0.0, 0.9),  # 1 for as soft as the gel
        "gloss": np.clip(spec.gloss * of_object.uniform(0.5, 1.3), 0.0, 1.0),  # weight of the highlight
        "colour": np.clip(colour, 0.02, 0.98),  # linear RGB
        "weight": of_object.uniform(0.8, 1.25),  # factor on the weight by density and size, see below
        "cell_seed": of_object.integers(1, 4096),  # seed of the relief's cells
        "angle": of_object.uniform(-np.pi, np.pi) + of_contact.uniform(-np.pi, np.pi),  # of the grain in the picture
        "offset": of_contact.uniform(-60.0, 60.0, 2),  # place of the contact on the object, mm
        "shape": of_contact.choice(len(SHAPES), p=np.array(list(SHAPES.values())) / sum(SHAPES.values())),
        "shape_angle": of_contact.uniform(-np.pi, np.pi),  # direction of the body
        "shape_offset": of_contact.uniform(-3.5, 3.5, 2),  # place of the body, mm
        "shape_radius": log_uniform(of_contact, 3.0, 12.0),  # size of the body, mm
        "proportions": of_contact.uniform(size=3),  # numbers that set the body's proportions
        "tilt": of_contact.uniform(-0.012, 0.012, 2),  # slopes of the object's face against the gel
        "indentation_depth": log_uniform(of_contact, 0.8, 2.5),  # mm beyond first contact
        "dwell": of_contact.uniform(0.15, 1.0),  # time between contact and exposure, s
        "light": np.asarray(  # unit vector toward the lamp
            [np.cos(turn) * np.cos(tilt), np.sin(turn) * np.cos(tilt), np.sin(tilt)]
        ),
        "white": of_contact.uniform(0.87, 1.15, 3),  # white balance of the picture, factors on RGB
        "place": of_contact.uniform(),  # place on the object of the impact that sounds
        "wording": of_contact.uniform(size=2),  # chooses the words of the caption
    }
    shape = list(SHAPES)[row["shape"]]
    is_whole = shape not in ("flat", "edge", "corner")  # the whole body is in the picture
    radius = row["shape_radius"] if is_whole else None
    width_in_radii = of_contact.uniform(2.5, 5.0)
    # Width of the picture, mm.
    if radius is None:
        row["camera"] = PATCH_MM * width_in_radii / 5.0
    else:
        row["camera"] = np.clip(radius * width_in_radii, 12.0, PATCH_MM)
    row |= _draw_sound(seed, (material, object_, contact), row["compliance"], radius)
    row["weight"] *= spec.density * STANDARD_GRAVITY * (row["size"] / 100.0) ** 3  # newton; a dm is 100 mm
    dtypes = {"shape": np.int64}
    return {name: np.asarray(value, dtype=dtypes.get(name, np.float32)) for name, value in row.items()}


def _draw_sound(seed: int, name: tuple[int, int, int], compliance: float, radius: float | None) -> dict[str, Any]:
    """Numbers of a contact's sound: its material's, varied by size, hardness and build of the object.

    `radius` is that of a whole body, mm. The ranges are chosen, not measured. Large objects sound lower, since the
    frequencies of bodies of one shape are proportional to one over their size. Small bodies sound higher, and soft ones
    duller and shorter.
    """
    spec = MATERIALS[name[0]]
    of_object = generator(seed, ROOM_STREAM, *name[:2])
    of_contact = generator(seed, ROOM_STREAM, *name)
    softness = compliance - spec.compliance
    pitch = log_uniform(of_object, 0.6, 1.6)
    size = 50.0 / pitch
    if radius is not None:
        pitch *= (6.0 / radius) ** 0.2
    pitch = min(max(pitch, 40.0 / spec.fundamental), 5000.0 / spec.fundamental)  # fundamentals of 40 to 5000 Hz
    noise_logit = of_object.normal(math.log((spec.noise + 0.02) / (1.02 - spec.noise)), 0.5)
    return {
        "size": size,  # side of a cube of the object's volume, mm
        "pitch": pitch * np.exp(of_object.normal(0.0, 0.04, MODES)),  # factors on the modal frequencies
        "inharmonicity": np.clip(spec.inharmonicity + of_object.normal(0.0, 0.12), 1.0, 2.3),
        # The loss factor is the material's, so higher sounds fade faster (Wildes and Richards, 1988).
        "decay": spec.decay * pitch * log_uniform(of_object, 0.6, 1.7) * math.exp(2.0 * softness),
        "noise": 1.0 / (1.0 + math.exp(-noise_logit)),
        "noise_centre": np.clip(spec.noise_centre * log_uniform(of_object, 0.65, 1.5), 200.0, 7000.0),
        "grains": spec.grains * log_uniform(of_object, 0.5, 2.0),
        "strike": of_contact.uniform(0.15, 1.0) * (1.0 - 0.5 * compliance),  # hardness of the impact
    }
