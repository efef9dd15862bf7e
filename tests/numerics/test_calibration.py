"""Calibrations against a law they are drawn from, and estimates against true errors of exact problems."""

import numpy as np
import pytest

from unitouch_gen.numerics.calibration import (
    STEPS,
    TOLERANCES,
    Observation,
    effectivity,
    entries,
    fit_calibration,
    fit_calibrations,
    observe,
)
from unitouch_gen.numerics.problems import make_problem
from unitouch_gen.numerics.subjects import Configuration, ProblemSubject
from unitouch_gen.numerics.work_precision import configurations
from unitouch_gen.schedulers.estimate import Calibration
from unitouch_gen.schedulers.solvers import SOLVERS


def drawn(count: int = 200, spread: float = 0.2, seed: int = 0) -> list[Observation]:
    """error = 3 indicator^1.4 times noise."""
    random = np.random.default_rng(seed)
    indicators = np.exp(random.uniform(np.log(1e-4), np.log(0.3), count))
    errors = 3 * indicators**1.4 * np.exp(spread * random.standard_normal(count))
    return [Observation("unipc", float(i), float(e)) for i, e in zip(indicators, errors, strict=True)]


def test_a_power_law_is_found():
    calibration = fit_calibration(drawn())
    for indicator in (1e-3, 1e-2, 0.1):
        assert calibration.error(indicator) == pytest.approx(3 * indicator**1.4, rel=0.25)


def test_the_law_holds_on_other_draws():
    found = effectivity(drawn(seed=1), fit_calibrations(drawn()))
    assert found.within(0.5, 2) > 0.97
    assert sum(count for _, count in found.histogram) == 200


def test_where_the_error_is_level_the_line_still_rises():
    seen = [Observation("ddim", 10.0 ** (-place / 10), 0.1) for place in range(40)]
    calibration = fit_calibration(seen)
    assert calibration.error(1e-2) == pytest.approx(0.1, rel=0.9)
    assert calibration.error(1e-3) < calibration.error(1e-1)


def test_too_few_observations_make_none():
    assert fit_calibration(drawn(7)) is None
    assert fit_calibrations([]) == {}


def test_what_a_checkpoint_stores_is_found_again():
    calibrations = fit_calibrations(drawn())
    stored = entries(calibrations, 3.0)
    assert Calibration.find(stored, "unipc", 3.0) == calibrations["unipc"]
    assert Calibration.find(stored, "unipc", 4.0) is None
    assert Calibration.find(stored, "ddim", 3.0) is None


def test_samples_that_ended_otherwise_are_left_out():
    subject = ProblemSubject(make_problem("mixture-7.5"), 4)
    reference = subject.reference(7.5)
    assert observe(subject, Configuration("ddim", 2, guidance_scale=7.5), reference) == []  # says nothing
    assert len(observe(subject, Configuration("ddim", 10, guidance_scale=7.5), reference)) == 4


@pytest.mark.parametrize("name", ["gaussian", "mixture-1", "mixture-7.5"])
def test_estimates_hold_on_other_noise(name):
    """Of every solver, from 6 to 80 steps and tolerances from 1e-1 to 1e-3: fitted on two thirds of the noises."""
    problem = make_problem(name)
    subject = ProblemSubject(problem, 24)
    reference = subject.reference(problem.guidance_scale)
    fitted, judged = [], []
    for configuration in configurations(
        [*SOLVERS, "adaptive"], STEPS, TOLERANCES, guidance_scales=[problem.guidance_scale]
    ):
        seen = observe(subject, configuration, reference)
        fitted += seen[: 2 * len(seen) // 3]
        judged += seen[2 * len(seen) // 3 :]
    found = effectivity(judged, fit_calibrations(fitted))
    assert len(found.values) > 400
    assert found.within(0.5, 2) > 0.85
    assert found.within(0.3, 3) > 0.95
