"""The pages quote the figures that stand beside the weights, between marks that stand where they should."""

import json
from pathlib import Path

import pytest

from tests.benchmarks.tables import MARKS, cost_table, pages, table, write_pages
from unitouch_gen import weights

FIGURES = json.loads(weights.FIGURES.read_text())["figures"]


@pytest.mark.skipif(not pages()[0].exists(), reason="there is no checkout here")
@pytest.mark.parametrize("mark", MARKS)
def test_the_pages_quote_the_figures_beside_the_weights(mark):
    text = "\n".join(page.read_text() for page in pages())
    assert text.count(f"<!-- {mark} -->") == 2
    assert f"<!-- {mark} -->\n{MARKS[mark](FIGURES)}\n<!-- {mark} -->" in text


@pytest.fixture
def root(tmp_path) -> Path:
    """All marks but one in README.md, and that one on a page of docs/."""
    first, *others = MARKS
    (tmp_path / "docs/more").mkdir(parents=True)
    (tmp_path / "docs/more/page.md").write_text(f"a\n<!-- {first} -->\nold\n<!-- {first} -->\nb\n")
    (tmp_path / "README.md").write_text("".join(f"<!-- {mark} --><!-- {mark} -->" for mark in others))
    return tmp_path


def test_what_stands_between_marks_is_replaced_wherever_they_are(root):
    first = next(iter(MARKS))
    for _ in range(2):
        write_pages(FIGURES, root)
        expected = f"a\n<!-- {first} -->\n{MARKS[first](FIGURES)}\n<!-- {first} -->\nb\n"
        assert (root / "docs/more/page.md").read_text() == expected


@pytest.mark.parametrize(
    ("more", "where"),
    [
        ("", "no page"),
        ("<!-- summary -->", "docs/more/page.md"),
        ("<!-- summary -->" * 4, "docs/more/page.md"),
    ],
)
def test_marks_that_are_nowhere_or_too_often_are_named_before_anything_is_written(root, more, where):
    (root / "docs/more/page.md").write_text(more)
    before = (root / "README.md").read_text()
    with pytest.raises(ValueError, match="<!-- summary -->") as caught:
        write_pages(FIGURES, root)
    assert where in str(caught.value) and (root / "README.md").read_text() == before


def test_marks_on_two_pages_are_named(root):
    (root / "docs/copy.md").write_text((root / "docs/more/page.md").read_text())
    with pytest.raises(ValueError, match=r"docs/copy\.md, .*docs/more/page\.md"):
        write_pages(FIGURES, root)


def test_a_table_is_markdown():
    assert table(["a", "b"], [("1", "2")], "Note.") == "| a | b |\n|---|---|\n| 1 | 2 |\n\nNote."


def test_costs_stand_by_error_with_what_no_run_reached_left_open():
    run, at = {"solver": "unipc", "steps": 8}, {"guidance_scale": 3.0, "conditions": 8}
    measured = {"touch-to-image": {**at, "cost_at_error": {"0.1": run}},
                "x-to-touch": {**at, "cost_at_error": {"0.1": run, "0.05": {**run, "steps": 12}}}}  # fmt: skip
    text = cost_table({"error_and_time": {"cost": measured}})
    assert "picture from a touch, guidance 3" in text
    assert "| at most 10.0 % | `unipc`, 8 steps | `unipc`, 8 steps |" in text
    assert "| at most 5.0 % | - | `unipc`, 12 steps |" in text
