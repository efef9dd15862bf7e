"""Log-mel clips against torchaudio's formulae in loops, stored values and transformers' own; sounds of every kind."""

import json
import math
import warnings
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch
from scipy.signal import resample_poly
from transformers import ASTFeatureExtractor
from transformers.audio_utils import spectrogram, window_function

from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.models import UniTouchProcessor
from unitouch_gen.models.sounds import LogMel, Sound, kaldi_filters, load_sounds, log_mel, power_spectra

RATE = 16_000
NOISE = (0.3 * np.random.default_rng(0).standard_normal(RATE)).clip(-1, 1).astype(np.float32)
RAW = {"mean": 0.0, "std": 1.0}


def tone(hertz: float, seconds: float, rate: int = RATE) -> np.ndarray:
    return np.sin(2 * np.pi * hertz * np.arange(round(seconds * rate)) / rate).astype(np.float32)


def test_the_papers_filters_are_made_once_and_say_nothing() -> None:
    kaldi_filters.cache_clear()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        LogMel()(Sound(tone(440.0, 3.0), RATE))
        LogMel()(Sound(tone(880.0, 3.0), RATE))
    assert kaldi_filters.cache_info().misses == 1


@pytest.mark.filterwarnings("ignore:At least one mel filter has all zero values")  # transformers', of its own filters
def test_a_clip_is_that_of_transformers_extractor() -> None:
    samples = NOISE - NOISE.mean()
    expected = ASTFeatureExtractor(do_normalize=False, max_length=98)(samples, sampling_rate=RATE, return_tensors="pt")
    log_mel = LogMel(clip_seconds=1.0, clips=1, frames=98, **RAW)
    torch.testing.assert_close(log_mel(Sound(NOISE, RATE))[0, 0].T, expected.input_values[0], rtol=1e-4, atol=1e-3)


def test_the_paper_takes_three_clips_of_128_bins_and_204_frames() -> None:
    assert LogMel()(Sound(tone(440.0, 3.0), RATE)).shape == (3, 1, 128, 204)


def test_values_are_centred_and_scaled() -> None:
    settings = {"clip_seconds": 0.5, "clips": 1, "frames": 48}
    raw = LogMel(**settings, **RAW)(Sound(NOISE, RATE))
    torch.testing.assert_close(LogMel(**settings, mean=-4.0, std=2.0)(Sound(NOISE, RATE)), (raw + 4.0) / 2.0)


def test_a_constant_offset_is_not_heard() -> None:
    settings = LogMel(clip_seconds=0.5, clips=2, frames=48)
    torch.testing.assert_close(settings(Sound(NOISE + 0.5, RATE)), settings(Sound(NOISE, RATE)), rtol=1e-3, atol=1e-3)


def test_clips_are_spread_evenly_over_the_sound() -> None:
    spread = LogMel(clip_seconds=0.2, clips=3, frames=18)
    single = LogMel(clip_seconds=0.2, clips=1, frames=18)
    starts = (0, 6400, 12800)  # first, middle and last 0.2 s of 1 s
    expected = torch.cat([single(Sound(NOISE[start : start + 3200], RATE)) for start in starts])
    torch.testing.assert_close(spread(Sound(NOISE, RATE)), expected)


def test_a_sound_shorter_than_a_clip_repeats_and_is_padded_before_scaling() -> None:
    clips = LogMel(clip_seconds=2.0, clips=3)(Sound(NOISE[:4000], RATE))
    assert torch.equal(clips[0], clips[1])
    assert torch.equal(clips[0], clips[2])
    frames = 1 + (4000 - 400) // 160
    assert torch.equal(clips[0, 0, :, frames:], torch.full((128, 204 - frames), 4.268) / 9.138)


def test_a_sound_shorter_than_a_frame_is_one_frame() -> None:
    clip = LogMel(clips=1, frames=3, **RAW)(Sound(NOISE[:50], RATE))
    assert torch.isfinite(clip).all()
    assert (clip[0, 0, :, 0] != 0).any()
    assert (clip[0, 0, :, 1:] == 0).all()


def test_silence_is_the_floor() -> None:
    clip = LogMel(clip_seconds=0.5, clips=1, frames=48, **RAW)(Sound(np.zeros(8000, np.float32), RATE))
    torch.testing.assert_close(clip, torch.full_like(clip, float(np.log(np.finfo(np.float32).eps))))


@pytest.mark.parametrize("level", [1e-30, 1e-3, 1e3, 1e18])
def test_any_loudness_gives_finite_values(level: float) -> None:
    clip = LogMel(clip_seconds=0.5, clips=1, frames=48)(Sound((level * NOISE).astype(np.float32), RATE))
    assert torch.isfinite(clip).all()


@pytest.mark.parametrize("rate", [8_000, 22_050, 44_100, 48_000])
def test_a_tone_of_another_rate_is_heard_at_the_same_pitch(rate: int) -> None:
    log_mel = LogMel(clip_seconds=1.0, clips=1, frames=98, **RAW)
    peaks = [log_mel(Sound(tone(1000.0, 1.0, r), r))[0, 0].mean(dim=1).argmax() for r in (RATE, rate)]
    assert peaks[0] == peaks[1]


def test_resampling_is_scipys_polyphase_filter() -> None:
    log_mel = LogMel(clip_seconds=0.5, clips=1, frames=48)
    by_hand = resample_poly(NOISE, 1, 2).astype(np.float32)
    torch.testing.assert_close(log_mel(Sound(NOISE, 2 * RATE)), log_mel(Sound(by_hand, RATE)))


@pytest.mark.parametrize(
    ("name", "value", "error"),
    [
        ("sampling_rate", 0, InvalidInputError),
        ("sampling_rate", 16_000.5, InvalidTypeError),
        ("clip_seconds", 0.0, InvalidInputError),
        ("clip_seconds", float("nan"), InvalidInputError),
        ("clips", 0, InvalidInputError),
        ("clips", True, InvalidTypeError),
        ("mel_bins", -1, InvalidInputError),
        ("frames", "204", InvalidTypeError),
        ("frame_length", 1e-5, InvalidInputError),
        ("frame_shift", 0.0, InvalidInputError),
        ("mean", float("inf"), InvalidInputError),
        ("mean", 1e300, InvalidInputError),
        ("std", 0.0, InvalidInputError),
        ("std", 1e-300, InvalidInputError),
    ],
)
def test_settings_that_cannot_be_used_are_refused_by_name(name: str, value: object, error: type[Exception]) -> None:
    with pytest.raises(error, match=f"`{name}`"):
        LogMel(**{name: value})


# Kinds of sound ---------------------------------------------------------------------------------------------------


def test_every_kind_of_samples_gives_the_same_sound() -> None:
    kinds = [
        (NOISE, RATE), (torch.from_numpy(NOISE), RATE), (NOISE.astype(np.float64), RATE), (NOISE[None], RATE),
        (np.stack([NOISE, NOISE]), RATE), (NOISE.astype(">f4"), np.int64(RATE)),
        (torch.from_numpy(NOISE).requires_grad_(), RATE),
    ]  # fmt: skip
    for sound in load_sounds("audio", kinds):
        assert sound.rate == RATE
        assert sound.samples.dtype == np.float32
        np.testing.assert_allclose(sound.samples, NOISE, atol=1e-7)


@pytest.mark.parametrize("dtype", [np.int16, np.int32])
def test_integer_samples_are_scaled_to_full_scale(dtype: type) -> None:
    integers = (NOISE.astype(np.float64) * np.iinfo(dtype).max).astype(dtype)
    for samples in (integers, torch.from_numpy(integers)):
        np.testing.assert_allclose(load_sounds("audio", (samples, RATE))[0].samples, NOISE, atol=1e-4)


def test_samples_may_have_their_rate_beside_them() -> None:
    np.testing.assert_array_equal(load_sounds("audio", NOISE, RATE)[0].samples, NOISE)


def test_channels_are_averaged() -> None:
    left, right = tone(300.0, 0.1), tone(700.0, 0.1)
    np.testing.assert_allclose(
        load_sounds("audio", (np.stack([left, right]), RATE))[0].samples, (left + right) / 2, atol=1e-7
    )


@pytest.mark.parametrize("suffix", ["wav", "flac", "ogg"])
def test_a_file_is_read_with_its_rate_and_channels(suffix: str, tmp_path: Path) -> None:
    left, right = 0.5 * tone(300.0, 0.5, 22_050), 0.5 * tone(700.0, 0.5, 22_050)
    soundfile.write(tmp_path / f"hit.{suffix}", np.stack([left, right], axis=1), 22_050)
    for path in (tmp_path / f"hit.{suffix}", str(tmp_path / f"hit.{suffix}")):
        sound = load_sounds("audio", path)[0]
        assert sound.rate == 22_050
        tolerance = 0.1 if suffix == "ogg" else 1e-3
        np.testing.assert_allclose(sound.samples, (left + right) / 2, atol=tolerance)


def test_a_batch_of_mono_sounds_is_taken_apart() -> None:
    batch = torch.from_numpy(np.stack([NOISE, NOISE[::-1].copy()]))[:, None]
    sounds = load_sounds("audio", batch, RATE)
    np.testing.assert_array_equal(np.stack([sound.samples for sound in sounds]), batch[:, 0].numpy())


def test_the_processor_stacks_sounds(processor: UniTouchProcessor) -> None:
    clips = processor.sounds([(NOISE, RATE), (tone(300.0, 0.3, 44_100), 44_100)])
    assert clips.shape == (2, 2, 1, 16, 24)
    torch.testing.assert_close(clips[:1], processor.sounds(NOISE, RATE))


# What is no sound -------------------------------------------------------------------------------------------------


def refused(sounds: object, match: str, error: type[Exception] = InvalidInputError, rate: int | None = None) -> None:
    with pytest.raises(error, match=match):
        load_sounds("audio", sounds, rate)


def test_a_name_in_another_encoding_is_read(tmp_path: Path) -> None:
    """Of bytes that are no UTF-8, as Latin-1 leaves them."""
    soundfile.write(tmp_path / "whole.wav", NOISE, RATE)
    (named,) = load_sounds("audio", (tmp_path / "whole.wav").rename(tmp_path / "\udcff.wav"))
    (whole,) = load_sounds("audio", (NOISE, RATE))
    np.testing.assert_allclose(named.samples, whole.samples, atol=2**-15)


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    refused(tmp_path / "nothing.wav", r"`audio` names '.*nothing.wav', which does not exist")


def test_a_folder_is_refused(tmp_path: Path) -> None:
    refused(tmp_path, "`audio` names .*which is a folder")


@pytest.mark.parametrize("content", [b"", b"not a sound", b"RIFF\0\0\0\0WAVE"])
def test_a_file_that_is_no_sound_is_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "bad.wav").write_bytes(content)
    refused(tmp_path / "bad.wav", "`audio` names .*cannot be read as a sound")


def test_a_file_without_samples_is_refused(tmp_path: Path) -> None:
    soundfile.write(tmp_path / "empty.wav", np.zeros(0), RATE)
    refused(tmp_path / "empty.wav", "`audio` holds 0 samples")


def test_a_file_with_nan_is_refused(tmp_path: Path) -> None:
    soundfile.write(tmp_path / "nan.wav", np.full(100, np.nan), RATE, subtype="FLOAT")
    refused(tmp_path / "nan.wav", "`audio` holds samples that are NaN or infinite")


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e300])
def test_samples_that_are_not_finite_are_refused(bad: float) -> None:
    samples = NOISE.astype(np.float64)
    samples[7] = bad
    with np.errstate(over="ignore"):
        refused((samples, RATE), "`audio` holds samples that are NaN or infinite")


def test_samples_without_a_rate_are_refused() -> None:
    refused(NOISE, "`audio` .*without a sampling rate")


@pytest.mark.parametrize("rate", [0, -1, 999, 768_001])
def test_a_rate_out_of_range_is_refused(rate: int) -> None:
    refused((NOISE, rate), f"`audio sampling rate` is {rate}")


@pytest.mark.parametrize("rate", [16_000.0, "16000", True])
def test_a_rate_that_is_no_integer_is_refused(rate: object) -> None:
    refused((NOISE, rate), "`audio sampling rate`", InvalidTypeError)


@pytest.mark.parametrize("shape", [(0,), (1,), (2, 0), (0, 5)])
def test_too_few_samples_are_refused(shape: tuple) -> None:
    refused((np.zeros(shape), RATE), "`audio` holds [01] samples")


@pytest.mark.parametrize("shape", [(2, 2, 50), (500, 2)])
def test_a_wrong_shape_is_refused(shape: tuple) -> None:
    refused((np.zeros(shape), RATE), r"`audio` is an array .*\(channels, T\)")


@pytest.mark.parametrize("dtype", [complex, object, "<U1", bool, np.uint8])
def test_samples_that_are_no_real_numbers_are_refused(dtype: object) -> None:
    refused((np.zeros(100, dtype), RATE), "`audio` is an array .*floats or signed integers", InvalidTypeError)


@pytest.mark.parametrize("sound", [None, 3, b"bytes", {"a": 1}, (NOISE, RATE, 1), ([0.1, 0.2], RATE)])
def test_a_wrong_type_is_refused(sound: object) -> None:
    refused(sound, "`audio` is .*pass the path of a sound file", InvalidTypeError)


def test_an_empty_list_is_refused() -> None:
    refused([], "`audio` is an empty list")


def test_the_item_of_a_list_that_is_wrong_is_named() -> None:
    refused([(NOISE, RATE), (NOISE[:1], RATE)], r"`audio\[1\]` holds 1 samples")


# The filter bank ------------------------------------------------------------------------------------------------------

LENGTH, SHIFT = 400, 160

STORED = Path(__file__).parent / "filter_bank_values.json"
"""Values of `reference` on `HIT`: {bins: [[frame, bin, value], ...]}."""


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


# Files that are cut short ---------------------------------------------------------------------------------------------

FORMATS = [("WAV", "PCM_16"), ("WAV", "FLOAT"), ("WAVEX", "PCM_24"), ("WAV", "IMA_ADPCM"), ("AIFF", "PCM_16"),
           ("RF64", "PCM_16"), ("W64", "PCM_16"), ("AU", "PCM_16"), ("CAF", "PCM_16"), ("FLAC", "PCM_16"),
           ("OGG", "VORBIS"), ("MP3", None)]  # fmt: skip


@pytest.mark.parametrize(("format_", "subtype"), FORMATS)
def test_a_file_that_is_cut_short_is_refused_and_a_whole_one_is_not(
    tmp_path: Path, format_: str, subtype: str | None
) -> None:
    """libsndfile reads what is there, and says so in a log that nobody sees. Of Ogg it cannot tell where it ends."""
    file = tmp_path / "sound"
    soundfile.write(file, NOISE, RATE, format=format_, subtype=subtype)
    whole = file.read_bytes()
    assert len(load_sounds("audio", file)[0].samples) >= RATE
    for share in (0.1, 0.5) if format_ == "OGG" else (0.1, 0.5, 0.9, 0.99):
        file.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(InvalidInputError, match=r"`audio` .*(is cut short|cannot be read|holds 0 samples)"):
            load_sounds("audio", file)


def test_a_file_that_is_cut_short_says_how_many_samples_it_should_have(tmp_path: Path) -> None:
    soundfile.write(tmp_path / "a.wav", np.zeros(1000), RATE)
    (tmp_path / "a.wav").write_bytes((tmp_path / "a.wav").read_bytes()[:-500])
    with pytest.raises(InvalidInputError, match="cut short: 750 of 1000 samples are there"):
        load_sounds("audio", tmp_path / "a.wav")


def test_a_sound_that_was_written_to_a_pipe_is_whole(tmp_path: Path) -> None:
    """Its header was written before its length was known: ffmpeg writes the largest there is."""
    file = tmp_path / "sound.wav"
    soundfile.write(file, NOISE, RATE)
    content = bytearray(file.read_bytes())
    content[4:8] = content[40:44] = b"\xff" * 4
    file.write_bytes(content)
    assert len(load_sounds("audio", file)[0].samples) == RATE


def test_what_follows_a_sound_is_no_part_of_it(tmp_path: Path) -> None:
    file = tmp_path / "sound.wav"
    soundfile.write(file, NOISE, RATE)
    file.write_bytes(file.read_bytes() + b"LIST\x04\0\0\0abcd")
    assert len(load_sounds("audio", file)[0].samples) == RATE
