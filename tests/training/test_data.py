"""Collections rendered to disk against the world itself, and what frozen models say of them, computed once."""

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
from unitouch_gen.files import running_system
from unitouch_gen.models import UniTouchModel, UniTouchProcessor
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.training.data.columns import (
    SETTINGS,
    DataConfig,
    Rendered,
    _render,
    fingerprint,
    image_embeddings,
    rendered,
    weights_hash,
)
from unitouch_gen.world import COLLECTIONS, SAMPLE_RATE, Scene, Style, World, contacts

ROWS = [0, 5, 77, 127]
NAME = "world_digit_unseen"
SPEC, FOLDER = COLLECTIONS[NAME], f"{NAME}-val-1-seed0"
ONE = DataConfig(contacts_per_object=1)


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Some contacts of `split`, straight from the world."""
    names = [part[ROWS] for part in contacts(SPEC, "val", 1)]
    return World(0, image_size=32).render(*names, sensors=(SPEC.sensor,), style=SPEC.style)


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
    material, object_, _ = contacts(SPEC, "val", 1)
    np.testing.assert_array_equal(split.material, material)
    np.testing.assert_array_equal(split.object, object_)


def test_a_second_call_reads_what_the_first_has_written(
    split: Rendered, cache: Path, processor: UniTouchProcessor
) -> None:
    files = {path: path.stat().st_mtime_ns for path in cache.rglob("*.npy")}
    again = rendered(cache, NAME, "val", ONE, processor)
    assert {path: path.stat().st_mtime_ns for path in cache.rglob("*.npy")} == files
    np.testing.assert_array_equal(again.image, split.image)
    assert again.text == split.text


def test_touches_may_have_a_size_of_their_own(
    split: Rendered, cache: Path, processor: UniTouchProcessor, scene: Scene
) -> None:
    again = rendered(cache, NAME, "val", ONE.model_copy(update={"touch_size": 64}), processor)
    assert again.image.shape == split.image.shape and again.touch.shape == (128, 3, 64, 64)
    larger = World(0, image_size=64).render(scene.material, scene.object, scene.contact, sensors=(SPEC.sensor,),
                                            modalities=("touch",), style=SPEC.style)  # fmt: skip
    np.testing.assert_allclose(again.touch[ROWS] / 255.0, larger.touch["digit"], atol=0.5 / 255 + 1e-6)
    assert sorted(path.name for path in (cache / f"{FOLDER}-touch64").iterdir()) == [SETTINGS, "touch.npy"]


@pytest.mark.parametrize("size", [48, 224, 256])
def test_any_size_can_be_rendered(size: int, tmp_path: Path) -> None:
    names = tuple(part[ROWS] for part in contacts(SPEC, "val", 1))
    _render(SPEC, names, 0, size, None, tmp_path)
    assert np.load(tmp_path / "touch.npy").shape == (4, 3, size, size)


def test_worlds_are_rendered_apart(split: Rendered, cache: Path, processor: UniTouchProcessor) -> None:
    other = rendered(cache, NAME, "val", ONE.model_copy(update={"world_seed": 1}), processor)
    assert not np.array_equal(other.image, split.image) and other.fingerprint != split.fingerprint


def test_arrays_are_mapped_not_read(split: Rendered) -> None:
    assert isinstance(split.image, np.memmap) and isinstance(split.touch, np.memmap)


def test_splits_hold_objects_apart(split: Rendered, cache: Path, processor: UniTouchProcessor) -> None:
    test = rendered(cache, NAME, "test", ONE, processor)
    train = contacts(SPEC, "train", 1)[1]
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
            rendered(tmp_path, NAME, "val", ONE, processor)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    assert list(tmp_path.iterdir()) == []


def test_what_an_interrupted_render_left_does_not_get_in_the_way(
    tmp_path: Path, split: Rendered, processor: UniTouchProcessor
) -> None:
    partial = tmp_path / f".unitouch-{running_system()}-1.partial"
    (partial / FOLDER).mkdir(parents=True)
    (partial / FOLDER / "image.npy").write_bytes(b"cut short")
    again = rendered(tmp_path, NAME, "val", ONE, processor)
    np.testing.assert_array_equal(again.image, split.image)
    assert not partial.exists()


@pytest.mark.parametrize("change", ["image_size", "audio"])
def test_a_cache_of_other_settings_is_refused(
    change: str, split: Rendered, cache: Path, processor: UniTouchProcessor
) -> None:
    other = copy.deepcopy(processor)
    other = UniTouchProcessor(image_size=64, audio=other.audio) if change == "image_size" else UniTouchProcessor(32)
    with pytest.raises(InvalidInputError, match=rf"`cache` holds .*{FOLDER}.*other image or sound settings"):
        rendered(cache, NAME, "val", ONE, other)


@pytest.mark.parametrize("change", ["world", "no settings"])
def test_a_cache_of_another_world_is_refused(
    change: str, split: Rendered, cache: Path, processor: UniTouchProcessor, tmp_path: Path
) -> None:
    file = Path(shutil.copytree(cache / FOLDER, tmp_path / FOLDER)) / SETTINGS
    if change == "world":
        file.write_text(json.dumps({**json.loads(file.read_text()), "world": "0123456789abcdef"}))
    else:
        file.unlink()
    with pytest.raises(InvalidInputError, match=rf"`cache` holds .*{FOLDER}.* or from another world; delete"):
        rendered(tmp_path, NAME, "val", ONE, processor)


def test_a_fingerprint_changes_with_the_world() -> None:
    names = contacts(SPEC, "val", 1)
    later = (names[0], names[1] + 1, names[2])
    prints = [
        fingerprint(SPEC, names, 0),
        fingerprint(SPEC, names, 1),
        fingerprint(SPEC, later, 0),
        fingerprint(replace(SPEC, style=Style(indentation_depth=1.01)), names, 0),
        fingerprint(replace(SPEC, sensor="tacto"), names, 0),
    ]
    assert len(set(prints)) == len(prints)
    assert fingerprint(SPEC, names, 0) == prints[0]


# Embeddings and hashes ------------------------------------------------------------------------------------------------

PICTURES = np.random.default_rng(0).integers(0, 256, (7, 3, 32, 32), dtype=np.uint8)


def test_embeddings_are_the_encoders(model: UniTouchModel, tmp_path: Path) -> None:
    embeds = image_embeddings(model, [PICTURES[:4], PICTURES[4:]], "k", tmp_path, batch_size=3)
    with torch.no_grad():
        expected = model.get_image_features(normalise_pixels(torch.from_numpy(PICTURES) / 255.0))
    torch.testing.assert_close(embeds, expected)


def test_embeddings_are_computed_once(model: UniTouchModel, tmp_path: Path) -> None:
    first = image_embeddings(model, [PICTURES], "k", tmp_path)
    assert torch.equal(image_embeddings(model, [], "k", tmp_path), first)  # no picture is looked at
    assert [path.suffix for path in tmp_path.iterdir()] == [".safetensors"]


def test_a_changed_encoder_has_its_embeddings_computed_anew(model: UniTouchModel, tmp_path: Path) -> None:
    first = image_embeddings(model, [PICTURES], "k", tmp_path)
    with torch.no_grad():
        model.vision_model.visual_projection.weight[3, 5] += 1.0
    assert not torch.equal(image_embeddings(model, [PICTURES], "k", tmp_path), first)


def test_other_pictures_have_embeddings_of_their_own(model: UniTouchModel, tmp_path: Path) -> None:
    image_embeddings(model, [PICTURES], "k", tmp_path)
    assert len(image_embeddings(model, [PICTURES[:2]], "other", tmp_path)) == 2


def test_a_hash_changes_with_any_weight(model: UniTouchModel) -> None:
    module = model.touch_model
    hashes = {weights_hash(module)}
    for parameter in module.parameters():
        with torch.no_grad():
            parameter.view(-1)[-1] += 1e-4
        hashes.add(weights_hash(module))
    assert len(hashes) == 1 + len(list(module.parameters()))


def test_a_hash_follows_from_the_weights_alone(model: UniTouchModel) -> None:
    assert weights_hash(copy.deepcopy(model.touch_model).train()) == weights_hash(model.touch_model)
