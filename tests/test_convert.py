"""The published checkpoints of ImageBind and UniTouch: what is read of them is what a plain transcription of their
networks computes, what is written of them is read again, and pickles run nothing."""

import math
import os
import pickle
import shutil
import sys
import types
from collections import OrderedDict
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from safetensors.torch import load_file, save_file

from tests.helpers.imagebind import ImageBind
from tests.helpers.published import features_of, inputs_of, published, sizes
from unitouch_gen import weights
from unitouch_gen.convert import convert_published, open_checkpoint
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.models import MODALITIES, UniTouchModel, UniTouchProcessor


@pytest.fixture(scope="module")
def both(tmp_path_factory) -> tuple[dict[str, Path], dict[str, torch.nn.Module]]:
    """The files, and the networks in them by modality."""
    return published(tmp_path_factory.mktemp("published"), sizes())


@pytest.fixture(scope="module")
def files(both) -> dict[str, Path]:
    return both[0]


@pytest.fixture(scope="module")
def folder(files, tmp_path_factory) -> Path:
    """In several shards, as files of the published size are."""
    folder = tmp_path_factory.mktemp("converted")
    convert_published(folder, **files, config=sizes(), tokenizer=weights.JOINT, max_shard_size="100KB")
    assert len(list(folder.glob("model-*.safetensors"))) > 2
    return folder


@pytest.fixture(scope="module")
def model(folder) -> UniTouchModel:
    return UniTouchModel.from_pretrained(folder)


@pytest.mark.parametrize("modality", MODALITIES)
def test_embeddings_are_those_of_the_published_networks(both, model, modality):
    values = inputs_of(sizes())[modality]
    frames = values[:, :, None].expand(-1, -1, 2, -1, -1) if modality in ("image", "touch") else values
    wanted, _ = both[1][modality].embed({"image": "vision"}.get(modality, modality), frames)
    wanted = F.normalize(wanted, dim=-1) if modality == "audio" else wanted
    assert (features_of(model, modality, values) - wanted).norm() <= 1e-6 * wanted.norm()


# Reading --------------------------------------------------------------------------------------------------------------


def test_one_file_brings_its_encoders_alone_in_the_dtype_asked_for(files, tmp_path):
    for name, known in (("touch", ("touch",)), ("imagebind", ("image", "text", "audio"))):
        lacks = convert_published(tmp_path / name, config=sizes(), dtype=torch.bfloat16, **{name: files[name]})
        assert UniTouchModel.from_pretrained(tmp_path / name).known_modalities == known
        assert [f"the {other} encoder" in lacks for other in MODALITIES] == [other not in known for other in MODALITIES]
        tensors = load_file(tmp_path / name / "model.safetensors")
        assert {tensor.dtype for tensor in tensors.values() if tensor.is_floating_point()} == {torch.bfloat16}


def test_files_of_another_network_change_nothing(tmp_path):
    state = ImageBind(sizes(), ("touch",)).state_dict()
    head = "heads.touch.2.weight"
    bias = "blocks.0.attn.bias_k"
    weight = state[f"modality_{head}"]
    for key, value, words in (
        (head, torch.full_like(weight, math.nan), f"{head}` holds .* values that are NaN"),
        (f"trunks.touch.{bias}", None, f"{bias} is missing"),
        (head, weight[:, :-1], r"edited.ckpt` .* projection.weight: .*\[16, 31\].*\[16, 32\]"),
        ("preprocessors.touch.rgbt_stem.proj.1.weight", weight, r"proj.1.weight is of the shape \(16, 32\)"),
        (head, weight.long(), f"{head} is missing"),
    ):
        edited = {name: one for name, one in {**state, f"modality_{key}": value}.items() if one is not None}
        torch.save(edited, tmp_path / "edited.ckpt")
        with pytest.raises(InvalidInputError, match=words):
            convert_published(tmp_path / "model", touch=tmp_path / "edited.ckpt", config=sizes(), dtype=torch.float16)
        assert sorted(path.name for path in tmp_path.iterdir()) == ["edited.ckpt"]


# Checkpoints ----------------------------------------------------------------------------------------------------------

WEIGHTS = {"a.weight": torch.arange(6.0).view(2, 3), "b": torch.ones(4, dtype=torch.float16)}


class Runs:
    """Makes a folder when it is unpickled by a reader that trusts it."""

    def __init__(self, folder: Path):
        self.folder = folder

    def __reduce__(self):
        return os.mkdir, (str(self.folder),)


def save_with_callbacks(file: Path) -> None:
    """As Lightning 1 leaves it: callbacks' states go by their classes, and scores are numpy's."""
    module = types.ModuleType("pytorch_lightning.callbacks.model_checkpoint")
    module.ModelCheckpoint = type("ModelCheckpoint", (), {"__module__": module.__name__})
    names = ("pytorch_lightning", "pytorch_lightning.callbacks", module.__name__)
    sys.modules.update(dict.fromkeys(names, module))
    callbacks = {module.ModelCheckpoint: {"best_model_score": np.float32(0.5)}}
    torch.save({"epoch": 3, "state_dict": WEIGHTS, "callbacks": callbacks}, file)
    for name in names:
        del sys.modules[name]


SAVED = {
    "model.pth": lambda file: torch.save(OrderedDict(WEIGHTS), file),
    "legacy.pth": lambda file: torch.save(WEIGHTS, file, _use_new_zipfile_serialization=False),
    "last.ckpt": save_with_callbacks,
    "model.safetensors": lambda file: save_file(WEIGHTS, file),
}


def test_state_dicts_of_all_formats_are_read(tmp_path):
    for name, write in SAVED.items():
        write(tmp_path / name)
        tensors = open_checkpoint("touch", tmp_path / name)
        assert set(tensors) == set(WEIGHTS), name
        assert all(torch.equal(tensors[key], WEIGHTS[key]) for key in WEIGHTS), name
    assert "pytorch_lightning" not in sys.modules


def test_code_in_a_pickle_is_not_run(tmp_path):
    trap = tmp_path / "trap"
    names = ("archive.pth", "legacy.pth", "bare.pth")
    archive, legacy, bare = (tmp_path / name for name in names)
    torch.save({"state_dict": WEIGHTS, "more": Runs(trap)}, archive)
    torch.save({"state_dict": WEIGHTS, "more": Runs(trap)}, legacy, _use_new_zipfile_serialization=False)
    bare.write_bytes(pickle.dumps(Runs(trap), protocol=2))
    for file in (archive, legacy, bare):
        with pytest.raises(InvalidInputError, match=r"holds more than weights: .*mkdir, of which nothing was run"):
            open_checkpoint("touch", file)
    assert not trap.exists()


# The folder -----------------------------------------------------------------------------------------------------------


@torch.no_grad()
def test_the_processor_of_the_folder_fits_its_model(model, folder):
    processor = UniTouchProcessor.from_pretrained(folder)
    assert processor.text("rough brick")["attention_mask"].sum() == 4  # whole words between start and end
    sound = torch.randn(16_000, generator=torch.Generator().manual_seed(0)).numpy()
    assert processor.image_size == 32
    assert model.get_audio_features(processor.sounds((sound, 16_000))).shape == (1, 16)


@pytest.mark.parametrize("there", ["a model", "a pipeline", "a file"])
def test_convert_writes_over_nothing_that_is_there(files, folder, tmp_path, there):
    output = tmp_path / "model"
    if there == "a file":
        output.write_text("notes")
    else:
        shutil.copytree(folder, output)
    if there == "a pipeline":
        (output / "config.json").rename(output / "model_index.json")

    def contents() -> dict[Path, bytes]:
        return {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}

    before = contents()
    with pytest.raises(InvalidInputError, match="`output`"):
        convert_published(output, touch=files["touch"], config=sizes())
    assert contents() == before
