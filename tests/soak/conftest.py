"""What the long tests look at, a saved pipeline of random weights and touches to make pictures of, and their counts."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.helpers import components
from unitouch_gen.pipelines import TouchToImagePipeline

TOUCHES = 8


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Prints what each test has counted, by `record_property`."""
    for report in (*terminalreporter.getreports("passed"), *terminalreporter.getreports("")):
        if report.user_properties and report.when != "setup":
            counts = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in report.user_properties)
            terminalreporter.write_line(f"{report.nodeid.rpartition('::')[2]}: {counts}")


@pytest.fixture(scope="session")
def given(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a pipeline `model`, and touches in a folder `touches`."""
    folder = tmp_path_factory.mktemp("given")
    settings = {"default_num_inference_steps": 2, "default_guidance_scale": 2.0}
    TouchToImagePipeline(**components.make_components(), **settings).save_pretrained(folder / "model")
    (folder / "touches").mkdir()
    for number in range(TOUCHES):
        pixels = np.random.default_rng(number).integers(0, 100, (32, 32, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(folder / "touches" / f"{number}.png")
    return folder


@pytest.fixture
def pictures(given: Path) -> list[str]:
    """The command that makes a picture of each touch; an output and more options are to be added."""
    touches = sorted(map(str, (given / "touches").iterdir()))
    return ["touch-to-image", *touches, "--model", str(given / "model"), "--batch-size", "1"]
