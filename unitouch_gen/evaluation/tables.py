"""A table of figures, each beside its controls, as JSON and Markdown."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from statistics import mean
from textwrap import wrap
from typing import Any, Self

import numpy as np
import torch
import torch.nn.functional as F
from matplotlib.figure import Figure
from torch import Tensor

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
        beside: Rows that are the model's, each with those that it should be better than; others are ceilings.
        falling: Columns whose figures are better the lower they are.
        examples: Whether a grid of examples lies beside it; see `draw_examples`.
    """

    name: str
    title: str
    metric: str
    columns: Mapping[str, str]
    rows: Mapping[str, Values]
    notes: Sequence[str] = ()
    paper: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    facts: Mapping[str, Any] = field(default_factory=dict)
    beside: Mapping[str, Sequence[str]] = field(default_factory=dict)
    falling: Sequence[str] = ()
    examples: bool = False

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

    def summary(self) -> list[list[str]]:
        """For each row that is the model's and each column the figure, and the best of those beside it by name."""
        lines = []
        for name, others in self.beside.items():
            for column, group in self.columns.items():
                known = {row: mean(self.rows[row][column]) for row in others if column in self.rows.get(row, {})}
                if column in self.rows.get(name, {}) and known:
                    best = (min if column in self.falling else max)(known, key=lambda row: known[row])
                    place = f"{column}, {group}" if group else column
                    mine, other = (_cell(self.rows[row][column]) for row in (name, best))
                    lines.append([self.title, place, name, mine, best, other])
        return lines

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
        lines += ["", f"![{self.title}]({self.name}.examples.png)"] if self.examples else []
        if self.paper:
            lines += ["", f"{OTHER_DATA}:", "", *_markdown(*self.paper_cells())]
        return "\n".join(lines) + "\n"

    def _caption(self) -> str:
        several = any(len(values) > 1 for row in self.rows.values() for values in row.values())
        return self.metric + ("; of several seeds means, in brackets their spread" if several else "")

    def _notes(self) -> list[str]:
        """What a reader has to know, and what was measured."""
        facts = [f"{name.replace('_', ' ')} {_listed(value)}" for name, value in self.facts.items() if name != "sets"]
        return [*self.notes, *([f"Measured: {'; '.join(facts)}."] if facts else [])]

    def write(self, folder: Path) -> None:
        """Writes NAME.json and NAME.md."""
        write_file("output", folder / f"{self.name}.json", json.dumps(asdict(self), indent=2) + "\n")
        write_file("output", folder / f"{self.name}.md", self.markdown())


def draw_examples(file: Path, columns: Mapping[str, Tensor], most: int = 12) -> None:
    """A grid of images, a row for each contact and a column for each way, with its name above.

    Args:
        file: PNG to write.
        columns: Images (K, 3, H, W) in [0, 1] of the same contacts, by name.
        most: Rows, of contacts as far apart as they are given.
    """
    count = len(next(iter(columns.values())))
    rows = sorted({round(row) for row in np.linspace(0, count - 1, min(most, count))})
    side = max(images.shape[-1] for images in columns.values())
    tiles = [
        F.pad(F.interpolate(images[rows].float(), (side, side)), (4,) * 4, value=1.0) for images in columns.values()
    ]
    pixels = torch.cat(list(torch.cat(tiles, dim=3)), dim=1).clamp(0.0, 1.0).permute(1, 2, 0)
    drawing = Figure(figsize=(1.2 * len(columns) + 0.2, 1.2 * len(rows) + 0.8), layout="constrained")
    axes = drawing.subplots()
    axes.imshow(pixels.numpy())
    middles = [(side + 8) * (place + 0.5) for place in range(len(columns))]
    axes.set_xticks(middles, ["\n".join(wrap(name, 18)) for name in columns], fontsize=7)
    axes.tick_params(top=True, labeltop=True, bottom=False, labelbottom=False, length=0)
    axes.set_yticks([])
    axes.spines[:].set_visible(False)
    with replacing("output", file) as partial:
        drawing.savefig(partial, dpi=110, format="png")


OTHER_DATA = "The paper's figures, which are of other data, and so nothing that these could be compared with"

SUMMARY = ["table", "column", "row", "figure", "the best of its controls and baselines", "figure"]


def summary(tables: Sequence[Table]) -> str:
    """What each table says of the model, in Markdown; see `Table.summary`."""
    return "\n".join(_markdown(SUMMARY, [line for table in tables for line in table.summary()])) + "\n"


def _listed(value: Any) -> str:
    return ", ".join(map(str, value)) if isinstance(value, Sequence) and not isinstance(value, str) else str(value)


def _cell(values: Sequence[float] | None) -> str:
    if values is None:
        return ""
    return f"{mean(values):.1f}" + (f" ({max(values) - min(values):.1f})" if len(values) > 1 else "")


def _markdown(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterator[str]:
    for row in (headings, ["---"] * len(headings), *rows):
        yield f"| {' | '.join(row)} |"
