"""Whatever a user calls a sound, as mono samples, and from there as the log-mel clips an encoder sees.

The filter bank is Kaldi's in torch, as ImageBind takes it: HTK's, with a Hann window, no energy and no dither (Povey et
al., "The Kaldi speech recognition toolkit", 2011). torchaudio's `compliance.kaldi.fbank` computes the same.
"""

import os
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.signal import resample_poly
from torch import Tensor
from transformers.audio_utils import mel_filter_bank

from unitouch_gen.errors import InvalidInputError, InvalidTypeError, check_dense, check_integer, check_number, describe
from unitouch_gen.files import check_file
from unitouch_gen.models.images import plain_array

AudioInput = Any  # a path, an array with a rate, or a list of them

MIN_RATE, MAX_RATE = 1_000, 768_000
"""Sampling rates outside of this are taken for mistakes, Hz."""

SILENCE = 2.0**-15
"""Samples of a sound within this of each other, one bit of 16, are silence."""

PADDING = 8
"""Bytes that headers may count and files lack."""

CUT = r": (\d+) \(should be (\d+)\)"
"""What libsndfile logs of a part of a file: how many bytes it speaks of, and how many are there."""

STREAMED = 2**31 - 2**16
"""Lengths from here on are those of programs that wrote a header before they knew."""

ESTIMATED = 0.01
"""Share by which a length may be off that was estimated, as of an mp3 file."""

PREEMPHASIS = 0.97
"""Share of the sample before that is taken from each."""

LOWEST = 20.0
"""Where the first filter begins, Hz."""

FLOOR = torch.finfo(torch.float32).eps
"""Least energy, before the logarithm."""

LARGEST_LOG = 1e4
"""Of what log-mels are centred and scaled by; they themselves are a hundred at most."""


@dataclass(frozen=True)
class Sound:
    """Mono samples in about [-1, 1], float32 (T,), and their rate in Hz."""

    samples: np.ndarray
    rate: int


def load_sounds(name: str, sounds: AudioInput, sampling_rate: int | None = None) -> list[Sound]:
    """Whatever a user passed, as a list of mono sounds.

    Accepts a path (wav, flac, ogg, mp3), a pair (array, rate), an array or tensor (T,) or (channels, T) with
    `sampling_rate` beside it, and lists of them. A tensor (B, 1, T) is a batch.

    Raises:
        InvalidInputError: If a file is no sound, samples are missing, not finite or of a wrong shape, or no rate came.
        InvalidTypeError: If it is something else altogether.
    """
    if isinstance(sounds, Tensor | np.ndarray) and sounds.ndim == 3:
        sounds = list(sounds)
    if isinstance(sounds, list):
        if not sounds:
            raise InvalidInputError(f"`{name}` is an empty list; pass at least one sound.")
        return [_load(f"{name}[{i}]", sound, sampling_rate) for i, sound in enumerate(sounds)]
    return [_load(name, sounds, sampling_rate)]


def check_audible(name: str, sounds: Sequence[Sound]) -> None:
    """Refuses sounds that are silent but for a constant and the last bit of 16.

    Raises:
        InvalidInputError: Naming the first.
    """
    for number, sound in enumerate(sounds):
        swing = float(np.ptp(sound.samples))
        if swing <= SILENCE:
            where = f"`{name}`" if len(sounds) == 1 else f"`{name}[{number}]`"
            raise InvalidInputError(
                f"{where} is silent: its samples differ by {swing:.1g} of full scale at most; pass a sound of a "
                "contact."
            )


def _load(name: str, sound: Any, rate: int | None) -> Sound:
    if isinstance(sound, str | os.PathLike):
        return _mono(name, *_read(name, Path(sound)))
    if isinstance(sound, tuple) and len(sound) == 2:
        sound, rate = sound
    if isinstance(sound, Tensor):
        check_dense(name, sound)
        sound = sound.detach().cpu()
        sound = (sound.float() if sound.is_floating_point() else sound).numpy()
    if not isinstance(sound, np.ndarray):
        raise InvalidTypeError(
            f"`{name}` is {describe(sound)}; pass the path of a sound file, or samples with their rate: (array, 16000)."
        )
    if rate is None:
        raise InvalidInputError(f"`{name}` is {describe(sound)} without a sampling rate; pass (array, rate in Hz).")
    return _mono(name, plain_array(name, sound), rate)


def _read(name: str, path: Path) -> tuple[np.ndarray, int]:
    import soundfile

    check_file(name, path, "a sound file")
    try:
        with soundfile.SoundFile(os.fsencode(path)) as file:
            samples = file.read(dtype="float32", always_2d=True)
            missing = is_cut(file.extra_info) or len(samples) < (1 - ESTIMATED) * file.frames
            parts = [(int(said), int(held)) for said, held in re.findall(CUT, file.extra_info) if int(held)]
            whole = max(file.frames, *(len(samples) * said // held for said, held in [(0, 1), *parts][-1:]))
    except (soundfile.LibsndfileError, OSError, MemoryError) as error:  # a forged header may claim any length
        raise InvalidInputError(
            f"`{name}` names {str(path)!r}, which cannot be read as a sound; pass a wav, flac, ogg or mp3 file."
        ) from error
    if missing:
        raise InvalidInputError(
            f"`{name}` names {str(path)!r}, which is cut short: {len(samples)} of {whole} samples are there; pass the "
            "whole file."
        )
    return samples.T, int(file.samplerate)


def is_cut(log: str) -> bool:
    """Whether libsndfile, which reads what is there, has met a part of a file that says that it is longer."""
    return any(int(held) + PADDING < int(said) < STREAMED for said, held in re.findall(CUT, log))


def _mono(name: str, samples: np.ndarray, rate: int) -> Sound:
    rate = check_integer(f"{name} sampling rate", rate, MIN_RATE, MAX_RATE, hint="It counts samples a second.")
    if samples.dtype.kind not in "fi":
        raise InvalidTypeError(f"`{name}` is {describe(samples)}; samples have to be floats or signed integers.")
    if samples.size < 2:
        raise InvalidInputError(f"`{name}` holds {samples.size} samples; a sound needs at least 2.")
    if samples.ndim not in (1, 2) or (samples.ndim == 2 and len(samples) > samples.shape[1]):
        raise InvalidInputError(f"`{name}` is {describe(samples)}; samples have to be (T,) or (channels, T).")
    if samples.dtype.kind == "i":
        samples = samples / -float(np.iinfo(samples.dtype).min)  # full scale is 1
    if samples.ndim == 2:
        samples = samples.mean(axis=0)
    with np.errstate(over="ignore"):
        samples = np.asarray(samples, dtype=np.float32)
    if not np.isfinite(samples).all():
        raise InvalidInputError(f"`{name}` holds samples that are NaN or infinite; pass finite samples only.")
    return Sound(samples, rate)


@dataclass(frozen=True)
class LogMel:
    """Kaldi's log-mel filter bank over clips spread evenly over a sound, as ImageBind takes it.

    Attributes:
        sampling_rate: Hz, from 1,000 to 768,000; sounds of another rate are resampled.
        clip_seconds, clips: Length, s, up to an hour, and number of the clips, up to 1,000.
        mel_bins, frames: Size of one clip's picture, up to 1,024 and 100,000; shorter clips are padded, longer cut.
        frame_length, frame_shift: s; at least two samples and one, at most 1 s and a minute.
        mean, std: Mean and deviation of the log-mel values over the training sounds; std from 1e-4, both up to 1e4.

    Raises:
        InvalidInputError, InvalidTypeError: If a value is out of range or no number; the message names it.
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
        check_integer("sampling_rate", self.sampling_rate, MIN_RATE, MAX_RATE, hint="It counts samples a second.")
        for name, most in (("clips", 1000), ("mel_bins", 1024), ("frames", 100_000)):
            check_integer(name, getattr(self, name), 1, most)
        check_number("frame_shift", self.frame_shift, 1 / self.sampling_rate, 60.0)
        check_number("frame_length", self.frame_length, 2 / self.sampling_rate, 1.0)
        check_number(
            "clip_seconds", self.clip_seconds, self.frame_length, 3600.0, hint="A clip holds at least one frame."
        )
        check_number("mean", self.mean, -LARGEST_LOG, LARGEST_LOG)
        check_number("std", self.std, 1 / LARGEST_LOG, LARGEST_LOG)

    def __call__(self, sound: Sound) -> Tensor:
        """Centred and scaled log-mel pictures, float32 (clips, 1, mel_bins, frames)."""
        samples = resample_poly(sound.samples, self.sampling_rate, sound.rate).astype(np.float32)
        length = round(self.clip_seconds * self.sampling_rate)
        starts = np.linspace(0, max(len(samples) - length, 0), self.clips).round().astype(int)
        # Clips that start together (a sound no longer than a clip) are computed once.
        pictures = {start: self._clip(samples[start : start + length]) for start in dict.fromkeys(starts.tolist())}
        return torch.stack([pictures[start] for start in starts.tolist()])

    def _clip(self, samples: np.ndarray) -> Tensor:
        window, hop = round(self.frame_length * self.sampling_rate), round(self.frame_shift * self.sampling_rate)
        samples = samples - samples.mean()
        if len(samples) < window:
            samples = np.pad(samples, (0, window - len(samples)))
        filters = kaldi_filters(window, self.mel_bins, self.sampling_rate)
        picture = log_mel(torch.from_numpy(samples), filters, window, hop).T[:, : self.frames]
        picture = torch.nn.functional.pad(picture, (0, self.frames - picture.shape[1]))
        return ((picture - float(self.mean)) / float(self.std))[None]


def log_mel(samples: Tensor, filters: Tensor, length: int, shift: int) -> Tensor:
    """Log-mel energies of a sound, float32 (frames, bins), in the 1 + (T - length) // shift frames that fit whole.

    Args:
        samples: Sound, float32 (T,), T at least the length of a frame.
        filters: Weights from `kaldi_filters`, (points / 2 + 1, bins).
        length, shift: Length and distance of the frames, samples.

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
        points: Size of the transform, at least the length; zeros fill the frames up.
    """
    centred = frames - frames.mean(dim=1, keepdim=True)
    before = torch.cat([centred[:, :1], centred[:, :-1]], dim=1)
    window = torch.hann_window(frames.shape[1], periodic=False, dtype=frames.dtype)
    spectra = torch.fft.rfft((centred - PREEMPHASIS * before) * window, n=points)
    return spectra.abs().double().square()  # the square of a loud sound leaves the range of float32


@lru_cache(maxsize=8)
def kaldi_filters(length: int, bins: int, rate: int) -> Tensor:
    """Triangular filters on the mel scale 1127 ln(1 + f / 700), float64 (points / 2 + 1, bins); kept, so change none.

    `points` of the Fourier transform is the power of two that a frame fits in.

    Args:
        length: Length of a frame, samples.
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
