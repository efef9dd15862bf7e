"""The world's own physics, measured: error against run time of what it renders, and what a request costs."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch

from unitouch_gen.numerics.physics_row import PhysicsRow, time_calls, with_orders
from unitouch_gen.numerics.physics_sound import sound_rows
from unitouch_gen.numerics.physics_touch import margin_rows, solver_rows, touch_rows
from unitouch_gen.world.materials import MATERIALS
from unitouch_gen.world.scene import MODALITIES, World
from unitouch_gen.world.sensors import SENSORS

REQUESTS: dict[str, dict[str, Any]] = {
    "everything": {"modalities": MODALITIES, "sensors": tuple(SENSORS)},
    "picture": {"modalities": ("image",)},
    "touch of one sensor": {"modalities": ("touch",)},
    "touch of five sensors": {"modalities": ("touch",), "sensors": tuple(SENSORS)},
    "picture and touch": {"modalities": ("image", "touch")},
    "sound": {"modalities": ("audio",)},
    "caption": {"modalities": ("text",)},
    "grasp": {"modalities": ("grasp",)},
}


@torch.no_grad()
def physics_rows(
    contacts: int = 16,
    sensors: Sequence[str] = tuple(SENSORS),
    refinements: Sequence[int] = (1, 2, 4),
    *,
    repeats: int = 3,
) -> list[PhysicsRow]:
    """Error against run time of touch images and impact sounds.

    Args:
        contacts: How many of `world_contacts`; sixteen show every material and shape.
        sensors: Whose touch images; the first is also pressed on surfaces in closed form.
        refinements: Of surface and gel, rising from 1; the reference is four times finer than the last.
        repeats: Timings of each setting, after a warm-up.
    """
    return with_orders(
        [
            *touch_rows(contacts, sensors, refinements, repeats=repeats),
            # These take milliseconds, which want more repeats.
            *margin_rows(contacts, sensors, repeats=5 * repeats),
            *solver_rows(contacts, sensors[0], repeats=5 * repeats),
            *sound_rows(contacts, repeats=2 * repeats),
        ]
    )


@dataclass(frozen=True)
class RequestRow:
    """What a request of `World.render` costs.

    Attributes:
        request: In words.
        contacts: Rendered at once.
        seconds, seconds_median: Least and median time of one contact.
        share: Of the time of everything.
    """

    request: str
    contacts: int
    seconds: float
    seconds_median: float
    share: float

    @property
    def saved(self) -> float:
        """Share of the time of everything that the request leaves out."""
        return 1.0 - self.share


def request_rows(contacts: int = 64, *, repeats: int = 3) -> list[RequestRow]:
    """What each request of `REQUESTS` costs, on contacts of every material."""
    index = torch.arange(contacts)
    names = index % len(MATERIALS), index // len(MATERIALS), torch.zeros_like(index)
    calls = {name: partial(World().render, *names, **request) for name, request in REQUESTS.items()}
    seconds = time_calls(calls, repeats)
    return [
        RequestRow(
            request=name,
            contacts=contacts,
            seconds=least / contacts,
            seconds_median=median / contacts,
            share=least / seconds["everything"][0],
        )
        for name, (least, median) in seconds.items()
    ]
