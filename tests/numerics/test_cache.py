"""Results kept on disk: what a fingerprint tells apart, and what is found again."""

import json
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch
from diffusers import AutoencoderKL

from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.numerics.cache import find, fingerprint, keep

TENSORS = {"latents": torch.arange(6, dtype=torch.float64).view(2, 3)}
RECORD = {"rtol": 1e-6, "evaluations": {"dop853": 10}}


@dataclass
class Pair:
    left: torch.Tensor
    right: float


def linear(seed: int = 0, width: int = 3) -> torch.nn.Module:
    torch.manual_seed(seed)
    return torch.nn.Linear(width, 2)


# Fingerprints ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "make",
    [
        lambda: None,
        lambda: (1, 2.5, "a", b"b", True),
        lambda: torch.ones(2, 3, dtype=torch.bfloat16),
        lambda: {"b": torch.zeros(()), "a": [1, None]},
        lambda: Pair(torch.zeros(0), 1.0),
        linear,
    ],
)
def test_the_same_content_has_the_same_fingerprint(make):
    assert fingerprint(make()) == fingerprint(make()) and len(fingerprint(make())) == 64


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ((1,), (1.0,)),
        ((1,), (True,)),
        (("ab", "c"), ("a", "bc")),
        ((("a",), "b"), ("a", ("b",))),
        (("a", "b"), ("b", "a")),
        (({"a": 1},), ({"b": 1},)),
        ((torch.zeros(2, 3),), (torch.zeros(3, 2),)),
        ((torch.zeros(2),), (torch.zeros(2, dtype=torch.int32),)),
        ((torch.zeros(2),), (torch.tensor([0.0, 1e-30]),)),
        ((torch.float16,), (torch.bfloat16,)),
        ((Pair(torch.zeros(1), 1.0),), (Pair(torch.zeros(1), 2.0),)),
        ((linear(0),), (linear(1),)),
        ((linear().train(),), (linear().eval(),)),
        ((linear(),), (linear().double(),)),
    ],
)
def test_other_content_has_another(one, other):
    assert fingerprint(*one) != fingerprint(*other)


def test_a_change_of_one_weight_shows():
    module = linear()
    before = fingerprint(module)
    module.weight.data[0, 0] += 1e-6
    assert fingerprint(module) != before


def test_layout_in_memory_does_not_count():
    tensor = torch.arange(6.0).view(2, 3)
    assert fingerprint(tensor.T) == fingerprint(tensor.T.contiguous())


def test_configuration_counts_but_not_where_it_came_from(tmp_path: Path):
    """diffusers' configuration of a model that was loaded names its folder."""
    torch.manual_seed(0)
    model = AutoencoderKL(block_out_channels=(4,), norm_num_groups=2).eval()
    model.save_pretrained(tmp_path)
    before = fingerprint(model)
    assert fingerprint(AutoencoderKL.from_pretrained(tmp_path)) == before
    model.register_to_config(scaling_factor=2.0)
    assert fingerprint(model) != before


def test_modules_without_tensors_are_refused():
    with pytest.raises(InvalidInputError, match="a Identity without tensors"):
        fingerprint(torch.nn.Identity())


def test_other_kinds_are_refused():
    with pytest.raises(InvalidTypeError, match="`parts` holds a function"):
        fingerprint(linear)


# Kept and found -------------------------------------------------------------------------------------------------------


def test_what_was_kept_is_found(tmp_path: Path):
    keep(tmp_path / "new", "key", TENSORS, RECORD)
    tensors, record = find(tmp_path / "new", "key")
    assert record == RECORD and torch.equal(tensors["latents"], TENSORS["latents"])
    assert sorted(file.name for file in (tmp_path / "new").iterdir()) == ["key.json", "key.safetensors"]


def test_nothing_is_found_under_another_key(tmp_path: Path):
    keep(tmp_path, "key", TENSORS, RECORD)
    assert find(tmp_path, "other") is None and find(tmp_path / "none", "key") is None


def test_the_newer_replaces_the_older(tmp_path: Path):
    keep(tmp_path, "key", TENSORS, RECORD)
    keep(tmp_path, "key", {"latents": torch.zeros(1)}, {})
    assert find(tmp_path, "key")[0]["latents"].tolist() == [0.0]


def flip_a_bit(folder: Path) -> None:
    data = bytearray((folder / "key.safetensors").read_bytes())
    data[-1] ^= 1
    (folder / "key.safetensors").write_bytes(bytes(data))


def cut_short(folder: Path) -> None:
    data = (folder / "key.safetensors").read_bytes()
    (folder / "key.safetensors").write_bytes(data[: len(data) // 2])


DAMAGE = {
    "a bit flipped": flip_a_bit,
    "tensors cut short": cut_short,
    "tensors gone": lambda folder: (folder / "key.safetensors").unlink(),
    "killed before the record": lambda folder: (folder / "key.json").unlink(),
    "record cut short": lambda folder: (folder / "key.json").write_text('{"rtol": 1e-0'),
    "record of another kind": lambda folder: (folder / "key.json").write_text("[]"),
    "record no text": lambda folder: (folder / "key.json").write_bytes(b"\xff\xfe\xff"),
    "record without hash": lambda folder: (folder / "key.json").write_text(json.dumps(RECORD)),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_results_are_not_found(tmp_path: Path, damage):
    keep(tmp_path, "key", TENSORS, RECORD)
    DAMAGE[damage](tmp_path)
    assert find(tmp_path, "key") is None
