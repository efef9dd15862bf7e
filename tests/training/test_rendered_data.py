"""Collections rendered to disk against the world itself, and columns of arrays against numpy."""

import copy
import json
import shutil
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.models import UniTouchProcessor
from unitouch_gen.training.data import SETTINGS, ArrayDataset, Rendered, Stacked, _scenes, fingerprint, rendered
from unitouch_gen.world import COLLECTIONS, SAMPLE_RATE, Scene, Style, World, contacts

ROWS = [0, 5, 77, 127]


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Some contacts of `split`, straight from the world."""
    spec = COLLECTIONS["world_digit_unseen"]
    names = [part[ROWS] for part in contacts(spec, "val", 1)]
    return World(0, image_size=32).render(*names, sensors=(spec.sensor,), style=spec.style)


# Rendering ------------------------------------------------------------------------------------------------------------


def test_pictures_are_the_worlds_up_to_eight_bits(split: Rendered, scene: Scene) -> None:
    assert split.image.dtype == np.uint8 and split.image.shape == (128, 3, 32, 32)
    np.testing.assert_allclose(split.image[ROWS] / 255.0, scene.image, atol=0.5 / 255 + 1e-6)


def test_touches_are_the_worlds_up_to_eight_bits(split: Rendered, scene: Scene) -> None:
    assert split.sensor == "digit" and split.touch.dtype == np.uint8
    np.testing.assert_allclose(split.touch[ROWS] / 255.0, scene.touch["digit"], atol=0.5 / 255 + 1e-6)


def test_sounds_are_the_processors_clips_up_to_half_precision(
    split: Rendered, scene: Scene, processor: UniTouchProcessor
) -> None:
    clips = processor.sounds([(sound, SAMPLE_RATE) for sound in scene.audio])
    assert split.audio.shape == (128, 1, 16, 24)
    np.testing.assert_allclose(split.audio[ROWS], clips[:, 0], rtol=1e-3, atol=1e-3)


def test_captions_are_the_worlds(split: Rendered, scene: Scene) -> None:
    assert [split.text[row] for row in ROWS] == scene.text
    assert len(split.text) == len(split) == 128


def test_labels_are_those_of_the_contacts(split: Rendered) -> None:
    material, object_, _ = contacts(COLLECTIONS["world_digit_unseen"], "val", 1)
    np.testing.assert_array_equal(split.material, material)
    np.testing.assert_array_equal(split.object, object_)


def test_a_second_call_reads_what_the_first_has_written(
    split: Rendered, cache: Path, processor: UniTouchProcessor
) -> None:
    files = {path: path.stat().st_mtime_ns for path in cache.rglob("*.npy")}
    again = rendered(cache, "world_digit_unseen", "val", 1, processor)
    assert {path: path.stat().st_mtime_ns for path in cache.rglob("*.npy")} == files
    np.testing.assert_array_equal(again.image, split.image)
    assert again.text == split.text


def test_touches_may_have_a_size_of_their_own(
    split: Rendered, cache: Path, processor: UniTouchProcessor, scene: Scene
) -> None:
    again = rendered(cache, "world_digit_unseen", "val", 1, processor, touch_size=64)
    assert again.image.shape == split.image.shape and again.touch.shape == (128, 3, 64, 64)
    spec = COLLECTIONS["world_digit_unseen"]
    larger = World(0, image_size=64).render(scene.material, scene.object, scene.contact, sensors=(spec.sensor,),
                                            modalities=("touch",), style=spec.style)  # fmt: skip
    np.testing.assert_allclose(again.touch[ROWS] / 255.0, larger.touch["digit"], atol=0.5 / 255 + 1e-6)
    assert sorted(path.name for path in (cache / "world_digit_unseen-val-1-seed0-touch64").iterdir()) == [
        SETTINGS,
        "touch.npy",
    ]


@pytest.mark.parametrize("size", [48, 224, 256])
def test_any_size_can_be_rendered(size: int, processor: UniTouchProcessor) -> None:
    names = [part[ROWS] for part in contacts(COLLECTIONS["world_digit_unseen"], "val", 1)]
    ((_, scene),) = _scenes(COLLECTIONS["world_digit_unseen"], names, size, 0, ("touch",), "test")
    assert scene.touch["digit"].shape == (4, 3, size, size)


def test_worlds_are_rendered_apart(split: Rendered, cache: Path, processor: UniTouchProcessor) -> None:
    other = rendered(cache, "world_digit_unseen", "val", 1, processor, world_seed=1)
    assert not np.array_equal(other.image, split.image) and other.fingerprint != split.fingerprint


def test_arrays_are_mapped_not_read(split: Rendered) -> None:
    assert isinstance(split.image, np.memmap) and isinstance(split.touch, np.memmap)


def test_splits_hold_objects_apart(split: Rendered, cache: Path, processor: UniTouchProcessor) -> None:
    test = rendered(cache, "world_digit_unseen", "test", 1, processor)
    train = contacts(COLLECTIONS["world_digit_unseen"], "train", 1)[1]
    assert len(test) == 256
    assert not set(split.object) & set(test.object)
    assert not (set(split.object) | set(test.object)) & set(train.tolist())


class KilledError(Exception):
    """What the alarm raises."""


def test_a_render_that_is_interrupted_leaves_no_final_folder(tmp_path: Path, processor: UniTouchProcessor) -> None:
    def interrupt(*_: object) -> None:
        raise KilledError

    before = signal.signal(signal.SIGALRM, interrupt)
    signal.setitimer(signal.ITIMER_REAL, 0.05)  # rendering 128 contacts takes longer than that
    try:
        with pytest.raises(KilledError):
            rendered(tmp_path, "world_digit_unseen", "val", 1, processor)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    assert [path.name for path in tmp_path.iterdir() if not path.name.endswith(".partial")] == []


def test_what_an_interrupted_render_left_does_not_get_in_the_way(
    tmp_path: Path, split: Rendered, processor: UniTouchProcessor
) -> None:
    partial = tmp_path / "world_digit_unseen-val-1-seed0.partial"
    partial.mkdir()
    (partial / "image.npy").write_bytes(b"cut short")
    again = rendered(tmp_path, "world_digit_unseen", "val", 1, processor)
    np.testing.assert_array_equal(again.image, split.image)
    assert not partial.exists()


def test_what_a_render_killed_between_its_renames_left_is_found(
    tmp_path: Path, split: Rendered, cache: Path, processor: UniTouchProcessor
) -> None:
    shutil.copytree(cache / "world_digit_unseen-val-1-seed0", tmp_path / "world_digit_unseen-val-1-seed0.old")
    rendered(tmp_path, "world_digit_unseen", "val", 1, processor)
    assert [path.name for path in tmp_path.iterdir()] == ["world_digit_unseen-val-1-seed0"]


@pytest.mark.parametrize("change", ["image_size", "audio"])
def test_a_cache_of_other_settings_is_refused(
    change: str, split: Rendered, cache: Path, processor: UniTouchProcessor
) -> None:
    other = copy.deepcopy(processor)
    other = UniTouchProcessor(image_size=64, audio=other.audio) if change == "image_size" else UniTouchProcessor(32)
    with pytest.raises(
        InvalidInputError, match=r"`cache` holds .*world_digit_unseen-val-1-seed0.*other image or sound settings"
    ):
        rendered(cache, "world_digit_unseen", "val", 1, other)


@pytest.mark.parametrize("change", ["world", "no settings"])
def test_a_cache_of_another_world_is_refused(
    change: str, split: Rendered, cache: Path, processor: UniTouchProcessor, tmp_path: Path
) -> None:
    file = (
        Path(shutil.copytree(cache / "world_digit_unseen-val-1-seed0", tmp_path / "world_digit_unseen-val-1-seed0"))
        / SETTINGS
    )
    if change == "world":
        file.write_text(json.dumps({**json.loads(file.read_text()), "world": "0123456789abcdef"}))
    else:
        file.unlink()
    with pytest.raises(
        InvalidInputError, match=r"`cache` holds .*world_digit_unseen-val-1-seed0.* or from another world; delete"
    ):
        rendered(tmp_path, "world_digit_unseen", "val", 1, processor)


def test_a_fingerprint_changes_with_the_world() -> None:
    spec = COLLECTIONS["world_digit_unseen"]
    names = contacts(spec, "val", 1)
    later = (names[0], names[1] + 1, names[2])
    prints = [
        fingerprint(spec, names, 0),
        fingerprint(spec, names, 1),
        fingerprint(spec, later, 0),
        fingerprint(replace(spec, style=Style(indentation_depth=1.01)), names, 0),
        fingerprint(replace(spec, sensor="tacto"), names, 0),
    ]
    assert len(set(prints)) == len(prints)
    assert fingerprint(spec, names, 0) == prints[0]


def test_an_unknown_collection_is_refused_with_the_choices(cache: Path, processor: UniTouchProcessor) -> None:
    with pytest.raises(InvalidInputError, match=r"`collection` is 'world_gelsigh'.*Did you mean 'world_gelsight'"):
        rendered(cache, "world_gelsigh", "val", 1, processor)


# Columns --------------------------------------------------------------------------------------------------------------


@pytest.fixture
def parts() -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [rng.standard_normal((n, 2, 3)).astype(np.float32) for n in (4, 1, 6)]


def test_stacked_arrays_read_as_their_concatenation(parts: list[np.ndarray]) -> None:
    whole, stacked = np.concatenate(parts), Stacked(parts)
    assert len(stacked) == 11
    for index in (np.arange(11), np.array([10, 0, 4, 4, 5, 3])):
        np.testing.assert_array_equal(stacked[index], whole[index])


def test_stacked_arrays_refuse_an_index_beyond_their_end(parts: list[np.ndarray]) -> None:
    with pytest.raises(IndexError):
        Stacked(parts)[np.array([11])]


def test_a_batch_is_its_samples_stacked(parts: list[np.ndarray]) -> None:
    dataset = ArrayDataset(stacked=parts, array=np.arange(11), tensor=torch.linspace(0, 1, 11))
    indices = [7, 0, 10, 7]
    batch = dataset.__getitems__(indices)
    for key, values in batch.items():
        assert torch.equal(values, torch.stack([dataset[index][key] for index in indices]))


def test_columns_are_indexed_together(parts: list[np.ndarray]) -> None:
    batch = ArrayDataset(x=parts, number=np.arange(11)).__getitems__([9, 2])
    assert batch["number"].tolist() == [9, 2]
    np.testing.assert_array_equal(batch["x"], np.concatenate(parts)[[9, 2]])


def test_a_batch_is_a_copy(parts: list[np.ndarray]) -> None:
    dataset = ArrayDataset(x=parts, number=np.arange(11))
    batch = dataset.__getitems__([0, 1])
    batch["x"].zero_(), batch["number"].zero_()
    assert dataset[1]["number"] == 1 and dataset[0]["x"].abs().sum() > 0


def test_columns_of_different_lengths_are_refused() -> None:
    with pytest.raises(ValueError, match=r"`columns` have lengths \{'a': 3, 'b': 4\}"):
        ArrayDataset(a=np.zeros(3), b=torch.zeros(4))
