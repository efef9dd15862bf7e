"""What tests of the command line share: commands that run in this process, and saved pipelines of random weights."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.helpers import components
from unitouch_gen.cli import main

Result = tuple[int, str, str]
"""Exit code, standard output, standard error."""


@pytest.fixture(scope="session")
def pipes() -> dict[str, Any]:
    """Pipelines by command."""
    return components.make_pipelines()


@pytest.fixture(scope="session")
def models(tmp_path_factory, pipes) -> dict[str, str]:
    """Their folders."""
    folder = tmp_path_factory.mktemp("models")
    for name, pipe in pipes.items():
        pipe.save_pretrained(folder / name)
    return {name: str(folder / name) for name in pipes}


@pytest.fixture
def here(tmp_path, monkeypatch) -> Path:
    """An empty folder to be in, with the touches dark.png and bright.png in a folder `in`."""
    (tmp_path / "in").mkdir()
    for name, level in (("dark", 50), ("bright", 200)):
        noise = np.random.default_rng(level).integers(level - 20, level + 20, (32, 32, 3), dtype=np.uint8)
        Image.fromarray(noise).save(tmp_path / "in" / f"{name}.png")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def command(monkeypatch, capsys) -> Callable[..., Result]:
    """Runs `unitouch-gen ...` in this process."""

    def call(*args: object) -> Result:
        monkeypatch.setattr(sys, "argv", ["unitouch-gen", *map(str, args)])
        with pytest.raises(SystemExit) as ended:
            main()
        return ended.value.code or 0, *capsys.readouterr()

    return call


@pytest.fixture
def files() -> Callable[[Path], list[str]]:
    """Lists the files in a folder and those below."""
    return lambda folder: sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


@pytest.fixture
def refused() -> Callable[..., None]:
    """Holds a result to exit code 2 and one line on standard error that has these words."""

    def check(result: Result, *words: str) -> None:
        code, out, err = result
        assert (code, out) == (2, ""), err
        assert err.startswith("unitouch-gen: ")
        assert err.count("\n") == 1
        assert not [word for word in words if word not in err], err

    return check
