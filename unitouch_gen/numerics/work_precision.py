"""Error against run time of any subject, in the manner of SciML's work-precision sets and Hairer & Wanner's diagrams.

Every configuration starts from the same noise and is measured against the same reference. A point is the median error
over seeds and conditions with its quartiles, the evaluations of the network, and seconds after a warm-up. What fails is
a point, too.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from unitouch_gen.errors import InvalidInputError, check_integer
from unitouch_gen.numerics.problems import make_problem
from unitouch_gen.numerics.reference import Progress, Reference
from unitouch_gen.numerics.subjects import DTYPES, SOLVERS, Configuration, ProblemSubject, Subject, errors_of, own_end
from unitouch_gen.sampling import ReturnCode, RunReport
from unitouch_gen.schedulers.adaptive import ADAPTIVE

Cost = Literal["seconds", "evaluations"]

ABOVE_FLOOR = 10.0
"""Orders are fitted to errors that many times above what the reference, the dtype or a plateau can tell."""

ASYMPTOTIC = 0.1
"""And below this error, where steps are short enough for an order to show."""

FEWEST = 3
"""Points that an order is fitted to; two of them always lie on a line."""

ORDER_PROBLEMS = ("gaussian", "mixture", "mixture-3")
ORDER_STEPS = (16, 24, 32, 48, 64, 96)
LATE_STEPS = {"ddim": (100, 150, 200, 300)}
"""Of solvers that come to their order later, as timesteps that are even in time are far apart near the end."""


@dataclass(frozen=True)
class Row:
    """One measured configuration.

    Attributes:
        solver, steps, tolerance, guidance_scale, dtype, options: Of the configuration.
        series: What it shares with points that differ in steps or tolerance alone.
        key: Of the configuration.
        default: Whether a call without options runs this.
        samples: Seeds times conditions.
        error_low, error, error_high: Quartiles of the relative RMS error of the latents.
        evaluations, rejected: Of the network, in one run; steps that were refused.
        seconds, seconds_median: Least and median time of the denoising of one sample.
        estimate_ratio: Median of estimated over true error, where the solver has an estimate.
        estimate_within_2, estimate_within_3: Share of samples whose estimate is 0.5-2, 0.3-3 times the true error.
        calibrated: Whether the checkpoint has a calibration for it; otherwise it is a rough guess.
        failures: Samples that did not end well.
        reason: Of the failure: a return code, or what was raised.
    """

    solver: str
    steps: int | None
    tolerance: float | None
    guidance_scale: float
    dtype: str
    options: dict[str, Any]
    series: str
    key: str
    default: bool = False
    samples: int = 0
    error_low: float | None = None
    error: float | None = None
    error_high: float | None = None
    evaluations: float | None = None
    rejected: float | None = None
    seconds: float | None = None
    seconds_median: float | None = None
    estimate_ratio: float | None = None
    estimate_within_2: float | None = None
    estimate_within_3: float | None = None
    calibrated: bool = False
    failures: int = 0
    reason: str = ""

    @property
    def failed(self) -> bool:
        """Whether any of its samples did not end well."""
        return self.failures > 0

    @property
    def amount(self) -> str:
        """ "20 steps" or "tolerance 0.01"."""
        return f"tolerance {self.tolerance:g}" if self.steps is None else f"{self.steps} steps"


# What to measure ------------------------------------------------------------------------------------------------------


def configurations(
    solvers: Sequence[str],
    steps: Sequence[int] = (),
    tolerances: Sequence[float] = (),
    dtypes: Sequence[str] = ("float32",),
    guidance_scales: Sequence[float] = (1.0,),
    options: Sequence[dict[str, Any]] = ({},),
) -> list[Configuration]:
    """Every combination, without those that come twice; "adaptive" goes with tolerances, others with steps.

    Raises:
        InvalidInputError: If a list is empty that is needed, or a value out of range.
    """
    needed = {"solvers": solvers, "dtypes": dtypes, "guidance": guidance_scales, "option": options}
    if any(solver != ADAPTIVE for solver in solvers):
        needed["steps"] = steps
    if ADAPTIVE in solvers:
        needed["tolerances"] = tolerances
    for name, values in needed.items():
        if not values:
            raise InvalidInputError(f"`{name}` is empty; pass at least one.")
    found: dict[str, Configuration] = {}
    for scale, option, dtype, solver in product(guidance_scales, options, dtypes, solvers):
        fixed = {"guidance_scale": float(scale), "dtype": dtype, "options": option}
        amounts: list[dict[str, Any]] = [{"steps": number} for number in steps]
        if solver == ADAPTIVE:
            amounts = [{"tolerance": tolerance} for tolerance in tolerances]
        for amount in amounts:
            configuration = Configuration(solver, **amount, **fixed)
            found.setdefault(configuration.key, configuration)
    return list(found.values())


# Measuring ------------------------------------------------------------------------------------------------------------


def sweep(
    subject: Subject,
    wanted: Sequence[Configuration],
    *,
    known: Iterable[str] = (),
    repeats: int = 3,
    folder: Path | None = None,
    rtol: float | None = None,
    on_reference: Callable[[float, Reference], None] | None = None,
    progress: Progress | None = None,
) -> Iterator[Row]:
    """Measures one configuration after the other.

    Args:
        subject: What to measure.
        wanted: See `configurations`; all are checked before the first is run.
        known: Keys of configurations that are left out, as they have been measured before.
        repeats: Runs of each that are timed. A run of two steps that is not timed goes before the first of its kind.
        folder: Where references are kept.
        rtol: Of the reference, see `solve_reference`; fine enough by default.
        on_reference: Called with each guidance scale and its reference.
        progress: Of a reference.

    Yields:
        The row of each.

    Raises:
        InvalidInputError, InvalidTypeError: If a configuration cannot be run.
        NonFiniteError, NotConvergedError: If there is no reference.
    """
    check_integer("repeats", repeats, 1)
    for configuration in wanted:
        subject.check(configuration)
    known, scale, warm = set(known), None, set()
    left = [configuration for configuration in wanted if configuration.key not in known]
    for configuration in sorted(left, key=lambda item: item.guidance_scale):  # stable: in their order for each scale
        if configuration.guidance_scale != scale:
            scale = configuration.guidance_scale
            reference = subject.reference(scale, folder=folder, rtol=rtol, progress=progress)
            if on_reference is not None:
                on_reference(scale, reference)
        kind = (configuration.dtype, scale > 1.0, configuration.variant)
        yield measure(subject, configuration, reference, repeats, warm_up=kind not in warm)
        warm.add(kind)


def measure(
    subject: Subject, configuration: Configuration, reference: Reference, repeats: int = 3, *, warm_up: bool = True
) -> Row:
    """One row; what the run raises is its reason."""
    row = Row(
        solver=configuration.solver,
        steps=configuration.steps,
        tolerance=configuration.tolerance,
        guidance_scale=configuration.guidance_scale,
        dtype=configuration.dtype,
        options=dict(configuration.options),
        series=configuration.series,
        key=configuration.key,
        default=configuration == subject.default,
        samples=subject.samples,
    )
    try:
        if warm_up:
            subject.run(replace(configuration, solver="ddim", steps=2, tolerance=None, options={}))
        runs = [subject.run(configuration) for _ in range(repeats)]
    except Exception as error:  # whatever it is, the other points are worth having, and this one says what it was
        line = str(error).strip().partition("\n")[0]
        return replace(row, failures=subject.samples, reason=f"{type(error).__name__}: {line}".rstrip(": "))
    seconds = [report.seconds["denoising"] / subject.samples for _, report in runs]
    latents, report = runs[0]
    batches = math.ceil(subject.samples / subject.batch_size)
    codes = [code for code in report.codes if code is not ReturnCode.SUCCESS]
    errors = errors_of(latents, reference).numpy()
    return replace(
        row,
        **_quartiles(errors),
        **_estimate(report, errors),
        evaluations=report.evaluations / batches,
        rejected=report.rejected / batches,
        seconds=min(seconds),
        seconds_median=float(np.median(seconds)),
        failures=len(codes),
        reason=", ".join(sorted({code.value for code in codes})),
    )


def _quartiles(errors: np.ndarray) -> dict[str, Any]:
    """Of those that are finite."""
    errors = errors[np.isfinite(errors)]
    if not len(errors):
        return {}
    return dict(zip(("error_low", "error", "error_high"), np.quantile(errors, (0.25, 0.5, 0.75)).tolist(), strict=True))


def _estimate(report: RunReport, errors: np.ndarray) -> dict[str, Any]:
    """How the estimated errors compare with the true ones."""
    estimates = np.asarray(report.error_estimate)
    if estimates.shape != errors.shape:
        return {}
    use = np.isfinite(errors) & np.isfinite(estimates) & (errors > 0)
    if not use.any():
        return {}
    ratio = estimates[use] / errors[use]
    return {
        "estimate_ratio": float(np.median(ratio)),
        "estimate_within_2": float(np.mean((ratio >= 0.5) & (ratio <= 2))),
        "estimate_within_3": float(np.mean((ratio >= 0.3) & (ratio <= 3))),
        "calibrated": report.calibrated,
    }


# What the rows say ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Order:
    """A fitted order of convergence.

    Attributes:
        solver, series, guidance_scale: Of the rows it is fitted to.
        fitted: Slope of log error over log(1 / steps); `None` for less than three usable points.
        nominal: The solver's own.
        points: How many rows it was fitted to.
    """

    solver: str
    series: str
    guidance_scale: float
    fitted: float | None
    nominal: int | None
    points: int


def fitted_orders(
    rows: Iterable[Row], own_errors: dict[float, float], nominal: Callable[[str], int | None]
) -> list[Order]:
    """The order that each series of fixed steps shows, by least squares.

    Over the points whose median error is below `ASYMPTOTIC` and at least `ABOVE_FLOOR` times above the largest of: the
    reference's own error; the rounding of the network's dtype; and, where more steps no longer help, the error that the
    series levels off at.

    Args:
        rows: Measured.
        own_errors: Of the reference, by guidance scale.
        nominal: Order of a solver, see `Subject.nominal_order`.
    """
    groups: dict[tuple[float, str], list[Row]] = {}
    for row in rows:
        if row.steps is not None:
            groups.setdefault((row.guidance_scale, row.series), []).append(row)
    found = []
    for (scale, series), group in groups.items():
        points = sorted((row.steps, row.error) for row in group if row.steps and row.error and not row.failed)
        floor = max(own_errors.get(scale, 0.0), torch.finfo(DTYPES[group[0].dtype]).eps, plateau(points))
        usable = [(steps, error) for steps, error in points if ABOVE_FLOOR * floor <= error <= ASYMPTOTIC]
        fitted = -float(np.polyfit(*np.log(usable).T, 1)[0]) if len(usable) >= FEWEST else None
        solver = group[0].solver
        found.append(Order(solver, series, scale, fitted, nominal(solver), len(usable)))
    return found


def plateau(points: Sequence[tuple[int, float]]) -> float:
    """The error that a series (steps, error), in rising steps, levels off at, or 0 if it falls to its end.

    It has levelled off where the last points fall by less than the half order.
    """
    if len(points) < 2:
        return 0.0
    (before, earlier), (steps, last) = points[-2:]
    return max(last, earlier) if last > earlier * (before / steps) ** 0.5 else 0.0


def pareto_front(rows: Iterable[Row], cost: Cost) -> list[Row]:
    """The rows of one guidance scale that no other beats in both median error and cost, cheapest first."""
    front: list[Row] = []
    usable = [row for row in rows if not row.failed and row.error is not None and getattr(row, cost) is not None]
    for row in sorted(usable, key=lambda row: (getattr(row, cost), row.error)):
        if not front or row.error < front[-1].error:  # type: ignore[operator]
            front.append(row)
    return front


def cheapest(rows: Iterable[Row], error: float, cost: Cost) -> Row | None:
    """The row of one guidance scale that costs least of those with at most this median error."""
    return next((row for row in pareto_front(rows, cost) if row.error is not None and row.error <= error), None)


def order_table(
    problems: Sequence[str] = ORDER_PROBLEMS,
    solvers: Sequence[str] = tuple(SOLVERS),
    steps: Sequence[int] | None = None,
    seeds: int = 8,
) -> list[Order]:
    """The order of each named solver on exact problems, named by the problem in `series`.

    Over `steps`, or those of the solver. The reference ends as the solver does, since the jump from the smallest noise
    level to none is the same for any number of steps and would cover what is asked for.
    """
    found = []
    for problem in map(make_problem, problems):
        for solver in solvers:
            subject = ProblemSubject(problem, seeds, end=own_end(solver))
            truth = subject.reference(problem.guidance_scale)
            numbers = LATE_STEPS.get(solver, ORDER_STEPS) if steps is None else steps
            wanted = configurations([solver], numbers, guidance_scales=[problem.guidance_scale])
            rows = [measure(subject, configuration, truth, 1, warm_up=False) for configuration in wanted]
            own = {problem.guidance_scale: own_error(truth)}
            (order,) = fitted_orders(rows, own, subject.nominal_order)
            found.append(replace(order, series=problem.name))
    return found


def own_error(reference: Reference) -> float:
    """The median over samples of a reference's own error."""
    return reference.disagreement.median().item()
