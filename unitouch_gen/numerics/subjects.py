"""What error against run time is measured on, and how a point of it is configured.

A subject has a start, the same for every solver; for each guidance scale a reference of where the exact flow ends from
there; and a way to run one configuration. Exact problems are subjects here, pipelines in `pipeline_subject`.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import torch
from diffusers import (
    DDIMScheduler,
    DPMSolverMultistepScheduler,
    EulerDiscreteScheduler,
    PNDMScheduler,
    UniPCMultistepScheduler,
)
from diffusers.schedulers.scheduling_utils import SchedulerMixin
from torch import Tensor

from unitouch_gen.errors import InvalidInputError, check_choice, check_integer, check_number
from unitouch_gen.numerics.cache import fingerprint
from unitouch_gen.numerics.flow import Flow
from unitouch_gen.numerics.problems import Problem
from unitouch_gen.numerics.reference import Progress, Reference, relative_rms, solve_reference
from unitouch_gen.sampling import RunReport, prepare_steps, sample, sample_to_tolerance
from unitouch_gen.schedulers.adaptive import ADAPTIVE
from unitouch_gen.schedulers.estimate import UNCALIBRATED
from unitouch_gen.schedulers.solvers import SOLVERS, Solver, make_scheduler, schedule_settings

DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}
"""Of the network; the state of the solver is float32."""

OWN = "own"
"""The scheduler that a pipeline came with."""

BASELINES: dict[str, Solver] = {
    "diffusers:ddim": Solver(
        DDIMScheduler,
        1,
        {"timestep_spacing": "leading", "steps_offset": 1, "set_alpha_to_one": False, "clip_sample": False},
    ),
    "diffusers:pndm": Solver(
        PNDMScheduler,
        2,
        {"timestep_spacing": "leading", "steps_offset": 1, "set_alpha_to_one": False, "skip_prk_steps": True},
    ),
    "diffusers:euler": Solver(EulerDiscreteScheduler, 1, {"timestep_spacing": "leading", "steps_offset": 1}),
    "diffusers:dpm++2m": Solver(DPMSolverMultistepScheduler, 2, {"use_karras_sigmas": True}),
    "diffusers:unipc": Solver(UniPCMultistepScheduler, 3, {"use_karras_sigmas": True}),
}
"""diffusers' own schedulers as its pipelines run them, Stable Diffusion's settings: what ours are measured against."""

MIN_TOLERANCE, MAX_TOLERANCE = 1e-5, 1.0
"""As pipelines take them."""


@dataclass(frozen=True)
class Configuration:
    """One point of error against run time.

    Attributes:
        solver: A name in `SOLVERS` or `BASELINES`, "own", or "adaptive".
        steps: Of the solver; `None` for "adaptive".
        tolerance: Of "adaptive"; `None` for others.
        guidance_scale: Of the flow; on above 1.
        dtype: Of the network, a name in `DTYPES`.
        options: More arguments of a pipeline's call, or settings of a problem's scheduler. They are what is measured,
            so the reference is without them.

    Raises:
        InvalidInputError, InvalidTypeError: If a value is out of range.
    """

    solver: str
    steps: int | None = None
    tolerance: float | None = None
    guidance_scale: float = 1.0
    dtype: str = "float32"
    options: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.solver == ADAPTIVE:
            check_number("tolerances", self.tolerance, MIN_TOLERANCE, MAX_TOLERANCE)
        else:
            check_integer("steps", self.steps, 1)
        check_number("guidance", self.guidance_scale, 0.0)
        check_choice("dtypes", self.dtype, DTYPES)

    @property
    def key(self) -> str:
        """The same for the same configuration, in any process."""
        return fingerprint(self)

    @property
    def variant(self) -> str:
        """What distinguishes it beside the solver and its steps: "bfloat16, eta=0.5", or nothing."""
        options = [f"{name}={value}" for name, value in sorted(self.options.items())]
        return ", ".join([*([] if self.dtype == "float32" else [self.dtype]), *options])

    @property
    def series(self) -> str:
        """Of points that differ in steps or tolerance alone: "unipc, bfloat16"."""
        return f"{self.solver}, {self.variant}" if self.variant else self.solver

    @property
    def amount(self) -> str:
        """ "20 steps" or "tolerance 0.01"."""
        return f"tolerance {self.tolerance:g}" if self.steps is None else f"{self.steps} steps"

    @property
    def expected_evaluations(self) -> int:
        """A guess, for the time that is left."""
        if self.steps is None:
            assert self.tolerance is not None
            return round(10 * self.tolerance ** (-1 / 3))
        return self.steps * (2 if self.solver == "heun" else 1)


class Subject(Protocol):
    """What can be measured.

    Attributes:
        name: To show.
        identity: Names all that its results depend on but the configuration.
        samples: How many errors a run gives.
        batch_size: Of them in work at once.
        guidance_scale: Where none is asked for.
        default: What a call without options runs, if there is such a thing.
    """

    name: str
    identity: str
    samples: int
    batch_size: int
    guidance_scale: float
    default: Configuration | None

    def check(self, configuration: Configuration) -> None:
        """Refuses what cannot be run, before anything is.

        Raises:
            InvalidInputError: Naming the setting.
        """

    def nominal_order(self, solver: str) -> int | None:
        """Of convergence, where it is known."""

    def reference(
        self, guidance_scale: float, *, folder: Path | None, rtol: float | None, progress: Progress | None
    ) -> Reference:
        """Where the exact flow ends, of all samples; found in the folder if it has been there before."""

    def run(self, configuration: Configuration) -> tuple[Tensor, RunReport]:
        """Latents (N, C, h, w), NaN for samples that broke, and what it took; "denoising" in seconds counts."""


def nominal_order(solver: str) -> int | None:
    """Of a solver by name."""
    known = {**SOLVERS, **BASELINES}
    return known[solver].order if solver in known else None


def own_end(solver: str) -> str:
    """The `end` of the reference that a solver of `SOLVERS` comes to with ever more steps."""
    scheduler = SOLVERS[solver].scheduler
    if getattr(scheduler, "second_order_end", False):
        return "extrapolate"
    return "zero" if issubclass(scheduler, DDIMScheduler) else "denoise"


def baseline(own: SchedulerMixin, name: str) -> SchedulerMixin:
    """A scheduler of diffusers in the place of another, as its users exchange them."""
    chosen = BASELINES[name]
    return chosen.scheduler.from_config({**schedule_settings(own), **chosen.settings})  # type: ignore[attr-defined]


def check_solver(solver: str, steps: int | None, most: int, more: Sequence[str] = ()) -> None:
    """Refuses unknown solvers and numbers of steps that a schedule does not have.

    Args:
        solver, steps: Of a configuration.
        most: Levels of the schedule.
        more: Names beside those that are known everywhere.

    Raises:
        InvalidInputError: Naming the choices, and the nearest.
    """
    check_choice("solvers", solver, [*SOLVERS, ADAPTIVE, *more, *BASELINES])
    if steps is not None:
        check_integer("steps", steps, 1, most)


def joined(parts: Sequence[Reference]) -> Reference:
    """One reference of several: samples in a row, evaluations and seconds summed."""
    evaluations: dict[str, int] = {}
    seconds: dict[str, float] = {}
    for part in parts:
        for name in part.evaluations:
            evaluations[name] = evaluations.get(name, 0) + part.evaluations[name]
            seconds[name] = seconds.get(name, 0.0) + part.seconds[name]
    return Reference(
        torch.cat([part.latents for part in parts]),
        torch.cat([part.disagreement for part in parts]),
        evaluations,
        seconds,
    )


def in_parts(samples: int, batch_size: int | None) -> list[list[int]]:
    """Row numbers of each batch.

    Raises:
        InvalidInputError, InvalidTypeError: If the batch size is no integer from 1.
    """
    size = samples if batch_size is None else check_integer("batch_size", batch_size, 1)
    return [list(range(first, min(first + size, samples))) for first in range(0, samples, size)]


def reference_in_parts(
    flow: Callable[[list[int]], Flow],
    noise: Tensor,
    parts: Sequence[list[int]],
    *,
    rtol: float,
    end: str,
    folder: Path | None,
    progress: Progress | None,
) -> Reference:
    """One reference of all rows of noise, solved part by part.

    Args:
        flow: Of the rows of a part.
        noise, parts: All rows, and the numbers of those of each part.
        rtol, end, folder, progress: As of `solve_reference`.
    """
    settings: dict[str, Any] = {"rtol": rtol, "end": end, "folder": folder, "progress": progress}
    return joined([solve_reference(flow(part), noise[part], **settings) for part in parts])


def run_in_parts(
    run: Callable[[list[int]], tuple[Tensor, RunReport]], parts: Sequence[list[int]]
) -> tuple[Tensor, RunReport]:
    """Latents of all parts in a row, and their joined report."""
    runs = [run(part) for part in parts]
    return torch.cat([latents for latents, _ in runs]), RunReport.joined([report for _, report in runs])


class ProblemSubject:
    """An exact problem.

    Its reference is the closed form where there is one, otherwise that of two solvers.

    Args:
        problem: Its own guidance scale is the default; others are the same data under another one.
        seeds: How many noises to start from.
        batch_size: In work at once; all by default.
        end: Of the reference, see `solve_reference`.
    """

    RTOL = 1e-10

    default: Configuration | None = None

    def __init__(self, problem: Problem, seeds: int = 8, batch_size: int | None = None, end: str = "zero"):
        self.problem, self.name, self.end = problem, problem.name, end
        self.guidance_scale = problem.guidance_scale
        self.samples = check_integer("seeds", seeds, 1)
        self.parts = in_parts(seeds, batch_size)
        self.batch_size = len(self.parts[0])
        self.noise = problem.noise(seeds)
        data = fingerprint(problem.data, problem.unconditional)
        schedule = json.dumps(dict(problem.schedule_config), sort_keys=True)
        self.identity = fingerprint(data, schedule, problem.prediction_type, self.noise, self.batch_size, end)
        self._guided = {problem.guidance_scale: problem}

    def at(self, guidance_scale: float) -> Problem:
        """The problem at a guidance scale.

        Raises:
            InvalidInputError: If it has no unconditional branch to guide away from.
        """
        if guidance_scale not in self._guided:
            if self.problem.unconditional is None:
                raise InvalidInputError(
                    f"`guidance` is {guidance_scale:g}, but {self.name!r} has no unconditional branch; leave it out."
                )
            self._guided[guidance_scale] = replace(self.problem, guidance_scale=guidance_scale)
        return self._guided[guidance_scale]

    def check(self, configuration: Configuration) -> None:
        self.at(configuration.guidance_scale)
        own = self.problem.scheduler()
        check_solver(configuration.solver, configuration.steps, own.config.num_train_timesteps)
        if configuration.options and configuration.solver == ADAPTIVE:
            raise InvalidInputError("`option` is for schedulers, and 'adaptive' is none; leave one of them out.")
        if configuration.options:
            known = self._plain(configuration.solver).config
            for name in configuration.options:
                check_choice("option", name, [key for key in known if not key.startswith("_")])
            self._scheduler(configuration)

    def nominal_order(self, solver: str) -> int | None:
        return nominal_order(solver)

    def reference(
        self,
        guidance_scale: float,
        *,
        folder: Path | None = None,
        rtol: float | None = None,
        progress: Progress | None = None,
    ) -> Reference:
        problem = self.at(guidance_scale)
        if problem.has_solution and self.end == "zero":
            solution = problem.solution(self.noise)
            return Reference(solution, torch.zeros(len(solution), dtype=torch.float64), {}, {})
        rtol = self.RTOL if rtol is None else rtol
        return reference_in_parts(
            lambda _: problem.flow, self.noise, self.parts, rtol=rtol, end=self.end, folder=folder, progress=progress
        )

    def run(self, configuration: Configuration) -> tuple[Tensor, RunReport]:
        return run_in_parts(lambda part: self._run(configuration, self.noise[part].float()), self.parts)

    def _plain(self, solver: str) -> SchedulerMixin:
        own = self.problem.scheduler()
        return baseline(own, solver) if solver in BASELINES else make_scheduler(own, solver)

    def _scheduler(self, configuration: Configuration) -> SchedulerMixin:
        """Fresh, with the options laid over the solver's settings."""
        plain = self._plain(configuration.solver)
        if not configuration.options:
            return plain
        try:
            return type(plain).from_config(plain.config, **configuration.options)  # type: ignore[attr-defined]
        except (ValueError, NotImplementedError, TypeError) as error:
            raise InvalidInputError(f"`option` is {dict(configuration.options)}: {error}") from error

    def _run(self, configuration: Configuration, noise: Tensor) -> tuple[Tensor, RunReport]:
        problem, dtype = self.at(configuration.guidance_scale), DTYPES[configuration.dtype]
        network: Callable[..., Any] = problem.network()
        report = RunReport(configuration.solver, guidance_scale=configuration.guidance_scale)
        options: dict[str, Any] = {"guidance": problem.guidance, "throw": False}

        def denoise(state: Tensor, timestep: Tensor) -> Tensor:
            return network(state.to(dtype), timestep)

        with report.stage("denoising"):
            if configuration.tolerance is not None:
                known = (self.problem.schedule, self.problem.prediction_type)
                latents = sample_to_tolerance(denoise, noise, *known, configuration.tolerance, report, **options)
            else:
                assert configuration.steps is not None
                scheduler = self._scheduler(configuration)
                prepare_steps(scheduler, configuration.steps, noise.device)
                latents = sample(denoise, noise, scheduler, report, **options)
        report.error_estimate = [UNCALIBRATED.error(value) for value in report.error_indicator]
        broken = torch.tensor([not code.finite for code in report.codes])
        latents[broken] = float("nan")
        return latents, report


def errors_of(latents: Tensor, reference: Reference) -> Tensor:
    """Relative RMS error of each sample, float64 (N,); infinite where a sample broke."""
    errors = relative_rms(latents.cpu(), reference.latents)
    return torch.where(torch.isnan(errors), torch.inf, errors)
