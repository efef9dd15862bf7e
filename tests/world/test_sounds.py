"""Damped oscillators against scipy, and impact sounds: no aliasing, no wrap-around, one peak, independence."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.signal import impulse

from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.world import DURATION, MATERIAL_NAMES, MATERIALS, SAMPLE_RATE
from unitouch_gen.world.draws import MODES, Draws, draw
from unitouch_gen.world.sounds import (
    PEAK,
    below_nyquist,
    grain_noise,
    impact_sounds,
    impulse_response,
    white_noise,
)

TIME = torch.linspace(0.0, 0.05, 400, dtype=torch.float64)


def column(value: float) -> torch.Tensor:
    return torch.tensor([value], dtype=torch.float64)


def draws_of(material: str, count: int = 1, seed: int = 0) -> Draws:
    index = torch.full((count,), MATERIAL_NAMES.index(material))
    return as_materials_are(draw(seed, index, torch.arange(count), torch.zeros(count, dtype=torch.int64)))


def as_materials_are(drawn: Draws) -> Draws:
    """Without what objects differ by."""
    usual = {name: drawn.of_material(name) for name in ("noise", "inharmonicity", "decay", "noise_centre")}
    return replace(drawn, **usual)


ALL = draw(0, torch.arange(len(MATERIALS)), torch.ones(len(MATERIALS), dtype=torch.int64), torch.arange(len(MATERIALS)))


@pytest.mark.parametrize("ratio", [0.0, 0.01, 0.5, 0.99, 1.0, 1.01, 2.0, 30.0])
def test_the_response_is_scipys_impulse_response(ratio: float) -> None:
    w = 800.0
    a = ratio * w
    _, expected = impulse(([w], [1.0, 2 * a, w * w]), T=TIME.numpy())
    np.testing.assert_allclose(impulse_response(column(w), column(a), TIME).numpy(), expected, rtol=0, atol=2e-6)


@pytest.mark.parametrize("a", [40.0, 300.0, 2500.0])
def test_the_response_solves_the_oscillators_equation(a: float) -> None:
    w = 300.0
    solved = solve_ivp(
        lambda _, y: [y[1], -2 * a * y[1] - w * w * y[0]],
        (0.0, 0.05), [0.0, 1.0], t_eval=TIME.numpy(), method="Radau", rtol=1e-10, atol=1e-13,
    )  # fmt: skip
    np.testing.assert_allclose(impulse_response(column(w), column(a), TIME).numpy(), w * solved.y[0], atol=1e-7)


@pytest.mark.parametrize("excess", [-1e-11, 0.0, 1e-12, 1e-11])
def test_at_critical_damping_the_response_is_its_limit(excess: float) -> None:
    w = 500.0
    response = impulse_response(column(w), column(w * (1 + excess)), TIME)
    torch.testing.assert_close(response, w * TIME * torch.exp(-w * TIME), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_response_is_continuous_across_critical_damping(dtype: torch.dtype) -> None:
    w = torch.tensor([[500.0]], dtype=dtype)
    a = w * (1 + torch.tensor([-1e-3, -1e-5, -1e-7, 0.0, 1e-7, 1e-5, 1e-3], dtype=dtype))[:, None]
    response = impulse_response(w, a, TIME.to(dtype))
    assert torch.isfinite(response).all()
    # d(w q)/da is at most t w q ~ 1e-3 x the response here, so a step of 1e-3 w moves it by less than 2e-3.
    assert response.diff(dim=0).abs().max() < 2e-3


def test_regimes_in_one_batch_are_the_same_as_alone() -> None:
    w, a = torch.tensor([[400.0], [400.0], [400.0]]), torch.tensor([[10.0], [400.0], [9000.0]])
    together = impulse_response(w, a, TIME.float())
    for row in range(3):
        assert torch.equal(together[row], impulse_response(w[row], a[row], TIME.float()))


def test_a_huge_decay_leaves_the_slow_root_only() -> None:
    w, a, time = torch.tensor([2000.0]), torch.tensor([1e6]), torch.linspace(1e-4, 0.2, 50)
    slow = 2000.0**2 / (2 * 1e6)  # s = w^2 / (a + sqrt(a^2 - w^2)) -> w^2 / 2a
    torch.testing.assert_close(
        impulse_response(w, a, time), 2000.0 / (2 * 1e6) * torch.exp(-slow * time), rtol=1e-4, atol=1e-12
    )


@pytest.mark.parametrize("a", [0.0, 1e-3, 1e3, 1e6, 1e12, 1e18])
@pytest.mark.parametrize("w", [1e-6, 1.0, 1e5, 1e12])
def test_the_response_is_finite_at_extremes(w: float, a: float) -> None:
    response = impulse_response(torch.tensor([w]), torch.tensor([a]), torch.tensor([0.0, 1e-9, 1e-3, 1.0, 1e6]))
    assert torch.isfinite(response).all()
    assert response[0] == 0.0


def test_modes_at_or_above_the_nyquist_frequency_weigh_nothing() -> None:
    weight = below_nyquist(torch.tensor([8000.0, 8000.1, 1e5]), 16_000)
    assert torch.equal(weight, torch.zeros(3))


def test_modes_well_below_the_nyquist_frequency_weigh_one() -> None:
    weight = below_nyquist(torch.tensor([1.0, 6399.0]), 16_000)
    assert torch.equal(weight, torch.ones(2))


def test_weights_fall_between() -> None:
    weight = below_nyquist(torch.linspace(6400.0, 8000.0, 20), 16_000)
    assert (weight.diff() < 0).all()


def test_a_mode_above_the_nyquist_frequency_adds_nothing() -> None:
    # At 6 kHz only glass's fundamental (about 2.3 kHz) is below the Nyquist frequency; its second is above 6 kHz.
    draws, rate = draws_of("glass"), 6000
    draws.pitch = torch.ones(1, MODES)
    glass = MATERIALS[MATERIAL_NAMES.index("glass")]
    assert glass.noise == 0.0
    assert glass.fundamental < 0.4 * rate
    assert glass.fundamental * 2**glass.inharmonicity > 0.5 * rate
    time = torch.arange(round(DURATION * rate)) / rate
    alone = impulse_response(torch.tensor([2 * torch.pi * glass.fundamental]), torch.tensor([glass.decay]), time)
    torch.testing.assert_close(
        impact_sounds(0, draws, sample_rate=rate)[0], PEAK * alone / alone.abs().max(), rtol=0, atol=2e-4
    )


def test_a_sound_with_no_audible_mode_is_silent() -> None:
    sound = impact_sounds(0, draws_of("glass"), sample_rate=3000)
    assert torch.equal(sound, torch.zeros_like(sound))


@pytest.mark.parametrize("hertz", [0.0, 8000.1, 1e30])
def test_a_fundamental_that_no_rate_carries_is_silent(hertz: float) -> None:
    pitch = torch.full((1, MODES), hertz / MATERIALS[MATERIAL_NAMES.index("glass")].fundamental)
    sound = impact_sounds(0, replace(draws_of("glass"), pitch=pitch))
    assert torch.equal(sound, torch.zeros_like(sound))


@pytest.mark.parametrize("options", [{"duration": 1 / SAMPLE_RATE}, {"sample_rate": 1, "duration": 4.0}])
def test_next_to_no_samples_are_finite_and_in_range(options: dict) -> None:
    assert impact_sounds(0, ALL, **options).abs().max() <= PEAK * (1 + 1e-6)


def test_metal_fades_from_each_quarter_of_a_second_to_the_next() -> None:
    quarters = impact_sounds(0, draws_of("metal"), duration=4.0)[0].unfold(0, 4000, 4000).square().sum(dim=1)
    assert (quarters.diff() < 0).all()


def test_a_harder_strike_sounds_brighter() -> None:
    modal = torch.tensor([spec.noise == 0.0 for spec in MATERIALS])
    centroids = []
    for strike in (0.0, 0.5, 1.0):
        sound = impact_sounds(0, replace(ALL, strike=torch.full((len(ALL),), strike)))[modal]
        power = torch.fft.rfft(sound).abs().square()
        centroids.append((power * torch.arange(power.shape[1])).sum(dim=1) / power.sum(dim=1))
    assert (torch.stack(centroids).diff(dim=0) >= 0).all()


@pytest.mark.parametrize("strike", [0.0, 1.0])
@pytest.mark.parametrize("options", [{}, {"sample_rate": 192_000}])
def test_every_material_sounds_finite_with_one_peak(strike: float, options: dict) -> None:
    sound = impact_sounds(0, replace(ALL, strike=torch.full((len(ALL),), strike)), **options)
    assert sound.shape == (len(MATERIALS), round(DURATION * options.get("sample_rate", SAMPLE_RATE)))
    assert torch.isfinite(sound).all()
    torch.testing.assert_close(sound.abs().amax(dim=1), torch.full((len(MATERIALS),), PEAK))


def test_a_higher_pitch_raises_the_spectrum() -> None:
    draws = draws_of("metal")
    centroids = []
    for pitch in (0.9, 1.1):
        draws.pitch = torch.full((1, MODES), pitch)
        power = np.abs(np.fft.rfft(impact_sounds(0, draws)[0].numpy())) ** 2
        centroids.append((power * np.arange(len(power))).sum() / power.sum())
    assert centroids[1] > centroids[0]


def test_a_fundamental_is_heard_where_it_belongs() -> None:
    draws = draws_of("metal")
    draws.pitch, draws.strike = torch.ones(1, MODES), torch.tensor([0.3])
    spectrum = np.abs(np.fft.rfft(impact_sounds(0, draws)[0].numpy(), 1 << 16))
    hertz = np.fft.rfftfreq(1 << 16, 1 / SAMPLE_RATE)
    fundamental = MATERIALS[MATERIAL_NAMES.index("metal")].fundamental
    near = (hertz > 0.5 * fundamental) & (hertz < 1.5 * fundamental)
    assert hertz[near][spectrum[near].argmax()] == pytest.approx(fundamental, rel=0.01)


def test_sounds_depend_on_the_seed_where_there_are_grains() -> None:
    draws = draws_of("sand")
    assert torch.equal(impact_sounds(0, draws), impact_sounds(0, draws))
    assert not torch.equal(impact_sounds(0, draws), impact_sounds(1, draws))


def noise_of(draws: Draws, samples: int) -> torch.Tensor:
    return grain_noise(0, draws, torch.arange(samples) / SAMPLE_RATE, SAMPLE_RATE)


@pytest.mark.parametrize("material", [spec.name for spec in MATERIALS if spec.noise])
def test_a_longer_clip_of_grains_begins_with_the_same_sound(material: str) -> None:
    samples, reach = round(DURATION * SAMPLE_RATE), 200  # reach: a few periods of the lowest band, 500 Hz
    short, long = (noise_of(draws_of(material, 20), length)[:, : samples - reach] for length in (samples, 2 * samples))
    torch.testing.assert_close(short, long, rtol=0, atol=1e-4 * long.abs().max().item())


@pytest.mark.parametrize("material", ["sand", "grass", "synthetic fabric"])
def test_grains_due_after_the_end_do_not_pile_up_on_it(material: str) -> None:
    noise = noise_of(draws_of(material, 60), round(DURATION * SAMPLE_RATE))
    loudness = noise.square().mean(dim=0).sqrt()
    assert loudness[-1] < 2 * loudness[-51:-1].square().mean().sqrt()


def test_a_sound_is_the_same_alone_and_in_a_batch() -> None:
    together = impact_sounds(0, ALL)
    for row in (0, 4, 8, 15):
        material = torch.tensor([row])
        alone = impact_sounds(0, draw(0, material, torch.ones(1, dtype=torch.int64), material))
        torch.testing.assert_close(alone[0], together[row], rtol=0, atol=1e-6)


# Sampling rates -------------------------------------------------------------------------------------------------------


def impacts() -> Draws:
    index = torch.arange(len(MATERIALS))
    return as_materials_are(draw(0, index, torch.ones_like(index), index))


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
    assert (cosines[heard] > 0.3).all()  # of other noise: about 1 / sqrt(520 bins) = 0.04
    assert np.median(cosines[heard]) > 0.9


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"sample_rate": 0}, "sample_rate"),
        ({"sample_rate": 16_000.0}, "sample_rate"),
        ({"duration": 0.0}, "duration"),
        ({"duration": math.nan}, "duration"),
        ({"duration": math.inf}, "duration"),
        ({"duration": None}, "duration"),
        ({"duration": 1e12}, "duration"),
        ({"sample_rate": True}, "sample_rate"),
        ({"sample_rate": 10**12}, "sample_rate"),
        ({"seed": "x"}, "seed"),
        ({"draws": None}, "draws"),
    ],
)
def test_a_bad_sound_is_refused_by_name(options: dict, named: str) -> None:
    with pytest.raises((InvalidInputError, InvalidTypeError), match=f"`{named}`"):
        impact_sounds(**{"seed": 0, "draws": impacts(), **options})


def test_a_strike_beyond_the_hardest_is_refused_by_name() -> None:
    draws = replace(ALL, strike=torch.full((len(ALL),), 1e3))
    with pytest.raises(ValueError, match=r"`draws.strike` holds 17 of 17 values"):
        impact_sounds(0, draws)


@pytest.mark.parametrize("value", [math.nan, math.inf, -1.0])
@pytest.mark.parametrize("number", ["strike", "pitch", "place"])
def test_bad_draws_are_refused_by_name(number: str, value: float) -> None:
    draws = impacts()
    setattr(draws, number, torch.full((len(draws),), value))
    with pytest.raises(ValueError, match=number):
        impact_sounds(0, draws)
