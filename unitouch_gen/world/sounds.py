"""Impact sounds by modal synthesis, in closed form, and the response of rooms and microphones.

Each mode is the impulse response of q'' + 2 a q' + w^2 q = delta(t). Modes at or above the Nyquist frequency fade out
instead of folding back.
"""

import math

import numpy as np
import torch
from torch import Tensor

from unitouch_gen.world.draws import MODES, ROOM_STREAM, SOUND_STREAM, Draws, generator

SAMPLE_RATE = 16_000  # Hz
DURATION = 0.26  # s
SAMPLES = round(DURATION * SAMPLE_RATE)
PEAK = 0.9  # loudest sample of a sound, of full scale


def impulse_response(angular_frequency: Tensor, decay: Tensor, time: Tensor) -> Tensor:
    """Exact velocity-scaled response w q(t) of damped oscillators struck at t = 0.

    It is w e^{-a t} sin(b t) / b below critical damping (b^2 = w^2 - a^2), w t e^{-a t} at it, and
    w (e^{-s t} - e^{-f t}) / (f - s) above it, with the slow root s = w^2 / (a + sqrt(a^2 - w^2)) computed without
    cancellation. It is finite up to frequencies and decays of 1e18, whose squares fit float32.

    Args:
        angular_frequency: Undamped w, rad/s, > 0, any shape broadcastable against the others.
        decay: Damping rate a, 1/s, >= 0.
        time: s, >= 0.
    """
    gap = angular_frequency**2 - decay**2
    b = gap.abs().sqrt()
    ringing = torch.exp(-decay * time) * time * torch.sinc(b * time / torch.pi)
    if (gap > 0).all():
        return angular_frequency * ringing
    # (e^{-s t} - e^{-f t}) / (f - s) = t e^{-s t} phi(2 b t) with phi(z) = (1 - e^{-z}) / z: b -> 0 divides by nothing.
    slow = angular_frequency**2 / (decay + b).clamp_min(1e-30)
    z = 2.0 * b * time
    phi = torch.where(z > 1e-3, -torch.expm1(-z) / z.clamp_min(1e-3), 1.0 - 0.5 * z)
    return angular_frequency * torch.where(gap > 0, ringing, time * torch.exp(-slow * time) * phi)


def impact_sounds(seed: int, draws: Draws) -> Tensor:
    """Sounds of N impacts in the world of a seed, (N, T), with a peak of 0.9; silence if no mode is audible."""
    time = torch.arange(SAMPLES, dtype=torch.float32) / SAMPLE_RATE
    share = draws.noise[:, None]
    sound = (1.0 - share) * _unit_peak(modal_sounds(draws, time))
    sound += share * _unit_peak(grain_noise(seed, draws, SAMPLES))
    return PEAK * _unit_peak(sound)


def modal_sounds(draws: Draws, time: Tensor) -> Tensor:
    """Sum of the modes of each struck object, (N, T), at times (T,) since the strike, s."""
    order = torch.arange(1, MODES + 1, dtype=torch.float32)[None, :]
    fundamental = draws.of_material("fundamental")[:, None] * draws.pitch
    decay = draws.decay[:, None] * order**0.7
    frequency = fundamental * order ** draws.inharmonicity[:, None]
    # A soft strike excites few partials. |sin(i phi)| is the shape of mode i at the place of the strike, phi from 0.6
    # to 2.1 rad; 0.15 keeps a mode that is struck at its node just audible. These and the exponents are chosen, not
    # measured.
    roll_off = torch.exp(-0.9 * (1.0 - draws.strike[:, None]) * (order - 1.0))
    place = torch.sin(order * (0.35 + 0.9 * draws.place[:, None]) * 1.7).abs() + 0.15
    below_nyquist = ((0.5 * SAMPLE_RATE - frequency) / (0.1 * SAMPLE_RATE)).clamp(0.0, 1.0)  # fades from 80 % of it on
    amplitude = roll_off * place / order**0.6 * below_nyquist
    sound = torch.zeros(len(draws), len(time))
    for mode in range(MODES):
        audible = torch.nonzero(amplitude[:, mode] > 1e-3 * amplitude.amax(dim=1))[:, 0]  # above -60 dB
        w = 2 * torch.pi * frequency[audible, mode, None]
        response = impulse_response(w, decay[audible, mode, None], time[None, :])
        sound[audible] += amplitude[audible, mode, None] * response
    return sound


def grain_noise(seed: int, draws: Draws, samples: int) -> Tensor:
    """Band-passed noise under an envelope of colliding grains, each an exact exponential, (N, samples).

    Both convolutions are padded to twice the clip, so nothing wraps from its end to its start. Grains that arrive after
    the end are left out. So a longer clip begins with the same sound, up to the reach of the band-pass at the end.
    """
    rows = list[np.ndarray]()
    time = np.arange(samples, dtype=np.float32) / np.float32(SAMPLE_RATE)
    hz = np.fft.rfftfreq(2 * samples, 1.0 / SAMPLE_RATE)
    for name, centre, grains in zip(draws.names(), draws.noise_centre.tolist(), draws.grains.tolist(), strict=True):
        rng = generator(seed, SOUND_STREAM, *name)
        arrivals = rng.exponential(0.09, 1 + rng.poisson(grains))  # after the strike, s
        strength = rng.uniform(0.2, 1.0, len(arrivals)).astype(np.float32)
        index = (arrivals * SAMPLE_RATE).astype(int)
        in_clip = index < samples
        impulses = np.zeros(samples, np.float32)
        np.add.at(impulses, index[in_clip], strength[in_clip])
        impulses[0] += 1.0  # the strike itself
        tail = np.exp(-time * (40.0 + 0.12 * centre))
        spectrum = np.fft.rfft(impulses, 2 * samples) * np.fft.rfft(tail, 2 * samples)
        envelope = np.fft.irfft(spectrum)[:samples]
        noise = np.fft.rfft(rng.standard_normal(samples, dtype=np.float32) * envelope, 2 * samples)
        band = np.exp(-0.5 * (np.log2(np.maximum(hz, 1.0) / centre) / 0.55) ** 2)  # octaves
        rows.append(np.fft.irfft(noise * band, 2 * samples)[:samples].astype(np.float32))
    return torch.from_numpy(np.stack(rows))


def _unit_peak(sound: Tensor) -> Tensor:
    """Scaled to a peak of 1; silence stays silence."""
    peak = sound.abs().amax(dim=-1, keepdim=True)
    return sound / torch.where(peak > 0, peak, 1.0)


def recorded(seed: int, names: list[tuple[int, int, int]], sounds: Tensor) -> Tensor:
    """Sounds (N, T) with a peak of 0.9, as recorded by a microphone in a room, with peaks 0 to 20 dB below it.

    Room and microphone are drawn for each name (material, object, contact). The sound is delayed by up to 20 ms, with
    echoes within 60 ms more and noise 25 to 60 dB below its peak. The microphone cuts off below 20 to 150 Hz and above
    4 to 8 kHz at 12 dB an octave, and tilts the band between by up to 2 dB an octave. These ranges are chosen, not
    measured.
    """
    samples = sounds.shape[1]
    hz = np.fft.rfftfreq(2 * samples, 1.0 / SAMPLE_RATE)  # twice the clip, so nothing wraps from its end to its start
    rows = list[np.ndarray]()
    for name, sound in zip(names, sounds.numpy(), strict=True):
        rng = generator(seed, ROOM_STREAM, *name, 1)
        room = _room_response(rng, hz)
        microphone = _microphone_response(rng, hz)
        noise_level = 10.0 ** (rng.uniform(-60.0, -25.0) / 20.0)
        level = 10.0 ** (rng.uniform(-20.0, 0.0) / 20.0)
        noise = np.fft.rfft(noise_level * PEAK * rng.standard_normal(samples, dtype=np.float32), 2 * samples)
        spectrum = (np.fft.rfft(sound, 2 * samples) * room + noise) * microphone
        recording = np.fft.irfft(spectrum)[:samples]
        rows.append((level * PEAK / max(np.abs(recording).max(), 1e-12) * recording).astype(np.float32))
    return torch.from_numpy(np.stack(rows))


def _room_response(rng: np.random.Generator, hz: np.ndarray) -> np.ndarray:
    """Frequency response of a random room: a delay, and four echoes that fade."""
    wave = -2j * np.pi * hz
    delays = rng.uniform(0.001, 0.06, 4)
    wetness = math.exp(rng.uniform(math.log(0.02), math.log(0.4)))
    fading = rng.uniform(0.005, 0.05)  # s
    gains = wetness * rng.normal(size=4) * np.exp(-delays / fading)
    echoes = np.exp(np.outer(wave, delays)) @ gains
    return np.exp(wave * rng.uniform(0.0, 0.02)) * (1.0 + echoes)


def _microphone_response(rng: np.random.Generator, hz: np.ndarray) -> np.ndarray:
    """Frequency response of a random microphone: a tilted band between two cut-offs."""
    low = math.exp(rng.uniform(math.log(20.0), math.log(150.0)))
    high = rng.uniform(4000.0, 8000.0)
    tilt = rng.uniform(-2.0, 2.0) / (20.0 * math.log10(2.0))
    above_zero = np.maximum(hz, 1.0)
    cut_off = np.sqrt((1.0 + (low / above_zero) ** 4) * (1.0 + (hz / high) ** 4))
    return (above_zero / 1000.0) ** tilt / cut_off
