"""What the long tests look at, saved pipelines of random weights and files to make pictures of, and their counts."""

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile
from PIL import Image

from tests.helpers import components
from tests.helpers.attempts import Attempts, bounds
from tests.helpers.damage import ANY
from tests.helpers.odd_values import SOUND
from tests.helpers.small_family import write_small_family
from unitouch_gen.pipelines import TactileStylizationPipeline, TouchToImagePipeline, XToTouchPipeline

TOUCHES = 8
FEW = {"default_num_inference_steps": 2, "default_guidance_scale": 2.0}


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
    TouchToImagePipeline(**components.make_components(), **FEW).save_pretrained(folder / "model")
    (folder / "touches").mkdir()
    for number in range(TOUCHES):
        pixels = np.random.default_rng(number).integers(0, 100, (32, 32, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(folder / "touches" / f"{number}.png")
    return folder


@pytest.fixture
def pictures(given: Path) -> list[str]:
    """The command that makes a picture of each touch; an output and more options are to be added."""
    touches = sorted(map(str, (given / "touches").iterdir()))
    return ["touch-to-image", *touches, "--model", str(given / "model"), "--batch-size", "1", "--overwrite"]


# Inputs that cannot be used -------------------------------------------------------------------------------------------


@pytest.fixture
def attempt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, record_property: Callable[[str, object], None]
) -> Iterator[Attempts]:
    """Tries inputs in an empty folder; the test fails by what went wrong with some when all were tried."""
    here, temporary = tmp_path / "here", tmp_path / "temporary"
    here.mkdir(), temporary.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)  # a word may be the id of a repository
    monkeypatch.chdir(here)
    attempts = Attempts(here, temporary)
    with bounds():
        yield attempts
    for outcome, count in attempts.counts.items():
        record_property(outcome, count)
    if attempts.wrong:
        pytest.fail("\n".join([f"{len(attempts.wrong)} of them:", *attempts.wrong]), pytrace=False)


@pytest.fixture(scope="session")
def pipes() -> dict[str, Any]:
    """Pipelines by the names of their commands, of random weights."""
    parts, own = components.make_components(), components.make_x_to_touch()
    shared = {name: parts[name] for name in ("unitouch", "processor", "scheduler")}
    made = {
        "touch-to-image": TouchToImagePipeline(**parts, **FEW),
        "stylize": TactileStylizationPipeline(**parts, **FEW),
        "x-to-touch": XToTouchPipeline(**shared, **own, **FEW, sensors=["gelsight", "digit"]),
    }
    for pipe in made.values():
        pipe.set_progress_bar_config(disable=True)
    return made


@pytest.fixture(scope="session")
def saved(tmp_path_factory: pytest.TempPathFactory, pipes: dict[str, Any]) -> dict[str, Path]:
    """Their folders, that of a joint space with its processor, `joint`, and a `family`."""
    folder = tmp_path_factory.mktemp("saved")
    for name, pipe in pipes.items():
        pipe.save_pretrained(folder / name)
    pipe.unitouch.save_pretrained(folder / "joint", max_shard_size="30KB")
    pipe.processor.save_pretrained(folder / "joint")
    write_small_family(folder / "family")
    return {path.name: path for path in folder.iterdir()}


@pytest.fixture(scope="session")
def files(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Pictures and sounds, first those that are whole, `whole.png` and the like, and then each damaged in every way."""
    folder = tmp_path_factory.mktemp("files")
    pixels = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    for suffix in ("png", "jpg", "gif", "tiff", "webp", "bmp"):
        Image.fromarray(pixels).save(folder / f"whole.{suffix}")
    for suffix in ("wav", "flac", "ogg", "mp3"):
        soundfile.write(folder / f"whole.{suffix}", *SOUND)
    whole = sorted(folder.iterdir())
    for file in whole:
        for name, damage in ANY.items():
            damaged = folder / f"{name}{file.suffix}"
            shutil.copy(file, damaged)
            damage(damaged)
    shutil.copy(folder / "whole.wav", folder / "a sound.png")
    shutil.copy(folder / "whole.png", folder / "a picture.wav")
    shutil.copy(folder / "whole.png", os.path.join(os.fsencode(folder), b"\xff\xfe.png"))
    (folder / "dangling.png").symlink_to(folder / "nothing.png")
    return [*whole, *sorted({*folder.iterdir()} - {*whole})]
