"""Recorded hits on real things, in place of synthesised sounds, and what recorders make of sounds: clipping and codecs.

`collection/index.csv` names each with its source, author and licence. Several takes of one kind of hit are on one side
of the split.
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

CODECS = (("OGG", "VORBIS"), ("MP3", "MPEG_LAYER_III"))  # format and subtype, as soundfile names them


@dataclass(frozen=True)
class Recording:
    """One take of one kind of hit."""

    name: str
    material: str
    group: str  # the kind of hit, of which there are several takes
    split: str  # "train", "val" or "test"
    source: str
    author: str
    licence: str

    @cached_property
    def samples(self) -> np.ndarray:
        """From where it begins, with a peak of 0.9, at 16 kHz."""
        return soundfile.read(COLLECTION / "sounds" / f"{self.name}.flac", dtype="float32")[0]


@cache
def recordings() -> tuple[Recording, ...]:
    """All recordings of the collection."""
    with (COLLECTION / "index.csv").open(encoding="utf-8", newline="") as stream:
        rows = [row for row in csv.DictReader(stream) if row["kind"] == "sound"]
    return tuple(Recording(**{name: row[name] for name in Recording.__annotations__}) for row in rows)


@cache
def recordings_of(material: int, split: str) -> tuple[Recording, ...]:
    """Those of a material and a split; objects beyond the ranges sound as those to test on."""
    kept = "test" if split == "beyond" else split
    return tuple(one for one in recordings() if one.material == MATERIAL_NAMES[material] and one.split == kept)


def recording_of(seed: int, name: tuple[int, int, int], share: float) -> Recording | None:
    """The recording that is heard at a contact, or `None` where its sound is synthesised."""
    rng = generator(seed, RECORDING_STREAM, *name)
    found = recordings_of(name[0], split_of(name[1]))
    return found[int(rng.integers(len(found)))] if found and rng.uniform() < share else None


def with_recordings(seed: int, draws: Draws, sounds: Tensor, share: float) -> Tensor:
    """Sounds (N, T) with a peak of 0.9, of which a share is recorded, where their material has recordings.

    Each is played up to a tenth faster or slower, and fades by up to e^-2.5 more in a second.
    """
    rows = sounds.clone()
    for row, name in enumerate(draws.names()):
        if (recording := recording_of(seed, name, share)) is None:
            continue
        rng = generator(seed, RECORDING_STREAM, *name, 1)
        speed = np.exp(rng.uniform(-0.1, 0.1))
        damping = rng.uniform(0.0, 2.5)
        samples = sounds.shape[1]
        heard = resample(recording.samples, round(len(recording.samples) / speed))[:samples]
        heard = np.pad(heard, (0, samples - len(heard))) * np.exp(-damping * np.arange(samples) / SAMPLE_RATE)
        rows[row] = torch.from_numpy((PEAK * heard / max(np.abs(heard).max(), 1e-12)).astype(np.float32))
    return rows


def as_files(seed: int, names: list[tuple[int, int, int]], sounds: Tensor) -> Tensor:
    """Sounds (N, T) as files hold them: a quarter is clipped, by up to 12 dB, and four of ten come from OGG or MP3."""
    rows = sounds.numpy().copy()
    for row, name in zip(rows, names, strict=True):
        rng = generator(seed, RECORDING_STREAM, *name, 2)
        chances = rng.uniform(size=2)
        decibels = rng.uniform(0.0, 12.0)
        quality = rng.uniform(0.2, 0.95)
        container, subtype = CODECS[rng.integers(len(CODECS))]
        if chances[0] < 0.25:
            most = np.abs(row).max() * 10.0 ** (-decibels / 20.0)
            np.clip(row, -most, most, out=row)
        if chances[1] < 0.4:
            content = io.BytesIO()
            soundfile.write(content, row, SAMPLE_RATE, format=container, subtype=subtype, compression_level=quality)
            decoded = soundfile.read(io.BytesIO(content.getvalue()), dtype="float32")[0][: len(row)]
            row[:] = 0.0
            row[: len(decoded)] = decoded
    return torch.from_numpy(rows).clamp_(-1.0, 1.0)
