"""Time in batches, and outside of networks: that they count what they say."""

import time

from tests.benchmarks.cost import BATCH, Inside, batch_figures, share_outside
from tests.benchmarks.measuring import in_turns, quiet, ratio_of


def test_calls_take_turns_after_one_that_does_not_count():
    order = []
    seen = in_turns({name: lambda name=name: order.append(name) or len(order) for name in "ab"}, 2)
    assert order == list("ababab") and seen == {"a": [3, 5], "b": [4, 6]}


def test_a_ratio_is_of_medians_and_its_spread_of_pairs():
    assert ratio_of([2.0, 4.0, 9.0], [1.0, 4.0, 3.0]) == {"ratio": 4 / 3, "low": 1.0, "high": 3.0}


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
