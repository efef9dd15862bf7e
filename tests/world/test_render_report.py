"""What a scene says of its own rendering, and that surfaces nobody will see are not coloured."""

import time

import pytest

from unitouch_gen.world import MODALITIES, SENSORS, World
from unitouch_gen.world.scene import PARTS, RenderReport

NAMES = [1, 5], [0, 0], [2, 2]


@pytest.mark.parametrize(
    ("request_", "parts"),
    [
        ({"modalities": ("text",)}, {"text"}),
        ({"modalities": ("audio",)}, {"audio"}),
        ({"modalities": ("grasp",)}, {"surfaces", "grasp"}),
        ({"modalities": ("outcome",)}, {"surfaces", "image", "grasp", "outcome"}),
        ({"modalities": ("image", "text")}, {"surfaces", "image", "text"}),
        (
            {"modalities": ("touch",), "sensors": ("digit", "gelsight_r15")},
            {"surfaces", "touch of digit", "touch of gelsight_r15"},
        ),
        ({"modalities": MODALITIES, "sensors": tuple(SENSORS)}, set(PARTS)),
    ],
)
def test_parts_are_either_timed_or_left_out(request_: dict, parts: set[str]) -> None:
    report = World(0).render(*NAMES, **request_).report
    assert set(report.seconds) == {"draws", *parts}
    assert set(report.left_out) - {"colours of surfaces"} == set(PARTS) - parts


@pytest.mark.parametrize(
    ("modalities", "left_out"),
    [(("touch",), True), (("grasp",), True), (("image",), False), (("outcome",), False), (("text",), False)],
)
def test_colours_are_left_out_where_there_are_surfaces_and_no_picture(
    modalities: tuple[str, ...], left_out: bool
) -> None:
    assert ("colours of surfaces" in World(0).render(*NAMES, modalities=modalities).report.left_out) == left_out


def test_the_parts_take_no_longer_than_the_whole() -> None:
    started = time.perf_counter()
    report = World(0).render(*NAMES).report
    whole = time.perf_counter() - started
    assert 0.5 * whole < sum(report.seconds.values()) <= whole
    assert report.contacts == 2


def test_a_report_reads_as_a_line() -> None:
    line = str(RenderReport(3, {"draws": 0.002, "text": 0.001}, ["surfaces", "audio"]))
    assert line == "3 contacts in 0.00 s (draws 2 ms, text 1 ms); left out: surfaces, audio"


def test_reports_are_not_shared() -> None:
    world = World(0)
    first = world.render(*NAMES, modalities=("text",)).report
    world.render(*NAMES, modalities=("audio",))
    assert "audio" not in first.seconds
