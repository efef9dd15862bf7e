"""Log-mel clips against torchaudio's formulae in loops; sounds of every kind."""

import math
import warnings
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.models import UniTouchProcessor
from unitouch_gen.models.sounds import LogMel, Sound, load_sounds

RATE = 16_000
NOISE = (0.3 * np.random.default_rng(0).standard_normal(RATE)).clip(-1, 1).astype(np.float32)
RAW = {"mean": 0.0, "std": 1.0}


def tone(hertz: float, seconds: float, rate: int = RATE) -> np.ndarray:
    return np.sin(2 * np.pi * hertz * np.arange(round(seconds * rate)) / rate).astype(np.float32)


def mel(hertz: float) -> float:
    return 1127.0 * math.log(1.0 + hertz / 700.0)


def reference(samples: np.ndarray, bins: int, number: int) -> list[float]:
    """One frame of `torchaudio.compliance.kaldi.fbank` with `htk_compat=True, use_energy=False, window_type="hanning",
    dither=0.0`, in float64.

    After torchaudio's documentation and Kaldi's feature-window.cc, feature-fbank.cc and mel-computations.cc.
    """
    lowest = mel(20.0)
    width = (mel(RATE / 2) - mel(20.0)) / (bins + 1)
    energies = []
    frame = [float(value) for value in samples[number * 160 : number * 160 + 400]]
    frame = [value - sum(frame) / 400 for value in frame]  # remove_dc_offset
    frame = [value - 0.97 * frame[max(i - 1, 0)] for i, value in enumerate(frame)]  # preemphasis_coefficient
    frame = [value * (0.5 - 0.5 * math.cos(2 * math.pi * i / 399)) for i, value in enumerate(frame)]
    power = np.abs(np.fft.fft(frame + [0.0] * 112)) ** 2  # round_to_power_of_two, use_power
    for index in range(bins):
        left, centre, right = (lowest + (index + edge) * width for edge in range(3))
        energy = 0.0
        for k in range(256):
            at = mel(k * RATE / 512)
            energy += power[k] * max(0.0, min((at - left) / (centre - left), (right - at) / (right - centre)))
        energies.append(math.log(max(energy, 2.0**-23)))  # use_log_fbank
    return energies


@pytest.mark.parametrize("bins", [128, 23])
def test_log_mel_frames_are_kaldis(bins: int) -> None:
    time = np.arange(RATE) / RATE
    ring = sum(a * np.exp(-d * time) * np.sin(2 * np.pi * f * time) for a, f, d in ((0.4, 440, 6), (0.2, 1830, 15)))
    samples = (ring + 0.02 * np.sin(2 * np.pi * (100 + 1800 * time) * time)).astype(np.float32)
    clip = LogMel(clip_seconds=1.0, clips=1, mel_bins=bins, frames=98, **RAW)(Sound(samples + np.float32(0.05), RATE))
    for number in (0, 9, 97):
        expected = reference(samples - samples.mean(), bins, number)
        np.testing.assert_allclose(clip[0, 0, :, number], expected, rtol=1e-3, atol=2e-3)


def test_the_paper_takes_three_clips_evenly_over_the_sound_and_warns_of_nothing() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        clips = LogMel()(Sound(np.tile(NOISE, 5), RATE))
    assert clips.shape == (3, 1, 128, 204)
    spread, single = (LogMel(clip_seconds=0.2, clips=clips, frames=18) for clips in (3, 1))
    starts = (0, 6400, 12800)  # first, middle and last 0.2 s of 1 s
    expected = torch.cat([single(Sound(NOISE[start : start + 3200], RATE)) for start in starts])
    torch.testing.assert_close(spread(Sound(NOISE, RATE)), expected)


def test_short_sounds_are_padded_before_scaling() -> None:
    clips = LogMel()(Sound(NOISE[:4000], RATE))
    frames = 1 + (4000 - 400) // 160
    assert torch.equal(clips[0], clips[1])
    assert torch.equal(clips[0], clips[2])
    torch.testing.assert_close(clips[0, 0, :, frames:], torch.full((128, 204 - frames), 4.268) / 9.138)
    one = LogMel(clips=1, frames=3, **RAW)(Sound(NOISE[:50], RATE))[0, 0]  # shorter than a frame
    assert torch.isfinite(one).all()
    assert (one[:, 0] != 0).any()
    assert (one[:, 1:] == 0).all()


def test_any_loudness_gives_finite_values_and_silence_the_floor() -> None:
    for level in (0.0, 1e-30, 1e18):
        clip = LogMel(clip_seconds=0.5, clips=1, frames=48, **RAW)(Sound((level * NOISE).astype(np.float32), RATE))
        assert torch.isfinite(clip).all()
        if level < 1e-20:
            torch.testing.assert_close(clip, torch.full_like(clip, float(np.log(np.finfo(np.float32).eps))))


def test_a_tone_of_another_rate_is_heard_at_the_same_pitch() -> None:
    log_mel = LogMel(clip_seconds=1.0, clips=1, frames=98, **RAW)
    rates = (RATE, 8_000, 22_050, 48_000)
    peaks = {int(log_mel(Sound(tone(1000.0, 1.0, rate), rate))[0, 0].mean(dim=1).argmax()) for rate in rates}
    assert len(peaks) == 1


# Kinds of sound -------------------------------------------------------------------------------------------------------


def test_every_kind_of_samples_gives_the_same_sound() -> None:
    integers = (NOISE.astype(np.float64) * np.iinfo(np.int32).max).astype(np.int32)
    kinds = [
        (NOISE, RATE),
        (torch.from_numpy(NOISE).requires_grad_(), RATE),
        (NOISE.astype(np.float64), RATE),
        (np.stack([NOISE - 0.1, NOISE + 0.1]), RATE),
        (NOISE.astype(">f4"), np.int64(RATE)),
        (integers, RATE),
        (torch.from_numpy(integers), RATE),
        (torch.from_numpy(NOISE).bfloat16(), RATE),
    ]
    sounds = load_sounds("audio", kinds)
    for sound in sounds:
        assert sound.rate == RATE
        assert sound.samples.dtype == np.float32
        np.testing.assert_allclose(sound.samples, NOISE, atol=1e-6 if sound is not sounds[-1] else 4e-3)


@pytest.mark.parametrize(("dtype", "bits"), [("i4", 16), ("i4", 24), ("i8", 16), ("i8", 32)])
def test_full_scale_of_wide_integers_is_that_of_the_bits_they_use(dtype: str, bits: int) -> None:
    with pytest.warns(UserWarning, match=f"full scale is taken to be {2 ** (bits - 1)}"):
        (sound,) = load_sounds("audio", ((2.0 ** (bits - 1) * 0.9 * NOISE).astype(dtype), RATE))
    np.testing.assert_allclose(sound.samples, 0.9 * NOISE, atol=1e-4)


@pytest.mark.parametrize("suffix", ["wav", "flac", "ogg", "mp3"])
def test_a_file_is_read_with_its_rate_and_channels(suffix: str, tmp_path: Path) -> None:
    left = 0.5 * tone(300.0, 0.5, 22_050)
    right = 0.5 * tone(700.0, 0.5, 22_050)
    file = tmp_path / f"\udcff.{suffix}"  # bytes that are no UTF-8, as Latin-1 leaves them
    soundfile.write(str(tmp_path / f"hit.{suffix}"), np.stack([left, right], axis=1), 22_050)
    (tmp_path / f"hit.{suffix}").rename(file)
    (sound,) = load_sounds("audio", file)
    assert sound.rate == 22_050
    if suffix != "mp3":  # which pads both ends
        tolerance = 0.1 if suffix == "ogg" else 1e-3
        np.testing.assert_allclose(sound.samples, (left + right) / 2, atol=tolerance)


@pytest.mark.parametrize(("other", "expected"), [(-1.0, 1.0), (-0.99, 1.0), (-1.5, -1.5), (0.0, 0.5), (1.0, 1.0)])
def test_channels_that_cancel_are_the_loudest_of_them(other: float, expected: float) -> None:
    (sound,) = load_sounds("audio", (np.stack([NOISE, other * NOISE]), RATE))
    np.testing.assert_allclose(sound.samples, expected * NOISE, atol=1e-6)


def test_silence_is_refused_where_it_is_asked_for(processor: UniTouchProcessor) -> None:
    silent = np.full(RATE, 0.5)
    assert processor.sounds((silent, RATE)).isfinite().all()
    with pytest.raises(InvalidInputError, match=r"`audio\[1\]` is silent"):
        processor.sounds([(NOISE, RATE), (silent, RATE)], audible=True)
