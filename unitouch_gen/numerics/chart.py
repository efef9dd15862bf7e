"""The chart of error against run time: how many seconds, and how many evaluations, for what error.

One row of two panels for each guidance scale. A colour is a solver and a line style a dtype or option; bars are
quartiles, the wide band is the Pareto front, a star what a call without options runs, a cross at the top what failed.
"""

import io
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from matplotlib.transforms import blended_transform_factory

from unitouch_gen.numerics.results import write_whole
from unitouch_gen.numerics.subjects import OWN
from unitouch_gen.numerics.work_precision import Cost, Order, Row, cheapest, pareto_front
from unitouch_gen.schedulers.adaptive import ADAPTIVE

COLOURS = {
    "ddim": "#b8860b",
    "euler": "#56b4e9",
    "heun": "#009e73",
    "dpm++2m": "#0050a0",
    "unipc": "#d55e00",
    "deis": "#cc79a7",
    ADAPTIVE: "#111111",
    OWN: "#7a3fbf",
    "diffusers:ddim": "#8c564b",
    "diffusers:pndm": "#a0a03c",
    "diffusers:euler": "#4f8f9f",
    "diffusers:dpm++2m": "#7f8fd0",
    "diffusers:unipc": "#e8955c",
}
"""Of solvers, the same on every chart (after Okabe & Ito, for all kinds of colour vision)."""

OTHER = "#777777"
STYLES = (("-", "o"), ("--", "s"), (":", "^"), ("-.", "D"), ((0, (5, 1, 1, 1, 1, 1)), "v"))
"""Line and marker of the variants of one solver, in turn."""

BAND = "#f2c94c"
TARGETS = (0.3, 0.1, 0.03, 0.01, 0.003, 0.001, 1e-4, 1e-5)
"""Errors that are looked up."""

COSTS: dict[Cost, str] = {"seconds": "seconds for one sample", "evaluations": "evaluations of the network"}
MOST_REASONS = 4

NAME_SIZE = 7.5
"""Of the names of points, in points."""


def draw_chart(
    rows: Iterable[Row], title: str, *, own_errors: dict[float, float], orders: Sequence[Order] = (), note: str = ""
) -> Figure:
    """The chart of all rows of one subject.

    Args:
        rows: At least one, of any guidance scales.
        title: What was measured.
        own_errors: Of the references, by guidance scale.
        orders: That labels name.
        note: Below it, such as the machine.
    """
    rows = list(rows)
    scales = sorted({row.guidance_scale for row in rows})
    reasons = failure_lines(rows)
    below = 0.72 + 0.17 * len(reasons)
    height = 4.9 * len(scales) + 0.55 + below
    figure = Figure(figsize=(12.6, height), layout=None)
    FigureCanvasAgg(figure)
    grid = figure.subplots(
        len(scales),
        2,
        squeeze=False,
        gridspec_kw={"left": 0.065, "right": 0.815, "top": 1 - 0.95 / height, "bottom": (below + 0.55) / height,
                     "wspace": 0.08, "hspace": 0.34},
    )  # fmt: skip
    figure.text(0.065, 1 - 0.3 / height, title, fontsize=14, weight="bold", va="center")
    styles = style_of(rows)
    for scale, panels in zip(scales, grid, strict=True):
        of_scale = [row for row in rows if row.guidance_scale == scale]
        _draw_scale(panels, of_scale, scale, own_errors.get(scale, 0.0), orders, styles, several=len(scales) > 1)
    star = "\N{BLACK STAR}: default of the pipeline.  " if any(row.default for row in rows) else ""
    footer = [f"Bars: quartiles over samples.  Band: Pareto front.  {star}", note]
    for number, line in enumerate([*footer, *reasons]):
        colour = "#b00020" if number >= len(footer) else "#555555"
        figure.text(0.065, (below - 0.25 - 0.17 * number) / height, line, fontsize=8, color=colour)
    return figure


def save_chart(figure: Figure, folder: Path) -> list[Path]:
    """Writes `chart.png` and `chart.svg`.

    Raises:
        InvalidInputError: If they cannot be written.
    """
    files = []
    for kind, settings in (("png", {"dpi": 160}), ("svg", {"metadata": {"Date": None}})):
        data = io.BytesIO()
        figure.savefig(data, format=kind, facecolor="white", **settings)  # type: ignore[arg-type]
        files.append(folder / f"chart.{kind}")
        write_whole(files[-1], data.getvalue())
    return files


# What it says in words ------------------------------------------------------------------------------------------------


def answers(rows: Sequence[Row]) -> list[tuple[float, Row]]:
    """The fastest row of one guidance scale for each round error that some row reaches, coarse errors first.

    Where one row is the fastest for several, the smallest of them.
    """
    found = {row.key: (target, row) for target in TARGETS if (row := cheapest(rows, target, "seconds")) is not None}
    return list(found.values())


def failure_lines(rows: Sequence[Row]) -> list[str]:
    """What failed and why, in a few lines."""
    failed: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        if row.failed:
            failed.setdefault((row.series, row.reason), []).append(row)
    lines = []
    for (series, reason), group in failed.items():
        amounts = ", ".join(dict.fromkeys(row.amount for row in group))
        where = amounts if len(amounts) <= 60 else f"{len(group)} points"
        count = min(row.failures for row in group)
        of = f"{count} of {group[0].samples} samples " if count < group[0].samples else ""
        lines.append(
            f"\N{MULTIPLICATION X} {series}, {where}: {of}{reason if len(reason) <= 110 else reason[:107] + '...'}"
        )
    if len(lines) > MOST_REASONS:
        lines = [*lines[: MOST_REASONS - 1], f"and {len(lines) - MOST_REASONS + 1} more: see results.csv"]
    return lines


def label_of(series: str, order: Order | None) -> str:
    """ "unipc (order 2.9 of 3)"."""
    if order is None or order.fitted is None:
        return series
    return f"{series}  order {order.fitted:.1f}" + (f" of {order.nominal}" if order.nominal is not None else "")


# Drawing --------------------------------------------------------------------------------------------------------------


def style_of(rows: Iterable[Row]) -> dict[str, dict[str, Any]]:
    """Colour, line and marker of each series."""
    variants: dict[str, list[str]] = {}
    for row in rows:
        mine = variants.setdefault(row.solver, [])
        if row.series not in mine:
            mine.append(row.series)
    styles = {}
    for solver, mine in variants.items():
        for number, series in enumerate(sorted(mine, key=len)):
            line, marker = STYLES[number % len(STYLES)]
            styles[series] = {"color": COLOURS.get(solver, OTHER), "linestyle": line, "marker": marker}
    return styles


def _draw_scale(
    panels: Sequence[Axes],
    rows: Sequence[Row],
    scale: float,
    own_error: float,
    orders: Sequence[Order],
    styles: dict[str, dict[str, Any]],
    several: bool,
) -> None:
    """Both panels of one guidance scale."""
    bottom, top = error_limits(rows, own_error)
    series: dict[str, list[Row]] = {}
    for row in rows:
        series.setdefault(row.series, []).append(row)
    for axes, cost in zip(panels, COSTS, strict=True):
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_ylim(bottom, top)
        _band(axes, pareto_front(rows, cost), cost)
        for name, group in series.items():
            _line(axes, [row for row in group if not row.failed], cost, styles[name])
        _crosses(axes, rows, cost, styles)
        _stars(axes, rows, cost, styles)
        _finish(axes, cost, pareto_front(rows, cost))
    left, right = panels
    left.set_ylabel("relative RMS error of the latents")
    right.tick_params(labelleft=False)
    _floor(panels, own_error, bottom)
    words = "     ".join(f"{target:g} in {_seconds(row.seconds)}" for target, row in answers(rows))
    heading = f"Guidance {scale:g}" if several or scale > 1.0 else "No guidance"
    left.set_title(f"{heading}.  An error of   {words}", loc="left", fontsize=9.5, color="#333333")
    _name_front(left, pareto_front(rows, "seconds"), styles)
    found = {order.series: order for order in orders if order.guidance_scale == scale}
    _labels(right, series, found, styles)


def error_limits(rows: Sequence[Row], own_error: float) -> tuple[float, float]:
    """Of the axis: around all bars, and the reference's own error if it is near them."""
    drawn = [row for row in rows if not row.failed and row.error]
    lows = [row.error_low or row.error for row in drawn]
    highs = [row.error_high or row.error for row in drawn]
    if not drawn:
        return 1e-4, 1.0
    low, high = float(min(lows)), float(max(highs))  # type: ignore[type-var, arg-type]
    if own_error > low / 30:
        low = min(low, own_error)
    return low / 2.2, max(high, low * 10) * 3.0


def _line(axes: Axes, rows: Sequence[Row], cost: Cost, style: dict[str, Any]) -> None:
    points = [
        (getattr(row, cost), row.error, row.error_low or row.error, row.error_high or row.error)
        for row in sorted(rows, key=lambda row: row.evaluations or 0.0)
        if row.error and getattr(row, cost)
    ]
    if not points:
        return
    x, error, low, high = np.asarray(points).T
    axes.errorbar(
        x, error, yerr=(error - low, high - error), markersize=5, linewidth=1.5, elinewidth=0.9, capsize=2,
        markeredgecolor="white", markeredgewidth=0.6, ecolor=(style["color"], 0.45), zorder=3, **style,
    )  # fmt: skip


def _band(axes: Axes, front: Sequence[Row], cost: Cost) -> None:
    """The Pareto front behind everything."""
    points = np.array([(getattr(row, cost), row.error) for row in front]).reshape(-1, 2)
    axes.plot(*points.T, color=BAND, linewidth=11, alpha=0.55, solid_capstyle="round",
              solid_joinstyle="round", zorder=1)  # fmt: skip


def _stars(axes: Axes, rows: Sequence[Row], cost: Cost, styles: dict[str, dict[str, Any]]) -> None:
    for row in rows:
        if row.default and not row.failed and row.error:
            axes.plot(getattr(row, cost), row.error, marker="*", markersize=19, color=styles[row.series]["color"],
                      markeredgecolor="white", markeredgewidth=1.2, linestyle="none", zorder=5)  # fmt: skip


def _crosses(axes: Axes, rows: Sequence[Row], cost: Cost, styles: dict[str, dict[str, Any]]) -> None:
    """What failed, at the top edge; where its cost is unknown, at what its steps cost other rows."""
    paid = [getattr(row, cost) / row.steps for row in rows if row.steps and getattr(row, cost)]
    at_top = blended_transform_factory(axes.transData, axes.transAxes)
    drawn: list[float] = []
    for row in rows:
        x = getattr(row, cost)
        if row.failed and not x and row.steps:
            x = row.steps * (float(np.median(paid)) if paid else 1.0)
        if row.failed and x:
            beside = sum(abs(math.log(x / other)) < 0.05 for other in drawn)  # those are below each other
            drawn.append(x)
            axes.plot(x, 0.965 - 0.042 * beside, marker="x", markersize=8, markeredgewidth=2.2,
                      color=styles[row.series]["color"], linestyle="none", transform=at_top, zorder=6)  # fmt: skip


def _finish(axes: Axes, cost: Cost, front: Sequence[Row]) -> None:
    axes.set_xlabel(COSTS[cost])
    axes.grid(which="major", color="#d9d9d9", linewidth=0.8)
    axes.grid(which="minor", color="#efefef", linewidth=0.5)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    low, high = axes.get_xlim()
    if cost == "seconds":
        low = min([low, *(_left_of_name(axes, row, high) for row in front)])
    short = high / low < 300
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if short else (1.0,)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlim(low, high)  # names are placed by it


def _left_of_name(axes: Axes, row: Row, high: float) -> float:
    """Where the axis of seconds has to begin so that there is room for a point's name on its left."""
    points = NAME_SIZE * 0.62 * len(_name_of(row)) + 12  # letters of the font are that wide in the mean
    share = points / (axes.bbox.width * 72 / axes.figure.dpi)
    return (row.seconds / high**share) ** (1 / (1 - share))  # type: ignore[operator]


def _name_of(row: Row) -> str:
    """ "unipc 20"."""
    name = row.series.removeprefix("diffusers:") if len(row.series) > 18 else row.series
    return f"{name} {row.steps}" if row.steps is not None else f"{name} {row.tolerance:g}"


def _floor(panels: Sequence[Axes], own_error: float, bottom: float) -> None:
    """The reference's own error, as a line or, where it is far below, in words."""
    left = panels[0]
    if own_error > bottom:
        for axes in panels:
            axes.axhline(own_error, color="#444444", linestyle=(0, (6, 3)), linewidth=1.1, zorder=2)
    words = f"reference's own error {own_error:.0e}" if own_error else "reference in closed form"
    below = "" if own_error > bottom else " \N{DOWNWARDS ARROW}"
    y = own_error * 1.08 if own_error > bottom else bottom * 1.15
    left.text(0.01, y, words + below, transform=blended_transform_factory(left.transAxes, left.transData),
              fontsize=7.5, color="#444444", va="bottom")  # fmt: skip


def _seconds(value: float | None) -> str:
    """ "0.12 s" or "3.1 ms"."""
    if value is None:
        return "?"
    return f"{value:.2g} s" if value >= 0.0995 else f"{1000 * value:.2g} ms"


def _name_front(axes: Axes, front: Sequence[Row], styles: dict[str, dict[str, Any]]) -> None:
    """What the points of the front are, as far as there is room between the names."""
    last = None
    for row in front:
        at = axes.transData.transform((row.seconds, row.error))  # type: ignore[arg-type]
        if last is not None and math.dist(at, last) < 52:
            continue
        last = at
        axes.annotate(
            _name_of(row), (row.seconds, row.error), (-7, -9), fontsize=NAME_SIZE, textcoords="offset points",  # type: ignore[arg-type]
            color=styles[row.series]["color"], ha="right", va="top", zorder=7,
            path_effects=[withStroke(linewidth=2.5, foreground="white", alpha=0.85)],
        )  # fmt: skip


def _labels(
    axes: Axes, series: dict[str, list[Row]], orders: dict[str, Order], styles: dict[str, dict[str, Any]]
) -> None:
    """Names of the series in the margin, each as near to the end of its line as the others allow."""
    ends = []
    for name, rows in series.items():
        points = [(row.evaluations, row.error) for row in rows if not row.failed and row.error and row.evaluations]
        ends.append((name, max(points) if points else None))
    drawn = [(name, end) for name, end in ends if end is not None]
    drawn.sort(key=lambda item: item[1][1], reverse=True)
    heights = [axes.transAxes.inverted().transform(axes.transData.transform(end))[1] for _, end in drawn]
    failed = [name for name, end in ends if end is None]
    places = spread([*[1.0] * len(failed), *heights], 0.052)
    for name, place in zip([*failed, *[name for name, _ in drawn]], places, strict=True):
        end = dict(drawn).get(name)
        style, label = styles[name], label_of(name, orders.get(name))
        leader = {
            "arrowstyle": "-",
            "color": style["color"],
            "linewidth": 0.6,
            "alpha": 0.5,
            "shrinkA": 0,
            "shrinkB": 4,
        }
        place_of = {"textcoords": "axes fraction", "va": "center", "fontsize": 8.5, "color": style["color"]}
        if end is None:
            axes.annotate(f"{label}  failed", (1.05, place), xycoords="axes fraction", **place_of)
        else:
            axes.annotate(label, (1.05, place), xycoords="axes fraction", **place_of)
            axes.annotate("", end, (1.02, place), textcoords="axes fraction", annotation_clip=False, arrowprops=leader)
        axes.add_line(
            Line2D([1.022, 1.044], [place, place], transform=axes.transAxes, clip_on=False, color=style["color"],
                   linestyle=style["linestyle"], linewidth=1.6)
        )  # fmt: skip


def spread(wanted: Sequence[float], apart: float) -> list[float]:
    """Places near the wanted ones that fall from each to the next by at least `apart`.

    Args:
        wanted: Falling.
        apart: Above 0.
    """
    groups: list[tuple[float, int]] = []  # the middle of each run of touching places, and how many they are
    for place in wanted:
        groups.append((place, 1))
        while len(groups) > 1:
            (above, many), (middle, few) = groups[-2:]
            if above - apart * (many + few) / 2 >= middle:
                break
            groups[-2:] = [((above * many + middle * few) / (many + few), many + few)]
    return [middle + apart * ((count - 1) / 2 - number) for middle, count in groups for number in range(count)]
