"""One contact, one sound: at other sample rates, with other numbers of modes and grains, and what is refused."""

import math

import numpy as np
import pytest
import torch

from unitouch_gen.world import DURATION, MATERIALS, SAMPLE_RATE
from unitouch_gen.world.draws import Draws, draw
from unitouch_gen.world.sounds import INAUDIBLE, MODES, grain_noise, impact_sounds, white_noise


def impacts() -> Draws:
    index = torch.arange(len(MATERIALS))
    return draw(0, index, torch.ones_like(index), index)


def noise(samples: int, rate: int) -> np.ndarray:
    return white_noise(np.random.default_rng(0), samples, rate)


@pytest.mark.parametrize("factor", [2, 3, 5])
def test_a_higher_rate_meets_the_same_noise_at_shared_times(factor: int) -> None:
    base = noise(101, SAMPLE_RATE)
    np.testing.assert_allclose(noise(101 * factor, SAMPLE_RATE * factor)[::factor], base, atol=1e-5)


@pytest.mark.parametrize("rate", [8000, 22_050, 44_100, 48_000])
def test_noise_has_the_same_waves_at_every_rate(rate: int) -> None:
    # 0.32 s: a whole number of samples at all of these rates, so waves fall on bins of 3.125 Hz.
    base = np.fft.rfft(noise(5120, SAMPLE_RATE)) / 5120
    other = np.fft.rfft(noise(round(0.32 * rate), rate)) / round(0.32 * rate)
    shared = min(len(base), len(other)) - 1
    np.testing.assert_allclose(other[:shared], base[:shared], atol=1e-6)


@pytest.mark.parametrize("rate", [8000, 32_000])
def test_grains_sound_alike_at_another_rate(rate: int) -> None:
    def spectrum(sample_rate: int) -> np.ndarray:
        time = torch.arange(round(DURATION * sample_rate)) / sample_rate
        made = np.fft.rfft(grain_noise(0, impacts(), time, sample_rate).numpy())[:, : round(2000 * DURATION)]
        return made / np.linalg.norm(made, axis=1, keepdims=True).clip(1e-9)

    cosines = np.abs((spectrum(rate).conj() * spectrum(SAMPLE_RATE)).sum(axis=1))
    heard = np.array([spec.noise > 0 for spec in MATERIALS])
    assert (cosines[heard] > 0.7).all()  # of other noise: about 1 / sqrt(520 bins) = 0.04
    assert np.median(cosines[heard]) > 0.95


def test_the_defaults_are_what_they_are_said_to_be() -> None:
    spelled = impact_sounds(
        0, impacts(), sample_rate=SAMPLE_RATE, duration=DURATION, modes=MODES, inaudible=INAUDIBLE, grains=10**6
    )
    assert torch.equal(impact_sounds(0, impacts()), spelled)


def test_fewer_grains_change_only_sounds_that_have_more() -> None:
    changed = (impact_sounds(0, impacts(), grains=0) != impact_sounds(0, impacts())).any(dim=1)
    assert torch.equal(changed, torch.tensor([spec.noise > 0 for spec in MATERIALS]))


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"sample_rate": 0}, "sample_rate"),
        ({"sample_rate": 16_000.0}, "sample_rate"),
        ({"duration": 0.0}, "duration"),
        ({"duration": math.nan}, "duration"),
        ({"duration": math.inf}, "duration"),
        ({"modes": 0}, "modes"),
        ({"grains": -1}, "grains"),
    ],
)
def test_a_bad_sound_is_refused_by_name(options: dict, named: str) -> None:
    with pytest.raises(ValueError, match=f"`{named}`"):
        impact_sounds(0, impacts(), **options)


@pytest.mark.parametrize("value", [math.nan, math.inf, -1.0])
@pytest.mark.parametrize("number", ["strike", "pitch", "place"])
def test_bad_draws_are_refused_by_name(number: str, value: float) -> None:
    draws = impacts()
    setattr(draws, number, torch.full((len(draws),), value))
    with pytest.raises(ValueError, match=number):
        impact_sounds(0, draws)
