"""Error against run time of impact sounds, over sample rate, modes and grains.

A contact's sound is one function of time at every sample rate, its noise included, so a rate and its reference compare
wave by wave: in the band where the rate carries all modes ("own band": what sampling an attack costs), and in that of
the highest rate ("whole band": also what a lower rate cannot carry).
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from torch import Tensor

from unitouch_gen.numerics.physics_row import PhysicsRow, time_calls, with_quartiles
from unitouch_gen.numerics.physics_touch import world_contacts
from unitouch_gen.world.draws import Draws
from unitouch_gen.world.sounds import DURATION, MODES, SAMPLE_RATE, impact_sounds

RATES = (8000, SAMPLE_RATE, 32_000)
FULL_WEIGHT = 0.4
"""Modes weigh one up to this share of the sample rate; from there to half of it they fade."""

FADE = 0.2
"""Share of the clip over which it is faded out before its spectrum is taken: the cut at its end is no sound."""

Make = Callable[[], Tensor]


def sound_spectrum(sounds: Tensor, rate: int) -> np.ndarray:
    """Spectrum (N, T // 2 + 1) of sounds (N, T) that are faded out, in units that do not depend on the rate."""
    left = (1.0 - np.arange(sounds.shape[1]) / (sounds.shape[1])) / FADE
    return np.fft.rfft(sounds.double().numpy() * (0.5 - 0.5 * np.cos(np.pi * np.minimum(left, 1.0)))) / rate


def fitted_error(sounds: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """|g x - y| / |y| for each row of x and y (N, F), at the gain g >= 0 that fits best, (N,); 0 where both are silent.

    F bins of a spectrum or samples of a sound.
    """
    power, target = ((np.abs(part) ** 2).sum(axis=1) for part in (sounds, reference))
    both = (sounds.conj() * reference).sum(axis=1).real
    gain = np.divide(both, power, out=np.zeros_like(power), where=power > 0).clip(0.0)
    missed = (np.abs(gain[:, None] * sounds - reference) ** 2).sum(axis=1)
    return np.sqrt(np.divide(missed, target, out=np.where(power > 0, np.inf, 0.0), where=target > 0))


def sound_rows(contacts: int = 16, rates: Sequence[int] = RATES, *, repeats: int = 3) -> Iterator[PhysicsRow]:
    """Rows of the world's own impacts."""
    draws = world_contacts(contacts)
    yield from rate_rows(draws, rates, repeats)
    make = partial(impact_sounds, 0, draws)
    all_modes = make(modes=4 * MODES, inaudible=0.0)
    kept: dict[str, Make] = {f"{n}": partial(make, modes=n) for n in (1, 2, 4, MODES // 2, MODES, 2 * MODES)}
    yield from _compared("sound, modes", "modes", kept, all_modes, repeats)
    heard: dict[str, Make] = {f"{level:g}": partial(make, inaudible=level) for level in (0.1, 0.01, 0.001, 0.0)}
    yield from _compared("sound, modes", "inaudible below", heard, all_modes, repeats)
    grains: dict[str, Make] = {f"{n}": partial(make, grains=n) for n in (0, 1, 4, 16, 64, 256)}
    yield from _compared("sound, grains", "grains", grains, make(), repeats)


def rate_rows(draws: Draws, rates: Sequence[int], repeats: int) -> Iterator[PhysicsRow]:
    """Rows of sample rates against one four times the highest."""
    finest = 4 * max(rates)
    target = sound_spectrum(impact_sounds(0, draws, sample_rate=finest), finest)
    calls = {rate: partial(impact_sounds, 0, draws, sample_rate=rate) for rate in rates}
    seconds = time_calls(calls, repeats)
    whole = round(max(rates) / 2 * DURATION)  # bins of 1 / DURATION hertz
    for rate, call in calls.items():
        spectrum = sound_spectrum(call(), rate)
        for band, bins in (("own band", round(FULL_WEIGHT * rate * DURATION)), ("whole band", whole)):
            carried = np.pad(spectrum[:, :bins], ((0, 0), (0, max(0, bins - spectrum.shape[1]))))
            least, median = (value / len(draws) for value in seconds[rate])
            row = PhysicsRow(f"sound, {band}", "sample rate", f"{rate}", SAMPLE_RATE / rate)
            row = with_quartiles(row, fitted_error(carried, target[:, :bins]))
            yield replace(row, seconds=least, seconds_median=median)


def _compared(problem: str, option: str, calls: dict[str, Make], target: Tensor, repeats: int) -> Iterator[PhysicsRow]:
    seconds = time_calls(calls, repeats)
    for value, call in calls.items():
        row = with_quartiles(PhysicsRow(problem, option, value), fitted_error(call().numpy(), target.numpy()))
        least, median = (taken / len(target) for taken in seconds[value])
        yield replace(row, seconds=least, seconds_median=median)
