"""The benchmarks of memory and of time outside of the networks: that they count what they say."""

import time
from functools import partial

import pytest

from tests.benchmarks.apart import in_own_process
from tests.benchmarks.memory import CASES, REQUEST, load, measure, write_small_family
from tests.benchmarks.overhead import clock_of, networks, share_outside
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.memory import resident
from unitouch_gen.pipelines.tiny import tiny


@pytest.mark.parametrize("case", CASES)
def test_the_warm_up_runs_the_request_on_a_small_family(case: str, tmp_path) -> None:
    write_small_family(tmp_path)
    pipe = load(case, tmp_path)[0]
    assert pipe(**{**REQUEST, "num_inference_steps": 2}).report.success
    assert sum(weight.numel() for weight in pipe.unet.parameters()) < 500_000


def test_an_unknown_case_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="case"):
        measure("nothing")


@pytest.mark.slow
@pytest.mark.skipif(resident("VmHWM") is None, reason="the system does not say")
def test_the_plan_takes_less_than_everything() -> None:
    peak = partial(in_own_process, "tests.benchmarks.memory")
    assert peak("planned") < 0.5 * peak("everything")


class Slow:
    def run(self) -> None:
        time.sleep(0.01)

    def twice(self) -> None:
        self.run()
        self.run()


class Inherits(Slow):
    pass


def test_time_within_time_counts_once_and_classes_are_as_they_were() -> None:
    before = dict(vars(Inherits)), Slow.run
    with clock_of([(Inherits, "run"), (Inherits, "twice")]) as clock:
        started = time.perf_counter()
        Inherits().twice()
        taken = time.perf_counter() - started
    assert 0.02 <= clock.seconds <= taken
    assert (dict(vars(Inherits)), Slow.run) == before


def test_a_share_of_a_run_is_outside_of_its_networks() -> None:
    pipe = tiny("x-to-touch")
    assert {name for _, name in networks(pipe)} >= {"get_text_features", "forward", "decode"}
    assert 0.0 < share_outside(pipe, text="rough brick", num_inference_steps=2) < 0.9
