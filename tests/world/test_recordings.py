"""Recorded hits: what ships and how it is split, and how contacts sound of them."""

from collections import defaultdict

import numpy as np
import torch

from tests.helpers.chances import has_chance
from unitouch_gen.world import MATERIAL_NAMES, SAMPLE_RATE, World
from unitouch_gen.world.recordings import as_files, recording_of, recordings, recordings_of, with_recordings
from unitouch_gen.world.scans import COLLECTION

MATERIALS = torch.arange(17).repeat(4)
NAMES = MATERIALS, torch.tensor([3, 4, 600, 801]).repeat_interleave(17), torch.zeros(68, dtype=torch.int64)


def test_takes_of_one_kind_of_hit_are_on_one_side_of_the_split() -> None:
    splits = defaultdict[str, set[str]](set)
    for one in recordings():
        splits[one.group].add(one.split)
        assert one.licence.startswith("CC0")
        assert one.author
        assert one.source
        assert one.material in MATERIAL_NAMES
    assert all(len(names) == 1 for names in splits.values())
    assert len(splits) == 18
    assert {f"{one.name}.flac" for one in recordings()} == {file.name for file in (COLLECTION / "sounds").iterdir()}
    held_out = {one.material for one in recordings() if one.split == "test"}
    assert held_out == {"wood", "metal", "glass", "tile"}
    assert held_out < {one.material for one in recordings() if one.split == "train"}


def test_recordings_begin_at_once_and_are_heard() -> None:
    for one in recordings():
        loud = np.abs(one.samples)
        assert one.samples.ndim == 1
        assert 0.05 < len(loud) / SAMPLE_RATE <= 0.6
        assert 0.89 < loud.max() < 0.91
        assert loud[:32].max() > 0.02


def test_a_share_of_sounds_is_recorded_and_the_others_stay() -> None:
    world = World(recordings=0.5)
    draws = world.draw(*NAMES)
    plain = torch.rand(68, 4160) - 0.5
    made = with_recordings(0, draws, plain, 0.5)
    changed = (made != plain).any(dim=1)
    named = [recording_of(0, name, 0.5) for name in draws.names()]
    assert changed.tolist() == [one is not None for one in named]
    assert 0 < changed.sum() < len(plain)
    for one, (material, object_, _) in zip(named, draws.names(), strict=True):
        if one is not None:
            assert one.material == MATERIAL_NAMES[material]
            assert (one.split == "train") == (object_ < 500)
    assert not any(recordings_of(MATERIAL_NAMES.index(name), "train") for name in ("rubber", "leather", "sand"))
    scene = world.render(*NAMES, modalities=("audio",))
    assert scene.recording == [one.name if one else None for one in named]
    assert torch.equal(scene.audio, world.render(*NAMES, modalities=("audio",)).audio)
    assert scene.audio.shape == plain.shape
    assert scene.audio.abs().max() <= 1.0
    assert scene.audio.isfinite().all()


def test_a_recording_sounds_like_itself() -> None:
    """At another speed, its spectrum is moved by as much; the room is added later."""
    draws = World().draw(*NAMES)
    made = with_recordings(0, draws, torch.zeros(68, 4160), 1.0)
    hz = np.fft.rfftfreq(4160, 1 / SAMPLE_RATE)
    for row, name in enumerate(draws.names()):
        if (one := recording_of(0, name, 1.0)) is not None:
            raw = np.pad(one.samples, (0, 4160))[:4160]
            centres = [
                (np.abs(np.fft.rfft(sound)) ** 2 @ hz) / (np.abs(np.fft.rfft(sound)) ** 2).sum()
                for sound in (raw, made[row].numpy())
            ]
            assert 0.8 < centres[1] / centres[0] < 1.25
            assert made[row].abs().max().item() == np.float32(0.9)


def test_files_clip_some_sounds_and_keep_them_in_place() -> None:
    names = [(1, 2, contact) for contact in range(40)]
    time = torch.arange(4160) / SAMPLE_RATE
    plain = (0.8 * torch.sin(2 * torch.pi * 700 * time) * torch.exp(-20 * time)).expand(40, -1).clone()
    filed = as_files(0, names, plain)
    same = (filed == plain).all(dim=1)
    assert has_chance(same.sum(), 40, 0.75 * 0.6)  # neither clipped nor coded
    assert torch.equal(filed, as_files(0, names, plain))
    clipped = filed.abs().amax(dim=1) < 0.75 * plain.abs().max()
    assert has_chance(clipped.sum(), 40, 0.25 * 9.5 / 12)  # by more than 2.5 of up to 12 dB
    for sound in filed[~same & ~clipped]:  # of a codec alone: no delay, little error
        assert np.corrcoef(sound, plain[0])[0, 1] > 0.97
