"""The run report: codes and their messages, stages, and what it looks like as text and as JSON."""

import json
import time

import pytest

from unitouch_gen.sampling import ReturnCode, RunReport


@pytest.fixture
def report() -> RunReport:
    return RunReport(
        solver="unipc",
        steps=10,
        evaluations=10,
        guidance_scale=7.5,
        seconds={"touch": 0.25, "denoising": 1.5},
        codes=[ReturnCode.SUCCESS, ReturnCode.NON_FINITE],
        failed_at={1: 3},
        sensors=["digit", None],
        sensor_distances=[0.1, None],
        left_out=["VAE"],
    )


@pytest.mark.parametrize("code", ReturnCode)
def test_every_code_has_a_message(code):
    assert code.message.endswith(".")


def test_the_message_of_a_failure_says_what_to_try_next():
    assert "`guidance_scale`" in ReturnCode.NON_FINITE.message
    assert "`num_inference_steps`" in ReturnCode.NON_FINITE.message


def test_a_run_is_a_success_if_all_samples_are(report):
    assert not report.success
    assert RunReport(codes=[ReturnCode.SUCCESS] * 2).success


def test_two_reports_share_nothing():
    first, second = RunReport(), RunReport()
    first.left_out.append("VAE")
    first.seconds["touch"] = 1.0
    assert (second.left_out, second.seconds) == ([], {})


def test_a_stage_takes_the_time_spent_inside():
    report = RunReport()
    started = time.perf_counter()
    with report.stage("touch"):
        time.sleep(0.01)
    assert 0.01 <= report.seconds["touch"] <= time.perf_counter() - started


def test_a_stage_entered_twice_adds_up():
    report = RunReport()
    for _ in range(2):
        with report.stage("touch"):
            time.sleep(0.01)
    assert list(report.seconds) == ["touch"]
    assert report.seconds["touch"] >= 0.02


def test_a_stage_that_fails_still_counts():
    report = RunReport()
    with pytest.raises(KeyError), report.stage("touch"):
        raise KeyError
    assert "touch" in report.seconds


def test_reports_are_joined_in_the_order_of_their_samples(report):
    other = RunReport(
        solver="unipc", steps=10, evaluations=4, guidance_scale=7.5, seconds={"denoising": 0.5, "decoding": 0.25},
        codes=[ReturnCode.NON_FINITE], failed_at={0: 2}, sensors=["taxim"], sensor_distances=[0.2], left_out=["VAE"],
    )  # fmt: skip
    whole = RunReport.joined([report, other])
    assert (whole.solver, whole.steps, whole.evaluations, whole.guidance_scale) == ("unipc", 10, 14, 7.5)
    assert whole.seconds == {"touch": 0.25, "denoising": 2.0, "decoding": 0.25}
    assert whole.codes == [ReturnCode.SUCCESS, ReturnCode.NON_FINITE, ReturnCode.NON_FINITE]
    assert whole.failed_at == {1: 3, 2: 2}
    assert whole.sensors == ["digit", None, "taxim"]
    assert whole.sensor_distances == [0.1, None, 0.2]
    assert whole.left_out == ["VAE"]


def test_joined_reports_say_which_of_all_samples_were_chosen():
    reports = [RunReport(codes=[ReturnCode.SUCCESS] * 3, chosen=[sample]) for sample in (2, 0)]
    assert RunReport.joined(reports).chosen == [2, 3]


def test_a_report_joined_with_none_is_itself_and_a_copy(report):
    whole = RunReport.joined([report])
    assert whole == report
    whole.codes.clear()
    assert report.codes


def test_the_report_goes_through_json(report):
    values = json.loads(json.dumps(report.to_dict()))
    assert values["codes"] == ["success", "non_finite"]
    assert values["seconds"] == report.seconds
    assert values["sensors"] == ["digit", None]
    assert values["failed_at"] == {"1": 3}


def test_the_dictionary_is_a_copy(report):
    report.to_dict()["left_out"].append("x")
    assert report.left_out == ["VAE"]


def test_the_text_has_solver_counts_time_and_outcome(report):
    text = str(report)
    assert "\n" not in text
    for part in ("unipc", "10 steps", "10 evaluations", "1.75 s", "touch 0.25 s", "success, non_finite"):
        assert part in text


def test_the_text_of_a_good_run_says_all_are_finite():
    assert str(RunReport(codes=[ReturnCode.SUCCESS])).endswith("all finite")
