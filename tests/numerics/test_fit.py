"""What a checkpoint brings beside its weights: steps that were fitted to it, and what its error indicators stand for.

Steps against closed forms, and against named solvers on noise that was not fitted on; calibrations against a law they
are drawn from; both used, stored and judged on other contacts.
"""

from dataclasses import asdict
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch

from tests.benchmarks.error_and_time import fit_calibrations
from tests.helpers.components import make_components, make_x_to_touch
from unitouch_gen.numerics import fit
from unitouch_gen.numerics.fit import (
    SPACINGS,
    Observation,
    calibrate_pipeline,
    exact_path,
    fit_calibration,
    fit_pipeline,
    fit_steps,
    noise_levels,
    observe,
    side_by_side,
    trained_contacts,
    with_fits,
)
from unitouch_gen.numerics.problems import make_problem
from unitouch_gen.numerics.reference import relative_rms
from unitouch_gen.numerics.targets import Configuration, PipelineTarget, ProblemTarget
from unitouch_gen.numerics.work_precision import configurations
from unitouch_gen.pipelines import XToTouchPipeline
from unitouch_gen.schedulers.exponential import Calibration
from unitouch_gen.schedulers.fitted import Fit, FittedScheduler
from unitouch_gen.schedulers.solvers import SOLVERS, make_scheduler

# Steps ----------------------------------------------------------------------------------------------------------------


def run(problem, scheduler, noise, steps: int) -> torch.Tensor:
    """Through the sampling loop."""
    return problem.run(noise, scheduler, steps, throw=False)[0]


@pytest.mark.parametrize("name", ["gaussian", "gaussian-guided"])
def test_the_path_is_the_closed_form(name):
    problem = make_problem(name)
    noise = problem.noise(4)
    path = exact_path(problem.flow, noise)
    for sigma in (10.0, 1.0, 0.1):
        assert relative_rms(path.at(sigma), problem.solution(noise, sigma)).max() < 1e-3
    assert relative_rms(path.end, problem.solution(noise)).max() < 1e-3


def error_of(fitted: tuple[Fit, float]) -> float:
    return fitted[1]


@pytest.fixture(scope="module")
def guided():
    """A guided mixture, and fits of it on 32 noises."""
    problem = make_problem("mixture-7.5")
    path = exact_path(problem.flow, problem.noise(32, seed=1))
    found = {
        steps: min(
            (
                fit_steps(problem.flow, path, problem.guidance_scale, noise_levels(problem.flow, steps, rho))
                for rho in SPACINGS
            ),
            key=error_of,
        )
        for steps in (8, 12)
    }
    config = problem.scheduler().config
    shared = {key: config[key] for key in ("num_train_timesteps", "beta_start", "beta_end", "beta_schedule",
                                           "trained_betas", "prediction_type")}  # fmt: skip
    scheduler = FittedScheduler(**shared, fits=[asdict(fit) for fit, _ in found.values()])
    return problem, found, scheduler


@pytest.mark.parametrize("steps", [8, 12])
def test_on_other_noise_fitted_steps_err_less_than_any_named_solver(guided, steps):
    problem, _, scheduler = guided
    noise = problem.noise(16, seed=2)
    truth = exact_path(problem.flow, noise, 400).end
    errors = {}
    for name in ("fitted", "dpm++2m", "unipc", "deis", "ddim"):
        chosen = make_scheduler(scheduler, name, steps=steps, guidance_scale=problem.guidance_scale)
        errors[name] = relative_rms(run(problem, chosen, noise, steps), truth).median().item()
    assert errors.pop("fitted") < 0.7 * min(errors.values())


def test_what_the_fit_promises_is_what_a_run_leaves(guided):
    """The same noise through the scheduler, in float32."""
    problem, found, scheduler = guided
    noise = problem.noise(32, seed=1)
    truth = exact_path(problem.flow, noise).end
    chosen = make_scheduler(scheduler, None, steps=8, guidance_scale=problem.guidance_scale)
    errors = relative_rms(run(problem, chosen, noise, 8), truth)
    assert errors.log().mean().exp().item() == pytest.approx(found[8][1], rel=0.02)


def test_more_steps_leave_less(guided):
    _, found, _ = guided
    assert found[12][1] < 0.6 * found[8][1]


def test_one_step_is_the_mean_of_the_data():
    """D at the largest level, as nothing came before it."""
    problem = make_problem("gaussian")
    noise = problem.noise(4)
    fit, _ = fit_steps(
        problem.flow, exact_path(problem.flow, noise, 60), 1.0, noise_levels(problem.flow, 1, SPACINGS[0])
    )
    assert fit.weights == ((),) and fit.sigmas[0] == pytest.approx(problem.schedule.sigma_max)


def test_levels_fall_from_the_first_of_training(guided):
    problem = guided[0]
    levels = noise_levels(problem.flow, 10, 4.0)
    assert levels[0] == pytest.approx(problem.schedule.sigma_max)
    assert all(high > low for high, low in pairwise(levels))


# A pipeline with its fits ---------------------------------------------------------------------------------------------


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
def target(pipe):
    return PipelineTarget(pipe, trained_contacts(pipe, ("image",), 8), name="x-to-touch", seeds=1, noise_seed=1)


@pytest.fixture(scope="module")
def fits(target):
    return fit_pipeline([target], [2.0], [4], told=lambda line: None)


def test_contacts_are_of_all_sensors_in_turn(pipe):
    inputs = trained_contacts(pipe, ("image",), 3)
    assert inputs["sensor"] == ["gelsight", "digit", "gelsight"] and len(inputs["image"]) == 3


def test_each_contact_starts_from_a_noise_of_its_own(target):
    assert len(torch.unique(target.noise, dim=0)) == 8


def test_a_call_runs_the_steps_that_were_fitted(pipe, target, fits):
    before = pipe.scheduler
    try:
        pipe.scheduler = with_fits(before, fits, "dpm++2m")
        latents, report = target.run(Configuration("default", 4, guidance_scale=2.0))
        assert (report.solver, report.evaluations) == ("fitted", 4)
        named = target.run(Configuration("dpm++2m", 4, guidance_scale=2.0))[0]
        truth = exact_path(target.flow(2.0, target.parts[0]), target.noise).end
        assert relative_rms(latents, truth).median() < relative_rms(named, truth).median()
    finally:
        pipe.scheduler = before


@pytest.mark.parametrize("call", [
    {"num_inference_steps": 5}, {"guidance_scale": 3.0}, {"guidance_interval": (0.2, 0.8)}, {"tolerance": 0.3},
])  # fmt: skip
def test_other_calls_run_otherwise(pipe, fits, call):
    before = pipe.scheduler
    call = {"num_inference_steps": 4, "guidance_scale": 2.0, **call}
    if "tolerance" in call:
        del call["num_inference_steps"]
    try:
        pipe.scheduler = with_fits(before, fits, "dpm++2m")
        report = pipe(image=trained_contacts(pipe, ("image",), 1)["image"], throw=False, **call).report
    finally:
        pipe.scheduler = before
    assert report.solver == ("adaptive" if "tolerance" in call else "dpm++2m")


def test_saved_with_its_fits_and_calibration_a_pipeline_has_them_when_loaded(pipe, fits, tmp_path):
    before = pipe.scheduler
    stored = {"fitted": [{"guidance_scale": 2.0, "indicators": [1e-3, 1.0], "errors": [1e-4, 0.1]}]}
    try:
        pipe.scheduler = with_fits(before, fits, "dpm++2m")
        pipe.register_to_config(calibration=stored)
        pipe.save_pretrained(tmp_path)
    finally:
        pipe.scheduler = before
        pipe.register_to_config(calibration={})
    loaded = XToTouchPipeline.from_pretrained(tmp_path)
    loaded.set_progress_bar_config(disable=True)
    assert loaded.scheduler.fits == fits
    image = trained_contacts(pipe, ("image",), 1)["image"]
    report = loaded(image=image, output_type="latent", throw=False).report
    assert report.error_estimate and report.solver == "fitted"
    assert "solver error about" in str(report)
    loaded.register_to_config(calibration={"fitted": [{**stored["fitted"][0], "share": 0.7}]})
    assert not loaded(image=image, output_type="latent", throw=False).report.error_estimate
    other = loaded(image=image, output_type="latent", guidance_scale=3.0, throw=False).report
    assert other.error_indicator and not other.error_estimate and "solver error" not in str(other)


def test_new_fits_join_those_that_were_there(pipe, fits):
    first = with_fits(pipe.scheduler, fits, "unipc")
    shorter = Fit(2.0, fits[0].sigmas[:1], ((),))
    assert {fit.steps for fit in with_fits(first, [shorter], "unipc").fits} == {1, 4}


def test_a_calibration_covers_solvers_at_every_guidance(target, monkeypatch):
    monkeypatch.setattr(fit, "CALIBRATION_EVALUATIONS", 40)
    monkeypatch.setattr(fit, "CALIBRATED_STEPS", (3, 4, 5, 6))
    monkeypatch.setattr(fit, "CALIBRATED_TOLERANCES", (0.5, 0.3))
    stored = calibrate_pipeline([target], [1.0, 3.0], told=lambda line: None)
    assert set(stored) == {"ddim", "dpm++2m", "unipc", "adaptive"}
    for solver in stored:
        steps = None if solver == "adaptive" else 5
        low, high = (Calibration.find(stored, solver, scale, steps) for scale in (1.0, 3.0))
        assert None not in (low, high) and low != high
        assert Calibration.find(stored, solver, 0.5, steps) == low
        assert Calibration.find(stored, solver, 2.5, steps) == high
        assert Calibration.find(stored, solver, 3.5, steps) is None


def test_a_calibration_is_of_the_nearest_number_of_steps_within_twice_or_half():
    def entry(error: float, **steps: int | None) -> dict[str, Any]:
        return {"guidance_scale": 2.0, "indicators": (1e-3, 1.0), "errors": (1e-4, error), **steps}

    stored = {
        "ddim": [entry(0.1, steps=6), entry(0.2, steps=16)],
        "unipc": [entry(0.3)],
        "adaptive": [entry(0.4, steps=None)],
    }
    taken = {number: Calibration.find(stored, "ddim", 2.0, number) for number in (2, 3, 9, 10, 32, 33)}
    assert {number: found and found.errors[1] for number, found in taken.items()} == {
        2: None, 3: 0.1, 9: 0.1, 10: 0.2, 32: 0.2, 33: None,
    }  # fmt: skip
    for solver, number in (("unipc", 3), ("unipc", 300), ("adaptive", None)):  # of any number, or of none
        assert Calibration.find(stored, solver, 2.0, number) is not None


# Estimates ------------------------------------------------------------------------------------------------------------


def drawn(count: int = 200, spread: float = 0.2, seed: int = 0) -> list[Observation]:
    """error = 3 indicator^1.4 times noise."""
    random = np.random.default_rng(seed)
    indicators = np.exp(random.uniform(np.log(1e-4), np.log(0.3), count))
    errors = 3 * indicators**1.4 * np.exp(spread * random.standard_normal(count))
    pairs = enumerate(zip(indicators, errors, strict=True))
    return [Observation("unipc", float(indicator), float(error), number) for number, (indicator, error) in pairs]


def effectivities(seen: list[Observation], fitted: list[Observation]) -> np.ndarray:
    """Estimate over true error (Ainsworth & Oden, 2000, "A Posteriori Error Estimation", Section 1)."""
    calibrations = fit_calibrations(fitted)
    return np.array([calibrations[item.solver].error(item.indicator) / item.error for item in seen])


def within(found: np.ndarray, low: float, high: float) -> float:
    return float(np.mean((found >= low) & (found <= high)))


def test_a_power_law_is_found():
    calibration = fit_calibration(drawn())
    for indicator in (1e-3, 1e-2, 0.1):
        assert calibration.error(indicator) == pytest.approx(3 * indicator**1.4, rel=0.25)


@pytest.mark.parametrize(("spread", "share"), [(0.2, 1.0), (1.0, 0.73), (2.0, 0.42)])
def test_a_calibration_knows_how_many_it_holds_for(spread, share):
    """Normal in logarithms, within log 3 of the law."""
    calibration = fit_calibration(drawn(2000, spread))
    assert calibration.share == pytest.approx(share, abs=0.04) and calibration.trusted == (spread < 1)


def test_the_law_holds_on_other_draws():
    found = effectivities(drawn(seed=1), drawn())
    assert len(found) == 200 and within(found, 0.5, 2) > 0.97


def test_where_the_error_is_level_the_line_still_rises():
    seen = [Observation("ddim", 10.0 ** (-place / 10), 0.1, place) for place in range(40)]
    calibration = fit_calibration(seen)
    assert calibration.error(1e-2) == pytest.approx(0.1, rel=0.9)
    assert calibration.error(1e-3) < calibration.error(1e-1)


def test_too_few_observations_make_none():
    assert fit_calibration(drawn(7)) is None
    assert fit_calibration(drawn(8)) is None  # nothing is left to judge it by
    assert fit_calibrations([]) == {}


def test_samples_that_ended_otherwise_are_left_out():
    target = ProblemTarget(make_problem("mixture-7.5"), 4)
    reference = target.reference(7.5)
    assert observe(target, Configuration("ddim", 2, guidance_scale=7.5), reference) == []  # says nothing
    assert len(observe(target, Configuration("ddim", 10, guidance_scale=7.5), reference)) == 4


@pytest.mark.parametrize("name", ["gaussian", "mixture-1", "mixture-7.5"])
def test_estimates_hold_on_other_noise(name):
    """Runs of every solver, from 6 to 80 steps and tolerances from 1e-1 to 1e-3: fitted on two thirds of the noises."""
    problem = make_problem(name)
    target = ProblemTarget(problem, 24)
    reference = target.reference(problem.guidance_scale)
    fitted, judged = [], []
    steps, tolerances = (6, 8, 10, 14, 20, 28, 40, 56, 80), (1e-1, 3e-2, 1e-2, 3e-3, 1e-3)
    named = [*SOLVERS, "adaptive"]
    for configuration in configurations(named, steps, tolerances, guidance_scales=[problem.guidance_scale]):
        seen = observe(target, configuration, reference)
        fitted += seen[: 2 * len(seen) // 3]
        judged += seen[2 * len(seen) // 3 :]
    found = effectivities(judged, fitted)
    assert len(found) > 400
    assert within(found, 0.5, 2) > 0.85
    assert within(found, 0.3, 3) > 0.95


def test_flows_side_by_side_are_each_its_own():
    problems = [make_problem("mixture-3"), make_problem("mixture-7.5")]
    flows = [problem.flow for problem in problems]
    noises = [problem.noise(count).double() for problem, count in zip(problems, (2, 3), strict=True)]
    both = side_by_side(flows, [2, 3]).denoise(torch.cat(noises), 0.7)
    assert torch.equal(both, torch.cat([flow.denoise(noise, 0.7) for flow, noise in zip(flows, noises, strict=True)]))
