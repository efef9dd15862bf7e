"""`make weights`: the stages' commands in order."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from unitouch_gen.training.stages import STAGES, command_of

CHECKOUT = Path(__file__).resolve().parents[2]
pytestmark = pytest.mark.skipif(
    not (CHECKOUT / "Makefile").is_file() or shutil.which("make") is None, reason="there is no checkout or no make"
)


def commands(runs: Path) -> list[str]:
    """What `make weights` would run, without the interpreter's path and the cache."""
    words = ["make", "--dry-run", "weights", f"RUNS={runs}", f"FAMILY={runs / 'family'}"]
    done = subprocess.run(words, cwd=CHECKOUT, capture_output=True, text=True, check=True)
    lines = done.stdout.replace("\\\n", " ").splitlines()
    found = [" ".join(line.split()) for line in lines if "unitouch_gen.training." in line]
    return [re.sub(r"^\S*python", "python", line.replace(f" --cache {runs / 'cache'}", "")) for line in found]


def expected(stage: str, runs: Path) -> list[str]:
    """Commands of a stage; pictures begin from captions alone, and touch from what it learns without pictures."""
    whole = command_of(stage, runs)
    if stage == "image_text":
        captions, output = runs / "captions", whole.split(" --output ")[1]
        first = f"python -m unitouch_gen.training.image_text --output {captions}"
        begun = f"python -m unitouch_gen.training.image_text --recipe image_text_lamps --init {captions / 'model'}"
        return [first, f"{begun} --output {output}"]
    if stage != "touch":
        return [whole]
    start, output = whole.split(" --output ")
    pairs = f"{start} --recipe touch_pairs --output {runs / 'touch_pairs'}"
    return [pairs, f"{start} --init {runs / 'touch_pairs' / 'model'} --output {output}"]


def test_stages_run_in_order_and_are_put_together(tmp_path: Path) -> None:
    family = tmp_path / "family"
    last = f"python -m unitouch_gen.training.assemble --runs {tmp_path} --output {family}"
    assert commands(tmp_path) == [*(line for stage in STAGES for line in expected(stage, tmp_path)), last]
