"""Memory, and the time outside of networks: that they count what they say."""

import time

import pytest

from tests.benchmarks.cost import BATCH, CASES, REQUEST, Inside, batch_figures, load, megabytes, share_outside
from tests.benchmarks.measuring import in_own_process, in_turns, quiet, ratio_of
from tests.helpers.small_family import write_small_family
from unitouch_gen.memory import resident


def test_calls_take_turns_after_one_that_does_not_count():
    order = []
    seen = in_turns({name: lambda name=name: order.append(name) or len(order) for name in "ab"}, 2)
    assert order == list("ababab") and seen == {"a": [3, 5], "b": [4, 6]}


def test_a_ratio_is_of_medians_and_its_spread_of_pairs():
    assert ratio_of([2.0, 4.0, 9.0], [1.0, 4.0, 3.0]) == {"ratio": 4 / 3, "low": 1.0, "high": 3.0}


@pytest.mark.parametrize("case", CASES)
def test_the_warm_up_runs_the_request_on_a_small_family(case: str, tmp_path) -> None:
    write_small_family(tmp_path)
    pipe = load(case, tmp_path)[0]
    assert pipe(**{**REQUEST, "num_inference_steps": 2}).report.success
    assert sum(weight.numel() for weight in pipe.unet.parameters()) < 500_000


@pytest.mark.slow
@pytest.mark.skipif(resident("VmHWM") is None, reason="the system does not say")
def test_the_plan_takes_less_than_everything() -> None:
    assert in_own_process(megabytes, "planned") < 0.5 * in_own_process(megabytes, "everything")


def test_a_batch_is_held_to_the_same_pictures_one_at_a_time() -> None:
    figures = batch_figures(quiet("touch-to-image"), steps=1, repeats=1)
    assert figures["items"] == BATCH and 0.0 < figures["low"] <= figures["ratio"] <= figures["high"]


def test_time_within_time_counts_once() -> None:
    inside = Inside()
    slow = inside.timed(lambda: time.sleep(0.01))
    started = time.perf_counter()
    inside.timed(lambda: (slow(), slow()))()
    assert 0.02 <= inside.seconds <= time.perf_counter() - started


def test_a_share_of_a_run_is_outside_of_its_networks() -> None:
    pipe = quiet("x-to-touch")
    methods = [(type(pipe.unet), "forward"), (type(pipe.vae), "decode"), (type(pipe.unitouch), "get_text_features")]
    before = [getattr(*method) for method in methods]
    assert 0.0 < share_outside(pipe, text="rough brick", num_inference_steps=2) < 0.9
    assert [getattr(*method) for method in methods] == before
