"""How fast touches come in: that the frames are like real ones, and that all of it is timed."""

from pathlib import Path

import pytest
from PIL import Image

from tests.benchmarks.training import CAMERA, training_figures, write_frames


def test_frames_are_as_large_as_those_of_real_sensors(tmp_path: Path) -> None:
    write_frames(tmp_path / "frames", 3)
    files = sorted((tmp_path / "frames").iterdir())
    assert [Image.open(file).size for file in files] == [CAMERA] * 3
    assert all(35_000 < file.stat().st_size < 75_000 for file in files)  # recordings at that size have 39,000 to 56,000


@pytest.mark.slow
def test_touches_come_in_faster_than_they_are_learned_from() -> None:
    figures = training_figures(repeats=1)
    assert figures["from_disk"]["ratio"] > 3.0 and figures["decoded"]["ratio"] > 1.0
