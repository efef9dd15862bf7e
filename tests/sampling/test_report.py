"""The run report: codes and their messages, stages, and what it looks like as text and as JSON."""

import json
import time
from contextlib import suppress

import pytest

from unitouch_gen.sampling import ReturnCode, RunReport


@pytest.fixture
def report() -> RunReport:
    return RunReport(
        solver="unipc", steps=10, evaluations=10, guidance_scale=7.5, seconds={"touch": 0.25, "denoising": 1.5},
        codes=[ReturnCode.SUCCESS, ReturnCode.NON_FINITE], failed_at={1: 3}, sensors=["digit", None],
        sensor_distances=[0.1, None], left_out=["VAE"],
    )  # fmt: skip


def test_every_code_has_a_message():
    assert all(code.message.endswith(".") for code in ReturnCode)
    assert [code for code in ReturnCode if not code.finite] == [ReturnCode.NON_FINITE]


def test_a_stage_adds_up_the_time_spent_inside_and_counts_where_it_fails():
    report, started = RunReport(), time.perf_counter()
    for _ in range(2):
        with suppress(KeyError), report.stage("touch"):
            time.sleep(0.01)
            raise KeyError
    assert 0.02 <= report.seconds["touch"] <= time.perf_counter() - started


def test_reports_are_joined_in_the_order_of_their_samples(report):
    other = RunReport(
        solver="unipc", steps=10, evaluations=4, guidance_scale=7.5, seconds={"denoising": 0.5, "decoding": 0.25},
        codes=[ReturnCode.NON_FINITE], failed_at={0: 2}, sensors=["taxim"], sensor_distances=[0.2], left_out=["VAE"],
        chosen=[0], unknown={"touch": ["unlike anything known"]},
    )  # fmt: skip
    whole = RunReport.joined([report, other])
    assert (whole.solver, whole.steps, whole.evaluations, whole.guidance_scale) == ("unipc", 10, 14, 7.5)
    assert whole.seconds == {"touch": 0.25, "denoising": 2.0, "decoding": 0.25}
    assert whole.codes == [ReturnCode.SUCCESS, ReturnCode.NON_FINITE, ReturnCode.NON_FINITE]
    assert (whole.failed_at, whole.chosen) == ({1: 3, 2: 2}, [2])
    assert (whole.sensors, whole.sensor_distances) == (["digit", None, "taxim"], [0.1, None, 0.2])
    assert whole.left_out == ["VAE"] and whole.unknown == other.unknown
    alone = RunReport.joined([report])
    assert alone == report
    alone.codes.clear()
    assert report.codes


def test_the_report_goes_through_json_as_a_copy(report):
    values = json.loads(json.dumps(report.to_dict()))
    assert values["codes"] == ["success", "non_finite"] and values["failed_at"] == {"1": 3}
    assert values["seconds"] == report.seconds and values["sensors"] == ["digit", None]
    report.to_dict()["left_out"].append("x")
    assert report.left_out == ["VAE"]


def test_the_text_is_a_line_of_solver_counts_time_and_outcome(report):
    report.unknown = {"touch": ["unlike anything known", None]}
    text = str(report)
    assert "\n" not in text
    for part in ("unipc: 10 steps, 10 evaluations, 1.75 s (touch", "success, non_finite; 1 of the inputs unknown"):
        assert part in text
    assert str(RunReport(codes=[ReturnCode.SUCCESS])).endswith("0 evaluations, 0.00 s (); all finite")
