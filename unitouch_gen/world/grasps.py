"""Grasps: whether two fingers lift an object by a contact, what a camera sees of that, and how it is told."""

from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from unitouch_gen.world.captions import NOUNS, described
from unitouch_gen.world.draws import GRASP_STREAM, Draws, generator

FRAME_MM = 160.0  # side of what a picture of an outcome shows
RAISED, GROUND = 0.38, 0.86  # where a lifted object is, and what a dropped one stands on: shares from the picture's top

OUTCOMES: tuple[tuple[str, ...], tuple[str, ...]] = (
    ("falling out of a gripper", "fallen to the ground", "dropped on the ground", "slipping and falling down"),
    ("lifted by a gripper", "held up in the air", "in the air between two fingers", "lifted up high"),
)
"""What is said of objects that are dropped, and lifted: words of the zero-shot prompts, but none of their sentences."""


class Outcome(NamedTuple):
    """What came of N grasps."""

    image: Tensor  # pictures of the object between the fingers or on the ground below them, (N, 3, S, S) in [0, 1]
    text: list[str]  # captions of them


def grasp_margin(friction: Tensor, weight: Tensor, indentation_depth: Tensor, share: Tensor) -> Tensor:
    """Carried over needed force of grasps (N,), at a depth in mm and a share of the gel in contact.

    Coulomb: two fingers carry 2 mu F, with a normal force F that grows with depth and share. Above 1 they lift, as
    about two of three do at 3 N for each mm.
    """
    return 2.0 * friction * (3.0 * indentation_depth * share) / weight


def outcome_pictures(seed: int, draws: Draws, skins: Tensor, lifted: Tensor) -> Tensor:
    """What a camera beside the gripper sees after it was raised, (N, 3, S, S) in [0, 1].

    Objects are in the skins of pictures of their surfaces, (N, 3, S, S). Those that are `lifted`, bool (N,), hang
    between the fingers, the others lie below them.
    """
    size, lifted = skins.shape[-1], lifted[:, None, None]
    rows = torch.linspace(0.5 / size, 1.0 - 0.5 / size, size)
    y, x = torch.meshgrid(rows, rows, indexing="ij")
    numbers = np.stack([generator(seed, GRASP_STREAM, *name).random(11) for name in draws.names()])
    drawn = torch.from_numpy(numbers.astype(np.float32))[:, :, None, None]
    wall, floor = 0.5 + 0.3 * drawn[:, 7:8] + 0.15 * drawn[:, :3], 0.15 + 0.2 * drawn[:, 10:11] + 0.2 * drawn[:, 3:6]
    half_width = (draws.size / FRAME_MM / 2.0)[:, None, None]
    half_height = half_width * (0.75 + 0.5 * drawn[:, 6])
    middle = 0.4 + 0.2 * drawn[:, 7]
    height = torch.where(lifted, RAISED + 0.06 * (drawn[:, 8] - 0.5), GROUND - half_height)

    picture = torch.lerp(wall, floor, _inside(y - (0.62 + 0.1 * drawn[:, 9]), size / 2)[:, None])
    lit = 1.0 - 0.25 * (y - 0.5)
    u, v = (x - middle) / half_width, (y - height) / half_height
    under = ((x - middle) / (1.2 * half_width)).square() + ((y - GROUND) / 0.04).square()
    shadow = _inside(1.0 - under, 4.0) * torch.where(lifted, 0.25, 0.6)
    picture = picture * lit * (1.0 - shadow[:, None])
    corners = 2.0 + 4.0 * drawn[:, 10]  # from an ellipse to a box
    object_ = _inside(1.0 - (u.abs() ** corners + v.abs() ** corners), size * half_width / 2)
    skin = F.grid_sample(skins, torch.stack([u, v], dim=-1), padding_mode="border", align_corners=False)
    picture = torch.lerp(picture, skin * (1.0 - 0.3 * v.clamp(-1.0, 1.0).square())[:, None], object_[:, None])
    # Fingers come from above, as far as the middle of what they close upon.
    apart = (x - middle).abs() - half_width - torch.where(lifted, 0.0, 0.06)  # open where they dropped it
    tip = torch.where(lifted, height + 0.4 * half_height, RAISED)
    fingers = _inside(apart, size) * _inside(0.09 - apart, size) * _inside(tip - y, size)
    return torch.lerp(picture, 0.12 + 0.1 * wall, fingers[:, None]).clamp(0.0, 1.0)


def _inside(distance: Tensor, sharpness: float | Tensor) -> Tensor:
    """1 where a signed distance is positive, 0 where it is negative, with an edge of about one over the sharpness."""
    return (distance * sharpness + 0.5).clamp(0.0, 1.0)


def outcome_captions(draws: Draws, lifted: Tensor, variant: int = 0) -> list[str]:
    """One sentence an outcome; each variant is another one, as true of it. Half name no more than a thing."""
    told = []
    for up, wording, skin in zip(lifted.tolist(), draws.wording.tolist(), described(draws, variant), strict=True):
        spare, thing, outcome = ((part * 7919.0 + 0.618033989 * variant) % 1.0 for part in (*wording, sum(wording)))
        subject = f"the {NOUNS[int(thing * len(NOUNS))]}" if spare < 0.5 else skin
        told.append(f"{subject}, {OUTCOMES[up][int(outcome * len(OUTCOMES[up]))]}")
    return told


def told_lifted(caption: str) -> bool:
    """Whether a sentence of `outcome_captions` is of an object that is lifted."""
    return caption.endswith(OUTCOMES[True])
