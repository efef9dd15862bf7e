"""Impact sounds by modal synthesis: a bank of damped oscillators and a train of grains, in closed form.

Each mode is the impulse response of q'' + 2 a q' + w^2 q = delta(t), evaluated exactly: ringing, critically damped and
over-damped modes come from one formula without a branch that loses digits, and modes at or above the Nyquist
frequency fade out instead of folding back.
"""

import math

import numpy as np
import torch
from torch import Tensor

from unitouch_gen.errors import InvalidInputError, check_integer, check_kind, check_number
from unitouch_gen.world.draws import MODES, SOUND_STREAM, Draws, generator
from unitouch_gen.world.surfaces import bad_values

SAMPLE_RATE = 16_000
"""Hz."""

DURATION = 0.26
"""s."""

LONGEST = 10**8
"""Samples of a sound."""

PEAK = 0.9
"""Loudest sample of a sound, of full scale."""

INAUDIBLE = 1e-3
"""Modes this far below the loudest (-60 dB) are left out."""

GRAIN_DELAY = 0.09
"""Mean delay of a grain after the strike, s."""


def impulse_response(angular_frequency: Tensor, decay: Tensor, time: Tensor) -> Tensor:
    """Exact velocity-scaled response w q(t) of damped oscillators struck at t = 0.

    Args:
        angular_frequency: Undamped w, rad/s, > 0, any shape broadcastable against the others.
        decay: Damping rate a, 1/s, >= 0.
        time: s, >= 0.

    Returns:
        w e^{-a t} sin(b t) / b below critical damping (b^2 = w^2 - a^2), w t e^{-a t} at it, and
        w (e^{-s t} - e^{-f t}) / (f - s) above it, with the slow root s = w^2 / (a + sqrt(a^2 - w^2)) computed
        without cancellation. Finite up to frequencies and decays of 1e18 (their squares have to fit float32).
    """
    gap = angular_frequency**2 - decay**2
    b = gap.abs().sqrt()
    if (gap > 0).all():
        return angular_frequency * _ringing(b, decay, time)
    overdamped = _overdamped(b, angular_frequency, decay, time)
    return angular_frequency * torch.where(gap > 0, _ringing(b, decay, time), overdamped)


def _ringing(b: Tensor, decay: Tensor, time: Tensor) -> Tensor:
    return torch.exp(-decay * time) * time * torch.sinc(b * time / torch.pi)


def _overdamped(b: Tensor, angular_frequency: Tensor, decay: Tensor, time: Tensor) -> Tensor:
    # (e^{-s t} - e^{-f t}) / (f - s) = t e^{-s t} phi(2 b t) with phi(z) = (1 - e^{-z}) / z: b -> 0 divides by nothing.
    slow = angular_frequency**2 / (decay + b).clamp_min(1e-30)
    z = 2.0 * b * time
    phi = torch.where(z > 1e-3, -torch.expm1(-z) / z.clamp_min(1e-3), 1.0 - 0.5 * z)
    return time * torch.exp(-slow * time) * phi


def below_nyquist(frequency: Tensor, sample_rate: int) -> Tensor:
    """Weight of a mode: 1 up to 80 % of the Nyquist frequency, 0 from it on."""
    return ((0.5 * sample_rate - frequency) / (0.1 * sample_rate)).clamp(0.0, 1.0)


def impact_sounds(seed: int, draws: Draws, *, sample_rate: int = SAMPLE_RATE, duration: float = DURATION) -> Tensor:
    """Sounds of N impacts.

    Args:
        seed: Seed of the world.
        draws: Numbers of the N contacts.
        sample_rate: Hz; at another rate a contact makes the same sound, as far as that rate can carry it.
        duration: s.

    Returns:
        (N, round(duration * sample_rate)) with a peak of 0.9, however little of a sound the rate can carry; silence
        where it carries nothing.

    Raises:
        InvalidInputError, InvalidTypeError: On a sample rate or duration that makes less than one sample or more than
            `LONGEST`, or draws out of range.
    """
    check_integer("seed", seed, 0), check_kind("draws", draws, Draws)
    check_integer("sample_rate", sample_rate, 1, LONGEST)
    check_number("duration", duration, 1 / sample_rate, LONGEST / sample_rate, hint="It is from one sample on, in s.")
    for label, most in (("strike", 1.0), ("place", 1.0), ("pitch", torch.finfo(torch.float32).max)):
        values = getattr(draws, label)
        good = (values >= 0.0) & (values <= most)
        if not bool(good.all()):
            raise InvalidInputError(
                f"`draws.{label}` holds {bad_values(good)} that are NaN or out of range; they have to lie from 0 to "
                f"{most:g}."
            )
    time = torch.arange(round(duration * sample_rate), dtype=torch.float32) / sample_rate
    share = draws.noise[:, None]
    sound = (1.0 - share) * _unit_peak(modal_sounds(draws, time, sample_rate))
    sound += share * _unit_peak(grain_noise(seed, draws, time, sample_rate))
    return PEAK * _unit_peak(sound)


def modal_sounds(draws: Draws, time: Tensor, sample_rate: int) -> Tensor:
    """Sum of the modes of each struck object, (N, T).

    Args:
        draws: Numbers of the N contacts.
        time: Time since the strike, s, (T,).
        sample_rate: Hz.
    """
    order = torch.arange(1, MODES + 1, dtype=torch.float32)[None, :]
    fundamental = draws.of_material("fundamental")[:, None] * draws.pitch
    exponent = draws.inharmonicity[:, None]
    decay = draws.decay[:, None] * order**0.7
    frequency = fundamental * order**exponent
    # A soft strike excites few partials. |sin(i phi)| is mode i's shape at the place struck, phi from 0.6 to 2.1 rad;
    # 0.15 keeps a mode struck at its node just audible. These and the exponents are chosen, not measured.
    roll_off = torch.exp(-0.9 * (1.0 - draws.strike[:, None]) * (order - 1.0))
    place = torch.sin(order * (0.35 + 0.9 * draws.place[:, None]) * 1.7).abs() + 0.15
    amplitude = roll_off * place / order**0.6 * below_nyquist(frequency, sample_rate)
    sound = torch.zeros(len(draws), len(time))
    for mode in range(MODES):
        heard = torch.nonzero(amplitude[:, mode] > INAUDIBLE * amplitude.amax(dim=1))[:, 0]
        w, a, gain = (values[heard, mode, None] for values in (2 * torch.pi * frequency, decay, amplitude))
        sound[heard] += gain * impulse_response(w, a, time[None, :])
    return sound


def grain_noise(seed: int, draws: Draws, time: Tensor, sample_rate: int) -> Tensor:
    """Band-passed noise under an envelope of colliding grains, each an exact exponential, (N, T).

    Both convolutions are padded to twice the clip, so nothing wraps from its end to its start, and grains that arrive
    after the end are not heard: but for the band-pass's reach at the end, a longer clip begins with the same sound.

    Args:
        seed: Seed of the world.
        draws: Numbers of the N contacts.
        time: Time since the strike, s, (T,).
        sample_rate: Hz.
    """
    rows = []
    samples = len(time)
    hz = np.fft.rfftfreq(2 * samples, 1.0 / sample_rate)
    numbers = zip(draws.noise.tolist(), draws.noise_centre.tolist(), draws.grains.tolist(), strict=True)
    for name, (share, centre, grains) in zip(draws.names(), numbers, strict=True):
        if share == 0.0:  # nothing to hear, nothing to draw
            rows.append(np.zeros(samples, np.float32))
            continue
        rng = generator(seed, SOUND_STREAM, *name)
        arrivals = rng.exponential(GRAIN_DELAY, 1 + rng.poisson(grains))
        strength = rng.uniform(0.2, 1.0, len(arrivals)).astype(np.float32)
        index = (arrivals * sample_rate).astype(int)
        heard = index < samples
        impulses = np.zeros(samples, np.float32)
        np.add.at(impulses, index[heard], strength[heard])
        impulses[0] += 1.0  # the strike itself
        tail = np.exp(-time.numpy() * (40.0 + 0.12 * centre))
        spectrum = np.fft.rfft(impulses, 2 * samples) * np.fft.rfft(tail, 2 * samples)
        envelope = np.fft.irfft(spectrum)[:samples]
        noise = np.fft.rfft(white_noise(rng, samples, sample_rate) * envelope, 2 * samples)
        octaves = np.log2(np.maximum(hz, 1.0) / centre)
        band = np.exp(-0.5 * (octaves / 0.55) ** 2)
        rows.append(np.fft.irfft(noise * band, 2 * samples)[:samples].astype(np.float32))
    return torch.from_numpy(np.stack(rows))


def white_noise(rng: np.random.Generator, samples: int, sample_rate: int) -> np.ndarray:
    """White noise of unit variance, drawn at `SAMPLE_RATE` and carried to other rates by its spectrum, (samples,).

    So another rate samples the same noise: a higher one adds nothing to it, and a lower one keeps what it can carry.
    """
    if sample_rate == SAMPLE_RATE:
        return rng.standard_normal(samples, dtype=np.float32)
    common = math.gcd(SAMPLE_RATE, sample_rate)
    periods = math.ceil(samples * common / sample_rate)  # of 1 / common s, whole numbers of samples at both rates
    drawn = rng.standard_normal(periods * SAMPLE_RATE // common, dtype=np.float32)
    spectrum = np.fft.rfft(drawn)
    if len(drawn) % 2 == 0:
        spectrum[-1] = 0.0  # at the Nyquist frequency only the cosine is known
    length = periods * sample_rate // common
    return np.fft.irfft(spectrum, length)[:samples] * (length / len(drawn))


def _unit_peak(sound: Tensor) -> Tensor:
    """Scaled to a peak of 1; silence stays silence."""
    peak = sound.abs().amax(dim=-1, keepdim=True)
    return sound / torch.where(peak > 0, peak, 1.0)
