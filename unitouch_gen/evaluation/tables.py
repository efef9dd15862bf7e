"""A table of figures, each beside its controls, as JSON, Markdown, a page and a chart."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from html import escape
from pathlib import Path
from statistics import mean
from textwrap import wrap
from typing import Any, Self

from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.files import read_json, replacing, write_file

Values = Mapping[str, Sequence[float]]
"""Figures by column, one for each seed."""


@dataclass(frozen=True)
class Table:
    """Figures by row and column.

    Attributes:
        name: Of the command that makes it.
        title: What it shows.
        metric: What its figures are, and in which unit.
        columns: Their names, and what each belongs to, such as "in domain"; empty for nothing.
        rows: By method; a column may be missing.
        notes: What a reader has to know.
        paper: The paper's figures, by row and column of its own.
        facts: What was measured: model, data, seeds, seconds.
        apart: Whether each column has a unit of its own, and so a panel in the chart.
    """

    name: str
    title: str
    metric: str
    columns: Mapping[str, str]
    rows: Mapping[str, Values]
    notes: Sequence[str] = ()
    paper: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    facts: Mapping[str, Any] = field(default_factory=dict)
    apart: bool = False

    @classmethod
    def read(cls, file: Path) -> Self:
        """A table that `write` wrote.

        Raises:
            InvalidInputError: If the file holds something else.
        """
        settings = read_json("table", file)
        if {one.name for one in fields(cls)} != {*settings}:
            raise InvalidInputError(f"`table` names {str(file)!r}, which is no table of this version; make it anew.")
        return cls(**settings)

    def cells(self) -> tuple[list[str], list[list[str]]]:
        """Headings, and rows of means, with the spread over several seeds: the largest figure less the least."""
        headings = ["", *(f"{name}, {group}" if group else name for name, group in self.columns.items())]
        rows = [[name, *(_cell(row.get(column)) for column in self.columns)] for name, row in self.rows.items()]
        return headings, rows

    def paper_cells(self) -> tuple[list[str], list[list[str]]]:
        """The same of the paper's figures."""
        columns = list(dict.fromkeys(column for row in self.paper.values() for column in row))
        return ["", *columns], [
            [name, *(f"{row[column]:g}" if column in row else "" for column in columns)]
            for name, row in self.paper.items()
        ]

    def markdown(self) -> str:
        """The table as a section of a page."""
        lines = [f"## {self.title}", "", *_markdown(*self.cells()), "", f"{self._caption()}."]
        lines += ["", *(f"- {note}" for note in self._notes())]
        if self.paper:
            lines += ["", f"{OTHER_DATA}:", "", *_markdown(*self.paper_cells())]
        return "\n".join(lines) + "\n"

    def html(self) -> str:
        """The table as a section of a page, with its chart."""
        parts = [f"<h2>{escape(self.title)}</h2>", _html(*self.cells()), f"<p>{escape(self._caption())}.</p>"]
        parts += ["<ul>", *(f"<li>{escape(note)}</li>" for note in self._notes()), "</ul>"] if self._notes() else []
        parts.append(f'<img src="{self.name}.png" alt="{escape(self.title)}">')
        if self.paper:
            parts += [f"<p>{OTHER_DATA}:</p>", _html(*self.paper_cells())]
        return "\n".join(parts)

    def _caption(self) -> str:
        count = max((len(values) for row in self.rows.values() for values in row.values()), default=1)
        return self.metric + (f"; means over {count} seeds, in brackets their spread" if count > 1 else "")

    def _notes(self) -> list[str]:
        """What a reader has to know, and what was measured."""
        facts = [f"{name.replace('_', ' ')} {_listed(value)}" for name, value in self.facts.items() if name != "sets"]
        return [*self.notes, *([f"Measured: {'; '.join(facts)}."] if facts else [])]

    def draw(self, file: Path) -> None:
        """A chart of all figures: a bar for each row in each column, its line the range over seeds."""
        panels = [[column] for column in self.columns] if self.apart else [list(self.columns)]
        inches = 0.28 * len(self.rows) * len(self.columns) + 0.5 * len(panels) + 2.6
        drawing = Figure(figsize=(inches, 4.2), layout="constrained")
        for axes, columns in zip(drawing.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
            self._bars(axes, columns)
        drawing.legend(*axes.get_legend_handles_labels(), frameon=False, fontsize=8, loc="outside right center")
        with replacing("output", file) as partial:
            drawing.savefig(partial, dpi=110, format="png")

    def _bars(self, axes: Axes, columns: Sequence[str]) -> None:
        axes.set_prop_cycle(color=colormaps["tab20"].colors)  # type: ignore[attr-defined]
        width = 0.8 / max(len(self.rows), 1)
        for place, (name, row) in enumerate(self.rows.items()):
            known = [(number, row[column]) for number, column in enumerate(columns) if column in row]
            middles = [mean(values) for _, values in known]
            ranges = [[max(m - min(v), 0) for m, (_, v) in zip(middles, known, strict=True)],
                      [max(max(v) - m, 0) for m, (_, v) in zip(middles, known, strict=True)]]  # fmt: skip
            at = [number + (place + 0.5) * width - 0.4 for number, _ in known]
            axes.bar(at, middles, width, yerr=ranges, label=name, error_kw={"linewidth": 0.8})
        labels = [f"{name.replace('_', ' ')}\n{self.columns[name]}" for name in columns]
        if self.apart:
            axes.set_title("\n".join(wrap(columns[0], 24)), fontsize=9)
            labels = [""]
        else:
            axes.set_ylabel(self.metric)
        axes.set_xticks(range(len(columns)), labels)
        axes.margins(x=0.02)
        axes.spines[["top", "right"]].set_visible(False)

    def write(self, folder: Path) -> None:
        """Writes NAME.json, NAME.md and NAME.png."""
        write_file("output", folder / f"{self.name}.json", json.dumps(asdict(self), indent=2) + "\n")
        write_file("output", folder / f"{self.name}.md", self.markdown())
        self.draw(folder / f"{self.name}.png")


OTHER_DATA = "The paper's figures, which are of other data, and so nothing that these could be compared with"

STYLE = """body { font-family: system-ui, sans-serif; max-width: 70rem; margin: 2rem auto; padding: 0 1rem; }
table { border-collapse: collapse; font-size: .9rem; } td, th { padding: .25rem .6rem; border-bottom: 1px solid #ccc; }
td + td, th + th { text-align: right; } img { max-width: 100%; } ul { font-size: .9rem; }"""


def page(tables: Sequence[Table], title: str = "Tables of touch") -> str:
    """Tables as one HTML page, whose charts lie beside it."""
    body = "\n".join(table.html() for table in tables)
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f"<style>{STYLE}</style></head><body><h1>{escape(title)}</h1>\n{body}\n</body></html>\n"
    )


def _listed(value: Any) -> str:
    return ", ".join(map(str, value)) if isinstance(value, Sequence) and not isinstance(value, str) else str(value)


def _cell(values: Sequence[float] | None) -> str:
    if values is None:
        return ""
    return f"{mean(values):.1f}" + (f" ({max(values) - min(values):.1f})" if len(values) > 1 else "")


def _markdown(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterator[str]:
    for row in (headings, ["---"] * len(headings), *rows):
        yield f"| {' | '.join(row)} |"


def _html(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    def line(tag: str, row: Sequence[str]) -> str:
        return f"<tr>{''.join(f'<{tag}>{escape(cell)}</{tag}>' for cell in row)}</tr>"

    return f"<table>{line('th', headings)}{''.join(line('td', row) for row in rows)}</table>"
