"""Training in two processes, held to one process with the joint batch."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from safetensors.torch import load_file

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.training.distributed import JointDraws, rows_of
from unitouch_gen.training.recipe import read_recipe

SHORT = (
    "data.drawn={sensors: [gelsight, digit], objects: 1, contacts_per_object: 1, held_out: 1}", "trainer.steps=4",
    "trainer.batch_size=8", "trainer.warmup=1", "trainer.save_every=2", "trainer.mixed_precision=no",
    "trainer.learning_rate=0.01", "trainer.ema_decay=0.5", "trainer.trackers=[]", "trainer.watch_every=2",
)  # fmt: skip


def train(count: int, joint: str, output: Path, cache: Path, *words: str) -> None:
    """Runs the touch stage in so many processes on the CPU, which accelerate's own launcher does not start."""
    launch = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node", str(count)]
    options = ["--joint", joint, "--output", str(output), "--cache", str(cache)]
    overrides = [word for setting in SHORT for word in ("--set", setting)]
    command = [*launch, "-m", "unitouch_gen.training.touch", *options, *overrides, *words]
    env = {**os.environ, "ACCELERATE_USE_CPU": "true"}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=env)
    assert done.returncode == 0, done.stderr[-3000:]


def losses(output: Path) -> list[float]:
    lines = [json.loads(line) for line in (output / "log.jsonl").read_text().splitlines()]
    return [value for line in lines for name, value in line.items() if name in ("loss", "retrieval_top5")]


@pytest.mark.slow
@pytest.mark.parametrize("accumulation", [1, 2])
def test_two_processes_train_as_one(tmp_path: Path, joint: str, cache: Path, accumulation: int) -> None:
    held_to_one(tmp_path, joint, cache, "--set", f"trainer.accumulation={accumulation}")


@pytest.mark.slow
@pytest.mark.parametrize("sensors", [[None, "digit"], [None]])
def test_two_processes_train_as_one_where_no_touch_of_a_batch_has_tokens(
    tmp_path: Path, joint: str, cache: Path, sensors: list[str | None]
) -> None:
    drawn = {"sensors": sensors, "objects": 1, "contacts_per_object": 1}
    recipe = {**read_recipe("touch"), "objective": {"touch": 1.0, "attributes": 1.0}, "data": {"drawn": drawn}}
    (tmp_path / "drawn.yaml").write_text(yaml.safe_dump(recipe))
    words = ("trainer.batch_size=2", "trainer.watch_every=0")
    words = ("--recipe", str(tmp_path / "drawn.yaml"), *(f"--set={word}" for word in words))
    # In batches of two some gradients all but cancel, and Adam's steps are as long on what rounding leaves of them.
    held_to_one(tmp_path, joint, cache, *words, atol=1e-4)


def held_to_one(tmp_path: Path, joint: str, cache: Path, *words: str, atol: float = 1e-5) -> None:
    """Trains in one process and in two, whose losses and weights have to be the same."""
    for count in (1, 2):
        train(count, joint, tmp_path / str(count), cache, *words)
    one, two = (tmp_path / name for name in ("1", "2"))
    np.testing.assert_allclose(losses(two), losses(one), atol=1e-5)
    weights = [load_file(output / "model" / "model.safetensors") for output in (one, two)]
    assert weights[0].keys() == weights[1].keys()
    for name, tensor in weights[0].items():
        torch.testing.assert_close(weights[1][name], tensor, atol=atol, rtol=0)


def test_random_numbers_are_the_rows_of_those_of_the_whole_batch() -> None:
    def draws(count: int) -> list[torch.Tensor]:
        torch.manual_seed(0)
        like = torch.zeros(count, 3, dtype=torch.float64)
        return [
            torch.rand(count, 2), torch.randn((count,)), torch.randint(0, 9, (count, 4)), torch.randint(9, (count,)),
            torch.randn_like(like), torch.rand_like(like), torch.rand(count, 1, device="cpu"),
        ]  # fmt: skip

    whole = draws(6)
    for rows in (slice(0, 2), slice(2, 4), slice(4, 6)):
        with JointDraws(rows, 6):
            found = draws(2)
        assert all(
            torch.equal(own, of_all[rows]) and own.dtype == of_all.dtype
            for own, of_all in zip(found, whole, strict=True)
        )


def test_random_numbers_that_are_of_no_rows_are_an_error() -> None:
    with JointDraws(slice(0, 2), 4), pytest.raises(RuntimeError, match=r"shape \(3, 2\)"):
        torch.rand(3, 2)


def test_a_batch_that_cannot_be_shared_evenly_is_refused() -> None:
    assert [rows_of(8, process, 4) for process in range(4)] == [slice(0, 2), slice(2, 4), slice(4, 6), slice(6, 8)]
    with pytest.raises(InvalidInputError, match="`batch_size` is 8, which 3 processes cannot share evenly"):
        rows_of(8, 0, 3)
