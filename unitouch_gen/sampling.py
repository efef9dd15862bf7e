"""Sampling: the steps of a call, the denoiser with its guidance, and the report of what the call did.

`prepare_steps` chooses the steps. A named solver or adaptive steps (see `solvers`) run a `Denoiser` by `solve`; the
pipeline's own diffusers scheduler runs in the loop of `pipelines.base`. The state is float32 whatever the network's
dtype.
"""

import copy
import inspect
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from typing import Any

import torch
from diffusers.schedulers.scheduling_utils import SchedulerMixin
from diffusers.utils.torch_utils import randn_tensor
from torch import Tensor

from unitouch_gen.arguments import SamplingArguments
from unitouch_gen.errors import (
    InvalidInputError,
    NonFiniteError,
    NotConvergedError,
    check_choice,
    check_integer,
    check_kind,
    check_unused,
    describe,
    explain_errors,
)
from unitouch_gen.schedule import NoiseSchedule, alpha, to_denoised, to_prediction
from unitouch_gen.solvers import DIVERGED_RMS, SOLVERS, Callback, sample_adaptive

# Report ---------------------------------------------------------------------------------------------------------------


class ReturnCode(StrEnum):
    """How one sample ended; `message` says what it means and what to try next."""

    message: str

    def __new__(cls, value: str, message: str) -> "ReturnCode":
        code = str.__new__(cls, value)
        code._value_ = value
        code.message = message
        return code

    SUCCESS = "success", "The sample is finite."
    NON_FINITE = "non_finite", "Not finite. Lower `guidance_scale` or `strength`, take more steps, or run in float32."
    DIVERGED = "diverged", "Far larger than the latents of pictures. Lower `guidance_scale`, or take more steps."
    MAX_EVALUATIONS = "max_evaluations", "Unfinished. Allow more `max_evaluations`, or a larger `tolerance`."
    INTERRUPTED = "interrupted", "Interrupted, with noise left in the sample. Call again to finish it."

    @property
    def finite(self) -> bool:
        """Whether there is a sample to return, finished or not."""
        return self is not ReturnCode.NON_FINITE


@dataclass
class RunReport:
    """What a pipeline call did."""

    solver: str = ""  #: a name in `SOLVERS`, "adaptive", or the class of the pipeline's own scheduler
    steps: int = 0  #: requested, or accepted with a tolerance
    evaluations: int = 0  #: calls of the denoising network; with guidance one call holds both branches
    guided: int = 0  #: calls that held both branches
    seconds: dict[str, float] = field(default_factory=dict)  #: wall-clock time of each stage
    codes: list[ReturnCode] = field(default_factory=list)  #: one for each sample
    #: by sample: step, from 0, at which it became non-finite or diverged; the number of steps if in decoding
    failed_at: dict[int, int] = field(default_factory=dict)
    sensors: list[str | None] = field(default_factory=list)  #: sensor whose tokens each touch got
    #: distance of each touch, or of its `background`, to that sensor; to the nearest where it got no tokens
    sensor_distances: list[float | None] = field(default_factory=list)
    #: by modality, why the model abstains from naming each input, such as "unlike anything known", or `None`
    unknown: dict[str, list[str | None]] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)  #: parts that were not needed and did not run

    @property
    def success(self) -> bool:
        """Whether every code is SUCCESS."""
        return all(code is ReturnCode.SUCCESS for code in self.codes)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Adds the time spent inside the block to a stage."""
        started = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - started

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return asdict(self)

    def __str__(self) -> str:
        stages = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in self.seconds.items())
        ended = "all finite" if self.success else ", ".join(code.value for code in self.codes)
        abstained = sum(reason is not None for reasons in self.unknown.values() for reason in reasons)
        if abstained:
            ended += f"; {abstained} of the inputs unknown to the model"
        counts = f"{self.steps} steps, {self.evaluations} evaluations"
        return f"{self.solver}: {counts}, {sum(self.seconds.values()):.2f} s ({stages}); {ended}"


# Steps ----------------------------------------------------------------------------------------------------------------


def prepare_steps(
    scheduler: Any, arguments: SamplingArguments, device: torch.device | str = "cpu"
) -> tuple[Any, NoiseSchedule | None]:
    """The steps of a call and, where they are noise levels, the schedule of the network; before any network runs.

    Steps are chosen by one of three arguments: `num_inference_steps` (default 50), `timesteps` of the scheduler, or a
    `tolerance`. `init_strength` (img2img) is the share of the steps to run. The first of them is at that share of the
    spacing of the solver or scheduler, which goes from data (0) to noise (1).

    Returns:
        With a `solver`, its falling noise levels, ending in 0. With a `tolerance`, the first and the last noise level.
        Otherwise a copy of the scheduler with its timesteps set, and `None`.

    Raises:
        InvalidInputError: If the steps are impossible, or arguments exclude each other.
    """
    check_kind("scheduler", scheduler, SchedulerMixin)
    steps = arguments.num_inference_steps
    solver = arguments.solver
    share = arguments.init_strength
    if arguments.tolerance is not None:
        others = {"num_inference_steps": steps, "timesteps": arguments.timesteps, "solver": solver}
        check_unused("with `tolerance`", **others, eta=arguments.eta or None)
        schedule = NoiseSchedule.of(scheduler)
        return [schedule.karras_level(1.0 - share), schedule.sigma_min], schedule
    check_unused("without `tolerance`", max_evaluations=arguments.max_evaluations)
    train_timesteps = scheduler.config.get("num_train_timesteps", 1000)
    if arguments.timesteps is not None:
        check_unused("with `timesteps`", num_inference_steps=steps, solver=solver)
        timesteps = [check_integer("timesteps", timestep, 0, train_timesteps - 1) for timestep in arguments.timesteps]
        if not timesteps or timesteps != sorted(set(timesteps), reverse=True):
            raise InvalidInputError(f"`timesteps` is {describe(timesteps)}; each has to be below the one before.")
        return prepare_scheduler(scheduler, timesteps, 1.0, device), None
    steps = check_integer("num_inference_steps", 50 if steps is None else steps, 1, train_timesteps)
    steps = max(round(share * steps), 1)
    if solver is None:
        return prepare_scheduler(scheduler, steps, share, device), None
    check_choice("solver", solver, SOLVERS)
    if not SOLVERS[solver].adds_noise:
        check_unused(f"with {solver!r}, which adds no noise", eta=arguments.eta or None)
    schedule = NoiseSchedule.of(scheduler)
    return [*SOLVERS[solver].spacing(schedule, steps, share), 0.0], schedule


def prepare_scheduler(scheduler: Any, steps: int | list[int], init_strength: float, device: torch.device | str) -> Any:
    """A copy of a diffusers scheduler with its timesteps set, by their number or one by one."""
    scheduler = copy.deepcopy(scheduler)
    kind = type(scheduler).__name__
    argument = "num_inference_steps" if isinstance(steps, int) else "timesteps"
    options: dict[str, Any] = {argument: steps, "device": device}
    parameters = inspect.signature(scheduler.set_timesteps).parameters
    if argument not in parameters:
        raise InvalidInputError(f"`{argument}` is {describe(steps)}, but {kind} chooses its own; leave it out.")
    problem = f"`{argument}` is {steps}, which {kind} cannot run"
    with explain_errors(problem, "take other steps, or name a `solver`", ValueError, IndexError, ZeroDivisionError):
        if "strength" in parameters:  # of LCM and TCD
            options["strength"] = init_strength
        elif init_strength < 1.0:
            scheduler = truncate_schedule(scheduler, init_strength)
        scheduler.set_timesteps(**options)
    first = float(scheduler.timesteps.max())
    levels = scheduler.config.num_train_timesteps
    # "leading" spacing starts too low with 1 step, or too high with 1000
    if init_strength == 1.0 and not levels / 3 <= first < levels:
        raise InvalidInputError(
            f"`{argument}` is {steps}, with which {kind} starts at timestep {first:g} of {levels}; take other steps or "
            "name a `solver`."
        )
    if hasattr(scheduler, "set_begin_index"):
        scheduler.set_begin_index(0)  # without it diffusers starts at the second of two equal timesteps
    return scheduler


def truncate_schedule(scheduler: Any, share: float) -> Any:
    """A copy of a diffusers scheduler that starts at a share of its spacing: its higher noise levels are cut off."""
    config = scheduler.config
    betas = getattr(scheduler, "betas", None)
    if "trained_betas" not in config or config.get("use_flow_sigmas") or betas is None:
        kind = type(scheduler).__name__
        raise InvalidInputError(f"`init_strength` is {share:g}, but {kind} can only start from noise; name a `solver`.")
    scheduler.set_timesteps(100)
    spacing = scheduler.timesteps.unique()  # from the smallest
    levels = max(round(float(spacing[max(round(share * len(spacing)), 1) - 1])) + 1, 2)
    changes = {
        "num_train_timesteps": levels,
        "trained_betas": betas[:levels].tolist(),
        "timestep_spacing": "trailing",
        "rescale_betas_zero_snr": False,
    }
    return type(scheduler).from_config(config, **{name: value for name, value in changes.items() if name in config})


# Denoising ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Guidance:
    """Classifier-free guidance by a scale s: u + s (c - u) (Ho & Salimans, 2022)."""

    scale: float

    @property
    def active(self) -> bool:
        """Whether the unconditional branch is needed: above a scale of 1."""
        return self.scale > 1.0

    def combine(self, prediction: Tensor) -> Tensor:
        """(2 B, ...) unconditional and conditional predictions -> (B, ...)."""
        unconditional, conditional = prediction.chunk(2)
        return unconditional + self.scale * (conditional - unconditional)


class Denoiser:
    """The denoiser D(x, sigma) of a UNet under its conditions, with guidance; it counts its evaluations.

    Args:
        unet: Called as `unet(z, timestep, **conditions, return_dict=False)` with variance-preserving states; the first
            item of what it returns is its prediction.
        schedule: What the UNet was trained for. May be `None` where a scheduler alone calls `predict`.
        conditions: Keyword arguments of the UNet. Tensors have B rows, or 2 B with the unconditional ones first.
        guidance: A callback may exchange it during a run.
        concat: Input channels beside the state, (B, C', h, w), the same in both branches.
        edit: Changes the guided prediction of the clean latents x_0, (B, C, h, w).
    """

    def __init__(
        self,
        unet: Callable[..., Any],
        schedule: NoiseSchedule | None,
        conditions: Mapping[str, Any],
        guidance: Guidance,
        *,
        concat: Tensor | None = None,
        edit: Callable[[Tensor], Tensor] | None = None,
    ):
        self.unet = unet
        self.schedule: Any = schedule
        self.conditions = dict(conditions)
        self.guidance = guidance
        self.concat = concat
        self.edit: Any = edit
        self.dtype = getattr(unet, "dtype", torch.float32)
        self.evaluations = 0  # calls of the UNet; with guidance one call holds both branches
        self.guided = 0  # calls that held both branches

    def __call__(self, x: Tensor, sigma: float) -> Tensor:
        """D(x, sigma) of x = x_0 + sigma n, float32 (B, C, h, w), at the exact (fractional) timestep."""
        z = x * alpha(sigma)
        prediction = self.predict(z, self.timestep(sigma, x.device))
        denoised = to_denoised(prediction, z, sigma, self.schedule.prediction_type)
        return denoised if self.edit is None else self.edit(denoised)

    def timestep(self, sigma: float, device: torch.device) -> Tensor:
        """The timestep of a noise level, float32 (); made on the device, so that nothing waits for a copy."""
        return torch.full((), self.schedule.timestep(sigma).item(), dtype=torch.float32, device=device)

    def predict(self, z: Tensor, timestep: Tensor) -> Tensor:
        """The guided prediction of the UNet at variance-preserving z, float32 (B, C, h, w), without `edit`."""
        guided = self.guidance.active
        state = torch.cat([z, z]) if guided else z
        rows = len(state)
        if self.concat is not None:
            concat = torch.cat([self.concat, self.concat]) if guided else self.concat
            state = torch.cat([state, concat.to(state)], dim=1)
        conditions = {
            name: value[-rows:] if isinstance(value, Tensor) else value for name, value in self.conditions.items()
        }
        prediction = self.unet(state.to(self.dtype), timestep, **conditions, return_dict=False)[0].float()
        self.evaluations += 1
        self.guided += guided
        return self.guidance.combine(prediction) if guided else prediction

    def edit_prediction(self, prediction: Tensor, z: Tensor, sigma: float) -> Tensor:
        """A prediction (B, C, h, w) whose clean latents are the edited ones: what diffusers' schedulers step with."""
        denoised = to_denoised(prediction, z, sigma, self.schedule.prediction_type)
        return to_prediction(self.edit(denoised), z, sigma, self.schedule.prediction_type)


class RunInterruptedError(Exception):
    """Raised by a callback to end a run of `solve`."""


def solve(
    denoise: Denoiser,
    x: Tensor,
    sigmas: Sequence[float],
    arguments: SamplingArguments,
    callback: Callback,
    generator: Any = None,
) -> tuple[Tensor, ReturnCode]:
    """Latents, float32 (B, C, h, w), by a named solver or to a tolerance, and how the run ended.

    Args:
        x: Where to start, at the first noise level: x_0 + sigma n, (B, C, h, w).
        sigmas: Noise levels of `prepare_steps`.
        callback: Called as `callback(step, x, sigma)` after each step; returns the x to go on from.
        generator: One, or one for each sample, for solvers that add noise.
    """
    if arguments.tolerance is not None:
        limit = arguments.max_evaluations or 1000
        x, finished = sample_adaptive(denoise, x, sigmas, arguments.tolerance, callback, max_evaluations=limit)
        return x, ReturnCode.SUCCESS if finished else ReturnCode.MAX_EVALUATIONS
    solver = SOLVERS[str(arguments.solver)]
    options: dict[str, Any] = {}
    if solver.adds_noise:
        options["eta"] = arguments.eta
        options["draw"] = lambda x: randn_tensor(x.shape, generator, x.device, x.dtype)
    return solver.sample(denoise, x, sigmas, callback, **options), ReturnCode.SUCCESS


NEVER = 2**31


class SampleStatus:
    """Which samples became non-finite or diverged, and after which step; kept on their device, and read once.

    A sample has diverged once the RMS of its variance-preserving state is above `DIVERGED_RMS`.
    """

    def __init__(self, samples: int, device: torch.device | str):
        self.non_finite_at = torch.full((samples,), NEVER, device=device)
        self.diverged_at = torch.full((samples,), NEVER, device=device)

    def update(self, step: int, z: Tensor) -> None:
        """Notes the samples of variance-preserving z (B, C, h, w) that a step, from 0, has broken."""
        values = z.flatten(1)
        non_finite = ~values.isfinite().all(dim=1)
        diverged = values.square().mean(dim=1).sqrt() > DIVERGED_RMS
        self.non_finite_at = torch.where(non_finite, self.non_finite_at.clamp(max=step), self.non_finite_at)
        self.diverged_at = torch.where(diverged, self.diverged_at.clamp(max=step), self.diverged_at)

    def conclude(self, report: RunReport, denoise: Denoiser, ended: ReturnCode, throw: bool) -> None:
        """Writes counts and return codes into the report of a run; `ended` is the code of samples that did not fail.

        Raises:
            NonFiniteError: If a sample is not finite and `throw` is set.
            NotConvergedError: If the run ended by MAX_EVALUATIONS and `throw` is set.
        """
        report.evaluations = denoise.evaluations
        report.guided = denoise.guided
        report.codes = []
        non_finite, diverged = torch.stack([self.non_finite_at, self.diverged_at]).tolist()
        for row, (broken, large) in enumerate(zip(non_finite, diverged, strict=True)):
            code = ended
            if broken < NEVER:
                code = ReturnCode.NON_FINITE
                report.failed_at[row] = broken
            elif large < NEVER:
                code = ReturnCode.DIVERGED
                report.failed_at[row] = large
            report.codes.append(code)
            if throw and code is ReturnCode.NON_FINITE:
                raise NonFiniteError(f"Sample {row} is not finite after step {broken + 1}. {code.message}")
        if throw and ended is ReturnCode.MAX_EVALUATIONS:
            raise NotConvergedError(f"Stopped after {report.evaluations} evaluations. {ended.message}")
