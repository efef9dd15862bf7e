"""What error indicators stand for, fitted to a subject, and how well estimates hold on others of its samples.

Effectivity is estimate over true error (Ainsworth & Oden, 2000, "A Posteriori Error Estimation", Section 1): 1 is
right, 0.5 to 2 is a good estimate.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression

from unitouch_gen.numerics.reference import Reference
from unitouch_gen.numerics.subjects import Configuration, Subject, errors_of
from unitouch_gen.sampling import ReturnCode
from unitouch_gen.schedulers.estimate import Calibration

STEPS = (6, 8, 10, 14, 20, 28, 40, 56, 80)
TOLERANCES = (1e-1, 3e-2, 1e-2, 3e-3, 1e-3)
"""That estimates are fitted and judged on."""

POINTS = 5
"""Of a calibration; fewer bend too little on guided problems, more follow single samples."""

FEWEST = 4
"""Observations for a point."""

LEAST_SLOPE = 0.1
"""In log-log coordinates, so that there is a way back from errors to indicators."""

ENDS = 1e3
"""So far beyond its points a calibration goes on at slope 1."""

BINS = (0.0, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.4, 2.0, 3.0, 5.0, 10.0, np.inf)
"""Of the histogram of effectivities."""


@dataclass(frozen=True)
class Observation:
    """One sample of one run.

    Attributes:
        solver: Its name.
        indicator: Of the error, without an evaluation.
        error: The true one, relative RMS.
    """

    solver: str
    indicator: float
    error: float


def observe(subject: Subject, configuration: Configuration, reference: Reference) -> list[Observation]:
    """Indicator and error of each sample of one run that ended well.

    Args:
        subject, configuration: What to run.
        reference: Of it.
    """
    latents, report = subject.run(configuration)
    if not report.error_indicator:
        return []
    seen = zip(report.codes, report.error_indicator, errors_of(latents, reference).tolist(), strict=True)
    return [
        Observation(configuration.solver, indicator, error)
        for code, indicator, error in seen
        if code is ReturnCode.SUCCESS and indicator > 0 and error > 0
    ]


def fit_calibration(observations: Sequence[Observation], points: int = POINTS) -> Calibration | None:
    """A calibration of one solver: medians of error over equal shares of the observations, by indicator, made to rise.

    `None` where there are too few observations for two points.
    """
    seen = np.log([[item.indicator, item.error] for item in observations]).reshape(-1, 2)
    points = min(points, len(seen) // FEWEST)
    if points < 2:
        return None
    parts = np.array_split(seen[seen[:, 0].argsort()], points)
    middle = np.array([np.median(part, axis=0) for part in parts])
    level = LEAST_SLOPE * middle[:, 0]
    middle[:, 1] = isotonic_regression(middle[:, 1] - level).x + level
    middle = np.concatenate([middle[:1] - np.log(ENDS), middle, middle[-1:] + np.log(ENDS)])
    indicators, errors = (tuple(float(f"{value:.6g}") for value in column) for column in np.exp(middle).T)
    return Calibration(indicators, errors)


def fit_calibrations(observations: Iterable[Observation]) -> dict[str, Calibration]:
    """Of each solver that was observed often enough."""
    by_solver: dict[str, list[Observation]] = {}
    for item in observations:
        by_solver.setdefault(item.solver, []).append(item)
    fitted = {solver: fit_calibration(group) for solver, group in by_solver.items()}
    return {solver: calibration for solver, calibration in fitted.items() if calibration is not None}


def entries(calibrations: Mapping[str, Calibration], guidance_scale: float) -> dict[str, list[dict[str, Any]]]:
    """As checkpoints hold them; `Calibration.find` reads them."""
    return {
        solver: [{"guidance_scale": guidance_scale, **asdict(calibration)}]
        for solver, calibration in calibrations.items()
    }


@dataclass(frozen=True)
class Effectivity:
    """Of many estimates.

    Attributes:
        values: Estimate over true error of each.
    """

    values: NDArray[np.float64]

    def within(self, low: float, high: float) -> float:
        """Share of the values between two bounds."""
        return float(np.mean((self.values >= low) & (self.values <= high)))

    @property
    def histogram(self) -> list[tuple[str, int]]:
        """Counts by `BINS`, with the bounds in words."""
        counts, _ = np.histogram(self.values, BINS)
        bounds = [f"{low:g} to {high:g}" for low, high in pairwise(BINS[:-1])]
        return list(zip([*bounds, f"above {BINS[-2]:g}"], counts.tolist(), strict=True))


def effectivity(observations: Iterable[Observation], calibrations: Mapping[str, Calibration]) -> Effectivity:
    """Of the observations whose solver has a calibration."""
    ratios = [
        calibrations[item.solver].error(item.indicator) / item.error
        for item in observations
        if item.solver in calibrations
    ]
    return Effectivity(np.asarray(ratios))
