"""What the built-in world's scenes cost to render, and how far they are from a far finer rendering."""

import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tests.benchmarks.measuring import Figures, in_own_process, in_turns, seconds_of
from unitouch_gen.training.data.drawn import GROUP
from unitouch_gen.world import MATERIAL_NAMES, SENSORS, World, draw_sensor
from unitouch_gen.world.draws import Draws, draw
from unitouch_gen.world.gel import GEL_MARGIN, GelGrid
from unitouch_gen.world.scene import MODALITIES
from unitouch_gen.world.sensors import touch_images
from unitouch_gen.world.sounds import DURATION, SAMPLE_RATE, impact_sounds
from unitouch_gen.world.surfaces import surfaces

COUNT = len(MATERIAL_NAMES)

CHUNK = 32
"""Samples that a process renders at once."""

REQUESTS: dict[str, dict[str, Any]] = {
    "everything": {"modalities": MODALITIES, "sensors": tuple(SENSORS)},
    "picture": {"modalities": ("image",)},
    "touch of one sensor": {"modalities": ("touch",)},
    "touch of four sensors": {"modalities": ("touch",), "sensors": tuple(SENSORS)},
    "picture and touch": {"modalities": ("image", "touch")},
    "sound": {"modalities": ("audio",)},
    "caption": {"modalities": ("text",)},
    "grasp": {"modalities": ("grasp",)},
}

# Time -----------------------------------------------------------------------------------------------------------------


def world_figures(samples: int = 512) -> Figures:
    """Full samples a second on two cores, and the cost of parts on one.

    Full are picture, touch of two drawn sensors, sound and caption at 128 pixels.
    """
    return {"samples_per_second": rate_of(_render_many, samples), "share_of_full": in_own_process(request_shares)}


def rate_of(render: Callable[[int], int], samples: int) -> float:
    """Samples a second of two processes that render chunks from their first numbers on."""
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        list(pool.map(render, [0, CHUNK]))  # start-up is not counted
        started = time.perf_counter()
        count = sum(pool.map(render, range(0, samples, CHUNK)))
        return count / (time.perf_counter() - started)


def _render_many(first: int) -> int:
    torch.set_num_threads(1)  # many small operations, at the end of each of which threads wait for each other
    world = World()
    for start in range(first, first + CHUNK, GROUP):
        rows, sensors = torch.arange(start, start + GROUP), (draw_sensor(0, 2 * start), draw_sensor(0, 2 * start + 1))
        world.render(rows % COUNT, rows // COUNT, rows * 0, sensors=sensors)
    return CHUNK


def request_shares(contacts: int = 34, repeats: int = 3) -> dict[str, float]:
    """Time of each request as a share of that of everything, on one thread, on contacts of every material."""
    torch.set_num_threads(1)
    index = torch.arange(contacts)
    render = partial(World().render, index % COUNT, index // COUNT, torch.zeros_like(index))
    calls = {name: partial(seconds_of, render, **request) for name, request in REQUESTS.items()}
    seconds = {name: min(seen) for name, seen in in_turns(calls, repeats).items()}
    return {name: taken / seconds["everything"] for name, taken in seconds.items()}


# Error ----------------------------------------------------------------------------------------------------------------

OBJECT = 10
"""Of which each contact is of another material."""

REFINEMENTS = (1, 2)
RATES = (8000, SAMPLE_RATE, 32_000)

FADE = 0.2
"""Share of a sound over which it is faded out before its spectrum is taken: the cut at its end is no sound."""


@torch.no_grad()
def physics_figures(contacts: int = 16, repeats: int = 3) -> Figures:
    """Median error, seconds a contact and order of touch images and sounds, by how finely they are rendered.

    References are rendered four times as finely as the finest. A contact's surface and sound are functions of position
    and time that a finer rendering samples more often, so both show the same contact.
    """
    index = torch.arange(contacts)
    draws = draw(0, index % COUNT, torch.full_like(index, OBJECT), index)
    flat = {"shape": 0 * index, "texture": 0 * index - 1, "scale": torch.ones(contacts), "tilt": 0.0 * draws.tilt}
    draws = replace(draws, **flat)  # a rim falls between pixels, however fine
    return {
        "touch of gelsight": touch_accuracy(draws, repeats),
        "sound, whole band": sound_accuracy(draws, 2 * repeats),
    }


def touch_accuracy(draws: Draws, repeats: int) -> Figures:
    """Error of GelSight's images relative to what the contact changes in that of the untouched gel.

    Surface and gel are refined together, with spectral slopes; images of a finer gel are averaged down.
    """
    sensor, world = replace(SENSORS["gelsight"], contact_steps=0), World()  # which is the equation that converges
    side, compliance = world.image_size, draws.compliance

    def touches(grid: GelGrid, rows: slice = slice(None)) -> Tensor:
        part = Draws(**{name: values[rows] for name, values in vars(draws).items()})
        height = surfaces(0, part, grid.refinement * world.resolution, coloured=False).height
        return touch_images(height, part.indentation_depth, part.dwell, compliance[rows], sensor, side, grid=grid)

    finest = GelGrid(refinement=4 * REFINEMENTS[-1])
    exact = torch.cat([touches(finest, slice(row, row + 1)) for row in range(len(draws))])  # each surface is megabytes
    level, nothing = torch.zeros(1, world.resolution, world.resolution), torch.zeros(1)
    untouched = touch_images(level, nothing, draws.dwell[:1], compliance[:1], sensor, side, grid=finest)
    scale = (exact - untouched).square().mean(dim=(1, 2, 3)).sqrt()
    calls = {f"{k}x": partial(touches, GelGrid(GEL_MARGIN, k, "spectral")) for k in REFINEMENTS}
    errors = {
        name: ((call() - exact).square().mean(dim=(1, 2, 3)).sqrt() / scale).numpy() for name, call in calls.items()
    }
    return _accuracy(calls, errors, [1 / k for k in REFINEMENTS], len(draws), repeats)


def sound_accuracy(draws: Draws, repeats: int) -> Figures:
    """Error of sounds in the whole band of the highest rate, at the loudness that fits best.

    A sound is brought to one peak, so its own loudness is arbitrary.
    """
    finest, bins = 4 * max(RATES), round(max(RATES) / 2 * DURATION)  # bins of 1 / DURATION hertz

    def spectra(rate: int) -> np.ndarray:
        spectrum = sound_spectrum(impact_sounds(0, draws, sample_rate=rate), rate)[:, :bins]
        return np.pad(spectrum, ((0, 0), (0, bins - spectrum.shape[1])))

    exact = spectra(finest)
    errors = {f"{rate}": fitted_error(spectra(rate), exact) for rate in RATES}
    calls = {f"{rate}": partial(impact_sounds, 0, draws, sample_rate=rate) for rate in RATES}
    return _accuracy(calls, errors, [SAMPLE_RATE / rate for rate in RATES], len(draws), repeats)


def sound_spectrum(sounds: Tensor, rate: int) -> np.ndarray:
    """Spectrum (N, T // 2 + 1) of sounds (N, T) that are faded out, in units that do not depend on the rate."""
    left = (1.0 - np.arange(sounds.shape[1]) / sounds.shape[1]) / FADE
    return np.fft.rfft(sounds.double().numpy() * (0.5 - 0.5 * np.cos(np.pi * np.minimum(left, 1.0)))) / rate


def fitted_error(spectra: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """|g x - y| / |y| for each row of x and y (N, F), at the gain g >= 0 that fits best, (N,)."""
    gain = (spectra.conj() * exact).sum(axis=1).real / (np.abs(spectra) ** 2).sum(axis=1)
    return np.linalg.norm(gain.clip(0.0)[:, None] * spectra - exact, axis=1) / np.linalg.norm(exact, axis=1)


def _accuracy(
    calls: dict[str, Callable[[], Tensor]],
    errors: dict[str, np.ndarray],
    spacings: list[float],
    count: int,
    repeats: int,
) -> Figures:
    """Median error, least seconds a contact, and the order that the errors fall at with the spacing, by setting."""
    medians = {name: float(np.median(found)) for name, found in errors.items()}
    order = float(np.polyfit(np.log(spacings), np.log(list(medians.values())), 1)[0])
    seen = in_turns({name: partial(seconds_of, call) for name, call in calls.items()}, repeats)
    return {name: {"error": medians[name], "seconds": min(seen[name]) / count, "order": order} for name in calls}
