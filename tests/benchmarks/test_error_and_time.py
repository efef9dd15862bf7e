"""Error against run time: what is compared with, and what is chosen."""

import shutil
from functools import partial

import pytest
import torch
from diffusers import DDIMScheduler, UNet2DConditionModel

from tests.benchmarks.error_and_time import (
    BASELINES,
    DDIM,
    MULTISTEP,
    Plain,
    called,
    candidates,
    cheapest,
    cheapest_within,
    close_reference,
    compiled_call,
    cost_figures,
    diffusers_pictures,
    diffusers_unclip,
    end_of,
    order_figures,
    picture_target,
    plain_touches,
    speedup_figures,
    touch_target,
)
from tests.helpers.components import make_components, make_x_to_touch
from unitouch_gen.conditioning import SensorBackgrounds
from unitouch_gen.errors import NotConvergedError
from unitouch_gen.numerics.targets import Configuration
from unitouch_gen.numerics.work_precision import Result
from unitouch_gen.pipelines import TouchToImagePipeline, XToTouchPipeline
from unitouch_gen.schedulers.solvers import SOLVERS

pytestmark = pytest.mark.filterwarnings("ignore::unitouch_gen.errors.UnfamiliarInputWarning")  # networks are random

FEW = {"default_num_inference_steps": 3, "default_guidance_scale": 2.0}
FOUR = {"num_inference_steps": 4, "guidance_scale": 3.0}


@pytest.fixture(scope="module")
def pictures():
    pipe = TouchToImagePipeline(**make_components(), **FEW, default_noise_level=300)
    pipe.set_progress_bar_config(disable=True)
    return picture_target(pipe, 2)


@pytest.fixture(scope="module")
def touches():
    """Of a network that is shown untouched gels."""
    parts = make_components() | make_x_to_touch()
    parts = {key: part for key, part in parts.items() if key in XToTouchPipeline.__init__.__annotations__}
    parts["unet"] = UNet2DConditionModel.from_config(parts["unet"].config, in_channels=6, num_class_embeds=3).eval()
    gels = SensorBackgrounds.of(torch.randn(2, 3, 8, 8, generator=torch.Generator().manual_seed(0)))
    pipe = XToTouchPipeline(**parts, **FEW, backgrounds=gels, sensors=["gelsight", "digit"])
    pipe.set_progress_bar_config(disable=True)
    return touch_target(pipe, 2)


# Solvers --------------------------------------------------------------------------------------------------------------


def test_where_solvers_end():
    assert {name: end_of(name) for name in SOLVERS} == {
        "ddim": "zero", "euler": "denoise", "heun": "extrapolate", "dpm++2m": "extrapolate", "unipc": "extrapolate",
        "deis": "extrapolate",
    }  # fmt: skip


@pytest.mark.parametrize("solver", [name for name in SOLVERS if name != "ddim"])
def test_a_named_solver_reaches_its_nominal_order(solver):
    order = order_figures(["mixture"], [solver], steps=(16, 24, 32, 48), seeds=4)[solver]
    assert order["fitted"] == {"mixture": pytest.approx(order["nominal"], abs=0.25)}


def test_ddim_in_uniform_timesteps_falls_short_of_first_order():
    """Its last steps in log sigma stay as long however many there are, which costs a logarithm."""
    order = order_figures(["mixture"], ["ddim"], steps=(16, 32, 64), seeds=4)["ddim"]
    assert 0.6 < order["fitted"]["mixture"] < 0.9


# The usual way --------------------------------------------------------------------------------------------------------


def test_diffusers_pipeline_makes_the_same_latents_from_the_same_start(pictures):
    latents, seconds = diffusers_pictures(pictures, [0, 1], "latent", **FOUR)
    expected, _ = pictures.run(Configuration(DDIM, 4, guidance_scale=3.0))
    torch.testing.assert_close(latents, expected, rtol=1e-3, atol=1e-4)
    assert 0 < seconds["denoising"] <= seconds["whole"]
    assert type(diffusers_unclip(pictures.pipe).scheduler) is DDIMScheduler


def test_a_row_alone_is_the_same_as_among_others(pictures):
    run = partial(diffusers_pictures, pictures, **FOUR)
    torch.testing.assert_close(run([1], "latent")[0][0], run([0, 1], "latent")[0][1], rtol=1e-3, atol=1e-4)
    assert run([1], "pt")[0].shape[1] == 3


def test_a_plain_network_in_a_loop_makes_the_same_latents(touches):
    own = touches.pipe.unet, touches.pipe.scheduler
    latents, _ = plain_touches(touches, [0, 1], "latent", **FOUR)
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


def test_the_usual_way_takes_the_papers_steps_and_guidance():
    assert [settings[2:] for settings in BASELINES.values()] == [(50, 9.0), (200, 7.5)]


# What is chosen -------------------------------------------------------------------------------------------------------


def test_candidates_come_by_evaluations():
    found = candidates(3.0, (2, 3))
    counts = [configuration.expected_evaluations for configuration in found]
    assert counts == sorted(counts) and {item.guidance_scale for item in found} == {3.0}


def test_the_cheapest_that_comes_within_a_bound_is_found(touches):
    truth = close_reference(touches, 2.0, 40)
    known = candidates(2.0, (2, 16))
    chosen = cheapest_within(touches, known, truth, 0.03)
    assert chosen.error <= 0.03 and chosen.evaluations <= 32
    cheaper = [item for item in known if item.expected_evaluations < chosen.expected_evaluations]
    with pytest.raises(NotConvergedError):
        cheapest_within(touches, cheaper, truth, 0.03)


def test_a_speed_up_is_over_what_comes_as_close(touches):
    figures = speedup_figures(touches, plain_touches, "plain", 16, 2.0, repeats=2, tried=(16,), evaluations=30)
    assert figures["ours"]["error"] <= figures["baseline"]["error"]
    assert figures["evaluations"] == 16 / figures["ours"]["evaluations"]
    assert figures["denoising"]["low"] <= figures["denoising"]["high"]
    assert "compiled" not in figures


def test_the_cost_of_an_error_is_that_of_the_fewest_evaluations(touches):
    figures = cost_figures(touches, (0.2, 1e-9), steps=(3, 6), evaluations=30)
    assert figures["guidance_scale"] == 2.0 and figures["conditions"] == 2
    (cost,) = figures["cost_at_error"].values()
    assert cost["error"] <= 0.2 and cost["solver"] in MULTISTEP


def test_of_results_that_are_good_enough_the_one_with_the_fewest_evaluations_is_cheapest():
    results = [Result("unipc", steps, error=error, evaluations=steps) for steps, error in ((3, 0.1), (4, 0.01))]
    results.append(Result("deis", 4, error=0.02, evaluations=4))
    assert [cheapest(results, error) for error in (0.2, 0.05, 0.001)] == [results[0], results[1], None]


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="there is no compiler")
def test_a_compiled_network_makes_the_same_touch_and_leaves_the_pipelines_own_in_place(touches):
    run = partial(called, touches, [0], "latent", num_inference_steps=4, solver="unipc", guidance_scale=2.0)
    own = touches.pipe.unet
    torch.testing.assert_close(compiled_call(touches.pipe, run)()[0], run()[0], rtol=1e-4, atol=1e-4)
    assert touches.pipe.unet is own
