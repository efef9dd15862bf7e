"""What the built-in world's scenes cost to render, and how far they are from a far finer rendering."""

import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from tests.benchmarks.measuring import Figures, in_turns, seconds_of
from tests.helpers.plain_sensor import touch_images
from unitouch_gen.training.data.drawn import GROUP
from unitouch_gen.world import MATERIAL_NAMES, SENSORS, World, draw_sensor, untouched_gel
from unitouch_gen.world.draws import Draws, draw
from unitouch_gen.world.surfaces import surfaces

COUNT = len(MATERIAL_NAMES)

CHUNK = 32
"""Samples that a process renders at once."""


def world_figures(samples: int = 512) -> Figures:
    """Full samples a second of two processes: picture, touch of two drawn sensors, sound and caption at 128 pixels."""
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        list(pool.map(_render_many, [0, CHUNK]))  # start-up is not counted
        started = time.perf_counter()
        count = sum(pool.map(_render_many, range(0, samples, CHUNK)))
        return {"samples_per_second": count / (time.perf_counter() - started)}


def _render_many(first: int) -> int:
    torch.set_num_threads(1)  # many small operations, at the end of each of which threads wait for each other
    world = World()
    for start in range(first, first + CHUNK, GROUP):
        rows = torch.arange(start, start + GROUP)
        sensors = (draw_sensor(0, 2 * start), draw_sensor(0, 2 * start + 1))
        world.render(rows % COUNT, rows // COUNT, rows * 0, sensors=sensors)
    return CHUNK


@torch.no_grad()
def physics_figures(contacts: int = 16, repeats: int = 3, refinements: tuple[int, ...] = (1, 2)) -> Figures:
    """Median error, seconds a contact and order of GelSight's touch images, by how finely they are rendered.

    Errors are relative to what the contact changes in the image of the untouched gel. A contact's surface is a function
    of position that a finer rendering samples more often, so both show the same contact. Surface, gel and image are
    refined together, and finer images averaged down; the reference is four times as fine as the finest.
    """
    index = torch.arange(contacts)
    draws = draw(0, index % COUNT, torch.full_like(index, 10), index)  # each contact is of another material
    draws = draws.but(shape=0 * index, scale=torch.ones(contacts), tilt=0.0 * draws.tilt)  # rims fall between pixels
    sensor = replace(SENSORS["gelsight"], contact_steps=0)  # which is the equation that converges
    world = World()
    side = world.image_size

    def touches(finer: int, rows: slice = slice(None)) -> Tensor:
        part = Draws(**{name: values[rows] for name, values in vars(draws).items()})
        height = surfaces(0, part, finer * world.resolution, coloured=False).height
        return F.avg_pool2d(touch_images(height, part.indentation_depth, part.dwell, sensor, finer * side), finer)

    finest = 4 * refinements[-1]
    exact = torch.cat([touches(finest, slice(row, row + 1)) for row in range(contacts)])  # each surface is megabytes
    untouched = F.avg_pool2d(untouched_gel(sensor, finest * side), finest)
    scale = (exact - untouched).square().mean(dim=(1, 2, 3)).sqrt()
    calls = {f"{k}x": partial(touches, k) for k in refinements}
    errors = {name: (call() - exact).square().mean(dim=(1, 2, 3)).sqrt() / scale for name, call in calls.items()}
    medians = {name: float(np.median(found)) for name, found in errors.items()}
    order = float(np.polyfit(np.log([1 / k for k in refinements]), np.log(list(medians.values())), 1)[0])
    seen = in_turns({name: partial(seconds_of, call) for name, call in calls.items()}, repeats)
    found = {name: {"error": medians[name], "seconds": min(seen[name]) / contacts, "order": order} for name in calls}
    return {"touch of gelsight": found}
