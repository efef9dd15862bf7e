"""The run report: stages, and what it looks like as text and as JSON."""

import json
import time
from contextlib import suppress

from unitouch_gen.sampling import ReturnCode, RunReport


def test_a_stage_adds_up_the_time_spent_inside_and_counts_where_it_fails():
    report, started = RunReport(), time.perf_counter()
    for _ in range(2):
        with suppress(KeyError), report.stage("touch"):
            time.sleep(0.01)
            raise KeyError
    assert 0.02 <= report.seconds["touch"] <= time.perf_counter() - started


def test_it_is_a_line_of_solver_counts_time_and_outcome_and_goes_through_json_as_a_copy():
    report = RunReport(solver="unipc", steps=10, evaluations=10, seconds={"touch": 0.25, "denoising": 1.5},
                       codes=[ReturnCode.SUCCESS, ReturnCode.NON_FINITE], failed_at={1: 3}, left_out=["VAE"],
                       unknown={"touch": ["unlike anything known", None]})  # fmt: skip
    values = json.loads(json.dumps(report.to_dict()))
    assert values["codes"] == ["success", "non_finite"] and values["failed_at"] == {"1": 3}
    assert values["seconds"] == report.seconds
    report.to_dict()["left_out"].append("x")
    assert report.left_out == ["VAE"] and "\n" not in str(report)
    for part in ("unipc: 10 steps, 10 evaluations, 1.75 s (touch", "success, non_finite; 1 of the inputs unknown"):
        assert part in str(report)
    assert str(RunReport(codes=[ReturnCode.SUCCESS])).endswith("0 evaluations, 0.00 s (); all finite")


def test_every_code_has_a_message():
    assert all(code.message.endswith(".") for code in ReturnCode)
