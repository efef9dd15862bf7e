"""The README quotes the figures that stand beside the weights, and names only files and commands that exist."""

import json
import re
from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.benchmarks.__main__ import README_PARTS
from unitouch_gen import weights

README = Path(__file__).resolve().parents[1] / "README.md"
pytestmark = pytest.mark.skipif(not README.exists(), reason="there is no checkout here")


def test_figures_are_those_beside_the_weights():
    figures = json.loads(weights.FIGURES.read_text())["figures"]
    text = README.read_text()
    for mark, content in README_PARTS.items():
        assert f"<!-- {mark} -->\n{content(figures)}\n<!-- {mark} -->" in text


def test_linked_files_exist():
    links = re.findall(r"\]\((?!http)([^)#]+)\)", README.read_text())
    missing = [link for link in links if not (README.parent / link).exists()]
    assert not missing


def test_modules_in_commands_exist():
    modules = set(re.findall(r"python -m ((?:unitouch_gen|tests)[\w.]*)", README.read_text()))
    assert modules
    for module in modules:
        assert find_spec(module), module
