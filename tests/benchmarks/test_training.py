"""How fast touches come in: that the frames are like real ones, and that all of it is timed."""

from pathlib import Path

import pytest
from PIL import Image

from tests.benchmarks.measuring import in_own_process
from tests.benchmarks.training import CAMERA, growth_figures, input_figures, trainer_figures, write_frames


def test_frames_are_as_large_as_those_of_real_sensors(tmp_path: Path) -> None:
    write_frames(tmp_path / "frames", 3)
    files = sorted((tmp_path / "frames").iterdir())
    assert [Image.open(file).size for file in files] == [CAMERA] * 3
    assert all(35_000 < file.stat().st_size < 75_000 for file in files)  # recordings at that size have 39,000 to 56,000


@pytest.mark.slow
def test_touches_come_in_faster_than_they_are_learned_from() -> None:
    figures = in_own_process(input_figures, 1)
    assert figures["from_disk"]["ratio"] > 3.0 and figures["decoded"]["ratio"] > 1.0


@pytest.mark.slow
def test_the_trainer_and_the_bare_loop_are_both_timed() -> None:
    figures = in_own_process(trainer_figures, 1)
    assert 0.5 < figures["times_as_long"]["ratio"] < 2.0  # of one pair of turns, on a busy machine


@pytest.mark.slow
def test_memory_is_read_at_two_steps() -> None:
    figures = in_own_process(growth_figures, 30, 2, 10, 20)
    assert figures["megabytes"] > 50 and abs(figures["growth"]) < 0.5
