"""Figures at the published size, on random weights: the conversion, the touch encoder, and touch to image."""

from pathlib import Path

from tests.benchmarks import Figures
from tests.benchmarks.conversion import conversion_figures
from tests.benchmarks.full_size import DTYPES, full_size_figures
from tests.benchmarks.throughput import throughput_figures


def published_figures(scratch: Path) -> Figures:
    """All of them; it takes a quarter of an hour.

    Args:
        scratch: Folder for files of 11 GB, on a disk and not in memory.
    """
    return {
        "conversion": conversion_figures(scratch),
        "touch_encoder": throughput_figures(),
        "touch_to_image": {dtype: full_size_figures(dtype=dtype, scratch=scratch) for dtype in DTYPES},
    }
