"""Error against run time: what is measured on problems and pipelines, orders, the front, and the chart."""

import json
from dataclasses import replace

import pytest
import torch
from diffusers import DDIMScheduler
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.text import Text
from PIL import Image

from tests.helpers.components import make_pipelines
from unitouch_gen.numerics import work_precision
from unitouch_gen.numerics.problems import PROBLEMS, STABLE_DIFFUSION
from unitouch_gen.numerics.reference import relative_rms
from unitouch_gen.numerics.work_precision import measure, pareto_front, pipeline_target, problem_target
from unitouch_gen.sampling import Guidance

GAUSSIAN = problem_target(PROBLEMS["gaussian"], 3)
MODALITIES = {"touch-to-image": ("touch",), "stylize": ("image", "touch"), "x-to-touch": ("image",)}


PIPES = make_pipelines()
PIPES["touch-to-image"].register_to_config(default_noise_level=300)


@pytest.mark.parametrize("solver", ["ddim", "heun", "unipc", "diffusers:ddim", "diffusers:dpm++2m"])
def test_a_row_has_the_error_against_the_closed_form(solver):
    row = measure(GAUSSIAN, solver, 12, repeats=1)
    assert row["error_low"] <= row["error"] <= row["error_high"] < 0.3 and row["failures"] == 0
    assert row["evaluations"] == (23 if solver == "heun" else 12) and row["seconds"] > 0
    if solver == "ddim":
        latents, _ = PROBLEMS["gaussian"].run(GAUSSIAN.noise, "ddim", num_inference_steps=12)
        assert row["error"] == pytest.approx(relative_rms(latents, GAUSSIAN.truth).median().item(), rel=1e-5)


def test_what_cannot_be_run_or_breaks_is_a_row_as_well():
    failed = measure(GAUSSIAN, "diffusers:ddim", 1000)  # leading spacing with an offset has no 1000 steps
    assert failed["failures"] == 3 and failed["reason"].startswith("InvalidInputError: `num_inference_steps` is 1000")
    broken = replace(GAUSSIAN, network=lambda z, timestep: z.index_fill(0, torch.tensor(1), torch.nan))
    row = measure(broken, "euler", 5, repeats=1)
    assert (row["failures"], row["reason"]) == (1, "non_finite") and row["error"] > 0.1


@pytest.mark.parametrize(("name", "scale"), [("touch-to-image", 2.0), ("stylize", 2.0), ("x-to-touch", 1.0)])
def test_the_flow_of_a_pipeline_is_the_one_that_its_call_follows(name, scale):
    """The same latents from the same noise; solvers come to the reference."""
    pipe, inputs = PIPES[name], work_precision.world_inputs(MODALITIES[name], 1)
    # Of few levels: a network of random weights changes with every one of them.
    pipe.scheduler = DDIMScheduler(num_train_timesteps=20, beta_start=0.02, beta_end=0.2)
    pipe.set_progress_bar_config(disable=True)
    options = {"layout": None} if name == "stylize" else {}
    target = pipeline_target(pipe, inputs, seeds=2, guidance_scale=scale, rtol=0.3, **options)
    generator = torch.Generator().manual_seed(0)
    inputs = {key: value.expand(2, -1, -1, -1) for key, value in inputs.items()}
    call = {"solver": "dpm++2m", "num_inference_steps": 4, "guidance_scale": scale, "output_type": "latent"}
    output = pipe(**inputs, latents=target.noise, generator=generator, **call, **options)
    exact = measure(replace(target, truth=output.images.double()), "dpm++2m", 4, repeats=1)
    assert exact["error"] < 1e-5 and not exact["default"]
    coarse, fine = (measure(target, "unipc", steps, repeats=1)["error"] for steps in (5, 20))
    assert fine < 0.1 and fine < coarse
    assert measure(target, "default", 2, repeats=1)["default"] and not pipe.unet._forward_pre_hooks


def test_a_baseline_is_diffusers_own_scheduler():
    scheduler = DDIMScheduler(**STABLE_DIFFUSION, clip_sample=False, set_alpha_to_one=False, steps_offset=1)
    scheduler.set_timesteps(7)
    z = GAUSSIAN.noise.float()
    for timestep in scheduler.timesteps:
        z = scheduler.step(GAUSSIAN.network(z, timestep), timestep, z, return_dict=False)[0]
    row = measure(GAUSSIAN, "diffusers:ddim", 7, repeats=1)
    assert row["error"] == pytest.approx(relative_rms(z, GAUSSIAN.truth).median().item(), rel=1e-5)


def test_a_distilled_network_runs_in_few_steps_without_guidance():
    """In one step it is its prediction of the data from noise, as DDIM's."""
    guided = replace(GAUSSIAN, turbo=lambda z, timestep: 0.5 * GAUSSIAN.network(z, timestep), guidance=Guidance(7.5))
    row, alone = measure(guided, "turbo", 1, repeats=1), replace(GAUSSIAN, network=guided.turbo)
    assert row["error"] == pytest.approx(measure(alone, "ddim", 1, repeats=1)["error"], rel=1e-4)
    assert measure(guided, "turbo", 4, repeats=1)["evaluations"] == 4


def row(steps: int = 10, error: float = 0.01, solver: str = "heun", **values) -> dict:
    known = {"tolerance": None, "error_low": error, "error_high": error, "evaluations": steps, "seconds": steps / 100}
    return {"solver": solver, "steps": steps, "error": error, "failures": 0, "default": False, **known, **values}


@given(st.lists(st.tuples(st.integers(1, 50), st.floats(1e-6, 1.0)), min_size=1))
def test_the_front_is_what_no_other_beats(points):
    rows = [row(steps, error) for steps, error in points]
    front = pareto_front(rows, "evaluations")
    assert front
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
