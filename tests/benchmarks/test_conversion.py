"""The benchmark of the conversion, on encoders of a few kilobytes."""

import pytest

from tests.benchmarks.conversion import WAYS, conversion_figures, write_published
from tests.helpers.published_files import small
from unitouch_gen.convert.unitouch import FILES
from unitouch_gen.memory import resident
from unitouch_gen.models import UniTouchModel


def test_the_files_are_laid_out_as_published(tmp_path):
    for name, modalities in FILES.items():
        write_published(tmp_path / name, modalities, small())
    model = UniTouchModel.from_published(**{name: tmp_path / name for name in FILES}, config=small())
    assert model.loaded_modalities == ("image", "text", "audio", "touch")


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
