"""Rooms and microphones: what a sound is heard through, drawn anew for every contact."""

import math

import numpy as np
import torch
from torch import Tensor

from unitouch_gen.world.draws import ROOM_STREAM, generator
from unitouch_gen.world.sounds import PEAK, SAMPLE_RATE, white_noise

ECHOES = 4
"""Reflections of a room."""


def recorded(seed: int, names: list[tuple[int, int, int]], sounds: Tensor) -> Tensor:
    """Sounds (N, T) as a microphone in a room records them.

    The sound comes up to 30 ms late, with echoes within 60 ms and noise 15 to 60 dB below its peak; the microphone cuts
    off below 20 to 300 Hz and above 2.5 to 8 kHz at 12 dB an octave and tilts what is between by up to 4 dB an octave.
    How wide these ranges are is chosen, not measured.

    Args:
        seed: Seed of the world.
        names: (material, object, contact) of each.
        sounds: Of a peak of 0.9, or silent.

    Returns:
        (N, T), with peaks 0 to 20 dB below 0.9.
    """
    samples = sounds.shape[1]
    hz = np.fft.rfftfreq(2 * samples, 1.0 / SAMPLE_RATE)  # twice the clip, so nothing wraps from its end to its start
    rows = []
    for name, sound in zip(names, sounds.numpy(), strict=True):
        rng = generator(seed, ROOM_STREAM, *name, 1)
        wave = -2j * np.pi * hz
        delays = rng.uniform(0.001, 0.06, ECHOES)
        wet, room = math.exp(rng.uniform(math.log(0.02), math.log(0.4))), rng.uniform(0.005, 0.05)
        gains = wet * rng.normal(size=ECHOES) * np.exp(-delays / room)
        room_response = np.exp(wave * rng.uniform(0.0, 0.02)) * (1.0 + np.exp(np.outer(wave, delays)) @ gains)
        low, high = math.exp(rng.uniform(math.log(20.0), math.log(150.0))), rng.uniform(4000.0, 8000.0)
        tilt = rng.uniform(-2.0, 2.0) / (20.0 * math.log10(2.0))
        microphone = np.maximum(hz, 1.0) / 1000.0
        microphone = microphone**tilt / np.sqrt((1.0 + (low / np.maximum(hz, 1.0)) ** 4) * (1.0 + (hz / high) ** 4))
        floor, level = (10.0 ** (rng.uniform(*decibels) / 20.0) for decibels in ((-60.0, -25.0), (-20.0, 0.0)))
        noise = np.fft.rfft(floor * PEAK * white_noise(rng, samples, SAMPLE_RATE), 2 * samples)
        heard = np.fft.irfft((np.fft.rfft(sound, 2 * samples) * room_response + noise) * microphone)[:samples]
        rows.append((level * PEAK / max(np.abs(heard).max(), 1e-12) * heard).astype(np.float32))
    return torch.from_numpy(np.stack(rows))
