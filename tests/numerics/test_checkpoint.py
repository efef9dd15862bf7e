"""What a pipeline brings beside its weights: fitted steps are used, stored and judged on other contacts."""

import pytest
import torch

from tests.helpers.components import make_components, make_x_to_touch
from unitouch_gen.numerics import checkpoint
from unitouch_gen.numerics.fitting import exact_path
from unitouch_gen.numerics.reference import relative_rms
from unitouch_gen.numerics.subjects import Configuration
from unitouch_gen.pipelines import XToTouchPipeline


@pytest.fixture(scope="module")
def pipe() -> XToTouchPipeline:
    parts = make_components()
    shared = {key: parts[key] for key in ("unitouch", "processor")}
    # A random network of noise would leave all of the noise in, and end diverged.
    shared["scheduler"] = parts["scheduler"].from_config(parts["scheduler"].config, prediction_type="v_prediction")
    pipe = XToTouchPipeline(**shared, **make_x_to_touch(), sensors=["gelsight", "digit"],
                            default_num_inference_steps=4, default_guidance_scale=2.0)  # fmt: skip
    pipe.set_progress_bar_config(disable=True)
    return pipe


@pytest.fixture(scope="module")
def subject(pipe):
    return checkpoint.fresh(pipe, checkpoint.trained_contacts(pipe, ("image",), 8), "x-to-touch", seed=1)


@pytest.fixture(scope="module")
def fits(subject):
    return checkpoint.fit_pipeline(subject, [2.0], [4], told=lambda line: None)


def test_contacts_are_of_all_sensors_in_turn(pipe):
    inputs = checkpoint.trained_contacts(pipe, ("image",), 3)
    assert inputs["sensor"] == ["gelsight", "digit", "gelsight"] and len(inputs["image"]) == 3


def test_each_contact_starts_from_a_noise_of_its_own(subject):
    assert len(torch.unique(subject.noise, dim=0)) == 8


def test_a_call_runs_the_steps_that_were_fitted(pipe, subject, fits):
    own = pipe.scheduler
    try:
        pipe.scheduler = checkpoint.with_fits(own, fits, "dpm++2m")
        latents, report = subject.run(Configuration("own", 4, guidance_scale=2.0))
        assert (report.solver, report.evaluations) == ("fitted", 4)
        named = subject.run(Configuration("dpm++2m", 4, guidance_scale=2.0))[0]
        truth = exact_path(subject.flow(2.0, subject.parts[0]), subject.noise).end
        assert relative_rms(latents, truth).median() < relative_rms(named, truth).median()
    finally:
        pipe.scheduler = own


@pytest.mark.parametrize("call", [
    {"num_inference_steps": 5}, {"guidance_scale": 3.0}, {"guidance_interval": (0.2, 0.8)}, {"tolerance": 0.3},
])  # fmt: skip
def test_other_calls_run_otherwise(pipe, fits, call):
    own = pipe.scheduler
    call = {"num_inference_steps": 4, "guidance_scale": 2.0, **call}
    if "tolerance" in call:
        del call["num_inference_steps"]
    try:
        pipe.scheduler = checkpoint.with_fits(own, fits, "dpm++2m")
        report = pipe(image=checkpoint.trained_contacts(pipe, ("image",), 1)["image"], throw=False, **call).report
    finally:
        pipe.scheduler = own
    assert report.solver == ("adaptive" if "tolerance" in call else "dpm++2m")


def test_saved_with_its_fits_and_calibration_a_pipeline_has_them_when_loaded(pipe, fits, tmp_path):
    own = pipe.scheduler
    stored = {"fitted": [{"guidance_scale": 2.0, "indicators": [1e-3, 1.0], "errors": [1e-4, 0.1]}]}
    try:
        pipe.scheduler = checkpoint.with_fits(own, fits, "dpm++2m")
        pipe.register_to_config(calibration=stored)
        pipe.save_pretrained(tmp_path)
    finally:
        pipe.scheduler = own
        pipe.register_to_config(calibration={})
    loaded = XToTouchPipeline.from_pretrained(tmp_path)
    loaded.set_progress_bar_config(disable=True)
    assert loaded.scheduler.fits == fits
    image = checkpoint.trained_contacts(pipe, ("image",), 1)["image"]
    report = loaded(image=image, output_type="latent", throw=False).report
    assert report.calibrated and report.solver == "fitted"
    assert not loaded(image=image, output_type="latent", guidance_scale=3.0, throw=False).report.calibrated


def test_new_fits_join_those_that_were_there(pipe, fits):
    first = checkpoint.with_fits(pipe.scheduler, fits, "unipc")
    shorter = checkpoint.Fit(2.0, fits[0].sigmas[:1], ((),))
    assert {fit.steps for fit in checkpoint.with_fits(first, [shorter], "unipc").fits} == {1, 4}


def test_a_calibration_covers_every_solver(subject, monkeypatch):
    monkeypatch.setattr(checkpoint, "PATH_EVALUATIONS", 40)
    monkeypatch.setattr(checkpoint, "CALIBRATED_STEPS", (3, 4, 5, 6))
    monkeypatch.setattr(checkpoint, "TOLERANCES", (0.5, 0.3))
    stored = checkpoint.calibrate_pipeline(subject, told=lambda line: None)
    assert {"ddim", "euler", "heun", "dpm++2m", "unipc", "deis", "adaptive"} <= set(stored)
    assert all(entry["guidance_scale"] == 2.0 for (entry,) in stored.values())
