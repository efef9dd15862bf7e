"""What a checkpoint can bring beside its weights: steps fitted to it, and what its error indicators stand for.

Named solvers take D between two evaluations for a polynomial. What a given network does is known better than that: from
exact paths of some conditions, each step's weights follow by least squares, one step after the other, each from the
states that the steps before it lead to, so that it makes up for their errors as far as it can. That takes one run of
the network for each number of steps, and no gradients. (Solvers fitted end to end, to a given number of evaluations,
are in Shaul et al., 2024, "Bespoke Non-Stationary Solvers".)

Steps are found on contacts that the networks were trained on, and calibrations on others, with noise of their own.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.optimize import isotonic_regression
from torch import Tensor

from unitouch_gen.errors import InvalidInputError, check_integer
from unitouch_gen.numerics.reference import Flow, Reference, relative_rms
from unitouch_gen.numerics.targets import Configuration, PipelineTarget, Target, errors_of, rendered_contacts
from unitouch_gen.numerics.work_precision import configurations
from unitouch_gen.sampling import ReturnCode
from unitouch_gen.schedulers.adaptive import ADAPTIVE
from unitouch_gen.schedulers.exponential import Calibration, FinalExtrapolation, advance, exponential_integral
from unitouch_gen.schedulers.fitted import FITTED, Fit, FittedScheduler, combined
from unitouch_gen.schedulers.solvers import schedule_settings
from unitouch_gen.world import FIRST_OBJECT, MATERIAL_NAMES

STEPS = (6, 8, 9, 10, 12, 15, 16, 20, 26)
"""Numbers of steps that are worth fitting: with more, named solvers come to their order."""

MOST_STEPS = 1000
"""As many as the usual schedules have levels: each step takes a weight for every one before it."""

PATH_EVALUATIONS = 250
"""Evaluations of an exact path; its own error is some thousandths on the built-in networks, far below those of fits."""

SPACINGS = (3.0, 4.0, 5.0)
"""rho of the noise levels that are tried (Karras et al., 2022, Equation 5)."""

LAST_LEVEL = 2.0
"""Last of the noise levels, in units of the schedule's smallest: the step from there to none is fitted as well."""

RIDGE = 1e-3
"""Share of the mean square of each of D's differences: keeps weights small that the data says nothing of. Differences
between near levels are small, and weigh as much as others where steps are many."""

ROUNDS = 4
"""Rounds of weighing samples by their errors, after which the weights no longer change."""

FLOOR = 1e-6
"""Least squared error, relative to the result: nearer samples weigh alike."""

CALIBRATED_SOLVERS = ("ddim", "dpm++2m", "unipc")
CALIBRATED_STEPS = (6, 9, 15, 20, 30)
CALIBRATED_TOLERANCES = (1e-1, 3e-2)
"""Runs that calibrations are fitted to, beside those of fitted steps and of the solver of other calls."""

NOISE_LEVELS = (0, 450, 900)
"""Of the noise on embeddings, where a pipeline takes it: contacts are fitted at each of them."""

CALIBRATION_EVALUATIONS = 300
"""Evaluations of the path that errors are told from: its own error is some ten-thousandths on the built-in networks."""

POINTS = 5
"""Points of a calibration; fewer bend too little on guided problems, more follow single samples."""

FEWEST = 4
"""Observations for a point."""

FOLDS = 4
"""Parts of the samples, of which each is judged by a calibration of the others."""

LEAST_SLOPE = 0.1
"""In log-log coordinates, so that there is a way back from errors to indicators."""

BEYOND = 1e3
"""So far beyond its points a calibration goes on at slope 1."""

SEED = 77
"""Seed of the noise that is fitted on."""


# What is fitted to ----------------------------------------------------------------------------------------------------


def trained_contacts(pipe: Any, modalities: Sequence[str], contacts: int, first: int = 0) -> dict[str, Any]:
    """Arguments of a pipeline's call: contacts with objects of the training split, or of the validation split from its
    `first` on, spread over the materials from the `first` of each, and the pipeline's sensors in turn, if it names any.

    Raises:
        InvalidInputError: If there are not as many.
    """
    check_integer("contacts", contacts, 1)
    rows, count = torch.arange(contacts), len(MATERIAL_NAMES)
    split = "val" if first < FIRST_OBJECT["val"] else "test"
    most = (FIRST_OBJECT[split] - first) * count  # what follows is for choosing, or for judging
    if contacts > most:
        raise InvalidInputError(f"`contacts` is {contacts}; there are {most} to fit on, so pass at most as many.")
    inputs = rendered_contacts(modalities, rows % count, first + rows // count)
    sensors = pipe.config.get("sensors")
    return {**inputs, "sensor": [sensors[row % len(sensors)] for row in rows.tolist()]} if sensors else inputs


def contact_targets(
    pipe: Any,
    modalities: Sequence[str],
    contacts: int,
    first: int = 0,
    *,
    name: str = "",
    seed: int = SEED,
    batch_size: int | None = None,
) -> list[PipelineTarget]:
    """Contacts of `trained_contacts` with a noise for each, as targets: one for each of `NOISE_LEVELS`, where the
    pipeline takes it, with as many of them."""
    inputs = trained_contacts(pipe, modalities, contacts, first)
    calls = [{"noise_level": level} for level in NOISE_LEVELS if "default_noise_level" in pipe.config] or [{}]
    calls = calls[:contacts]
    parts = [{name: values[number :: len(calls)] for name, values in inputs.items()} for number in range(len(calls))]
    return [
        PipelineTarget(
            pipe, part, name=name, seeds=1, batch_size=batch_size, noise_seed=seed + 100 * number, options=call
        )
        for number, (part, call) in enumerate(zip(parts, calls, strict=True))
    ]


def joint_flow(targets: Sequence[PipelineTarget], guidance_scale: float) -> tuple[Flow, Tensor]:
    """One flow of all samples of several targets, one after the other, and their noise (N, C, h, w)."""
    flows = [target.flow(guidance_scale, list(range(target.samples))) for target in targets]
    noise = torch.cat([target.noise for target in targets])
    return side_by_side(flows, [target.samples for target in targets]), noise


@dataclass(frozen=True, eq=False)
class ExactPath:
    """An exact path of a batch: log sigma, falling (K,); x there, float32 (K, B, C, h, w); x at sigma = 0, float64; and
    the noise that it starts from, (B, C, h, w)."""

    levels: Tensor
    states: Tensor
    end: Tensor
    noise: Tensor

    def at(self, sigma: float) -> Tensor:
        """x at a noise level, float64 (B, C, h, w), linear in log sigma between two known ones."""
        level = math.log(sigma)
        place = int(torch.searchsorted(-self.levels, -level)) - 1
        place = min(max(place, 0), len(self.levels) - 2)
        high, low = self.levels[place : place + 2].tolist()
        return torch.lerp(self.states[place].double(), self.states[place + 1].double(), (level - high) / (low - high))


def exact_path(flow: Flow, noise: Tensor, evaluations: int = PATH_EVALUATIONS) -> ExactPath:
    """Follows a flow closely, from unit-variance noise (B, C, h, w) to sigma = 0, at levels of Karras spacing.

    The formulas are those of `schedulers.adaptive`: order three after a prediction of order two.
    """
    sigmas = [flow.schedule.karras(number / (evaluations - 1)) for number in range(evaluations)]
    levels = [-math.log(sigma) for sigma in sigmas]
    state, final = flow.start(noise), FinalExtrapolation()
    values, states = [flow.denoise(state, sigmas[0])], [state.float()]
    for number in range(1, evaluations):
        step = levels[number] - levels[number - 1]
        nodes = [levels[number - 1 - back] - levels[number - 1] for back in range(len(values))]
        predicted = advance(state, step, exponential_integral(step, nodes, values))
        value = flow.denoise(predicted, sigmas[number])
        state = advance(state, step, exponential_integral(step, [step, *nodes], [value, *values]))
        values = [value, *values[:1]]
        states.append(state.float())
        final.add(sigmas[number], value)
    return ExactPath(-torch.tensor(levels, dtype=torch.float64), torch.stack(states), final.result(), noise)


def side_by_side(flows: Sequence[Flow], counts: Sequence[int]) -> Flow:
    """One flow of samples of several: as many of each as `counts` says, in this order."""

    def denoise(x: Tensor, sigma: float) -> Tensor:
        parts = zip(flows, x.split(list(counts)), strict=True)
        return torch.cat([flow.denoise(part, sigma) for flow, part in parts])

    return Flow(denoise, flows[0].schedule)


def close_reference(target: PipelineTarget, guidance_scale: float, evaluations: int) -> Reference:
    """Where the exact flow ends, from a close path, whose own error is not known."""
    flows = [(target.flow(guidance_scale, part), target.noise[part]) for part in target.parts]
    return Reference.exact(torch.cat([exact_path(flow, noise, evaluations).end for flow, noise in flows]))


# Steps ----------------------------------------------------------------------------------------------------------------


def fit_pipeline(
    targets: Sequence[PipelineTarget],
    guidance_scales: Sequence[float],
    steps: Sequence[int] = STEPS,
    told: Callable[[str], object] = print,
) -> list[Fit]:
    """Steps fitted to a pipeline's network, for calls of these guidance scales and all between, and numbers of steps.

    The spacing of the noise levels is chosen at the first scale, as levels and weights have to change smoothly from one
    to the next.

    Args:
        targets: Of one pipeline, with contacts for calls that differ otherwise.
        guidance_scales, steps: Of the calls.
        told: Gets a line of each fit.
    """
    fits: list[Fit] = []
    spacings: dict[int, float] = {}
    for scale in guidance_scales:
        flow, noise = joint_flow(targets, scale)
        path = exact_path(flow, noise)
        for number in steps:
            tried = [spacings[number]] if number in spacings else SPACINGS
            found = {rho: fit_steps(flow, path, scale, noise_levels(flow, number, rho)) for rho in tried}
            spacings[number] = min(found, key=lambda rho: found[rho][1])
            fit, error = found[spacings[number]]
            told(f"{targets[0].name}, guidance {scale:g}: {number} steps leave an error of {error:.4f}")
            fits.append(fit)
    return fits


def fit_steps(flow: Flow, path: ExactPath, guidance_scale: float, sigmas: Sequence[float]) -> tuple[Fit, float]:
    """The fit of steps to an exact path of a flow, at noise levels of its evaluations, falling.

    Returns:
        The fit, and the geometric mean of the relative RMS errors that it leaves on the path's samples.
    """
    state, values, rows = flow.start(path.noise), [], []
    for sigma, following in zip(sigmas, [*sigmas[1:], 0.0], strict=True):
        values.append(flow.denoise(state, sigma))
        wanted, kept = (path.at(following), following / sigma) if following else (path.end, 0.0)
        rows.append(_fit_row((wanted - kept * state) / (1 - kept), values, path.end))
        state = kept * state + (1 - kept) * combined(values, rows[-1])
    error = relative_rms(state, path.end).log().mean().exp().item()
    return Fit(guidance_scale, tuple(sigmas), tuple(map(tuple, rows))), error


def noise_levels(flow: Flow, steps: int, rho: float) -> list[float]:
    """Noise levels of a number of evaluations, falling."""
    last = LAST_LEVEL * flow.schedule.sigma_min
    return [flow.schedule.karras(number / max(steps - 1, 1), rho, last) for number in range(steps)]


def _fit_row(mean: Tensor, values: Sequence[Tensor], end: Tensor) -> list[float]:
    """Weights of earlier values of D, such that D and its differences to them come close to its mean over the step.

    Samples are weighed by one over their squared error, as it is relative errors and their median that count, and some
    paths bend more than others by far.
    """
    *earlier, now = values
    if not earlier:
        return []
    differences = torch.stack([(value - now).flatten(1) for value in earlier], dim=-1)  # (B, n, number)
    wanted = (mean - now).flatten(1)[..., None]
    products, sides = differences.mT @ differences, differences.mT @ wanted
    size = end.flatten(1).square().sum(dim=1)
    trust, weights = 1 / size, torch.zeros(0)
    for _ in range(ROUNDS):
        matrix, side = (trust[:, None, None] * products).sum(0), (trust[:, None, None] * sides).sum(0)
        ridge = RIDGE * matrix.diagonal().diag()
        weights = torch.linalg.solve(matrix + ridge, side)
        left = (wanted - differences @ weights).flatten(1).square().sum(dim=1)
        trust = 1 / (left + FLOOR * size)
    return [float(f"{weight:.6g}") for weight in weights[:, 0].tolist()]


def with_fits(scheduler: Any, fits: Sequence[Fit], otherwise: str) -> FittedScheduler:
    """A scheduler that brings fits, on the noise schedule of a pipeline's own, and a named solver for other calls.

    Fits that it brought already stay, if there are none for the same guidance and number of steps.
    """
    settings = schedule_settings(scheduler)
    settings.pop("steps_offset", None)  # there are no timesteps to move
    whole = {(fit.guidance_scale, fit.steps): fit for fit in (*getattr(scheduler, "fits", ()), *fits)}
    return FittedScheduler(**settings, fits=[asdict(whole[key]) for key in sorted(whole)], otherwise=otherwise)


def fitted_runs(scheduler: Any, guidance_scale: float) -> list[Configuration]:
    """The steps that a pipeline's scheduler brings for a guidance, if it brings any."""
    return [
        Configuration(FITTED, steps, guidance_scale=guidance_scale)
        for steps in sorted({fit.steps for fit in getattr(scheduler, "fits", ())})
        if scheduler.find(steps, guidance_scale) is not None
    ]


# Estimates ------------------------------------------------------------------------------------------------------------


class Observation(NamedTuple):
    """One sample of one run: solver, indicator of the error without an evaluation, true error, relative RMS, and the
    sample's number."""

    solver: str
    indicator: float
    error: float
    sample: int = 0


def observe(target: Target, configuration: Configuration, reference: Reference) -> list[Observation]:
    """Indicator and error of each sample of one run that ended well."""
    latents, report = target.run(configuration)
    errors = errors_of(latents, reference).tolist()
    return [
        Observation(configuration.solver, indicator, error, sample)
        for sample, (code, indicator, error) in enumerate(
            zip(report.codes, report.error_indicator, errors)  # which may say nothing
        )
        if code is ReturnCode.SUCCESS and indicator > 0 and error > 0
    ]


def fit_calibration(observations: Sequence[Observation]) -> Calibration | None:
    """A calibration of one solver: medians of error over equal shares of the observations, by indicator, made to rise.

    `None` where there are too few observations for two points, or to judge it by: its share is of each part of the
    samples by what was fitted to the others.
    """
    calibration, ratios = _curve(observations), list[float]()
    for part in range(FOLDS):
        curve = _curve([item for item in observations if item.sample % FOLDS != part])
        if curve is not None:
            held = [item for item in observations if item.sample % FOLDS == part]
            ratios += [curve.error(item.indicator) / item.error for item in held]
    if calibration is None or not ratios:
        return None
    return replace(calibration, share=float(np.mean([0.3 <= ratio <= 3 for ratio in ratios]).round(3)))


def _curve(observations: Sequence[Observation]) -> Calibration | None:
    """The line of `fit_calibration`, whose share is not known."""
    seen = np.log([[item.indicator, item.error] for item in observations]).reshape(-1, 2)
    points = min(POINTS, len(seen) // FEWEST)
    if points < 2:
        return None
    parts = np.array_split(seen[seen[:, 0].argsort()], points)
    middle = np.array([np.median(part, axis=0) for part in parts])
    level = LEAST_SLOPE * middle[:, 0]
    middle[:, 1] = isotonic_regression(middle[:, 1] - level).x + level
    middle = np.concatenate([middle[:1] - np.log(BEYOND), middle, middle[-1:] + np.log(BEYOND)])
    indicators, errors = (tuple(float(f"{value:.6g}") for value in column) for column in np.exp(middle).T)
    return Calibration(indicators, errors)


def calibrate_pipeline(
    targets: Sequence[PipelineTarget], guidance_scales: Sequence[float], told: Callable[[str], None] = print
) -> dict[str, list[dict[str, Any]]]:
    """What the indicators of solvers stand for at guidance scales, as `Calibration.find` reads it of checkpoints.

    Args:
        targets: Of one pipeline, with contacts for calls that differ otherwise.
        guidance_scales: Of the calls.
        told: Gets a line of each run.
    """
    stored: dict[str, list[dict[str, Any]]] = {}
    scheduler = targets[0].pipe.scheduler
    solvers = dict.fromkeys([*CALIBRATED_SOLVERS, scheduler.config.get("otherwise", CALIBRATED_SOLVERS[0]), ADAPTIVE])
    for scale in guidance_scales:
        seen: dict[str, dict[int | None, list[Observation]]] = {}
        named = configurations([*solvers], CALIBRATED_STEPS, CALIBRATED_TOLERANCES, guidance_scales=[scale])
        for target in targets:
            truth = close_reference(target, scale, CALIBRATION_EVALUATIONS)
            for configuration in [*named, *fitted_runs(scheduler, scale)]:
                found = observe(target, configuration, truth)
                told(f"{target.name}, {configuration.key}: {len(found)} observations")
                seen.setdefault(configuration.solver, {}).setdefault(configuration.steps, []).extend(found)
        for solver, groups in seen.items():
            fitted = {number: fit_calibration(group) for number, group in groups.items()}
            if not any(fitted.values()):  # too few contacts for each number of steps: one for all
                fitted = {None: fit_calibration([item for group in groups.values() for item in group])}
            for number, calibration in fitted.items():
                if calibration is not None:
                    entry = {"guidance_scale": scale, "steps": number, **asdict(calibration)}
                    stored.setdefault(solver, []).append(entry)
    return stored
