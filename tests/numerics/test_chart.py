"""The chart: that all of it is on the paper, where it belongs, and legible."""

import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex
from matplotlib.text import Text
from PIL import Image

from unitouch_gen.numerics.chart import BAND, COLOURS, answers, draw_chart, failure_lines, save_chart, style_of
from unitouch_gen.numerics.targets import BASELINES
from unitouch_gen.numerics.work_precision import Order, Result, pareto_front
from unitouch_gen.schedulers import SOLVERS

AMOUNTS = (5, 10, 20, 40)


def result(solver: str = "heun", steps: int = 10, error: float | None = 0.01, **values) -> Result:
    known = {"samples": 8, "seconds": steps * 0.01, "evaluations": float(steps)}
    bars = {} if error is None else {"error_low": error / 1.5, "error": error, "error_high": error * 1.5}
    return Result(solver, steps, **{**known, **bars, **values})


def failing(solver: str, steps: int, **values) -> Result:
    known = {"seconds": None, "evaluations": None, "failures": 8, "reason": "non_finite"}
    return result(solver, steps, None, **{**known, **values})


def curves(scale: float = 1.0) -> list[Result]:
    orders = {"ddim": 1, "euler": 1, "heun": 2, "dpm++2m": 2, "unipc": 3, "deis": 2, "diffusers:ddim": 1}
    return [
        result(solver, steps, 2.0 * steps**-order, guidance_scale=scale)
        for solver, order in orders.items()
        for steps in AMOUNTS
    ]


ORDERS = [Order("unipc", "unipc", 1.0, 2.87, 3, 4), Order("heun", "heun", 1.0, None, 2, 0)]


@pytest.fixture(scope="module")
def figure():
    results = [*curves(), failing("unipc", 3), result("default", 20, 0.02, default=True)]
    drawn = draw_chart(results, "a title", own_errors={1.0: 1e-9}, orders=ORDERS, note="a machine")
    FigureCanvasAgg(drawn).draw()
    return drawn


def texts(figure) -> list[str]:
    return [item.get_text() for item in figure.findobj(match=Text)]


def test_both_panels_are_logarithmic_in_both_directions(figure):
    assert [(axes.get_xscale(), axes.get_yscale()) for axes in figure.axes] == 2 * [("log", "log")]
    assert [axes.get_xlabel() for axes in figure.axes] == ["seconds for one sample", "evaluations of the network"]
    assert figure.axes[0].get_ylim() == figure.axes[1].get_ylim()


def test_every_point_is_drawn(figure):
    left, right = figure.axes
    drawn = {point for line in right.lines for point in zip(*line.get_data(), strict=True)}
    assert {(item.evaluations, item.error) for item in curves()} <= drawn
    low, high = left.get_ylim()
    assert low < min(item.error_low for item in curves()) and high > max(item.error_high for item in curves())


def test_the_front_is_a_band(figure):
    results = [*curves(), result("default", 20, 0.02)]
    for axes, cost in zip(figure.axes, ("seconds", "evaluations"), strict=True):
        (band,) = [line for line in axes.lines if to_hex(line.get_color()) == BAND]
        expected = [(getattr(item, cost), item.error) for item in pareto_front(results, cost)]
        np.testing.assert_allclose(np.transpose(band.get_data()), expected)


def test_the_default_is_a_star_and_what_failed_a_cross_at_the_top(figure):
    for axes in figure.axes:
        (star,) = [line for line in axes.lines if line.get_marker() == "*"]
        assert star.get_ydata()[0] == 0.02
        (cross,) = [line for line in axes.lines if line.get_marker() == "x"]
        assert cross.get_ydata()[0] > 0.9 and to_hex(cross.get_color()) == COLOURS["unipc"]
    assert any("unipc, 3 steps: non_finite" in text for text in texts(figure))


def test_the_legend_names_every_series_and_its_order(figure):
    found = [item.get_text() for item in figure.axes[1].get_legend().get_texts()]
    assert {"unipc  order 2.9 of 3", "heun", "ddim", "default", "diffusers:ddim", "what a plain call runs"} <= set(
        found
    )
    assert "reference's own error 1e-09 \N{DOWNWARDS ARROW}" in found
    assert "a title" in texts(figure) and any("a machine" in text for text in texts(figure))


def test_the_legend_lies_on_the_paper_beside_the_panels(figure):
    paper, legend = figure.bbox, figure.axes[1].get_legend().get_window_extent()
    assert legend.x0 > figure.axes[1].bbox.x1
    assert legend.x1 <= paper.x1 and legend.y0 >= paper.y0 and legend.y1 <= paper.y1


def test_steps_on_the_front_lie_within_the_panel_and_left_of_their_points(figure):
    axes, renderer = figure.axes[0], figure.canvas.get_renderer()
    names = [item for item in axes.texts if item.get_text()]
    assert [item.get_text() for item in names] == [str(amount) for amount in AMOUNTS]
    for item in names:
        box = Text.get_window_extent(item, renderer)
        assert box.x0 > axes.bbox.x0 and box.x1 < axes.transData.transform(item.xy)[0]


def test_every_cross_is_to_be_seen():
    for axes in draw_chart([*curves(), failing("unipc", 5), failing("heun", 5)], "t", own_errors={}).axes:
        places = [line.get_xydata()[0] for line in axes.lines if line.get_marker() == "x"]
        assert places[0][0] == places[1][0] and abs(places[0][1] - places[1][1]) > 0.03


def test_a_near_floor_is_a_line():
    near = draw_chart(curves(), "t", own_errors={1.0: 1e-5})
    heights = [line.get_ydata()[0] for line in near.axes[1].lines if line.get_label() == "reference's own error 1e-05"]
    assert heights == [1e-5] and near.axes[0].get_ylim()[0] < 1e-5
    (closed,) = {text for text in texts(draw_chart(curves(), "t", own_errors={})) if "reference" in text}
    assert closed == "reference in closed form \N{DOWNWARDS ARROW}"


def test_each_guidance_scale_has_its_panels():
    figure = draw_chart([*curves(1.0), *curves(7.5)], "t", own_errors={})
    assert len(figure.axes) == 4
    assert [axes.get_title(loc="left").partition(".  ")[0] for axes in figure.axes[::2]] == [
        "Guidance 1",
        "Guidance 7.5",
    ]


def test_files_are_a_picture_and_a_drawing(figure, tmp_path):
    png, svg = save_chart(figure, tmp_path)
    with Image.open(png) as picture:
        assert picture.size == tuple(round(160 * side) for side in figure.get_size_inches())
        assert len(picture.convert("RGB").getcolors(2**24)) > 50
    assert ET.parse(svg).getroot().tag.endswith("svg")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["chart.png", "chart.svg"]


def test_nothing_but_failures_is_a_chart_as_well(tmp_path):
    figure = draw_chart([failing("unipc", steps) for steps in AMOUNTS], "t", own_errors={})
    save_chart(figure, tmp_path)
    assert "unipc  failed" in texts(figure)


# What it is made of ---------------------------------------------------------------------------------------------------


def test_solvers_have_colours_of_their_own():
    assert {*SOLVERS, *BASELINES, "adaptive", "default"} == set(COLOURS)
    assert len(set(COLOURS.values())) == len(COLOURS)


def test_variants_of_a_solver_differ_in_line_and_share_its_colour():
    variants = ({}, {"dtype": "bfloat16"}, {"options": {"eta": 1}})
    styles = style_of([*(result("heun", **values) for values in variants), result("unipc")])
    assert {styles[name]["color"] for name in styles if name.startswith("heun")} == {COLOURS["heun"]}
    assert len({styles[name]["marker"] for name in styles if name.startswith("heun")}) == 3
    assert styles["heun"]["linestyle"] == styles["unipc"]["linestyle"] == "-"


def test_failures_are_told_once_and_in_few_lines():
    rows = [failing("unipc", steps) for steps in AMOUNTS]
    assert failure_lines(rows) == ["✕ unipc, 5 steps, 10 steps, 20 steps, 40 steps: non_finite"]
    part = replace(rows[0], failures=3, error=0.1)
    assert failure_lines([part]) == ["✕ unipc, 5 steps: 3 of 8 samples non_finite"]
    many = [failing("unipc", 5, reason=f"reason {number}") for number in range(9)]
    assert len(failure_lines(many)) == 4 and failure_lines(many)[-1] == "and 6 more: see results.csv"


def test_answers_are_the_fastest_for_an_error():
    rows = [
        result("heun", 5, 0.2),
        result("heun", 40, 0.02),
        result("unipc", 20, 0.025),
        result("unipc", 99, 0.0009, failures=1),
    ]
    assert [(target, item.seconds) for target, item in answers(rows)] == [(0.3, 0.05), (0.03, 0.2)]


@pytest.mark.parametrize(
    ("seconds", "words"), [(0.00312, "3.1 ms"), (0.0994, "99 ms"), (0.0996, "0.1 s"), (0.123, "0.12 s"), (12.3, "12 s")]
)
def test_seconds_are_told_in_two_digits(seconds, words):
    figure = draw_chart([result(error=0.2, seconds=seconds)], "a title", own_errors={1.0: 1e-9}, orders=[], note="")
    assert any(f"0.3 in {words}" in text for text in texts(figure))
