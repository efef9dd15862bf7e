"""Damped oscillators against scipy; impact sounds without aliasing or wrap-around; what rooms and microphones add."""

import numpy as np
import pytest
import torch
from scipy.signal import impulse
from torch import Tensor

from unitouch_gen.world import DURATION, MATERIAL_NAMES, MATERIALS, SAMPLE_RATE
from unitouch_gen.world.draws import MODES, Draws, draw
from unitouch_gen.world.sounds import PEAK, grain_noise, impact_sounds, impulse_response, modal_sounds, recorded

TIME = torch.linspace(0.0, 0.05, 400, dtype=torch.float64)


def column(value: float) -> Tensor:
    return torch.tensor([value], dtype=torch.float64)


def draws_of(material: str, count: int = 24) -> Draws:
    index = torch.full((count,), MATERIAL_NAMES.index(material))
    return draw(0, index, torch.arange(count), torch.zeros_like(index))


ALL = draw(0, torch.arange(17), torch.ones(17, dtype=torch.int64), torch.arange(17))


@pytest.mark.parametrize("ratios", [(0.0, 0.01, 0.5, 0.99), (0.01, 0.99, 1.0, 1.01, 2.0, 30.0)])
def test_the_response_is_scipys_impulse_response_in_all_regimes_of_a_batch(ratios: tuple[float, ...]) -> None:
    w = 800.0
    a = w * torch.tensor(ratios, dtype=torch.float64)[:, None]
    for found, decay in zip(impulse_response(torch.full_like(a, w), a, TIME), a.flatten().tolist(), strict=True):
        _, expected = impulse(([w], [1.0, 2 * decay, w * w]), T=TIME.numpy())
        np.testing.assert_allclose(found.numpy(), expected, rtol=0, atol=2e-6)


@pytest.mark.parametrize("excess", [-1e-11, 0.0, 1e-12, 1e-11])
def test_at_critical_damping_the_response_is_its_limit(excess: float) -> None:
    w = 500.0
    response = impulse_response(column(w), column(w * (1 + excess)), TIME)
    torch.testing.assert_close(response, w * TIME * torch.exp(-w * TIME), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("strike", [0.0, 1.0])
def test_every_material_sounds_finite_with_one_peak(strike: float) -> None:
    sound = impact_sounds(0, ALL.but(strike=torch.full((17,), strike)))
    assert sound.shape == (17, round(DURATION * SAMPLE_RATE))
    assert torch.isfinite(sound).all()
    torch.testing.assert_close(sound.abs().amax(dim=1), torch.full((17,), PEAK))


@pytest.mark.parametrize("hertz", [0.0, 8000.1, 1e30])
def test_a_fundamental_that_no_rate_carries_is_silent(hertz: float) -> None:
    pitch = torch.full((1, MODES), hertz / MATERIALS[MATERIAL_NAMES.index("glass")].fundamental)
    assert not impact_sounds(0, draws_of("glass", 1).but(pitch=pitch, noise=torch.zeros(1))).any()


def ringing() -> Draws:
    """Metal struck so softly that little but its lowest mode is excited, and without grains."""
    drawn = draws_of("metal")
    return drawn.but(noise=0.0 * drawn.noise, strike=0.0 * drawn.strike)


def test_the_fundamental_heard_is_the_one_drawn_and_covers_an_octave() -> None:
    drawn = ringing()
    spectrum = np.abs(np.fft.rfft(impact_sounds(0, drawn).numpy(), 1 << 16))
    heard = np.fft.rfftfreq(1 << 16, 1 / SAMPLE_RATE)[spectrum.argmax(axis=1)]
    np.testing.assert_allclose(heard, drawn.of_material("fundamental") * drawn.pitch[:, 0], rtol=0.01)
    assert heard.max() > 2.0 * heard.min()
    for made in map(draws_of, MATERIAL_NAMES):
        lowest = made.of_material("fundamental") * made.pitch[:, 0]
        assert lowest.min() > 0.8 * 40.0
        assert lowest.max() < 1.25 * 5000.0


def test_sounds_fade_as_fast_as_drawn() -> None:
    drawn = ringing()
    time = torch.arange(SAMPLE_RATE) / SAMPLE_RATE
    power = modal_sounds(drawn, time).square()
    early, late = (power[:, start : start + SAMPLE_RATE // 4].sum(dim=1) for start in (0, SAMPLE_RATE // 4))
    torch.testing.assert_close(torch.log(early / late) / 0.5, drawn.decay, rtol=0.1, atol=0.1)


@pytest.mark.parametrize("material", ["sand", "grass", "gravel", "leather"])
def test_a_longer_clip_of_grains_begins_with_the_same_sound_and_none_pile_up_on_its_end(material: str) -> None:
    drawn = draws_of(material, 60)
    samples = round(DURATION * SAMPLE_RATE)
    reach = 400  # a few periods of the lowest
    short, long = (grain_noise(0, drawn, length) for length in (samples, 2 * samples))
    atol = 2e-3 * long.abs().max().item()
    torch.testing.assert_close(short[:, :-reach], long[:, : samples - reach], rtol=0, atol=atol)
    loudness = short.square().mean(dim=0).sqrt()
    assert loudness[-1] < 2 * loudness[-51:-1].square().mean().sqrt()
    assert not torch.equal(short, grain_noise(1, drawn, samples))


def test_recordings_are_late_echo_and_are_of_many_levels() -> None:
    names = [(3, 0, contact) for contact in range(40)]
    sounds = torch.zeros(40, 4000)
    sounds[:, 0] = PEAK
    heard = recorded(0, names, sounds)
    peaks = 20 * torch.log10(heard.abs().amax(dim=1) / PEAK)
    assert peaks.max() <= 1e-3
    assert peaks.min() >= -20.001
    assert peaks.max() - peaks.min() > 10.0
    late = heard.abs().argmax(dim=1) / SAMPLE_RATE
    assert late.max() < 0.09
    assert late.unique().numel() > 20
    before, after = (part.square().mean(dim=1) for part in (heard[:, :1280], heard[:, 1600:]))
    assert (after < before).all()  # nothing but noise is left
    torch.testing.assert_close(recorded(0, names[7:8], sounds[:1])[0], heard[7], rtol=0, atol=1e-6)
    silence = recorded(0, names, torch.zeros(40, 4000))
    assert torch.isfinite(silence).all()
    assert (silence.std(dim=1) > 0).all()
