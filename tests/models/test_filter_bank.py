"""The filter bank against torchaudio's formulae written out in loops, values stored of them, and transformers' own."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from transformers.audio_utils import spectrogram, window_function

from unitouch_gen.models.filter_bank import kaldi_filters, log_mel, power_spectra
from unitouch_gen.models.sounds import LogMel, Sound

RATE, LENGTH, SHIFT = 16_000, 400, 160

STORED = Path(__file__).parent / "filter_bank_values.json"
"""Of `reference` on `HIT`: {bins: [[frame, bin, value], ...]}."""


def hit(seconds: float) -> np.ndarray:
    """Three decaying tones over a sweep and an offset: a closed form, so that every machine has the same samples."""
    time = np.arange(round(seconds * RATE)) / RATE
    tones = [(0.4, 440.0, 6.0), (0.2, 1830.0, 15.0), (0.1, 5210.0, 40.0)]
    ring = sum(a * np.exp(-d * time) * np.sin(2 * np.pi * f * time) for a, f, d in tones)
    return (ring + 0.02 * np.sin(2 * np.pi * (100.0 + 1800.0 * time) * time) + 0.05).astype(np.float32)


HIT = hit(0.3)
LOUDEST = 5.5
"""No logarithm of an energy of it is above."""


def reference(samples: np.ndarray, bins: int, only: set[int] | None = None) -> np.ndarray:
    """`torchaudio.compliance.kaldi.fbank` with `htk_compat=True, use_energy=False, window_type="hanning", dither=0.0`,
    in float64 and a frame at a time, (frames, bins); frames that are left out stay NaN.

    After torchaudio's documentation and Kaldi's feature-window.cc, feature-fbank.cc and mel-computations.cc.
    """
    points = 2 ** math.ceil(math.log2(LENGTH))
    count = 1 + (len(samples) - LENGTH) // SHIFT  # snip_edges
    lowest, highest = mel(20.0), mel(RATE / 2)
    width = (highest - lowest) / (bins + 1)
    energies = np.full((count, bins), np.nan)
    for number in sorted(only or range(count)):
        frame = [float(value) for value in samples[number * SHIFT : number * SHIFT + LENGTH]]
        mean = sum(frame) / LENGTH  # remove_dc_offset
        frame = [value - mean for value in frame]
        frame = [value - 0.97 * frame[max(i - 1, 0)] for i, value in enumerate(frame)]  # preemphasis_coefficient
        frame = [value * (0.5 - 0.5 * math.cos(2 * math.pi * i / (LENGTH - 1))) for i, value in enumerate(frame)]
        power = np.abs(np.fft.fft(frame + [0.0] * (points - LENGTH))) ** 2  # round_to_power_of_two, use_power
        for index in range(bins):
            left, centre, right = (lowest + (index + edge) * width for edge in range(3))
            energy = 0.0
            for k in range(points // 2):
                at = mel(k * RATE / points)
                energy += power[k] * max(0.0, min((at - left) / (centre - left), (right - at) / (right - centre)))
            energies[number, index] = math.log(max(energy, 2.0**-23))  # use_log_fbank
    return energies


def mel(hertz: float) -> float:
    return 1127.0 * math.log(1.0 + hertz / 700.0)


def port(samples: np.ndarray, bins: int) -> torch.Tensor:
    return log_mel(torch.from_numpy(samples), kaldi_filters(LENGTH, bins, RATE), LENGTH, SHIFT)


def assert_alike(found: torch.Tensor, expected: np.ndarray, loudest: float) -> None:
    """Logarithms of energies but for float32: its transform errs by about eps of the loudest amplitude of a frame."""
    eps = np.finfo(np.float32).eps
    tolerance = 4 * eps * np.abs(expected).clip(1.0) + 2 * eps * np.exp((loudest - expected) / 2)
    assert (np.abs(found.double().numpy() - expected) <= tolerance).all()


def test_values_are_those_stored_of_torchaudios_formulae() -> None:
    for bins, values in json.loads(STORED.read_text()).items():
        found = port(HIT, int(bins))
        for frame, index, value in values:
            assert_alike(found[frame, index], np.array(value), LOUDEST)


@pytest.mark.parametrize("bins", [23, 128])
def test_frames_are_those_of_torchaudios_formulae(bins: int) -> None:
    frames = {0, 9, 27}
    found, expected = port(HIT, bins), reference(HIT, bins, frames)
    assert found.shape == expected.shape
    for frame in frames:
        assert_alike(found[frame], expected[frame], expected[frame].max())


@pytest.mark.parametrize(("bins", "shift"), [(128, 160), (64, 128)])
def test_a_sound_is_that_of_transformers(bins: int, shift: int) -> None:
    noise = (0.3 * np.random.default_rng(0).standard_normal(RATE)).astype(np.float32)
    for samples in (HIT, noise):
        filters = kaldi_filters(LENGTH, bins, RATE)
        expected = spectrogram(
            samples, window_function(LENGTH, "hann", periodic=False), LENGTH, shift, fft_length=512, power=2.0,
            center=False, preemphasis=0.97, mel_filters=filters.numpy(), log_mel="log", mel_floor=2.0**-23,
            remove_dc_offset=True,
        ).T  # fmt: skip
        found = log_mel(torch.from_numpy(samples), filters, LENGTH, shift)
        assert found.dtype == torch.float32
        for row, values in zip(found, expected, strict=True):
            assert_alike(row, values, values.max())
        in_double = log_mel(torch.from_numpy(samples).double(), filters, LENGTH, shift)
        np.testing.assert_allclose(in_double.numpy(), expected, atol=1e-5)  # so what is left is float32's rounding


@pytest.mark.parametrize("bins", [23, 64, 128])
def test_filters_are_kaldis_triangles(bins: int) -> None:
    filters = kaldi_filters(LENGTH, bins, RATE)
    lowest, width = mel(20.0), (mel(8000.0) - mel(20.0)) / (bins + 1)
    centres = [lowest + (index + 1) * width for index in range(bins)]
    expected = [[max(0.0, 1.0 - abs(mel(k * 31.25) - centre) / width) for centre in centres] for k in range(257)]
    np.testing.assert_allclose(filters.numpy(), expected, atol=1e-12)
    assert (filters[-1] == 0).all()  # torchaudio's have no row for half the rate, and are padded with a zero


def test_the_power_of_a_frame_is_parsevals() -> None:
    frames = torch.from_numpy(HIT).unfold(0, LENGTH, SHIFT)
    centred = frames - frames.mean(dim=1, keepdim=True)
    emphasised = centred - 0.97 * torch.cat([centred[:, :1], centred[:, :-1]], dim=1)
    energy = (emphasised * torch.hann_window(LENGTH, periodic=False)).double().square().sum(dim=1)
    power = power_spectra(frames, 512)
    torch.testing.assert_close(
        (power[:, 0] + 2 * power[:, 1:-1].sum(dim=1) + power[:, -1]) / 512, energy, rtol=1e-5, atol=0
    )


def test_the_papers_three_clips_are_centred_padded_and_scaled() -> None:
    samples = hit(5.0)
    clips = LogMel()(Sound(samples, RATE))
    assert clips.shape == (3, 1, 128, 204)
    for clip, start in zip(clips, (0, 24_000, 48_000), strict=True):  # two seconds each, evenly over five
        part = samples[start : start + 32_000]
        expected = np.zeros((204, 128))
        whole = port(part - part.mean(), 128).numpy()
        assert len(whole) == 198
        expected[:198] = whole
        np.testing.assert_allclose(clip[0].T.numpy(), (expected + 4.268) / 9.138, atol=1e-6)
        row = reference(part - part.mean(), 128, {100})[100]
        assert_alike(9.138 * clip[0, :, 100].double() - 4.268, row, row.max())
