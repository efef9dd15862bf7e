"""Sounds as mono samples, and as the log-mel clips of an audio encoder.

The filter bank is Kaldi's with ImageBind's settings: HTK compatible, with a Hann window, no energy and no dither (Povey
et al., "The Kaldi speech recognition toolkit", 2011). torchaudio's `compliance.kaldi.fbank` computes the same.
"""

import os
import warnings
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from scipy.signal import resample_poly
from torch import Tensor
from transformers.audio_utils import mel_filter_bank, spectrogram

from unitouch_gen.errors import (
    InvalidInputError,
    InvalidTypeError,
    check_file,
    check_finite,
    check_integer,
    check_not_empty,
    check_number,
    describe,
)
from unitouch_gen.models.formats import file_kind

AudioInput = Any  # a path, samples with their rate, or a list of them

RATES = (1_000, 768_000)  # allowed sampling rates, Hz; others are likely mistakes


@dataclass(frozen=True)
class Sound:
    """Mono samples in about [-1, 1], float32 (T,), and their rate in Hz."""

    samples: np.ndarray
    rate: int


def load_sounds(name: str, sounds: AudioInput) -> list[Sound]:
    """Mono sounds.

    Accepts a path (wav, flac, ogg, mp3), a pair of an array or tensor (T,) or (channels, T) and its rate in Hz, and
    lists of them. Integers of 32 bits or more that use only 16 or 24 bits are scaled by those.

    Raises:
        InvalidInputError, InvalidTypeError: If a file is no sound, samples are missing, not finite or of a wrong shape,
            or the rate is missing. The message names the argument, `name`, and the item.
    """
    if not isinstance(sounds, list):
        return [_load(name, sounds)]
    check_not_empty(name, sounds)
    return [_load(f"{name}[{i}]", sound) for i, sound in enumerate(sounds)]


def _load(name: str, sound: Any) -> Sound:
    if isinstance(sound, str | os.PathLike):
        sound = _read(name, sound)
    rate = None
    if isinstance(sound, tuple) and len(sound) == 2:
        sound, rate = sound
    samples = sound
    if isinstance(sound, Tensor) and sound.layout == torch.strided and not sound.is_meta:
        numbers = sound.float() if sound.is_floating_point() else sound
        samples = numbers.detach().cpu().numpy()
    if not isinstance(samples, np.ndarray) or samples.dtype.kind not in "fi":
        wanted = "pass the path of a sound file, or samples, floats or signed integers, with their rate: (array, 16000)"
        raise InvalidTypeError(f"`{name}` is {describe(sound)}; {wanted}.")
    if rate is None:
        raise InvalidInputError(f"`{name}` is {describe(sound)} without a sampling rate; pass (array, rate in Hz).")
    rate = check_integer(f"{name} sampling rate", rate, *RATES)
    if samples.size < 2 or samples.ndim not in (1, 2) or (samples.ndim == 2 and len(samples) > samples.shape[1]):
        raise InvalidInputError(f"`{name}` is {describe(sound)}; it has to be (T,) or (channels, T), T at least 2.")
    full_scale = _full_scale(name, samples)
    with np.errstate(all="ignore"):
        mono = (_mono(samples) / full_scale).astype(np.float32)
    check_finite(name, torch.from_numpy(mono))
    peak = np.abs(mono).max()
    if peak > 100:
        raise InvalidInputError(f"`{name}` holds samples up to {peak:g}; floats run from -1 to 1, or pass integers.")
    return Sound(mono, rate)


def _full_scale(name: str, samples: np.ndarray) -> float:
    """The value that stands for 1: that of the dtype, or of 16 or 24 bits in wider integers that use no more."""
    if samples.dtype.kind != "i":
        return 1.0
    of_dtype = -float(np.iinfo(samples.dtype).min)
    if of_dtype <= 1 << 15 or not (samples & 255).any():  # fewer bits in the upper part of the integers
        return of_dtype
    peak = max(int(samples.max()), -int(samples.min()))
    if peak <= 1 << 15:
        full_scale = 2.0**15
    elif peak <= 1 << 23:
        full_scale = 2.0**23
    else:
        full_scale = 2.0**31
    if full_scale < of_dtype:
        warnings.warn(f"`{name}` holds up to {peak}; full scale is taken to be {full_scale:.0f}.", stacklevel=3)
    return full_scale


def _mono(samples: np.ndarray) -> np.ndarray:
    """The mean of the channels; the loudest one if they cancel each other, as of a microphone wired upside down."""
    channels = np.atleast_2d(samples)
    mean = channels.mean(axis=0)
    power = channels.var(axis=1)
    cancelled = mean.var() < power.mean() / (2 * len(channels))
    return channels[power.argmax()] if cancelled else mean


def _read(name: str, file: str | os.PathLike) -> tuple[np.ndarray, int]:
    """Samples (channels, T) of a file, and their rate."""
    import soundfile

    file = os.path.expanduser(file)
    check_file(name, file, "a sound file")
    try:
        samples, rate = soundfile.read(os.fsencode(file), dtype="float32", always_2d=True)
    except (soundfile.LibsndfileError, OSError, MemoryError) as error:  # the last of a header with a forged length
        reason = f"which cannot be read as a sound ({file_kind(file)})"
        message = f"`{name}` names {str(file)!r}, {reason}; pass a wav, flac, ogg or mp3 file."
        raise InvalidInputError(message) from error
    return samples.T, rate


@dataclass(frozen=True)
class LogMel:
    """Kaldi's log-mel filter bank over clips spread evenly over a sound, as in ImageBind.

    Attributes:
        sampling_rate: Hz; sounds of another rate are resampled.
        clip_seconds, clips: Length, s, and number of the clips.
        mel_bins, frames: Size of a clip's spectrogram; shorter clips are padded, longer ones cut.
        frame_length, frame_shift: Length and distance of the frames, s.
        mean, std: Mean and deviation of the log-mel values over the training sounds.
    """

    sampling_rate: int = 16_000
    clip_seconds: float = 2.0
    clips: int = 3
    mel_bins: int = 128
    frames: int = 204
    frame_length: float = 0.025
    frame_shift: float = 0.010
    mean: float = -4.268
    std: float = 9.138

    def __post_init__(self) -> None:
        check_integer("sampling_rate", self.sampling_rate, *RATES)
        check_integer("clips", self.clips, 1, 1000)
        check_integer("mel_bins", self.mel_bins, 1, 1024)
        check_integer("frames", self.frames, 1, 100_000)
        check_number("frame_length", self.frame_length, 2 / self.sampling_rate, 3600.0)
        check_number("frame_shift", self.frame_shift, 1 / self.sampling_rate, 3600.0)
        check_number("clip_seconds", self.clip_seconds, self.frame_length, 3600.0)
        check_number("mean", self.mean, -100.0, 3600.0)
        check_number("std", self.std, 1e-4, 3600.0)

    def __call__(self, sound: Sound) -> Tensor:
        """Centred and scaled log-mel spectrograms, float32 (clips, 1, mel_bins, frames)."""
        samples = resample_poly(sound.samples, self.sampling_rate, sound.rate).astype(np.float32)
        length = round(self.clip_seconds * self.sampling_rate)
        starts = np.linspace(0, max(len(samples) - length, 0), self.clips).round().astype(int)
        return torch.stack([self._clip(samples[start : start + length]) for start in starts])

    def _clip(self, samples: np.ndarray) -> Tensor:
        """The log-mel spectrogram of one clip, float32 (1, mel_bins, frames)."""
        length = round(self.frame_length * self.sampling_rate)
        shift = round(self.frame_shift * self.sampling_rate)
        samples = np.pad(samples - samples.mean(), (0, max(length - len(samples), 0)))
        points = 1 << (length - 1).bit_length()  # of the transform: the power of two that a frame fits in
        log_mel = spectrogram(
            samples,
            window=np.hanning(length),
            frame_length=length,
            hop_length=shift,
            fft_length=points,
            power=2.0,
            center=False,
            preemphasis=0.97,
            remove_dc_offset=True,
            mel_filters=_filters(points, self.mel_bins, self.sampling_rate),
            mel_floor=2.0**-23,
            log_mel="log",
        )[:, : self.frames]
        log_mel = np.pad(log_mel, ((0, 0), (0, self.frames - log_mel.shape[1])))
        return torch.from_numpy((log_mel - self.mean) / self.std).float()[None]


@lru_cache(maxsize=8)
def _filters(points: int, bins: int, rate: int) -> np.ndarray:
    """Triangles on the mel scale 1127 ln(1 + f / 700), from 20 Hz to half the rate, (points / 2 + 1, bins)."""
    with warnings.catch_warnings():
        # At the low end, 128 filters are finer than the transform, so some are empty, as Kaldi's are.
        warnings.filterwarnings("ignore", message="At least one mel filter has all zero values")
        return mel_filter_bank(
            num_frequency_bins=points // 2 + 1,
            num_mel_filters=bins,
            min_frequency=20.0,
            max_frequency=rate / 2,
            sampling_rate=rate,
            mel_scale="kaldi",
            triangularize_in_mel_space=True,
        )
