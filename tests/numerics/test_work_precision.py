"""Error against run time: what is measured on problems and pipelines, orders, the front, and the chart."""

import copy
import json
from dataclasses import replace

import pytest
import torch
from diffusers import DDIMScheduler, LCMScheduler
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.text import Text
from PIL import Image

from tests.helpers.components import make_pipelines
from unitouch_gen.numerics import work_precision
from unitouch_gen.numerics.problems import PROBLEMS, STABLE_DIFFUSION, relative_rms
from unitouch_gen.numerics.work_precision import measure, pareto_front, pipeline_target, problem_target

PROBLEM = PROBLEMS["gaussian"]
GAUSSIAN = problem_target(PROBLEM, 3)
NOISE = PROBLEM.noise(3)
MODALITIES = {"touch-to-image": ("touch",), "stylize": ("image", "touch"), "x-to-touch": ("image",)}


PIPES = make_pipelines()
for each in PIPES.values():
    # Of few levels: a network of random weights changes with every one of them.
    each.scheduler = DDIMScheduler(num_train_timesteps=40, beta_start=0.015, beta_end=0.15)
    each.set_progress_bar_config(disable=True)


@pytest.mark.parametrize("solver", ["ddim", "heun", "unipc", "diffusers:ddim", "diffusers:dpm++2m"])
def test_a_row_has_the_error_against_the_closed_form(solver):
    row = measure(GAUSSIAN, solver, 12, repeats=1)
    assert row["error_low"] <= row["error"] <= row["error_high"] < 0.3
    assert row["failures"] == 0
    assert row["evaluations"] == (23 if solver == "heun" else 12)
    assert row["seconds"] > 0
    if solver == "ddim":
        latents, _ = PROBLEM.run(NOISE, "ddim", num_inference_steps=12)
        assert row["error"] == pytest.approx(relative_rms(latents, GAUSSIAN.truth).median().item(), rel=1e-5)


def test_work_precision_has_a_row_for_runs_that_fail():
    failed = measure(GAUSSIAN, "diffusers:ddim", 1000)  # leading spacing with an offset has no 1000 steps
    assert failed["failures"] == 3
    assert failed["reason"].startswith("InvalidInputError: `num_inference_steps` is 1000")
    pipe = PIPES["x-to-touch"]
    inputs = {"condition_embeds": torch.ones(2, 1, 16)}
    target = pipeline_target(pipe, inputs, seeds=1, guidance_scale=1.0)
    hook = pipe.unet.register_forward_hook(lambda _, args, out: (out[0].index_fill(0, torch.tensor(1), torch.nan),))
    row = measure(target, "euler", 5, repeats=1)
    hook.remove()
    assert (row["failures"], row["reason"]) == (1, "non_finite")
    assert row["error"] > 0.0


@pytest.mark.parametrize(("name", "scale"), [("touch-to-image", 2.0), ("stylize", 2.0), ("x-to-touch", 1.0)])
def test_solvers_come_to_the_reference_of_a_pipeline(name, scale):
    pipe = PIPES[name]
    inputs = work_precision.world_inputs(MODALITIES[name], 1)
    target = pipeline_target(pipe, inputs, seeds=2, guidance_scale=scale)
    coarse, fine = (measure(target, "heun", steps, repeats=1) for steps in (4, 20))
    assert fine["error"] < 0.1
    assert fine["error"] < coarse["error"]
    assert len(target.truth) == 2
    assert measure(target, "diffusers:dpm++2m", 20, repeats=1)["error"] < coarse["error"]
    assert type(pipe.scheduler) is DDIMScheduler  # as before
    assert not fine["default"]
    assert measure(target, "default", target.default_steps, repeats=1)["default"]


def test_a_baseline_is_diffusers_own_scheduler():
    scheduler = DDIMScheduler(**STABLE_DIFFUSION, clip_sample=False, set_alpha_to_one=False, steps_offset=1)
    scheduler.set_timesteps(7)
    z = NOISE.float()
    network = PROBLEM.network(3)
    for timestep in scheduler.timesteps:
        z = scheduler.step(network(z, timestep), timestep, z, return_dict=False)[0]
    row = measure(GAUSSIAN, "diffusers:ddim", 7, repeats=1)
    assert row["error"] == pytest.approx(relative_rms(z, GAUSSIAN.truth).median().item(), rel=1e-5)
    zero_snr = DDIMScheduler(rescale_betas_zero_snr=True)
    for name in work_precision.BASELINES:
        assert work_precision.scheduler_of(name, zero_snr).alphas_cumprod[-1] < 1e-6


def test_a_distilled_pipeline_runs_at_its_timesteps_without_guidance():
    pipe = PIPES["x-to-touch"]
    inputs = {"condition_embeds": torch.ones(1, 1, 16)}
    timesteps = [999, 619, 299, 79]
    turbo = copy.copy(pipe)
    turbo.scheduler = LCMScheduler()
    turbo.register_to_config(default_num_inference_steps=4, default_timesteps=timesteps)
    target = pipeline_target(pipe, inputs, seeds=2, guidance_scale=3.0, turbo=turbo)
    call = {**inputs, "num_images_per_prompt": 2, "guidance_scale": 1.0, "output_type": "latent"}
    for steps, way in ((2, {"num_inference_steps": 2}), (4, {"timesteps": timesteps})):
        latents = turbo(**call, **way, generator=torch.Generator().manual_seed(0)).images
        row = measure(target, "turbo", steps, repeats=1)
        assert row["error"] == pytest.approx(relative_rms(latents, target.truth).mean().item(), rel=1e-4)
        assert row["evaluations"] == steps


def row(steps: int = 10, error: float = 0.01, solver: str = "heun", **values) -> dict:
    known = {"tolerance": None, "error_low": error, "error_high": error, "evaluations": steps, "seconds": steps / 100}
    told = {"failures": 0, "default": False, "noisy": False}
    return {"solver": solver, "steps": steps, "error": error, **told, **known, **values}


@given(st.lists(st.tuples(st.integers(1, 50), st.floats(1e-6, 1.0)), min_size=1))
def test_the_front_is_what_no_other_beats(points):
    rows = [row(steps, error) for steps, error in points]
    front = pareto_front(rows, "evaluations")
    assert front
    assert pareto_front([*rows, row(1, 1e-9, "turbo", noisy=True)], "evaluations") == front
    for one in rows:
        beaten = [each for each in rows if each["evaluations"] <= one["evaluations"] and each["error"] < one["error"]]
        assert one not in front or not beaten


def test_files_are_rows_and_a_chart_of_them(tmp_path):
    rows = [row(steps, 1.0 / steps**2) for steps in (5, 10, 20, 40)]
    rows += [row(3, 0.3, "default", default=True), {**row(5, solver="unipc"), "failures": 8, "reason": "diverged"}]
    failed = {key: value for key, value in rows[-1].items() if key not in ("error", "seconds", "evaluations")}
    target = replace(GAUSSIAN, own_error=3e-5)
    results, png = work_precision.save(tmp_path, target, [*rows, failed])
    assert json.loads(results.read_text())["rows"][0] == rows[0]
    with Image.open(png) as picture:
        assert len(picture.convert("RGB").getcolors(2**24)) > 50
    words = {text.get_text() for text in work_precision.draw_chart(target, rows).findobj(Text)}
    assert {"heun", "reference's own error 3e-05"} <= words
    work_precision.save(tmp_path, GAUSSIAN, [failed])  # nothing but failures is a chart as well
