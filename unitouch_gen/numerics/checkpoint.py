"""What a checkpoint can bring beside its weights: steps fitted to it, and what its error indicators stand for.

Both are found on contacts that its networks were trained on, with noise of their own, and are good for others.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch

from unitouch_gen.errors import InvalidInputError, check_integer
from unitouch_gen.numerics.calibration import TOLERANCES, Observation, entries, fit_calibrations, observe
from unitouch_gen.numerics.fitting import exact_path, fit_steps
from unitouch_gen.numerics.pipeline_subject import PipelineSubject
from unitouch_gen.numerics.reference import Reference
from unitouch_gen.numerics.subjects import Configuration
from unitouch_gen.numerics.work_precision import configurations
from unitouch_gen.schedulers.adaptive import ADAPTIVE
from unitouch_gen.schedulers.fitted import FITTED, Fit, FittedScheduler
from unitouch_gen.schedulers.solvers import SOLVERS, schedule_settings
from unitouch_gen.world import MATERIAL_NAMES, World
from unitouch_gen.world.collections import SPLITS

STEPS = (6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 18, 20, 26)
"""Numbers of steps that are worth fitting: with more, named solvers come to their order."""

CALIBRATED_STEPS = (6, 8, 12, 20, 40, 80)
"""Of the runs that calibrations are fitted to, with `calibration.TOLERANCES`; pipelines take their time."""

SEED = 77
"""Of the noise that is fitted on."""

PATH_EVALUATIONS = 400
"""Of the path that errors are told from: its own is some ten-thousandths on the built-in networks."""

Told = Callable[[str], None]
"""Gets a line of each thing that was done."""


def trained_contacts(pipe: Any, modalities: Sequence[str], contacts: int, first: int = 0) -> dict[str, Any]:
    """Arguments of a pipeline's call: contacts with objects of the training split, and the sensors in turn.

    Args:
        pipe: Its `sensors` are drawn in turn, if it names any.
        modalities: "image", "touch".
        contacts: At least one; spread over the materials.
        first: Number of the first object of each material.

    Raises:
        InvalidInputError: If there are not as many.
    """
    check_integer("contacts", contacts, 1)
    rows = torch.arange(contacts)
    count = len(MATERIAL_NAMES)
    most = (SPLITS["val"][0] - first) * count  # what follows is for choosing and judging
    if contacts > most:
        raise InvalidInputError(f"`contacts` is {contacts}; there are {most} to fit on, so pass at most as many.")
    scene = World().render(rows % count, first + rows // count, rows * 0, modalities=tuple(modalities))
    found = {"image": scene.image, "touch": scene.touch.get("gelsight")}
    inputs: dict[str, Any] = {modality: found[modality] for modality in modalities}
    sensors = pipe.config.get("sensors")
    return {**inputs, "sensor": [sensors[row % len(sensors)] for row in rows.tolist()]} if sensors else inputs


def fresh(pipe: Any, inputs: Mapping[str, Any], name: str, seed: int) -> PipelineSubject:
    """A pipeline on inputs, each from a noise of its own."""
    subject = PipelineSubject(pipe, inputs, name=name, seeds=1)
    generator = torch.Generator().manual_seed(seed)
    subject.noise = torch.randn(subject.noise.shape, generator=generator)
    return subject


def close_reference(subject: PipelineSubject, guidance_scale: float, evaluations: int) -> Reference:
    """Where the exact flow ends, from a close path, whose own error is not known."""
    ends = [
        exact_path(subject.flow(guidance_scale, part), subject.noise[part], evaluations).end for part in subject.parts
    ]
    end = torch.cat(ends)
    return Reference(end, torch.zeros(len(end), dtype=torch.float64), {}, {})


def fit_pipeline(
    subject: PipelineSubject, guidance_scales: Sequence[float], steps: Sequence[int] = STEPS, told: Told = print
) -> list[Fit]:
    """Steps fitted to a pipeline's network.

    Args:
        subject: On contacts to fit on.
        guidance_scales, steps: Of the calls that they are for.
        told: Gets a line of each fit.
    """
    (rows,) = subject.parts
    fits = []
    for guidance_scale in guidance_scales:
        flow = subject.flow(guidance_scale, rows)
        path = exact_path(flow, subject.noise)
        for number in steps:
            fit, error = fit_steps(flow, path, guidance_scale, number)
            told(f"{subject.name}, guidance {guidance_scale:g}: {number} steps leave an error of {error:.4f}")
            fits.append(fit)
    return fits


def with_fits(scheduler: Any, fits: Sequence[Fit], otherwise: str) -> FittedScheduler:
    """A scheduler that brings fits, on the noise schedule of another one.

    Fits that it brought already stay, if there are none for the same guidance and number of steps.

    Args:
        scheduler: The pipeline's own.
        fits: New ones.
        otherwise: Named solver for other calls.
    """
    settings = schedule_settings(scheduler)
    settings.pop("steps_offset", None)  # there are no timesteps to move
    new = {(fit.guidance_scale, fit.steps): fit for fit in fits}
    old = {(fit.guidance_scale, fit.steps): fit for fit in getattr(scheduler, "fits", ())}
    whole = {**old, **new}
    return FittedScheduler(**settings, fits=[whole[key].to_dict() for key in sorted(whole)], otherwise=otherwise)


def calibrate_pipeline(subject: PipelineSubject, told: Told = print) -> dict[str, list[dict[str, Any]]]:
    """What the indicators of every solver stand for at a pipeline's default guidance, as checkpoints hold it.

    Args:
        subject: On contacts to fit on.
        told: Gets a line of each solver.
    """
    scale = subject.guidance_scale
    truth = close_reference(subject, scale, PATH_EVALUATIONS)
    seen: list[Observation] = []
    for configuration in calibrated_runs(subject.pipe.scheduler, scale):
        found = observe(subject, configuration, truth)
        told(f"{subject.name}: {configuration.solver}, {configuration.amount}: {len(found)} observations")
        seen += found
    return entries(fit_calibrations(seen), scale)


def calibrated_runs(scheduler: Any, guidance_scale: float) -> list[Configuration]:
    """Runs that a calibration is fitted to: named solvers, tolerances, and fitted steps where there are any."""
    named = [*SOLVERS, ADAPTIVE]
    runs = configurations(named, CALIBRATED_STEPS, TOLERANCES, guidance_scales=[guidance_scale])
    return [*runs, *fitted_runs(scheduler, guidance_scale)]


def fitted_runs(scheduler: Any, guidance_scale: float) -> list[Configuration]:
    """The steps that a pipeline's scheduler brings for a guidance, if it brings any."""
    return [
        Configuration(FITTED, fit.steps, guidance_scale=guidance_scale)
        for fit in getattr(scheduler, "fits", ())
        if fit.guidance_scale == guidance_scale
    ]
