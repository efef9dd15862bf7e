"""The README and the pages of docs/ name files and commands that exist, and their snippets run."""

import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parents[1]
README, CONTRIBUTING = CHECKOUT / "README.md", CHECKOUT / "CONTRIBUTING.md"
PAGES = [README, *sorted((CHECKOUT / "docs").glob("*.md"))]
pytestmark = pytest.mark.skipif(not README.exists(), reason="there is no checkout here")

every_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)


def slug(heading: str) -> str:
    """The anchor that GitHub and MyST make of a heading."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


@pytest.mark.parametrize("page", [*PAGES, CONTRIBUTING], ids=lambda page: page.stem)
def test_linked_files_and_headings_exist(page):
    if not page.exists():
        pytest.skip("there is no checkout here")
    for link in re.findall(r"\]\((?!http)([^)]+)\)", page.read_text()):
        name, _, anchor = link.partition("#")
        target = page.parent / name if name else page
        assert target.exists(), link
        if anchor:
            assert anchor in {slug(heading) for heading in re.findall(r"^#+ (.*)$", target.read_text(), re.M)}, link


def test_modules_in_commands_exist():
    text = "".join(page.read_text() for page in (*PAGES, CONTRIBUTING) if page.exists())
    modules = set(re.findall(r"python -m ((?:unitouch_gen|tests)[\w.]*)", text))
    assert modules
    for module in modules:
        assert find_spec(module), module


def test_each_layout_of_data_sets_has_a_row():
    rows = re.findall(r"^\| `(\w+)` \|", (CHECKOUT / "docs" / "training.md").read_text(), re.M)
    modules = (CHECKOUT / "training" / "data").glob("*.py")
    layouts = {file.stem for file in modules if re.search("^LOOKS_LIKE", file.read_text(), re.M)}
    assert layouts and layouts <= set(rows)


def test_figures_of_the_readme_are_quoted_from_the_pages():
    """There they stand between two comments, and are held to those beside the weights."""
    table = README.read_text().partition("## What is good and what is not")[2].partition("## ")[0]
    figures = re.findall(r"\d+\.\d+ %|\d+\.\d+ times", table)
    assert figures
    text = "".join(page.read_text() for page in PAGES[1:])
    measured = "".join(part[0] for part in re.finditer(r"<!-- (.*?) -->.*?<!-- \1 -->", text, re.S))
    assert not [figure for figure in figures if figure not in measured]


@pytest.mark.wheel
@pytest.mark.slow
@every_page
def test_snippets_run(page, tmp_path):
    """Those in Python, one after the other, but for those that need weights which are not here."""
    blocks = re.findall(r"^```python\n(.*?)^```", page.read_text(), re.M | re.S)
    blocks = [block for block in blocks if not re.search(r"path/to|from_published|from_pipe\(", block)]
    if not blocks:
        pytest.skip("there are none")
    (tmp_path / "samples").symlink_to(CHECKOUT / "samples")
    command = [sys.executable, "-c", "\n".join(blocks)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr
