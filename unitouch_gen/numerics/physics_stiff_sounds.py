"""Stiff and extreme sounds: modes from over-damped to ringing, at and above the Nyquist frequency, and all strikes.

What no impact can be has to be refused.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from unitouch_gen.numerics.physics_case import apart, at_most, in_range
from unitouch_gen.numerics.stability import Case, Seen, refused
from unitouch_gen.world.draws import Draws, draw
from unitouch_gen.world.materials import MATERIAL_NAMES, MATERIALS
from unitouch_gen.world.sounds import PEAK, impact_sounds, impulse_response

DAMPING = (1e-6, 1e-3, 0.1, 0.999999, 1.0, 1.000001, 10.0, 1e3, 1e6)
ANGULAR = 2000.0
"""Undamped angular frequency of the modes that are struck, rad/s."""

ROUNDING = 1e-5


def energy(ratio: float) -> Tensor:
    """q'^2 + w^2 q^2 of a mode struck at t = 0, over its first energy, at 400 times up to 0.3 s, float64."""
    w = torch.tensor([ANGULAR], dtype=torch.float64)
    times = torch.linspace(1e-6, 0.3, 400, dtype=torch.float64)
    with torch.enable_grad():
        times.requires_grad_()
        response = impulse_response(w, ratio * w, times)  # w q
        (speed,) = torch.autograd.grad(response.sum(), times)  # w q', and q'(0) = 1
    return (response.detach() ** 2 + (speed / ANGULAR) ** 2).detach()


def mode_cases() -> Iterator[Case]:
    """Damping from none to far beyond the critical."""
    for ratio in DAMPING:
        yield Case(
            f"mode at {ratio} of critical damping",
            "never gains energy, and starts with that of the strike at most",
            lambda r=ratio: _never_gains(energy(r)),  # type: ignore[misc]
        )
    w, times = torch.tensor([[500.0]]), torch.linspace(0.0, 0.05, 400)
    beside = torch.tensor([1 - 1e-6, 1.0, 1 + 1e-6])[:, None] * w
    extreme = torch.tensor([[1e-6], [1.0], [1e5], [1e12], [1e18]])
    long = torch.tensor([0.0, 1e-9, 1e-3, 1.0, 1e6])
    for name, expected, run in (
        ("mode without damping", "keeps its energy", lambda: apart(energy(0.0), torch.ones(400), 1e-9)),
        ("critical damping from both sides", "passes into one another",
         lambda: at_most(impulse_response(w, beside, times).diff(dim=0).abs().max(), 1e-4)),
        ("frequencies from 1e-6 to 1e18 rad/s", "are finite, undamped",
         lambda: in_range(impulse_response(extreme, 0 * extreme, long), -1.0 - ROUNDING, 1.0 + ROUNDING)),
        ("dampings from 1e-6 to 1e18 1/s", "are finite, and within the undamped swing",
         lambda: in_range(impulse_response(0 * extreme + 1e3, extreme, long), -1.0 - ROUNDING, 1.0 + ROUNDING)),
    ):  # fmt: skip
        yield Case(name, expected, run)


def _never_gains(energies: Tensor) -> Seen:
    gained = max(float(energies.diff().max()), float(energies.max()) - 1.0)
    return Seen(gained <= 1e-12, f"gains at most {gained:.1e} of the strike", gained)


# Impacts ------------------------------------------------------------------------------------------------------------


def impacts(material: str | None = None, **numbers: float) -> Draws:
    """One impact on each material, or on one, with some of their numbers set."""
    index = torch.arange(len(MATERIALS)) if material is None else torch.tensor([MATERIAL_NAMES.index(material)])
    draws = draw(0, index, torch.ones_like(index), torch.zeros_like(index))
    return replace(draws, **{name: torch.full((len(index),), value) for name, value in numbers.items()})


def hear(draws: Draws, **options: Any) -> Tensor:
    """The sounds of some impacts."""
    return impact_sounds(0, draws, **options)


def centroid(sounds: Tensor) -> Tensor:
    """Mean frequency of each sound's power, in bins, (N,)."""
    power = torch.fft.rfft(sounds).abs().square()
    return (power * torch.arange(power.shape[1])).sum(dim=1) / power.sum(dim=1)


def sound_cases() -> Iterator[Case]:
    """Pitches, strikes, clips and rates at their ends."""
    silence, peaks = torch.zeros(1, 1), "has one peak of 0.9"
    glass = MATERIALS[MATERIAL_NAMES.index("glass")].fundamental
    nyquist = 8000.0 / glass

    def loudest(draws: Draws, **options: Any) -> Seen:
        return apart(hear(draws, **options).abs().amax(dim=1), torch.tensor(PEAK), ROUNDING)

    def brighter() -> Seen:
        struck = [centroid(hear(impacts(strike=strike))[modal]) for strike in (0.0, 0.5, 1.0)]
        least = float(torch.stack(struck).diff(dim=0).min())
        return Seen(least >= 0.0, f"least rise {least:.2g} bins", least)

    def fading() -> Seen:
        blocks = hear(impacts("metal"), duration=4.0)[0].unfold(0, 4000, 4000).square().sum(dim=1)
        kept = float((blocks[1:] / blocks[:-1]).max())
        return Seen(kept < 1.0, f"keeps at most {kept:.2f} of its energy", kept)

    modal = torch.tensor([spec.noise == 0.0 for spec in MATERIALS])
    for name, expected, run in (
        ("every material", peaks, lambda: loudest(impacts())),
        ("softest strike", peaks, lambda: loudest(impacts(strike=0.0))),
        ("hardest strike", peaks, lambda: loudest(impacts(strike=1.0))),
        ("strikes from soft to hard", "sound ever brighter", brighter),
        ("fundamental just below the Nyquist frequency", peaks,
         lambda: loudest(impacts("glass", pitch=0.999 * nyquist))),
        ("fundamental just above the Nyquist frequency", "is silent",
         lambda: apart(hear(impacts("glass", pitch=1.0001 * nyquist)), silence)),
        ("fundamental of 1e30 Hz", "is silent", lambda: apart(hear(impacts("glass", pitch=1e27)), silence)),
        ("pitch 0", "is silent", lambda: apart(hear(impacts("glass", pitch=0.0)), silence)),
        ("metal for 4 s", "fades from each quarter second to the next", fading),
        ("a clip of one sample", "is finite and in range",
         lambda: in_range(hear(impacts(), duration=1 / 16_000), -PEAK - ROUNDING, PEAK + ROUNDING)),
        ("one sample a second", "is finite and in range",
         lambda: in_range(hear(impacts(), sample_rate=1, duration=4.0), -PEAK - ROUNDING, PEAK + ROUNDING)),
        ("192 kHz", peaks, lambda: loudest(impacts(), sample_rate=192_000, duration=0.05)),
        ("no grains but the strike", peaks, lambda: loudest(impacts(), grains=0)),
        ("500 modes", peaks, lambda: loudest(impacts("rubber"), modes=500, inaudible=0.0)),
    ):  # fmt: skip
        yield Case(name, expected, run)


def refused_sounds() -> Iterator[Case]:
    """What no impact can be."""
    for name, call, named in (
        ("strike of 1000", lambda: hear(impacts(strike=1e3)), "draws.strike"),
        ("strike of -1", lambda: hear(impacts(strike=-1.0)), "draws.strike"),
        ("strike of NaN", lambda: hear(impacts(strike=math.nan)), "draws.strike"),
        ("pitch of NaN", lambda: hear(impacts(pitch=math.nan)), "draws.pitch"),
        ("pitch without end", lambda: hear(impacts(pitch=math.inf)), "draws.pitch"),
        ("sample rate 0", lambda: hear(impacts(), sample_rate=0), "sample_rate"),
        ("clip of no length", lambda: hear(impacts(), duration=0.0), "duration"),
        ("clip without end", lambda: hear(impacts(), duration=math.inf), "duration"),
        ("no modes", lambda: hear(impacts(), modes=0), "modes"),
    ):
        yield refused(name, call, named)
