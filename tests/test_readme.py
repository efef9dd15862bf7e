"""The README quotes the figures that stand beside the weights, and names only files and commands that exist."""

import json
import re
from pathlib import Path

import pytest

from unitouch_gen import weights
from unitouch_gen.bench.tables import markdown, x_to_touch_table

README = Path(__file__).resolve().parents[1] / "README.md"
pytestmark = pytest.mark.skipif(not README.exists(), reason="there is no checkout here")


def test_figures_are_those_beside_the_weights():
    figures = json.loads(weights.FIGURES.read_text())["figures"]
    assert markdown(figures) in README.read_text()
    assert x_to_touch_table(figures) in README.read_text()


def test_linked_files_exist():
    links = re.findall(r"\]\((?!http)([^)#]+)\)", README.read_text())
    missing = [link for link in links if not (README.parent / link).exists()]
    assert not missing


def test_modules_in_commands_exist():
    modules = set(re.findall(r"python -m (unitouch_gen[\w.]*)", README.read_text()))
    assert modules
    for module in modules:
        folder, name = module.rsplit(".", 1)
        assert (README.parent / folder.removeprefix("unitouch_gen.").replace(".", "/") / f"{name}.py").exists() or (
            README.parent / "unitouch_gen" / f"{name}.py"
        ).exists()
