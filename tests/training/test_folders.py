"""Folders that are replaced whole: watched at every rename, and after a kill between two of them."""

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch

from unitouch_gen.training.core import Trainer
from unitouch_gen.training.data import ArrayDataset
from unitouch_gen.training.folders import replace_folder, restore_folder, write_folder
from unitouch_gen.training.recipe import TrainerConfig

WATCHERS: list[Callable[[], None]] = []


def _hook(event: str, _: tuple) -> None:
    if WATCHERS and event in ("os.rename", "shutil.rmtree", "os.remove", "os.rmdir"):
        WATCHERS[0]()


sys.addaudithook(_hook)  # sees each rename and removal of this process just before it happens


@contextmanager
def watched(check: Callable[[], None]) -> Iterator[None]:
    WATCHERS[:] = [check]
    try:
        yield
    finally:
        WATCHERS.clear()
    check()


def folder(path: Path, content: str) -> Path:
    path.mkdir()
    (path / "weights").write_text(content)
    return path


def contents(*paths: Path) -> list[str]:
    return [(path / "weights").read_text() for path in paths if (path / "weights").is_file()]


def test_a_whole_folder_is_there_at_every_moment(tmp_path: Path) -> None:
    final, old = folder(tmp_path / "final", "old"), tmp_path / "final.old"
    partial = folder(tmp_path / "partial", "new")
    seen = []

    def check() -> None:
        seen.append(contents(final, old))
        assert seen[-1]

    with watched(check):
        replace_folder(partial, final)
    assert len(seen) > 3
    assert contents(final) == ["new"] and {path.name for path in tmp_path.iterdir()} == {"final"}


def test_a_whole_folder_is_there_at_every_moment_after_a_kill_between_the_renames(tmp_path: Path) -> None:
    final, old = tmp_path / "final", folder(tmp_path / "final.old", "old")
    partial = folder(tmp_path / "partial", "new")

    def check() -> None:
        assert contents(final, old)

    with watched(check):
        replace_folder(partial, final)
    assert contents(final) == ["new"] and not old.exists()


def test_a_folder_that_is_new_is_just_renamed(tmp_path: Path) -> None:
    replace_folder(folder(tmp_path / "partial", "new"), tmp_path / "final")
    assert contents(tmp_path / "final") == ["new"] and not (tmp_path / "partial").exists()


def test_a_kill_between_the_renames_is_undone(tmp_path: Path) -> None:
    folder(tmp_path / "final.old", "old")
    restore_folder(tmp_path / "final")
    assert contents(tmp_path / "final") == ["old"]


def test_a_kill_after_the_renames_is_left_alone(tmp_path: Path) -> None:
    folder(tmp_path / "final", "new"), folder(tmp_path / "final.old", "old")
    restore_folder(tmp_path / "final")
    assert contents(tmp_path / "final") == ["new"]


class Quadratic(torch.nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.trained = torch.nn.Linear(1, 1)

    def forward(self, batch: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        return {"loss": self.trained(batch["x"]).square().mean()}


def test_a_run_killed_between_the_renames_goes_on(tmp_path: Path) -> None:
    def make() -> Trainer:
        dataset = ArrayDataset(x=torch.ones(4, 1))
        config = TrainerConfig(steps=6, batch_size=2, learning_rate=0.1, save_every=3)
        return Trainer(Quadratic(), dataset, lambda step: [0, 1], config, tmp_path)

    make().fit()
    (tmp_path / "checkpoint").rename(tmp_path / "checkpoint.old")
    trainer = make()
    trainer.resume()
    assert trainer.step == 6


def test_a_write_that_fails_leaves_the_folder_as_it_was(tmp_path: Path) -> None:
    final = folder(tmp_path / "final", "old")

    def write(target: Path) -> None:
        (target / "weights").write_text("ne")
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        write_folder(final, write)
    assert contents(final) == ["old"]


def test_a_write_that_fails_after_a_kill_between_the_renames_leaves_the_old_folder(tmp_path: Path) -> None:
    folder(tmp_path / "final.old", "old")

    def write(target: Path) -> None:
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        write_folder(tmp_path / "final", write)
    assert contents(tmp_path / "final") == ["old"]


def test_a_write_starts_from_an_empty_folder(tmp_path: Path) -> None:
    folder(tmp_path / "final.partial", "of a write that was killed")
    write_folder(tmp_path / "final", lambda target: (target / "figures.json").write_text(json.dumps({"a": 1})))
    assert [path.name for path in (tmp_path / "final").iterdir()] == ["figures.json"]
