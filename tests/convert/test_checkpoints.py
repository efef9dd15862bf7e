"""Checkpoints of others: what is read of them, and what is refused without running any of it."""

import os
import pickle
import sys
import types
import zipfile
from collections import OrderedDict
from pathlib import Path

import numpy as np
import psutil
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from unitouch_gen.convert.checkpoints import LazyTensor, open_checkpoint, page_out, write_tensors
from unitouch_gen.errors import InvalidInputError

WEIGHTS = {"a.weight": torch.arange(6.0).view(2, 3), "b": torch.ones(4, dtype=torch.float16)}


@pytest.fixture
def file(tmp_path) -> Path:
    torch.save(WEIGHTS, tmp_path / "model.pth")
    return tmp_path / "model.pth"


def same(tensors) -> bool:
    return set(tensors) == set(WEIGHTS) and all(torch.equal(tensors[key], WEIGHTS[key]) for key in WEIGHTS)


# What is read ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("zipped", [True, False])
def test_state_dicts_of_both_formats_are_read(tmp_path, zipped):
    torch.save(OrderedDict(WEIGHTS), tmp_path / "model.pth", _use_new_zipfile_serialization=zipped)
    assert same(open_checkpoint("touch", tmp_path / "model.pth"))


def test_lightning_wraps_the_weights(tmp_path):
    torch.save({"epoch": 3, "global_step": 10, "state_dict": WEIGHTS, "callbacks": {}}, tmp_path / "last.ckpt")
    assert same(open_checkpoint("touch", tmp_path / "last.ckpt"))


def test_what_lightning_leaves_beside_the_weights_is_not_made(tmp_path, monkeypatch):
    """Callbacks' states go by their classes, and scores are numpy's: known by name, and never imported."""
    module = types.ModuleType("pytorch_lightning.callbacks.model_checkpoint")
    module.ModelCheckpoint = type("ModelCheckpoint", (), {"__module__": module.__name__})
    for name in ("pytorch_lightning", "pytorch_lightning.callbacks", module.__name__):
        monkeypatch.setitem(sys.modules, name, module)
    held = {"state_dict": WEIGHTS, "callbacks": {module.ModelCheckpoint: {"best_model_score": np.float32(0.5)}}}
    torch.save(held, tmp_path / "last.ckpt")
    monkeypatch.undo()
    assert same(open_checkpoint("touch", tmp_path / "last.ckpt"))
    assert "pytorch_lightning" not in sys.modules


def test_safetensors_are_read(tmp_path):
    save_file(WEIGHTS, tmp_path / "model.safetensors")
    assert same(open_checkpoint("touch", tmp_path / "model.safetensors"))


# What is refused ------------------------------------------------------------------------------------------------------


class Runs:
    """Makes a folder when it is unpickled by a reader that trusts it."""

    def __init__(self, folder: Path):
        self.folder = folder

    def __reduce__(self):
        return os.mkdir, (str(self.folder),)


@pytest.mark.parametrize("zipped", [True, False])
def test_code_in_a_pickle_is_not_run(tmp_path, zipped):
    file, trap = tmp_path / "model.pth", tmp_path / "trap"
    torch.save({"state_dict": WEIGHTS, "more": Runs(trap)}, file, _use_new_zipfile_serialization=zipped)
    with pytest.raises(InvalidInputError, match=r"holds more than weights: .*mkdir, of which nothing was run"):
        open_checkpoint("touch", file)
    assert not trap.exists()


def test_code_in_a_bare_pickle_is_not_run(tmp_path):
    file, trap = tmp_path / "model.pth", tmp_path / "trap"
    file.write_bytes(pickle.dumps(Runs(trap), protocol=2))
    with pytest.raises(InvalidInputError, match=r"mkdir, of which nothing was run"):
        open_checkpoint("touch", file)
    assert not trap.exists()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "is empty"),
        (b"these are no weights\n" * 10, "cannot be read as a checkpoint"),
        (b"PK\x03\x04" + bytes(200), "cannot be read as a checkpoint"),
    ],
)
@pytest.mark.parametrize("suffix", [".pth", ".safetensors"])
def test_files_of_something_else(tmp_path, content, words, suffix):
    file = tmp_path / f"model{suffix}"
    file.write_bytes(content)
    with pytest.raises(InvalidInputError, match=rf"`imagebind` names .*{words}"):
        open_checkpoint("imagebind", file)


@pytest.mark.parametrize("share", [0.3, 0.9, 0.99])
def test_files_that_are_cut_off(file, share):
    content = file.read_bytes()
    file.write_bytes(content[: int(share * len(content))])
    with pytest.raises(InvalidInputError, match=r"cut off, or something else"):
        open_checkpoint("touch", file)


def test_a_folder_and_a_file_that_is_not_there(tmp_path):
    with pytest.raises(InvalidInputError, match=r"is a folder"):
        open_checkpoint("touch", tmp_path)
    with pytest.raises(InvalidInputError, match=r"does not exist"):
        open_checkpoint("touch", tmp_path / "gone.pth")


@pytest.mark.parametrize("held", [torch.ones(3), [1, 2], {"epoch": 1}, {"state_dict": {"epoch": 1}}])
def test_files_without_a_state_dict(tmp_path, held):
    torch.save(held, tmp_path / "model.pth")
    with pytest.raises(InvalidInputError, match=r"pass a state dict"):
        open_checkpoint("touch", tmp_path / "model.pth")


def test_a_tensor_that_claims_more_than_it_holds(tmp_path):
    torch.save({"weight": torch.ones(1).expand(1 << 20, 1 << 20)}, tmp_path / "model.pth")
    with pytest.raises(InvalidInputError, match=r"'weight' claims 1099511627776 values and holds 4 bytes"):
        open_checkpoint("touch", tmp_path / "model.pth")


def test_a_file_that_was_damaged_on_the_way(file):
    content = bytearray(file.read_bytes())
    place = content.index(WEIGHTS["a.weight"].numpy().tobytes())
    content[place + 5] ^= 1
    file.write_bytes(content)
    with pytest.raises(InvalidInputError, match=r"whose part 'model/data/0' is damaged"):
        open_checkpoint("touch", file)


@pytest.mark.parametrize(
    ("tensor", "words"),
    [(torch.eye(3).to_sparse(), "sparse_coo on the device 'cpu'"), (torch.empty(3, device="meta"), "device 'meta'")],
    ids=["sparse", "meta"],
)
def test_a_tensor_without_plain_values(tmp_path, tensor, words):
    torch.save({**WEIGHTS, "odd": tensor}, tmp_path / "model.pth")
    with pytest.raises(InvalidInputError, match=rf"'odd' is .*{words}"):
        open_checkpoint("touch", tmp_path / "model.pth")


def test_a_file_that_may_not_be_read_is_not_called_broken(file, monkeypatch):
    def refused(*args, **kwargs):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", refused)
    with pytest.raises(InvalidInputError, match=r"`touch` names .*which cannot be read: .*Permission denied"):
        open_checkpoint("touch", file)


def test_an_archive_that_unpacks_to_more_than_it_is(file, tmp_path):
    packed = tmp_path / "packed.pth"
    with zipfile.ZipFile(file) as archive, zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as other:
        for name in archive.namelist():
            other.writestr(name, archive.read(name) + bytes(1 << 20) * name.endswith("data/0"))
    with pytest.raises(InvalidInputError, match=r"unpack to .* bytes, more than the file has"):
        open_checkpoint("touch", packed)


def test_what_is_paged_out_is_there_again(tmp_path):
    mapped = torch.arange(300_000.0)
    torch.save({"changed": mapped, "same": mapped + 1}, tmp_path / "model.pth")
    tensors = open_checkpoint("touch", tmp_path / "model.pth")
    tensors["changed"] += 7  # a copy of this process's own, which the file does not have
    tensors["made"] = mapped * 2
    expected = {key: tensor.clone() for key, tensor in tensors.items()}
    for key, tensor in tensors.items():
        page_out(tensor)
        assert torch.equal(tensor, expected[key])


@pytest.mark.slow  # and of this machine: a disk in memory has nowhere to read from again
@pytest.mark.skipif(sys.platform != "linux", reason="no other system knows how")
def test_a_mapped_tensor_that_is_paged_out_takes_no_memory(tmp_path):
    torch.save({"weight": torch.ones(16 * 2**20)}, tmp_path / "model.pth")  # 64 MB
    weight = open_checkpoint("touch", tmp_path / "model.pth")["weight"]
    weight.sum()
    held = psutil.Process().memory_info().rss
    page_out(weight)
    assert held - psutil.Process().memory_info().rss > 50e6


# Writing --------------------------------------------------------------------------------------------------------------


def write(file: Path, tensors: dict[str, LazyTensor]) -> None:
    write_tensors(file.parent, {file.name: tensors})


def test_what_is_written_is_read_by_safetensors_itself(tmp_path):
    tensors = {
        **WEIGHTS, "half": torch.randn(3, 5).bfloat16(), "none": torch.zeros(0, 7), "flags": torch.tensor([True]),
        "turned": torch.randn(4, 6).T, "one": torch.tensor(2.5),
    }  # fmt: skip
    write(tmp_path / "model.safetensors", {key: LazyTensor.of(value) for key, value in tensors.items()})
    found = load_file(tmp_path / "model.safetensors")
    assert set(found) == set(tensors)
    for key, value in tensors.items():
        assert found[key].dtype == value.dtype and torch.equal(found[key], value)
    with safe_open(tmp_path / "model.safetensors", framework="pt") as written:
        assert written.metadata() == {"format": "pt"}


def test_the_order_of_tensors_makes_no_difference(tmp_path):
    for file, keys in (("one", list(WEIGHTS)), ("two", list(reversed(WEIGHTS)))):
        write(tmp_path / file, {key: LazyTensor.of(WEIGHTS[key]) for key in keys})
    assert (tmp_path / "one").read_bytes() == (tmp_path / "two").read_bytes()


def test_a_tensor_that_is_not_what_it_was_going_to_be(tmp_path):
    with pytest.raises(ValueError, match=r"was promised"):
        write(tmp_path / "file", {"a": LazyTensor((2,), torch.float32, lambda: torch.ones(3))})


def test_one_tensor_is_in_memory_at_a_time(tmp_path):
    alive: list[int] = []
    held = {"count": 0}

    class Counted:
        def __init__(self):
            held["count"] += 1

        def __del__(self):
            held["count"] -= 1

    def make() -> torch.Tensor:
        tensor = torch.ones(1000)
        tensor.counted = Counted()
        alive.append(held["count"])
        return tensor

    write(tmp_path / "file", {str(number): LazyTensor((1000,), torch.float32, make) for number in range(5)})
    assert max(alive) <= 2  # the next one is made before the name of the last is given away


def test_several_files_are_written_one_after_the_other(tmp_path):
    """Each is taken out when it is written; bytes are counted over all."""
    seen = []
    files = {f"{name}/model": {name: LazyTensor.of(tensor)} for name, tensor in WEIGHTS.items()}
    write_tensors(tmp_path, files, lambda done, size: seen.append((done, size)))
    assert seen == [(24, 32), (32, 32)] and not files
    assert set(load_file(tmp_path / "b" / "model")) == {"b"}
