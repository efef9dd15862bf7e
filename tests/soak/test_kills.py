"""Saves that are killed at random moments or just before a change to files, and disks that are full: what is there is
whole.
"""

import random
import time
from pathlib import Path

import pytest

from tests.helpers.processes import Child, finished, save_numbered
from unitouch_gen.pipelines import TouchToImagePipeline


def seen(folder: Path) -> dict[str, bytes]:
    """Files that are not hidden."""
    files = {str(file.relative_to(folder)): file for file in folder.rglob("*") if file.is_file()}
    return {name: file.read_bytes() for name, file in files.items() if not name.startswith(".")}


@pytest.mark.slow
@pytest.mark.parametrize("kills", [20])
def test_a_pipeline_is_the_old_or_the_new_one_after_kills(tmp_path: Path, kills: int) -> None:
    def start(folder: Path, number: int, killed_at: int | None = None) -> Child:
        return Child(save_numbered, str(folder), number, folder=tmp_path, killed_at=killed_at)

    begun, whole = time.monotonic(), {}
    for number in (1, 2):
        alone = tmp_path / str(number) / "there"  # the card that is saved names the folder
        child = finished(start(alone, number))
        whole[number] = seen(alone)
    seconds, drawn, folder = (time.monotonic() - begun) / 2, random.Random(3), tmp_path / "there"
    finished(start(folder, 1))
    for count in range(kills):
        killed = start(folder, 1 + count % 2, drawn.choice([None, drawn.randint(1, child.changes)]))
        if drawn.random() < 0.5:
            time.sleep(drawn.uniform(0.0, seconds))
            killed.kill()
        assert killed.wait() in (-9, 0), killed.err
        pipe = TouchToImagePipeline.from_pretrained(folder)
        assert seen(folder) == whole[pipe.config["default_num_inference_steps"]]


def test_a_full_disk_leaves_what_was_there(tmp_path: Path) -> None:
    """Or as good as one: no file may be longer than a setting, or than a part of the weights."""
    finished(Child(save_numbered, "there", 1, folder=tmp_path))
    before = seen(tmp_path / "there")
    for longest in (0, 60_000):
        child = Child(save_numbered, "there", 2, folder=tmp_path, longest=longest)
        assert child.wait() == 1 and "`save_directory` cannot be written to" in child.err.splitlines()[-1]
        assert seen(tmp_path / "there") == before
