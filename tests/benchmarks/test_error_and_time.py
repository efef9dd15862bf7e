"""The benchmark of error against run time: what it compares with, what it chooses, and what the tables say of it."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from diffusers import DDIMScheduler

from tests.benchmarks.effectivities import exact_effectivity, figures_of, pipeline_effectivity
from tests.benchmarks.eliminations import elimination_figures
from tests.benchmarks.error_and_time import order_figures, price_figures, run_parts, stability_figures
from tests.benchmarks.error_tables import (
    effectivity_table,
    gains_table,
    orders_table,
    price_table,
    stability_text,
)
from tests.benchmarks.speedup import (
    DDIM,
    Plain,
    called,
    candidates,
    cheapest_within,
    compiled_calls,
    diffusers_unclip,
    picture_subject,
    speedup_figures,
    touch_subject,
    usual_pictures,
    usual_touches,
)
from tests.benchmarks.turns import in_turns, ratio_of
from tests.helpers.components import make_components, make_x_to_touch
from unitouch_gen.errors import NotConvergedError
from unitouch_gen.numerics.calibration import Effectivity
from unitouch_gen.numerics.checkpoint import close_reference
from unitouch_gen.numerics.problems import make_problem
from unitouch_gen.numerics.stability import Case, Ended
from unitouch_gen.numerics.subjects import Configuration
from unitouch_gen.numerics.work_precision import Order
from unitouch_gen.pipelines import TouchToImagePipeline, XToTouchPipeline
from unitouch_gen.pipelines.tiny import tiny
from unitouch_gen.sampling import ReturnCode
from unitouch_gen.schedulers.fitted import FittedScheduler

FEW = {"default_num_inference_steps": 3, "default_guidance_scale": 2.0}


@pytest.fixture(scope="module")
def pictures():
    pipe = TouchToImagePipeline(**make_components(), **FEW, default_noise_level=300)
    pipe.set_progress_bar_config(disable=True)
    return picture_subject(pipe, 2)


@pytest.fixture(scope="module")
def touches():
    parts = make_components()
    shared = {key: parts[key] for key in ("unitouch", "processor", "scheduler")}
    pipe = XToTouchPipeline(**shared, **make_x_to_touch(), **FEW, sensors=["gelsight", "digit"])
    pipe.set_progress_bar_config(disable=True)
    return touch_subject(pipe, 2)


@pytest.fixture(scope="module")
def trained():
    pipe = tiny("x-to-touch")
    pipe.set_progress_bar_config(disable=True)
    return touch_subject(pipe, 1)


@pytest.fixture(scope="module")
def gained(touches) -> dict:
    return speedup_figures(touches, usual_touches(touches, steps=16, guidance_scale=2.0), 2, (16,), 30)


# Turns ----------------------------------------------------------------------------------------------------------------


def test_calls_take_turns_after_one_that_does_not_count():
    order = []
    seen = in_turns({name: lambda name=name: order.append(name) or len(order) for name in "ab"}, 2)
    assert order == list("ababab") and seen == {"a": [3, 5], "b": [4, 6]}


def test_a_ratio_is_of_medians_and_its_spread_of_pairs():
    assert ratio_of([2.0, 4.0, 9.0], [1.0, 4.0, 3.0]) == {"ratio": 4 / 3, "low": 1.0, "high": 3.0}


# The usual way --------------------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore::unitouch_gen.errors.UnfamiliarTouchWarning")  # a press that is unlike the others
def test_diffusers_pipeline_makes_the_same_latents_from_the_same_start(pictures):
    usual = usual_pictures(pictures, steps=4, guidance_scale=3.0)
    latents, seconds = usual.run([0, 1], "latent")
    expected, _ = pictures.run(Configuration(DDIM, 4, guidance_scale=3.0))
    torch.testing.assert_close(latents, expected, rtol=1e-3, atol=1e-4)
    assert 0 < seconds["denoising"] <= seconds["whole"]


def test_a_row_alone_is_the_same_as_among_others(pictures):
    usual = usual_pictures(pictures, steps=2, guidance_scale=3.0)
    torch.testing.assert_close(usual.run([1], "latent")[0][0], usual.run([0, 1], "latent")[0][1], rtol=1e-3, atol=1e-4)
    assert usual.run([1], "pt")[0].shape[1] == 3


def test_a_plain_network_in_a_loop_makes_the_same_latents(touches):
    own = touches.pipe.unet, touches.pipe.scheduler
    latents, _ = usual_touches(touches, steps=4, guidance_scale=3.0).run([0, 1], "latent")
    expected, report = touches.run(Configuration(DDIM, 4, guidance_scale=3.0))
    torch.testing.assert_close(latents, expected, rtol=1e-3, atol=1e-4)
    assert report.left_out and (touches.pipe.unet, touches.pipe.scheduler) == own


def test_of_a_plain_network_nothing_is_left_out(touches):
    pipe, own = touches.pipe, touches.pipe.unet
    inputs = {name: value[:1] for name, value in touches.inputs.items()}
    try:
        pipe.unet = Plain(own)
        report = pipe(**inputs, output_type="latent").report
    finally:
        pipe.unet = own
    assert not [words for words in report.left_out if "attention" in words or "branch" in words]


# What is chosen -------------------------------------------------------------------------------------------------------


def test_candidates_come_by_evaluations_with_what_was_fitted(pictures):
    pipe = pictures.pipe
    own, fit = pipe.scheduler, {"guidance_scale": 3.0, "sigmas": (9.0, 1.0), "weights": ((), (0.1,))}
    try:
        pipe.scheduler = FittedScheduler(fits=[fit, {**fit, "guidance_scale": 4.0}])
        found = candidates(pipe, 3.0, (2, 3))
    finally:
        pipe.scheduler = own
    counts = [configuration.expected_evaluations for configuration in found]
    assert counts == sorted(counts) and [item.steps for item in found if item.solver == "fitted"] == [2]
    assert {item.guidance_scale for item in found} == {3.0}


def test_the_cheapest_that_comes_within_a_bound_is_found(touches):
    truth = close_reference(touches, 2.0, 40)
    known = candidates(touches.pipe, 2.0, (2, 16))
    found = cheapest_within(touches, known, truth, 0.1)
    assert found.error <= 0.1 and found.evaluations <= 32
    cheaper = [item for item in known if item.expected_evaluations < found.configuration.expected_evaluations]
    with pytest.raises(NotConvergedError):
        cheapest_within(touches, cheaper, truth, 0.1)


def test_the_price_of_an_error_is_that_of_the_fewest_evaluations(touches):
    runs = [
        {"solver": "unipc", "steps": 3, "tolerance": None, "error": 0.1, "evaluations": 3},
        {"solver": "ddim", "steps": 4, "tolerance": None, "error": 0.01, "evaluations": 4},
        {"solver": "adaptive", "steps": None, "tolerance": 0.1, "error": 0.001, "evaluations": 2},
    ]
    prices = price_figures(touches, runs, 1, (0.2, 0.05, 0.001))
    assert {error: price["solver"] for error, price in prices.items()} == {"0.2": "unipc", "0.05": "ddim"}
    assert all(0 < price["low"] <= price["seconds"] <= price["high"] for price in prices.values())


# Figures --------------------------------------------------------------------------------------------------------------


def test_a_speed_up_is_over_what_comes_as_close(gained):
    assert gained["ours"]["error"] <= gained["usual"]["error"]
    assert gained["evaluations"] == 16 / gained["ours"]["evaluations"]
    assert gained["denoising"]["low"] <= gained["denoising"]["high"]


def test_eliminations_change_nothing(touches):
    figures = elimination_figures(touches, rows=(2, 4), repeats=1)
    assert list(figures) == ["2 rows", "4 rows"]
    assert all(found["difference"] <= 1e-5 and found["ratio"] > 0 for found in figures.values())


def test_estimates_of_exact_problems_are_judged_on_other_noise():
    figures = exact_effectivity([make_problem("mixture-1")], samples=(4, 2))
    assert figures["estimates"] == sum(figures["histogram"].values()) > 80
    assert 0.6 < figures["within 0.5 to 2"] <= figures["within 0.3 to 3"] <= 1


def test_where_all_errors_are_rounding_nothing_is_judged():
    figures = exact_effectivity([make_problem("near-delta")], samples=(2, 1))
    assert figures["left_out"] > figures["estimates"]


def test_configurations_that_a_schedule_has_no_steps_for_are_counted():
    problem = make_problem("mixture-1")
    short = replace(problem, schedule_config={**problem.schedule_config, "num_train_timesteps": 50})
    assert exact_effectivity([problem], samples=(2, 1))["refused"] == 0
    assert exact_effectivity([short], samples=(2, 1))["refused"] == 2  # DDIM's 56 and 80 steps


@pytest.mark.parametrize("stored", [False, True])
def test_estimates_of_pipelines_are_judged_where_they_are_calibrated(trained, stored):
    calibration = {"ddim": [{"guidance_scale": 3.0, "indicators": [1e-6, 1.0], "errors": [1e-6, 1.0]}]}
    trained.pipe.register_to_config(calibration=calibration if stored else {})
    wanted = [Configuration(solver, 5, guidance_scale=3.0) for solver in ("ddim", "euler")]
    figures = pipeline_effectivity(trained, close_reference(trained, 3.0, 25), wanted)
    assert figures["calibrated"] == ["ddim"] * stored
    assert figures["estimates"] + figures["left_out"] == stored
    assert figures["by_run"]["estimates"] == figures["estimates"]  # of one sample each
    assert [run["solver"] for run in figures["runs"]] == ["ddim", "euler"]


def test_cases_that_end_otherwise_are_named():
    cases = [
        Case(name, lambda code=code: Ended(torch.zeros(1), 0.0, [code]))
        for name, code in (("fine", ReturnCode.SUCCESS), ("not", ReturnCode.DIVERGED))
    ]
    figures = stability_figures({"few": cases})
    assert figures["wrong"] == ["not"] and (figures["cases"], figures["as_expected"], figures["silent"]) == (2, 1, 0)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="there is no compiler")
def test_a_compiled_network_makes_the_same_touch_and_leaves_the_pipelines_own_in_place(touches):
    run = lambda: called(touches, [0], "latent", num_inference_steps=4, solver="unipc", guidance_scale=2.0)  # noqa: E731
    own = touches.pipe.unet
    torch.testing.assert_close(compiled_calls(touches.pipe, run)()[0], run()[0], rtol=1e-4, atol=1e-4)
    assert touches.pipe.unet is own


# Tables ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("write", [price_table, gains_table, orders_table, effectivity_table, stability_text])
def test_what_was_not_measured_is_no_table(write):
    assert write({}) == ""


def test_orders_stand_beside_nominal_ones():
    orders = [Order("unipc", "gaussian", 1.0, 3.14, 3, 6), Order("ddim", "gaussian", 1.0, None, 1, 2)]
    text = orders_table({"error_and_time": {"orders": order_figures(orders)}})
    assert "| `unipc` | 3 | 3.14 |" in text and "| `ddim` | 1 | - |" in text


def test_tables_say_what_was_measured(touches, gained, capsys):
    figures = {
        "error_and_time": run_parts(
            {
                "speedup": lambda: {"x-to-touch": gained},
                "eliminations": lambda: {"x-to-touch": elimination_figures(touches, (2,), 1)},
                "effectivity": lambda: {"exact": figures_of(Effectivity(np.array([0.4, 1.0, 1.2, 5.0])))},
            }
        )
    }
    assert "speedup:" in capsys.readouterr().err
    gains = gains_table(figures)
    assert "compiled" not in gains
    faster = {**gained, "compiled": {"denoising": {"ratio": 4.0, "low": 3.5, "high": 4.5}}}
    text = gains_table({"error_and_time": {"speedup": {"x-to-touch": faster}}})
    assert "ours compiled 4.00 times (3.50 to 4.50)" in text
    assert "DDIM in 16 steps at guidance 2" in gains and "predictions differ by" in gains
    assert "| **0.5 to 2** | **50.0 %** |" in effectivity_table(figures)


PRICE = {"solver": "unipc", "steps": 8, "seconds": 0.25, "low": 0.2, "high": 0.3}


def test_prices_stand_by_error_with_what_no_run_reached_left_open():
    at = {"guidance_scale": 3.0, "conditions": 8}
    priced = {"touch-to-image": {**at, "prices": {"0.1": PRICE}},
              "x-to-touch": {**at, "prices": {"0.1": PRICE, "0.05": {**PRICE, "steps": 12}}}}  # fmt: skip
    text = price_table({"error_and_time": {"effectivity": priced, "machine": "a laptop"}})
    assert "picture from a touch, guidance 3" in text and text.endswith("Timings: a laptop.")
    paid = "0.25 s (0.20 to 0.30): `unipc`,"
    assert f"| at most 10.0 % | {paid} 8 steps | {paid} 8 steps |" in text
    assert f"| at most 5.0 % | - | {paid} 12 steps |" in text


def test_memory_and_time_outside_are_shares():
    share = {"median": 0.25, "spread": 0.01}
    sizes = {case: {"megabytes": size, "spread": 1.0} for case, size in (("planned", 20.0), ("everything", 80.0))}
    memory = {**sizes, "family": sizes["everything"], "repeats": 3, "share_of_everything": share,
              "share_of_family": share, "seconds_in_float16": {"ratio": 1.2, "spread": 0.1}}  # fmt: skip
    overhead = {"steps": 20, "repeats": 9, "touch_to_image": share, "x_to_touch": share}
    text = gains_table({"memory": memory, "overhead": overhead})
    assert "20 MB: 25.0 % of the whole pipeline's 80 MB (spread 1.0 points)" in text and "1.20 times" in text
    assert "picture from a touch: 25.0 % (spread 1.0 points); touch from words: 25.0 %" in text


def test_the_stability_of_solvers_and_of_the_world_is_told_in_words():
    grid = {
        "1x": {"error": 0.02, "seconds": 0.004, "order": 2.0},
        "2x": {"error": 0.005, "seconds": 0.02, "order": None},
    }
    cases = {"cases": 9, "as_expected": 8, "silent": 0}
    lines = stability_text({"error_and_time": {"stability": cases, "physics": {"a gel": grid}}}).splitlines()
    assert lines[0].startswith("Of 9 stiff and extreme cases 8 end as expected; 0 leave")
    assert lines[1:] == [
        "",
        "What the world renders, a gel, against a far finer one: 2.0 % in 4.0 ms at 1x its resolution, 0.5 % in "
        "20.0 ms at 2x its resolution, which is order 2.0.",
    ]


def test_the_usual_way_is_diffusers_own_ddim_in_its_own_steps(pictures):
    usual = usual_pictures(pictures)
    assert (usual.steps, usual.guidance_scale) == (50, 9.0)
    assert type(diffusers_unclip(pictures.pipe).scheduler) is DDIMScheduler
