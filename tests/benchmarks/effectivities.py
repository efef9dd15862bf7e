"""How well runs estimate their own error: estimate over true error, on exact problems and on the built-in pipelines."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from tests.benchmarks import Figures
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.numerics.calibration import STEPS as ALL_STEPS
from unitouch_gen.numerics.calibration import TOLERANCES as ALL_TOLERANCES
from unitouch_gen.numerics.calibration import (
    Effectivity,
    Observation,
    effectivity,
    fit_calibrations,
    observe,
)
from unitouch_gen.numerics.checkpoint import fitted_runs
from unitouch_gen.numerics.pipeline_subject import PipelineSubject
from unitouch_gen.numerics.problems import Problem, all_problems
from unitouch_gen.numerics.reference import Reference
from unitouch_gen.numerics.subjects import Configuration, ProblemSubject, errors_of
from unitouch_gen.numerics.work_precision import configurations
from unitouch_gen.sampling import ReturnCode
from unitouch_gen.schedulers.adaptive import ADAPTIVE
from unitouch_gen.schedulers.solvers import SOLVERS

SAMPLES = (16, 8)
"""Noises to fit calibrations on, and others to judge them on."""

NOTHING = 1e-6
"""Errors below it are rounding, and nothing that anybody could estimate."""

TRUTH = 1e-3
"""Errors of pipelines below it are not judged, as a close path errs by some ten-thousandths itself."""

STEPS = (8, 14, 20, 40)
TOLERANCES = (1e-1, 3e-2, 1e-2)
"""Of pipelines, which take their time."""

NAMED = (*SOLVERS, ADAPTIVE)

BOUNDS = ((0.5, 2.0), (0.3, 3.0))


def figures_of(found: Effectivity) -> Figures:
    """Shares within `BOUNDS` and the histogram; none of nothing."""
    if not len(found.values):
        return {"estimates": 0}
    shares = {f"within {low:g} to {high:g}": found.within(low, high) for low, high in BOUNDS}
    return {"estimates": len(found.values), **shares, "histogram": dict(found.histogram)}


# Exact problems -------------------------------------------------------------------------------------------------------


def exact_effectivity(problems: Iterable[Problem] | None = None, samples: tuple[int, int] = SAMPLES) -> Figures:
    """Of every solver and "adaptive" on exact problems, with calibrations fitted to other noises.

    Args:
        problems: All of them when left out, with the stiff and extreme ones.
        samples: See `SAMPLES`.

    Returns:
        See `figures_of`, of all and by problem; `left_out` counts samples with errors of rounding size alone, and
        `refused` configurations that solvers refuse a problem's schedule for.
    """
    everything, by_problem, left_out, refused = [], {}, 0, 0
    for problem in all_problems() if problems is None else problems:
        fitted, _ = _observations(problem, samples[0], seed=0)
        judged, without = _observations(problem, samples[1], seed=1)
        refused += without
        telling = [item for item in judged if item.error > NOTHING]
        left_out += len(judged) - len(telling)
        found = effectivity(telling, fit_calibrations(item for item in fitted if item.error > NOTHING))
        everything.append(found.values)
        figures = figures_of(found)
        figures.pop("histogram", None)
        by_problem[problem.name] = figures
    whole = figures_of(Effectivity(np.concatenate(everything)))
    return {**whole, "problems": by_problem, "left_out": left_out, "refused": refused}


def _observations(problem: Problem, count: int, seed: int) -> tuple[list[Observation], int]:
    """Of every configuration that can be run on a problem, and how many cannot."""
    subject = ProblemSubject(problem, count)
    subject.noise = problem.noise(count, seed)
    reference = subject.reference(problem.guidance_scale)
    seen: list[Observation] = []
    refused = 0
    for configuration in configurations(NAMED, ALL_STEPS, ALL_TOLERANCES, guidance_scales=[problem.guidance_scale]):
        try:
            seen += observe(subject, configuration, reference)
        except InvalidInputError:  # solvers refuse schedules that they break on, and more steps than there are levels
            refused += 1
    return seen, refused


# Pipelines ------------------------------------------------------------------------------------------------------------


def pipeline_configurations(pipe: Any, guidance_scale: float) -> list[Configuration]:
    """Every solver over `STEPS`, "adaptive" over `TOLERANCES`, and what was fitted to the checkpoint."""
    return [
        *configurations(NAMED, STEPS, TOLERANCES, guidance_scales=[guidance_scale]),
        *fitted_runs(pipe.scheduler, guidance_scale),
    ]


def pipeline_effectivity(
    subject: PipelineSubject, reference: Reference, wanted: Sequence[Configuration] | None = None
) -> Figures:
    """Of the estimates that a pipeline's calls report, with the calibrations of its checkpoint; and errors beside.

    Args:
        subject, reference: At one guidance scale, on conditions and noises that nothing was fitted to.
        wanted: Of that guidance; see `pipeline_configurations`.

    Returns:
        See `figures_of`, of the calibrated estimate of each sample; `by_run` alike, of the median estimate over the
        median error of each run. `calibrated` and `uncalibrated` name solvers, `left_out` counts errors too small for
        the reference, and `runs` hold median error and evaluations.
    """
    ratios, by_run, runs, left_out = [], [], [], 0
    solvers: dict[bool, dict[str, None]] = {True: {}, False: {}}
    for configuration in pipeline_configurations(subject.pipe, subject.guidance_scale) if wanted is None else wanted:
        latents, report = subject.run(configuration)
        errors = errors_of(latents, reference).numpy()
        runs.append(
            {
                "solver": configuration.solver,
                "steps": configuration.steps,
                "tolerance": configuration.tolerance,
                "error": float(np.median(errors)),
                "evaluations": report.evaluations / len(subject.parts),
            }
        )
        solvers[report.calibrated][configuration.solver] = None
        if not report.calibrated or not report.error_estimate:
            continue
        ended = np.array([code is ReturnCode.SUCCESS for code in report.codes])
        left_out += int((ended & (errors <= TRUTH)).sum())
        use = ended & (errors > TRUTH)
        estimates = np.asarray(report.error_estimate)[use]
        ratios.append(estimates / errors[use])
        if use.any():
            by_run.append(np.median(estimates) / np.median(errors[use]))
    found = Effectivity(np.concatenate(ratios) if ratios else np.zeros(0))
    return {
        **figures_of(found),
        "by_run": figures_of(Effectivity(np.asarray(by_run))),
        "guidance_scale": subject.guidance_scale,
        "conditions": subject.samples,
        "calibrated": list(solvers[True]),
        "uncalibrated": list(solvers[False]),
        "left_out": left_out,
        "runs": runs,
    }
