"""What a stage was built on: known by its hash, kept with checkpoints, and refused when it has been trained anew."""

import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.training.core import Trainer
from unitouch_gen.training.data import ArrayDataset
from unitouch_gen.training.inputs import weights_of
from unitouch_gen.training.recipe import TrainerConfig
from unitouch_gen.training.stages import parse


class Least(torch.nn.Module):
    """Something to train."""

    def __init__(self) -> None:
        super().__init__()
        self.trained = torch.nn.Linear(3, 1)

    def forward(self, batch: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        return {"loss": self.trained(batch["x"]).square().mean()}


def arguments(monkeypatch: pytest.MonkeyPatch, *words: str) -> None:
    monkeypatch.setattr(sys, "argv", ["stage", *words])


def train_anew(folder: str, value: float) -> None:
    """Other weights in a model's folder."""
    file = next(Path(folder).rglob("*.safetensors"))
    save_file({"weight": torch.full((2,), value)}, file)


def test_the_weights_of_a_folder_are_those_of_all_its_files(tmp_path: Path) -> None:
    hashes = set()
    for name in ("model.safetensors", "unet/model.safetensors", "vae/model.safetensors"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        save_file({"weight": torch.ones(2)}, tmp_path / name)
        hashes.add(weights_of(tmp_path))
    (tmp_path / "unet").rename(tmp_path / "other")
    hashes.add(weights_of(tmp_path))
    train_anew(str(tmp_path / "vae"), 2.0)
    hashes.add(weights_of(tmp_path))
    (tmp_path / "config.json").write_text("{}")
    assert len(hashes) == 5 and weights_of(tmp_path) in hashes


def test_a_stage_knows_what_it_is_built_on(monkeypatch: pytest.MonkeyPatch, joint: str, vae: str) -> None:
    arguments(monkeypatch, "--joint", joint, "--vae", vae)
    assert parse("unclip").inputs == {"joint": weights_of(Path(joint)), "vae": weights_of(Path(vae))}
    arguments(monkeypatch)
    assert parse("image_text").inputs == {}


def test_a_stage_does_not_go_on_with_other_weights_than_it_began_with(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, joint: str
) -> None:
    output = tmp_path / "runs" / "touch"
    begun = TrainerConfig(1, 2, 0.1, warmup=0)
    inputs = {"joint": weights_of(Path(joint))}
    Trainer(Least(), ArrayDataset(x=torch.ones(2, 3)), lambda step: [0, 1], begun, output, inputs).fit()
    words = ("--joint", joint, "--output", str(output), "--resume")
    arguments(monkeypatch, *words)
    assert parse("touch").inputs == inputs
    train_anew(joint, 2.0)
    with pytest.raises(InvalidInputError, match=r"`resume` finds .*other weights than `joint` .*; remove .*touch"):
        parse("touch")
    arguments(monkeypatch, *words[:-1])
    assert parse("touch").inputs != inputs


def test_a_checkpoint_that_says_nothing_of_its_inputs_is_gone_on_from(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, joint: str
) -> None:
    checkpoint = tmp_path / "touch" / "checkpoint"
    checkpoint.mkdir(parents=True)
    (checkpoint / "progress.json").write_text('{"step": 1, "seconds": 1.0}')
    arguments(monkeypatch, "--joint", joint, "--output", str(tmp_path / "touch"), "--resume")
    assert parse("touch").resume
