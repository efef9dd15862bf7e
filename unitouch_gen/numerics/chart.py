"""The chart of error against run time: how many seconds, and how many evaluations, for what error.

One row of two panels for each guidance scale. A colour is a solver and a line style a dtype or option; bars are
quartiles, the wide band is the Pareto front with its steps or tolerances, a star what a call without options runs, a
cross at the top what failed.
"""

import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from unitouch_gen.files import write_file
from unitouch_gen.numerics.targets import BASELINES, DEFAULT, SOLVERS
from unitouch_gen.numerics.work_precision import COSTS, Order, Result, grouped, pareto_front
from unitouch_gen.schedulers.adaptive import ADAPTIVE

COLOURS = dict(
    zip(
        (*SOLVERS, ADAPTIVE, DEFAULT, *BASELINES),
        ("#b8860b", "#56b4e9", "#009e73", "#0050a0", "#d55e00", "#cc79a7", "#111111", "#7a3fbf", "#8c564b",
         "#a0a03c", "#4f8f9f", "#7f8fd0", "#e8955c"),
        strict=True,
    )
)  # fmt: skip
"""Colours of solvers, the same on every chart (after Okabe & Ito, for all kinds of colour vision)."""

STYLES = (("-", "o"), ("--", "s"), (":", "^"), ("-.", "D"), ((0, (5, 1, 1, 1, 1, 1)), "v"))
"""Line and marker of the variants of one solver, in turn."""

BAND = "#f2c94c"
ERRORS = (0.3, 0.1, 0.03, 0.01, 0.003, 0.001, 1e-4, 1e-5)
"""Errors whose cost is told."""

MOST_REASONS = 4


def answers(results: Sequence[Result]) -> list[tuple[float, Result]]:
    """The fastest result of one guidance scale for each round error that some result reaches, coarse errors first.

    Where one result is the fastest for several, the smallest of them.
    """
    front = [(result.error, result) for result in pareto_front(results, "seconds") if result.error is not None]
    fastest = [(error, next((item for reached, item in front if reached <= error), None)) for error in ERRORS]
    return list({item.key: (error, item) for error, item in fastest if item is not None}.values())


def failure_lines(results: Sequence[Result]) -> list[str]:
    """What failed and why, in a few lines."""
    failed: dict[tuple[str, str], list[Result]] = {}
    for result in results:
        if result.failures:
            failed.setdefault((result.series, result.reason), []).append(result)
    lines = []
    for (series, reason), group in failed.items():
        amounts = ", ".join(dict.fromkeys(result.amount for result in group))
        where = amounts if len(amounts) <= 60 else f"{len(group)} points"
        count = min(result.failures for result in group)
        of = f"{count} of {group[0].samples} samples " if count < group[0].samples else ""
        short = reason if len(reason) <= 110 else reason[:107] + "..."
        lines.append(f"\N{MULTIPLICATION X} {series}, {where}: {of}{short}")
    if len(lines) > MOST_REASONS:
        lines = [*lines[: MOST_REASONS - 1], f"and {len(lines) - MOST_REASONS + 1} more: see results.csv"]
    return lines


def draw_chart(
    results: Sequence[Result],
    title: str,
    *,
    own_errors: dict[float, float],
    orders: Sequence[Order] = (),
    note: str = "",
) -> Figure:
    """The chart of all results of one target; the legend names the orders, and a note stands below."""
    scales, styles = sorted(grouped(results, "guidance_scale").items()), style_of(results)
    figure = Figure(figsize=(12.6, 4.6 * len(scales) + 0.9), layout="constrained")
    figure.suptitle(title, x=0.01, ha="left", fontsize=14, weight="bold")
    figure.supxlabel("\n".join([note, *failure_lines(results)]), x=0.01, ha="left", fontsize=8, color="#555555")
    for (scale, group), panels in zip(
        scales, figure.subplots(len(scales), 2, squeeze=False, sharey="row"), strict=True
    ):
        own_error = own_errors.get(scale, 0.0)
        named = {order.series: order for order in orders if order.guidance_scale == scale}
        for axes, cost in zip(panels, COSTS, strict=True):
            _draw_panel(axes, group, cost, own_error, named, styles)
        heading = f"Guidance {scale:g}" if len(scales) > 1 or scale > 1.0 else "No guidance"
        words = "     ".join(f"{error:g} in {_seconds(item.seconds)}" for error, item in answers(group))
        panels[0].set_title(f"{heading}.  An error of   {words}", loc="left", fontsize=9.5, color="#333333")
        panels[0].set_ylabel("relative RMS error of the latents")
        panels[1].legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False, fontsize=8.5)
    return figure


def save_chart(figure: Figure, folder: Path) -> list[Path]:
    """Writes `chart.png` and `chart.svg`."""
    files = []
    for kind, settings in (("png", {"dpi": 160}), ("svg", {"metadata": {"Date": None}})):
        data = io.BytesIO()
        figure.savefig(data, format=kind, facecolor="white", **settings)  # type: ignore[arg-type]
        files.append(write_file("output", folder / f"chart.{kind}", data.getvalue()))
    return files


def style_of(results: Sequence[Result]) -> dict[str, dict[str, Any]]:
    """Colour, line and marker of each series."""
    variants: dict[str, set[str]] = {}
    for result in results:
        variants.setdefault(result.solver, set()).add(result.series)
    styles = {}
    for solver, series in variants.items():
        for number, name in enumerate(sorted(series, key=lambda name: (len(name), name))):
            line, marker = STYLES[number % len(STYLES)]
            styles[name] = {"color": COLOURS[solver], "linestyle": line, "marker": marker}
    return styles


def _draw_panel(
    axes: Axes,
    results: Sequence[Result],
    cost: str,
    own_error: float,
    orders: dict[str, Order],
    styles: dict[str, dict[str, Any]],
) -> None:
    """Error against one cost, at one guidance scale."""
    axes.set(xscale="log", yscale="log", xlabel=COSTS[cost], autoscalex_on=False)
    front = pareto_front(results, cost)
    axes.plot(*_points(front, cost)[:2], color=BAND, linewidth=11, alpha=0.55, solid_capstyle="round", zorder=1,
              label="Pareto front")  # fmt: skip
    named = math.inf
    for item in front:
        if item.error and item.error < 0.8 * named:  # room for it
            named, amount = item.error, item.tolerance if item.steps is None else item.steps
            axes.annotate(f"{amount:g}", (getattr(item, cost), item.error), (-7, -7), textcoords="offset points",
                          ha="right", va="top", fontsize=7.5, color=styles[item.series]["color"], zorder=7)  # fmt: skip
    # What failed is at the top edge; where its cost is unknown, at what its steps cost others.
    paid = [getattr(item, cost) / item.steps for item in results if item.steps and getattr(item, cost)]
    typical, height = float(np.median(paid)) if paid else 1.0, 0.97
    for series, group in grouped(results, "series").items():
        good = [item for item in group if not item.failures and item.error]
        good.sort(key=lambda item: item.evaluations or 0.0)
        x, error, low, high = _points(good, cost)
        order, colour = orders.get(series), styles[series]["color"]
        label = series if order is None or order.fitted is None else f"{series}  order {order.fitted:.1f}"
        if order is not None and order.fitted is not None and order.nominal is not None:
            label += f" of {order.nominal}"
        axes.errorbar(
            x, error, yerr=(error - low, high - error), markersize=5, linewidth=1.5, elinewidth=0.9, capsize=2,
            markeredgecolor="white", markeredgewidth=0.6, ecolor=(colour, 0.45), zorder=3, **styles[series],
            label=label if good else f"{label}  failed",
        )  # fmt: skip
        plain = [item for item in good if item.default]
        if plain:
            axes.plot(*_points(plain, cost)[:2], "*", markersize=19, color=colour, markeredgecolor="white", zorder=5,
                      label="what a plain call runs")  # fmt: skip
        failed = [getattr(item, cost) or (item.steps or 0) * typical for item in group if item.failures]
        if failed:
            axes.plot(failed, [height] * len(failed), "x", markersize=8, markeredgewidth=2.2, color=colour, zorder=6,
                      transform=axes.get_xaxis_transform())  # fmt: skip
            height -= 0.04
    drawn = [item.error_low or item.error for item in results if item.error and not item.failures]
    if own_error > min(drawn, default=math.inf) / 30:
        axes.axhline(own_error, color="#444444", linestyle=(0, (6, 3)), linewidth=1.1, zorder=2,
                     label=f"reference's own error {own_error:.0e}")  # fmt: skip
    else:
        words = f"reference's own error {own_error:.0e}" if own_error else "reference in closed form"
        axes.plot([], [], " ", label=f"{words} \N{DOWNWARDS ARROW}")
    low, high = axes.dataLim.intervalx
    if 0 < low <= high < math.inf:  # matplotlib warns where all points are at one cost
        axes.set_xlim(low / (1.2 * (high / low) ** 0.1), high * 1.2)
    axes.margins(y=0.1)
    axes.grid(color="#d9d9d9")
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter("")


def _points(results: Sequence[Result], cost: str) -> np.ndarray:
    """Cost, error and its quartiles, (4, N)."""
    names = (cost, "error", "error_low", "error_high")
    rows = [[getattr(item, name) for name in names] for item in results]
    return np.array(rows, dtype=np.float64).reshape(-1, 4).T


def _seconds(value: float | None) -> str:
    """ "0.12 s" or "3.1 ms"."""
    if value is None:
        return "?"
    return f"{value:.2g} s" if value >= 0.0995 else f"{1000 * value:.2g} ms"
