"""The README and the pages of docs/ name files and commands that exist, and their snippets run."""

import re
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from pkgutil import iter_modules

import pytest

from tests.helpers.processes import Child, finished, script
from unitouch_gen.solvers import SOLVERS
from unitouch_gen.training import data

CHECKOUT = Path(__file__).resolve().parents[1]
README = CHECKOUT / "README.md"
CONTRIBUTING = CHECKOUT / "CONTRIBUTING.md"
PAGES = [README, *sorted((CHECKOUT / "docs").glob("*.md"))]
pytestmark = pytest.mark.skipif(not README.exists(), reason="there is no checkout here")


def test_linked_files_and_headings_exist():
    for page in (*PAGES, CONTRIBUTING):
        for link in re.findall(r"\]\((?!http)([^)]+)\)", page.read_text()):
            name, _, anchor = link.partition("#")
            target = page.parent / name if name else page
            assert target.exists(), link
            if anchor:
                headings = re.findall(r"^#+ (.*)$", target.read_text().lower(), re.M)
                slugs = {re.sub(r"[^\w\- ]", "", one.strip()).replace(" ", "-") for one in headings}
                assert anchor in slugs, link  # as GitHub and MyST make them


def test_modules_in_commands_exist():
    text = "".join(page.read_text() for page in (*PAGES, CONTRIBUTING))
    modules = set(re.findall(r"python -m ((?:unitouch_gen|tests)[\w.]*)", text))
    assert modules
    for module in modules:
        assert find_spec(module), module


def test_each_solver_has_a_row_and_is_in_the_reference():
    table, reference = ((CHECKOUT / "docs" / name).read_text() for name in ("error_and_time.md", "reference.md"))
    for name, solver in SOLVERS.items():
        assert f"\n| `{name}` | {solver.order} |" in table, name
        assert solver.sample.__name__ in reference, name


def test_each_layout_of_data_sets_has_a_row():
    rows = re.findall(r"^\| `(\w+)` \|", (CHECKOUT / "docs" / "training.md").read_text(), re.M)
    names = [module.name for module in iter_modules(data.__path__)]
    layouts = {name for name in names if hasattr(import_module(f"{data.__name__}.{name}"), "LOOKS_LIKE")}
    assert layouts
    assert layouts <= set(rows)


def test_figures_of_the_readme_are_quoted_from_the_pages():
    """There they stand between two comments, and are held to those beside the weights."""
    table = README.read_text().partition("## What is good and what is not")[2].partition("## ")[0]
    figures = re.findall(r"\d+\.\d+ %|\d+\.\d+ times", table)
    assert figures
    text = "".join(page.read_text() for page in PAGES[1:])
    measured = "".join(part[0] for part in re.finditer(r"<!-- (.*?) -->.*?<!-- \1 -->", text, re.S))
    assert not [figure for figure in figures if figure not in measured]


@pytest.mark.slow
@pytest.mark.parametrize(
    "page",
    [pytest.param(page, id=page.stem, marks=pytest.mark.wheel if page == README else ()) for page in PAGES],
)
def test_snippets_run(page, tmp_path):
    """Those in Python, one after the other, but for those that need weights which are not here."""
    blocks = re.findall(r"^```python\n(.*?)^```", page.read_text(), re.M | re.S)
    blocks = [block for block in blocks if not re.search(r"path/to|from_published|from_pipe\(", block)]
    if not blocks:
        pytest.skip("there are none")
    (tmp_path / "samples").symlink_to(CHECKOUT / "samples")
    finished(Child(script, "\n".join(blocks), folder=tmp_path))
