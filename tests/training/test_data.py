"""What is rendered to disk, mapped and rendered once, and what frozen models say of it, computed once."""

import copy
import json
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.training.conftest import DRAWN
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.files import running_system
from unitouch_gen.models import UniTouchModel, UniTouchProcessor
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.training.data.columns import SETTINGS, DataConfig, Rendered, drawn, image_embeddings, weights_hash
from unitouch_gen.world import SAMPLE_RATE

DATA = DataConfig(drawn=DRAWN)
(SOURCE,) = DATA.sources()


@pytest.fixture(scope="module")
def folder(split: Rendered, cache: Path) -> Path:
    """That of `split`."""
    return cache / f"drawn-digit-train-{split.fingerprint}"


# Rendering ------------------------------------------------------------------------------------------------------------


def test_sounds_are_the_processors_clips_up_to_half_precision(split: Rendered, processor: UniTouchProcessor) -> None:
    names = [part[:4] for part in SOURCE.contacts("train")]
    scene = SOURCE.world(32).render(*names, modalities=("audio",))
    clips = processor.sounds([(sound, SAMPLE_RATE) for sound in scene.audio])
    assert split.audio.shape == (136, 1, 16, 24)
    np.testing.assert_allclose(split.audio[:4], clips[:, 0], rtol=1e-3, atol=1e-2)


def test_labels_are_those_of_the_contacts(split: Rendered) -> None:
    material, object_, _ = SOURCE.contacts("train")
    np.testing.assert_array_equal(split.material, material)
    np.testing.assert_array_equal(split.object, object_)


def test_a_second_call_reads_what_the_first_has_written(
    split: Rendered, cache: Path, processor: UniTouchProcessor
) -> None:
    files = {path: path.stat().st_mtime_ns for path in cache.rglob("*.npy")}
    again = drawn(cache, SOURCE, "train", DATA, processor)
    assert {path: path.stat().st_mtime_ns for path in cache.rglob("*.npy")} == files
    np.testing.assert_array_equal(again.image, split.image)
    assert again.text == split.text


def test_touches_of_another_size_than_pictures_are_refused(cache: Path, processor: UniTouchProcessor) -> None:
    with pytest.raises(InvalidInputError, match="`touch_size` is 64; with drawn sensors it is that of the pictures"):
        drawn(cache, SOURCE, "train", DATA.model_copy(update={"touch_size": 64}), processor)


def test_arrays_are_mapped_not_read(split: Rendered) -> None:
    assert isinstance(split.image, np.memmap) and isinstance(split.touch, np.memmap)


class KilledError(Exception):
    """What the alarm raises."""


def test_a_render_that_is_interrupted_leaves_no_final_folder(tmp_path: Path, processor: UniTouchProcessor) -> None:
    def interrupt(*_: object) -> None:
        raise KilledError

    before = signal.signal(signal.SIGALRM, interrupt)
    signal.setitimer(signal.ITIMER_REAL, 0.5)  # rendering 136 contacts takes longer than that
    try:
        with pytest.raises(KilledError):
            drawn(tmp_path, SOURCE, "train", DATA, processor)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    assert list(tmp_path.iterdir()) == []


def test_what_an_interrupted_render_left_does_not_get_in_the_way(
    tmp_path: Path, split: Rendered, folder: Path, processor: UniTouchProcessor
) -> None:
    partial = tmp_path / f".unitouch-{running_system()}-1.partial"
    (partial / folder.name).mkdir(parents=True)
    (partial / folder.name / "image.npy").write_bytes(b"cut short")
    again = drawn(tmp_path, SOURCE, "train", DATA, processor)
    np.testing.assert_array_equal(again.image, split.image)
    assert not partial.exists()


@pytest.mark.parametrize("change", ["audio", "no settings"])
def test_a_cache_of_other_settings_is_refused(
    change: str, folder: Path, processor: UniTouchProcessor, tmp_path: Path
) -> None:
    file = Path(shutil.copytree(folder, tmp_path / folder.name)) / SETTINGS
    if change == "audio":
        file.write_text(json.dumps({"audio": {**json.loads(file.read_text())["audio"], "mel_bins": 17}}))
    else:
        file.unlink()
    with pytest.raises(InvalidInputError, match=rf"`cache` holds .*{folder.name}.*other image or sound settings"):
        drawn(tmp_path, SOURCE, "train", DATA, processor)


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
