"""Kaldi's log-mel filter bank in torch, as ImageBind takes it: HTK's, with a Hann window, no energy and no dither.

Povey et al., "The Kaldi speech recognition toolkit" (2011). torchaudio's `compliance.kaldi.fbank` computes the same.
"""

import warnings
from functools import lru_cache

import torch
from torch import Tensor
from transformers.audio_utils import mel_filter_bank

PREEMPHASIS = 0.97

LOWEST = 20.0
"""Where the first filter begins, Hz."""

FLOOR = torch.finfo(torch.float32).eps
"""Of energies, before their logarithm."""


def log_mel(samples: Tensor, filters: Tensor, length: int, shift: int) -> Tensor:
    """Log-mel energies of a sound, float32 (frames, bins), of the 1 + (T - length) // shift frames that fit whole.

    Args:
        samples: Of the sound, float32 (T,), T at least the length of a frame.
        filters: From `kaldi_filters`, (points / 2 + 1, bins).
        length, shift: Of the frames, samples.

    Raises:
        RuntimeError: From torch, if the sound is shorter than a frame.
    """
    power = power_spectra(samples.unfold(0, length, shift), points=2 * (len(filters) - 1))
    return (power @ filters).clamp(min=FLOOR).log().float()


def power_spectra(frames: Tensor, points: int) -> Tensor:
    """|FFT|^2 of frames after their mean is removed, pre-emphasis and window, float64 (frames, points / 2 + 1).

    Nothing comes before a frame's first sample, which stands in for it in the pre-emphasis.

    Args:
        frames: Samples, float32 (frames, length).
        points: Of the transform, at least the length; zeros fill the frames up.
    """
    centred = frames - frames.mean(dim=1, keepdim=True)
    before = torch.cat([centred[:, :1], centred[:, :-1]], dim=1)
    window = torch.hann_window(frames.shape[1], periodic=False, dtype=frames.dtype)
    spectra = torch.fft.rfft((centred - PREEMPHASIS * before) * window, n=points)
    return spectra.abs().double().square()  # the square of a loud sound leaves the range of float32


@lru_cache(maxsize=8)
def kaldi_filters(length: int, bins: int, rate: int) -> Tensor:
    """Triangular filters on the mel scale 1127 ln(1 + f / 700), float64 (points / 2 + 1, bins), not to be changed: they
    are kept.

    `points` of the Fourier transform is the power of two that a frame fits in.

    Args:
        length: Of a frame, samples.
        bins: Number of filters, from 20 Hz to half the rate. The paper's 128 are finer than the transform at the low
            end, so that some are empty, as Kaldi's are.
        rate: Sampling rate, Hz.
    """
    points = 1 << (length - 1).bit_length()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="At least one mel filter has all zero values")
        filters = mel_filter_bank(
            num_frequency_bins=points // 2 + 1,
            num_mel_filters=bins,
            min_frequency=LOWEST,
            max_frequency=rate / 2,
            sampling_rate=rate,
            norm=None,
            mel_scale="kaldi",
            triangularize_in_mel_space=True,
        )
    return torch.from_numpy(filters)
