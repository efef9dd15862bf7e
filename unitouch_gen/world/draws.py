"""The random numbers of objects and contacts, drawn from their identity alone.

A contact is named by (material, object, contact). Its numbers come from `numpy.random.SeedSequence` over that name and
the world's seed, so a scene is the same alone, in a batch, today and on another machine.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from unitouch_gen.world.materials import MATERIALS, SHAPE_NAMES

OBJECT_STREAM, CONTACT_STREAM, RELIEF_STREAM, SOUND_STREAM, SENSOR_STREAM, DRAWN_SENSOR_STREAM, WIDE_SOUND_STREAM = (
    range(7)
)


def generator(seed: int, *name: int) -> np.random.Generator:
    """The random stream that belongs to a name."""
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence((seed, *name))))


@dataclass
class Draws:
    """Numbers of N contacts; every tensor has N as its first dimension.

    Attributes:
        material, object, contact: The contacts' names, int64.
        scale, amplitude: The object's factors on lengths and heights.
        colour: Linear RGB of the object, (N, 3).
        weight: Weight of the object, newton.
        pitch: The object's factor on its modal frequencies, (N,), or on each of them, (N, M).
        angle: Direction of the grain in the picture, radians.
        offset: Place on the object where it is touched, mm, (N, 2).
        cell_seed: Seeds the cells of the texture.
        shape: Index into `SHAPE_NAMES`.
        shape_angle, shape_offset, shape_radius: Pose (radians, mm) and radius of curvature (mm) of the macro shape.
        indentation_depth: Depth that the sensor is pushed beyond first contact, mm.
        dwell: Time between contact and exposure, s.
        light: Direction toward the light, unit vectors, (N, 3).
        strike: Hardness of the impact that sounds, [0, 1].
        place: Where on the object the impact that sounds falls, [0, 1).
        wording: Picks the caption's template and adjective, (N, 2) in [0, 1).
    """

    material: Tensor
    object: Tensor
    contact: Tensor
    scale: Tensor
    amplitude: Tensor
    colour: Tensor
    weight: Tensor
    pitch: Tensor
    angle: Tensor
    offset: Tensor
    cell_seed: Tensor
    shape: Tensor
    shape_angle: Tensor
    shape_offset: Tensor
    shape_radius: Tensor
    indentation_depth: Tensor
    dwell: Tensor
    light: Tensor
    strike: Tensor
    place: Tensor
    wording: Tensor

    def __len__(self) -> int:
        return len(self.material)

    def names(self) -> list[tuple[int, int, int]]:
        """(material, object, contact) of each."""
        return list(zip(self.material.tolist(), self.object.tolist(), self.contact.tolist(), strict=True))

    def number(self, number: str) -> Tensor:
        """A field of `Material`, such as "friction", of each contact: its own if it was drawn, float32 (N,)."""
        if hasattr(self, number):
            return getattr(self, number)
        return torch.tensor([getattr(MATERIALS[index], number) for index in self.material.tolist()])


def draw(seed: int, material: Tensor, object_: Tensor, contact: Tensor) -> Draws:
    """Draws the numbers of N contacts named by three int64 tensors (N,)."""
    rows = [_draw_one(seed, *name) for name in zip(material.tolist(), object_.tolist(), contact.tolist(), strict=True)]
    columns = {key: torch.from_numpy(np.stack([row[key] for row in rows])) for key in rows[0]}
    return Draws(material=material, object=object_, contact=contact, **columns)


def _draw_one(seed: int, material: int, object_: int, contact: int) -> dict[str, np.ndarray]:
    spec = MATERIALS[material]
    of_object = generator(seed, OBJECT_STREAM, material, object_)
    of_contact = generator(seed, CONTACT_STREAM, material, object_, contact)

    base = np.asarray(spec.colours[of_object.integers(len(spec.colours))])
    colour = base * of_object.uniform(0.82, 1.18) + of_object.normal(0.0, 0.03, 3)
    tilt, turn = of_contact.uniform(0.45, 1.0), of_contact.uniform(-np.pi, np.pi)
    radius = of_contact.uniform(10.0, 26.0)
    scale, amplitude = of_object.uniform(0.85, 1.2), of_object.uniform(0.8, 1.3)
    of_object.uniform()  # read by nothing, but every number after it keeps its place in the stream
    row = {
        "scale": scale,
        "amplitude": amplitude,
        "colour": np.clip(colour, 0.02, 0.98),
        "weight": of_object.uniform(1.0, 12.0),
        "pitch": of_object.uniform(0.85, 1.18),
        "cell_seed": of_object.integers(1, 4096),
        "angle": of_object.uniform(-np.pi, np.pi) + of_contact.uniform(-np.pi, np.pi),
        "offset": of_contact.uniform(-60.0, 60.0, 2),
        "shape": of_contact.choice(len(SHAPE_NAMES), p=(0.4, 0.15, 0.1, 0.15, 0.2)),
        "shape_angle": of_contact.uniform(-np.pi, np.pi),
        "shape_offset": of_contact.uniform(-3.0, 3.0, 2),
        "shape_radius": radius,
        "indentation_depth": of_contact.uniform(0.6, 1.4),
        "dwell": of_contact.uniform(0.15, 1.0),
        "light": np.asarray([np.cos(turn) * np.cos(tilt), np.sin(turn) * np.cos(tilt), np.sin(tilt)]),
        "strike": of_contact.uniform(0.3, 1.0),
        "place": of_contact.uniform(),
        "wording": of_contact.uniform(size=2),
    }
    return {key: np.asarray(value, dtype=np.int64 if key == "shape" else np.float32) for key, value in row.items()}
