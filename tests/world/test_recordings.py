"""Sounds as they are drawn, of classes that overlap, and recorded somewhere."""

import numpy as np
import pytest
import torch
from torch import Tensor

from unitouch_gen.world import MATERIAL_NAMES, SAMPLE_RATE, World
from unitouch_gen.world.draws import HEARD, Draws, draw
from unitouch_gen.world.recordings import recorded
from unitouch_gen.world.sounds import PEAK, impact_sounds

OBJECTS = 24
METAL = MATERIAL_NAMES.index("metal")


def draws_of(material: int, count: int = OBJECTS) -> Draws:
    return draw(0, torch.full((count,), material), torch.arange(count), torch.zeros(count, dtype=torch.int64))


def ringing(count: int = OBJECTS) -> Draws:
    """Metal struck so softly that little but its lowest mode is excited, and without grains."""
    drawn = draws_of(METAL, count)
    drawn.noise[:], drawn.strike[:] = 0.0, 0.0
    return drawn


def test_the_fundamental_heard_is_the_one_drawn_and_covers_an_octave() -> None:
    drawn = ringing()
    spectrum = np.abs(np.fft.rfft(impact_sounds(0, drawn).numpy(), 1 << 16))
    heard = np.fft.rfftfreq(1 << 16, 1 / SAMPLE_RATE)[spectrum.argmax(axis=1)]
    expected = drawn.of_material("fundamental") * drawn.pitch[:, 0]
    np.testing.assert_allclose(heard, expected, rtol=0.01)
    assert heard.max() > 2.0 * heard.min()


def test_sounds_fade_as_fast_as_drawn() -> None:
    drawn = ringing()
    power = impact_sounds(0, drawn, duration=1.0).square()
    early, late = (power[:, start : start + SAMPLE_RATE // 4].sum(dim=1) for start in (0, SAMPLE_RATE // 4))
    torch.testing.assert_close(torch.log(early / late) / 0.5, drawn.decay, rtol=0.1, atol=0.1)


def test_no_fundamental_is_beyond_hearing() -> None:
    for material in range(len(MATERIAL_NAMES)):
        drawn = draws_of(material, 60)
        lowest = drawn.of_material("fundamental") * drawn.pitch[:, 0]
        assert lowest.min() > 0.8 * HEARD[0] and lowest.max() < 1.25 * HEARD[1]


def bands(sounds: Tensor) -> Tensor:
    """Log power (N, 24) in bands of a quarter of an octave."""
    power = torch.fft.rfft(sounds).abs().square()
    hertz = torch.fft.rfftfreq(sounds.shape[1], 1 / SAMPLE_RATE)
    band = (4 * torch.log2(hertz.clamp_min(1.0) / 125.0)).floor()
    return torch.stack([power[:, band == number].mean(dim=1) for number in range(24)], dim=1).clamp_min(1e-9).log()


def test_classes_overlap_and_still_tell_something() -> None:
    material = torch.arange(16).repeat_interleave(OBJECTS)
    names = material, torch.arange(OBJECTS).repeat(16), torch.zeros_like(material)
    found = bands(World(0).render(*names, modalities=("audio",)).audio).view(16, OBJECTS, -1)
    known, others = found[:, ::2], found[:, 1::2]
    nearest = torch.cdist(others.flatten(0, 1), known.mean(dim=1)).argmin(dim=1).view(16, -1)
    assert 4 / 16 < (nearest == torch.arange(16)[:, None]).float().mean() < 0.8


# Recordings -----------------------------------------------------------------------------------------------------------

NAMES = [(3, 0, contact) for contact in range(40)]


@pytest.fixture(scope="module")
def clicks() -> Tensor:
    """Impulses, as they are recorded."""
    sounds = torch.zeros(len(NAMES), 4000)
    sounds[:, 0] = PEAK
    return recorded(0, NAMES, sounds)


def test_recordings_are_of_many_levels_and_none_too_loud(clicks: Tensor) -> None:
    peaks = 20 * torch.log10(clicks.abs().amax(dim=1) / PEAK)
    assert peaks.max() <= 1e-3 and peaks.min() >= -20.001
    assert peaks.max() - peaks.min() > 10.0


def test_a_sound_arrives_within_20_ms_and_its_echoes_within_60_more(clicks: Tensor) -> None:
    late = clicks.abs().argmax(dim=1) / SAMPLE_RATE
    assert late.max() < 0.09 and late.unique().numel() > 20
    before, after = (part.square().mean(dim=1) for part in (clicks[:, :1280], clicks[:, 1600:]))
    assert (after < before).all()  # nothing but noise is left


def test_a_recording_is_the_same_alone_and_in_a_batch_and_another_for_each_contact(clicks: Tensor) -> None:
    sound = torch.zeros(1, 4000)
    sound[:, 0] = PEAK
    torch.testing.assert_close(recorded(0, NAMES[7:8], sound)[0], clicks[7], rtol=0, atol=1e-6)
    assert not torch.allclose(clicks[7], clicks[8], atol=0.01)


def test_silence_is_recorded_as_noise() -> None:
    noise = recorded(0, NAMES, torch.zeros(len(NAMES), 4000))
    assert torch.isfinite(noise).all()
    assert (noise.std(dim=1) > 0).all()
