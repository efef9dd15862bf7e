"""Processes that are killed at random moments or just before a change to files, and disks that are full: what is there
is whole.
"""

import random
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.helpers import components
from tests.helpers.processes import Child, command, finished, save_numbered
from unitouch_gen.pipelines import TouchToImagePipeline


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a pipeline `model`, and touches in a folder `touches`."""
    folder = tmp_path_factory.mktemp("given") / "here"
    TouchToImagePipeline(**components.make_components(), default_num_inference_steps=2).save_pretrained(
        folder / "model"
    )
    (folder / "touches").mkdir()
    for number in range(4):
        pixels = np.random.default_rng(number).integers(0, 100, (32, 32, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(folder / "touches" / f"{number}.png")
    return folder


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


@pytest.mark.parametrize("longest", [0, 300, 60_000])
def test_a_full_disk_leaves_what_was_there(given: Path, tmp_path: Path, longest: int) -> None:
    """Or as good as one: no file may be longer."""
    finished(Child(save_numbered, "there", 1, folder=tmp_path))
    before = seen(tmp_path / "there")
    child = Child(save_numbered, "there", 2, folder=tmp_path, longest=longest)
    assert child.wait() == 1 and "`save_directory` cannot be written to" in child.err.splitlines()[-1]
    words = ["touch-to-image", "touches", "--model", "model", "-o", str(tmp_path / "out")]
    child = Child(command, *words, folder=given, longest=min(longest, 300))
    assert child.wait() == 2 and "cannot be written to" in child.err and child.err.count("\n") == 1
    assert seen(tmp_path / "there") == before and not list((tmp_path / "out").glob("*"))
