"""The benchmark of the conversion, on encoders of a few kilobytes."""

import runpy
from pathlib import Path

import pytest

from unitouch_gen.bench.conversion import WAYS, conversion_figures, write_published
from unitouch_gen.diffusion.memory import resident
from unitouch_gen.encoders import UniTouchModel
from unitouch_gen.encoders.published import FILES

small = runpy.run_path(str(Path(__file__).parents[1] / "encoders" / "published_files.py"))["small"]


def test_the_files_are_laid_out_as_published(tmp_path):
    for name, senses in FILES.items():
        write_published(tmp_path / name, senses, small())
    model = UniTouchModel.from_published(**{name: tmp_path / name for name in FILES}, config=small())
    assert model.loaded_senses == ("image", "text", "audio", "touch")


@pytest.mark.slow
@pytest.mark.skipif(resident("VmHWM") is None, reason="the system does not say")
def test_a_conversion_is_measured_in_a_process_of_its_own(tmp_path):
    figures = conversion_figures(tmp_path, small())
    for way in WAYS:
        assert figures[way]["seconds"] > 0 and figures[way]["megabytes"] >= 0
    assert sum(figures["parameters"].values()) * 4 / 1e6 == pytest.approx(
        sum(figures["megabytes_of_files"].values()), rel=0.2
    )
    assert list(tmp_path.iterdir()) == []
