"""Recorded hits on real things, in place of synthesised sounds, and clipping and codecs of recorders.

`collection/index.csv` names each with its source, author and licence. All takes of one kind of hit are in one split.
"""

import csv
import io
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
import soundfile
import torch
from scipy.signal import resample
from torch import Tensor

from unitouch_gen.world.draws import RECORDING_STREAM, Draws, generator
from unitouch_gen.world.materials import MATERIAL_NAMES
from unitouch_gen.world.scans import COLLECTION, split_of
from unitouch_gen.world.sounds import PEAK, SAMPLE_RATE

CODECS = (("OGG", "VORBIS"), ("MP3", "MPEG_LAYER_III"))  # format and subtype of soundfile


@dataclass(frozen=True)
class Recording:
    """One take of one kind of hit."""

    name: str
    material: str
    group: str  # the kind of hit, which may have several takes
    split: str  # "train", "val" or "test"
    source: str
    author: str
    licence: str

    @cached_property
    def samples(self) -> np.ndarray:
        """Samples from the onset, with a peak of 0.9, at 16 kHz, float32 (T,)."""
        samples, _ = soundfile.read(COLLECTION / "sounds" / f"{self.name}.flac", dtype="float32")
        return samples


@cache
def recordings() -> tuple[Recording, ...]:
    """All recordings of the collection."""
    with (COLLECTION / "index.csv").open(encoding="utf-8", newline="") as stream:
        rows = [row for row in csv.DictReader(stream) if row["kind"] == "sound"]
    return tuple(Recording(**{name: row[name] for name in Recording.__annotations__}) for row in rows)


@cache
def recordings_of(material: int, split: str) -> tuple[Recording, ...]:
    """The recordings of a material and a split; "beyond" has those of "test"."""
    material_name = MATERIAL_NAMES[material]
    own_split = "test" if split == "beyond" else split
    return tuple(
        recording for recording in recordings() if recording.material == material_name and recording.split == own_split
    )


def recording_of(seed: int, name: tuple[int, int, int], share: float) -> Recording | None:
    """The recording of a contact, or `None` if its sound is synthesised."""
    rng = generator(seed, RECORDING_STREAM, *name)
    material, object_, _ = name
    candidates = recordings_of(material, split_of(object_))
    if not candidates or rng.uniform() >= share:
        return None
    return candidates[int(rng.integers(len(candidates)))]


def with_recordings(seed: int, draws: Draws, sounds: Tensor, share: float) -> Tensor:
    """Sounds (N, T) with a peak of 0.9, a share of them replaced by recordings, if their material has some.

    Each recording is played up to a tenth faster or slower, and fades by up to e^-2.5 more in a second.
    """
    rows = sounds.clone()
    length = sounds.shape[1]
    for row, name in enumerate(draws.names()):
        recording = recording_of(seed, name, share)
        if recording is None:
            continue
        rng = generator(seed, RECORDING_STREAM, *name, 1)
        speed = np.exp(rng.uniform(-0.1, 0.1))
        damping = rng.uniform(0.0, 2.5)
        played = resample(recording.samples, round(len(recording.samples) / speed))[:length]
        played = np.pad(played, (0, length - len(played)))
        played = played * np.exp(-damping * np.arange(length) / SAMPLE_RATE)
        scaled = PEAK * played / max(np.abs(played).max(), 1e-12)
        rows[row] = torch.from_numpy(scaled.astype(np.float32))
    return rows


def as_files(seed: int, names: list[tuple[int, int, int]], sounds: Tensor) -> Tensor:
    """Sounds (N, T) as in files: a quarter is clipped, by up to 12 dB, and four of ten have been OGG or MP3."""
    rows = sounds.numpy().copy()
    for row, name in zip(rows, names, strict=True):
        rng = generator(seed, RECORDING_STREAM, *name, 2)
        chances = rng.uniform(size=2)
        decibels = rng.uniform(0.0, 12.0)
        quality = rng.uniform(0.2, 0.95)
        container, subtype = CODECS[rng.integers(len(CODECS))]
        if chances[0] < 0.25:
            limit = np.abs(row).max() * 10.0 ** (-decibels / 20.0)
            np.clip(row, -limit, limit, out=row)
        if chances[1] < 0.4:
            content = io.BytesIO()
            soundfile.write(content, row, SAMPLE_RATE, format=container, subtype=subtype, compression_level=quality)
            decoded, _ = soundfile.read(io.BytesIO(content.getvalue()), dtype="float32")
            decoded = decoded[: len(row)]
            row[:] = 0.0
            row[: len(decoded)] = decoded
    return torch.from_numpy(rows).clamp_(-1.0, 1.0)
