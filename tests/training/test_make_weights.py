"""`make weights`: the stages' commands in order, going on where an earlier call stopped."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from unitouch_gen.training.assemble import command_of
from unitouch_gen.training.stages import STAGES

CHECKOUT = Path(__file__).resolve().parents[2]
pytestmark = pytest.mark.skipif(
    not (CHECKOUT / "Makefile").is_file() or shutil.which("make") is None,
    reason="there is no checkout or no make",
)


def commands(runs: Path) -> list[str]:
    """What `make weights` would run, without the interpreter's path and the cache."""
    words = ["make", "--dry-run", "weights", f"RUNS={runs}", f"FAMILY={runs / 'family'}"]
    done = subprocess.run(words, cwd=CHECKOUT, capture_output=True, text=True, check=True)
    lines = done.stdout.replace("\\\n", " ").splitlines()
    found = [" ".join(line.split()) for line in lines if "unitouch_gen.training." in line]
    return [re.sub(r"^\S*python", "python", line.replace(f" --cache {runs / 'cache'}", "")) for line in found]


def expected(stage: str, runs: Path) -> list[str]:
    """Commands of a stage; touch begins from what it learns without pictures."""
    whole = command_of(stage, runs)
    if stage != "touch":
        return [whole]
    start, output = whole.split(" --output ")
    pairs = f"{start} --recipe touch_pairs --output {runs / 'touch_pairs'}"
    return [pairs, f"{start} --init {runs / 'touch_pairs' / 'model'} --output {output}"]


def test_all_stages_run_in_order_and_are_put_together(tmp_path: Path) -> None:
    family = tmp_path / "family"
    last = [
        f"python -m unitouch_gen.training.assemble --runs {tmp_path} --output {family}",
        f"python -m unitouch_gen.training.abstention --joint {family / 'joint'}",
    ]
    assert commands(tmp_path) == [*(line for stage in STAGES for line in expected(stage, tmp_path)), *last]


def test_a_stage_that_is_done_is_not_run_again(tmp_path: Path) -> None:
    for stage in ("image_text", "touch_vae"):
        (tmp_path / stage).mkdir()
        (tmp_path / stage / "record.json").touch()
    left = [stage for stage in STAGES if stage not in ("image_text", "touch_vae")]
    assert commands(tmp_path)[:-2] == [line for stage in left for line in expected(stage, tmp_path)]


def test_a_stage_that_was_stopped_goes_on(tmp_path: Path) -> None:
    for name in ("unclip/checkpoints/step-00000250", "touch/checkpoints"):  # one stopped before its first was whole
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "unclip" / "checkpoints" / "step-00000250" / "progress.json").touch()
    found = commands(tmp_path)
    assert [line for line in found if "--resume" in line] == [f"{command_of('unclip', tmp_path)} --resume"]
