"""Disks that are full, or get full: what was there stays whole, one line says so, and nothing else is left.

A disk of a few megabytes is mounted where that is possible, as for root; elsewhere processes may write no long file.
"""

import json
import os
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from PIL import Image

from tests.helpers.processes import Child, command, finished, save_numbered, short_stage, stage
from tests.helpers.published_files import published, small
from tests.soak.conftest import TOUCHES
from unitouch_gen.pipelines import TouchToImagePipeline
from unitouch_gen.training.trainer import checkpoints_in

pytestmark = pytest.mark.slow

STAGE = short_stage(20)
POINTS = ("work-precision", "--problem", "gaussian", "--solvers", "ddim,unipc", "--steps", "5,10,20", "--json")


class Disk:
    """A disk of 10 MB in a folder, with whatever fills it; without one, the length of the longest file there may be."""

    def __init__(self, folder: Path):
        self.folder, self.filler, self.longest, self.filled = folder, folder / "filler", None, 0
        folder.mkdir()
        mount = ["mount", "-t", "tmpfs", "-o", "size=10m", "none", folder]
        self.mounted = subprocess.run(mount, capture_output=True, check=False).returncode == 0

    def fill(self, left: int = 0) -> None:
        """Leaves a number of bytes."""
        self.empty()
        self.filled += 1
        if self.mounted:
            found = os.statvfs(self.folder)
            self.filler.write_bytes(bytes(max(found.f_bavail * found.f_bsize - left, 0)))
        else:
            self.longest = left

    def empty(self) -> None:
        self.filler.unlink(missing_ok=True)
        self.longest = None

    def found(self) -> dict[str, bytes | None]:
        """All else that is there: files with their contents, and folders."""
        paths = {str(path.relative_to(self.folder)): path for path in self.folder.rglob("*") if path != self.filler}
        return {name: path.read_bytes() if path.is_file() else None for name, path in paths.items()}

    def full(self, function: Callable[..., None], *arguments: str, left: int = 0) -> Child:
        """A process that has to end with one line, as the disk is full, and to leave what is there."""
        self.fill(left)
        before = self.found()
        child = Child(function, *arguments, folder=self.folder.parent, longest=self.longest)
        refused(child)
        assert self.found() == before
        self.empty()
        return child


@pytest.fixture
def disk(tmp_path: Path, record_property: Callable[[str, object], None]) -> Iterator[Disk]:
    (tmp_path / "here").mkdir()
    disk = Disk(tmp_path / "here" / "disk")
    yield disk
    if disk.mounted:
        subprocess.run(["umount", disk.folder], check=True)
    record_property("full disks", disk.filled)


@pytest.fixture
def mounted(disk: Disk) -> Disk:
    if not disk.mounted:
        pytest.skip("only root mounts a disk")
    return disk


def refused(child: Child) -> None:
    code, last = child.wait(), child.err.splitlines()[-1:]
    assert code == 2 and len(last) == 1, child.err
    assert "cannot be written to" in last[0] and "Traceback" not in child.err
    assert any(why in last[0] for why in ("No space left", "File too large", "MB are needed", "torch could not"))


def under_way(child: Child, there: Callable[[], bool]) -> None:
    """Waits until something is there."""
    while not there():
        assert child.process.is_alive(), child.err
        time.sleep(0.001)


# Full from the beginning ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("output", ["out", "out/picture.png"])
def test_pictures_are_refused_before_a_model_is_looked_for(disk: Disk, given: Path, output: str) -> None:
    touch = str(given / "touches" / "0.png")
    child = disk.full(command, "touch-to-image", touch, "-o", f"disk/{output}", "--model", "gone")
    assert child.out == "" and child.err.count("\n") == 1
    child = disk.full(command, "x-to-touch", "--touch", touch, "-o", f"disk/{output}", "--model", "gone")
    assert child.out == "" and child.err.count("\n") == 1


def test_training_is_refused_before_anything_is_rendered(disk: Disk, tmp_path: Path) -> None:
    disk.full(stage, *STAGE, "--output", "disk/run", "--cache", "cache")
    disk.full(stage, *STAGE, "--output", "run", "--cache", "disk/cache")
    assert {path.name for path in (tmp_path / "here").iterdir()} == {"disk"}


def test_a_checkpoint_that_has_no_room_is_refused_before_the_first_step(mounted: Disk, tmp_path: Path) -> None:
    """Two of 1.7 MB have to be there for a moment."""
    finished(Child(stage, *STAGE, "--output", "run", folder=tmp_path / "here"))  # renders
    mounted.full(stage, *STAGE, "--output", "disk/run", left=3_000_000)


def test_a_cache_that_has_no_room_is_refused_before_it_is_rendered(mounted: Disk) -> None:
    """It takes 5.7 MB; written to as it is mapped into memory, it would end the process by a signal."""
    child = mounted.full(stage, *STAGE, "--output", "run", "--cache", "disk/cache", left=4_000_000)
    assert "`cache`" in child.err and "it/s" not in child.err


def test_measuring_is_refused_before_anything_is_measured(disk: Disk, given: Path) -> None:
    child = disk.full(command, *POINTS, "-o", "disk/out")
    assert child.out == "" and child.err.count("\n") == 1


def test_converting_leaves_nothing(disk: Disk, tmp_path: Path) -> None:
    published(tmp_path / "here", small())
    small().save_pretrained(tmp_path / "here")
    words = ("convert", "unitouch", "--imagebind", "imagebind_huge.pth", "--config", "config.json", "-o", "disk/model")
    for left in (0, 10_000, 200_000):
        disk.full(command, *words, left=left)
    finished(Child(command, *words, folder=tmp_path / "here"))


# Full in between ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("left", [0, 4_096, 50_000, 250_000, 500_000])
def test_a_pipeline_that_cannot_be_saved_leaves_the_old_one(disk: Disk, tmp_path: Path, left: int) -> None:
    finished(Child(save_numbered, "disk/model", 1, folder=tmp_path / "here"))
    disk.fill(left)
    before = disk.found()
    child = Child(save_numbered, "disk/model", 2, folder=tmp_path / "here", longest=disk.longest)
    assert child.wait() == 1
    assert child.err.splitlines()[-1].startswith(
        "unitouch_gen.errors.InvalidInputError: `save_directory` cannot be written to"
    )
    assert disk.found() == before
    disk.empty()
    assert TouchToImagePipeline.from_pretrained(disk.folder / "model").config["default_num_inference_steps"] == 1
    finished(Child(save_numbered, "disk/model", 2, folder=tmp_path / "here"))
    assert TouchToImagePipeline.from_pretrained(disk.folder / "model").config["default_num_inference_steps"] == 2


def test_a_pipeline_with_a_part_on_another_disk_is_not_replaced(mounted: Disk, tmp_path: Path) -> None:
    """Which could not be done at one moment."""
    folder = tmp_path / "here" / "model"
    finished(Child(save_numbered, str(folder), 1, folder=tmp_path / "here"))
    (folder / "unet").rename(folder / "before")
    (folder / "unet").symlink_to(mounted.folder, target_is_directory=True)
    before = {file: file.read_bytes() for file in folder.rglob("*") if file.is_file()}
    child = Child(save_numbered, str(folder), 2, folder=tmp_path / "here")
    assert child.wait() == 1 and "unet is on another disk. Nothing was changed" in child.err.splitlines()[-1]
    assert {file: file.read_bytes() for file in folder.rglob("*") if file.is_file()} == before


def test_pictures_that_are_made_stay_where_a_disk_gets_full(
    mounted: Disk, given: Path, pictures: list[str], tmp_path: Path
) -> None:
    child = Child(command, *pictures, "--steps", "50", "-o", "disk/out", folder=tmp_path / "here")
    under_way(child, lambda: (mounted.folder / "out" / "0.png").exists())
    with child.stopped():
        mounted.fill()
    refused(child)
    made = [name for name, content in mounted.found().items() if content is not None]
    assert 0 < len(made) < TOUCHES
    for name in made:
        Image.open(mounted.folder / name).load()
    mounted.empty()
    finished(Child(command, *pictures, "--steps", "50", "-o", "disk/out", folder=tmp_path / "here"))
    assert len(mounted.found()) == 1 + TOUCHES


def test_training_goes_on_to_the_same_bits_where_a_disk_got_full(mounted: Disk, tmp_path: Path) -> None:
    here, run = tmp_path / "here", mounted.folder / "run"
    finished(Child(stage, *STAGE, "--output", "whole", folder=here))
    child = Child(stage, *STAGE, "--output", "disk/run", folder=here)
    under_way(child, lambda: bool(checkpoints_in(run)))
    with child.stopped():
        mounted.fill()
    refused(child)
    assert {path.name for path in run.iterdir()} <= {"checkpoints", "log", "log.jsonl"} and len(
        checkpoints_in(run)
    ) == 1
    mounted.empty()
    finished(Child(stage, *STAGE, "--output", "disk/run", "--resume", folder=here))
    weights = [(folder / "model" / "model.safetensors").read_bytes() for folder in (run, here / "whole")]
    assert weights[0] == weights[1]


def test_measuring_goes_on_where_a_disk_got_full(mounted: Disk, tmp_path: Path) -> None:
    results = mounted.folder / "out" / "results.json"
    child = Child(command, *POINTS, "-o", "disk/out", folder=tmp_path / "here")
    under_way(child, results.exists)
    with child.stopped():
        mounted.fill()
    refused(child)
    measured = json.loads(results.read_text())["rows"]
    mounted.empty()
    finished(Child(command, *POINTS, "-o", "disk/out", folder=tmp_path / "here"))
    assert json.loads(results.read_text())["rows"][: len(measured)] == measured
