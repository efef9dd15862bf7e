"""From noise to latents: the steps of a call, guidance, the run, and the report of what it did.

`prepare_steps` validates the step arguments; `sample` runs the steps: of a named solver or adaptive (see `solvers`), or
of the pipeline's own diffusers scheduler in diffusers' loop. The state is float32 whatever the network's dtype.
"""

import copy
import inspect
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from typing import Any

import torch
from diffusers.schedulers.scheduling_utils import SchedulerMixin
from diffusers.utils.torch_utils import randn_tensor
from torch import Tensor

from unitouch_gen.errors import (
    InvalidInputError,
    NonFiniteError,
    NotConvergedError,
    check_choice,
    check_integer,
    check_kind,
    check_number,
    check_tensor,
    check_unused,
    describe,
)
from unitouch_gen.schedule import PREDICTION_TYPES, NoiseSchedule, alpha, to_denoised
from unitouch_gen.solvers import SOLVERS, sample_adaptive

# Report ---------------------------------------------------------------------------------------------------------------


class ReturnCode(StrEnum):
    """How one sample ended; `message` says what it means and what to try next."""

    message: str

    def __new__(cls, value: str, message: str) -> "ReturnCode":
        code = str.__new__(cls, value)
        code._value_, code.message = value, message
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
    #: of each touch, or of its `background`, to that sensor; to the nearest where it got no tokens
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


@dataclass(frozen=True, eq=False)
class Steps:
    """How a run goes from noise to latents; made by `prepare_steps`."""

    solver: str  # a name in `SOLVERS`, "adaptive", or the class of `scheduler`
    count: int = 0  # number of steps; 0 with a tolerance (chosen during the run)
    sigmas: Sequence[float] = ()  # noise levels of a named solver, ending in 0; with a tolerance only the first
    schedule: Any = None  # the network's `NoiseSchedule`; None with `scheduler`
    prediction_type: str = ""
    scheduler: Any = None  # a diffusers scheduler with its timesteps set
    timesteps: Any = ()  # scheduler timesteps to run, (n,)
    tolerance: float | None = None
    max_evaluations: int | None = None
    eta: float = 0.0


def prepare_steps(
    scheduler: SchedulerMixin, *, solver: str | None = None, num_inference_steps: int | None = None,
    timesteps: Sequence[int] | None = None, tolerance: float | None = None, max_evaluations: int | None = None,
    eta: float = 0.0, init_strength: float = 1.0, device: torch.device | str = "cpu",
) -> Steps:  # fmt: skip
    """Validates the step arguments of a call, before any network runs.

    Steps are given by one of three: `num_inference_steps` (default 50); `timesteps` of `scheduler`; or `tolerance`, a
    relative RMS error of the latents from 1e-5 to 1. Without `solver` and `tolerance` a copy of the scheduler runs;
    otherwise only its noise levels and prediction type are used. `max_evaluations` (default 1000) is of a tolerance,
    `eta` of DDIM. `init_strength` (img2img) is the share of the steps to run. The first of them is at that share of the
    spacing of the solver or scheduler, which goes from data (0) to noise (1). Raises `InvalidInputError` or
    `InvalidTypeError` if steps are impossible or arguments exclude each other.
    """
    config = check_kind("scheduler", scheduler, SchedulerMixin).config  # type: ignore[attr-defined]
    check_number("eta", eta, 0.0, 1.0)
    check_number("init_strength", init_strength, 0.0, 1.0)
    if tolerance is not None:
        given = {"num_inference_steps": num_inference_steps, "timesteps": timesteps, "solver": solver}
        check_unused("tolerance", **given, eta=eta or None)
        check_number("tolerance", tolerance, 1e-5, 1.0)
        limit = check_integer("max_evaluations", 1000 if max_evaluations is None else max_evaluations, 2)
        schedule, prediction_type = trained_for(scheduler)
        start = schedule.karras_level(1.0 - init_strength)
        return Steps("adaptive", 0, [start], schedule, prediction_type, tolerance=tolerance, max_evaluations=limit)
    if max_evaluations is not None:
        raise InvalidInputError(f"`max_evaluations` is {describe(max_evaluations)}; it needs a `tolerance`.")
    if timesteps is not None:
        check_unused("timesteps", num_inference_steps=num_inference_steps, solver=solver)
        check_kind("timesteps", timesteps, list, tuple)
        falling = [check_integer("timesteps", one, 0, config.get("num_train_timesteps", 1000) - 1) for one in timesteps]
        if not falling or falling != sorted(set(falling), reverse=True):
            raise InvalidInputError(f"`timesteps` is {describe(timesteps)}; each has to be below the one before.")
        return prepare_scheduler(copy.deepcopy(scheduler), falling, eta, 1.0, device)
    whole = 50 if num_inference_steps is None else num_inference_steps
    check_integer("num_inference_steps", whole, 1, config.get("num_train_timesteps", 1000))
    count = max(round(init_strength * whole), 1)
    if solver is None:
        return prepare_scheduler(copy.deepcopy(scheduler), count, eta, init_strength, device)
    schedule, prediction_type = trained_for(scheduler)
    if check_choice("solver", solver, SOLVERS) != "ddim" and eta:
        raise InvalidInputError(f"`eta` is {eta:g}, but {solver!r} adds no noise; pass solver='ddim', or leave it out.")
    sigmas = [*SOLVERS[solver].spacing(schedule, count, init_strength), 0.0]
    return Steps(solver, count, sigmas, schedule, prediction_type, eta=eta)


def trained_for(scheduler: Any) -> tuple[NoiseSchedule, str]:
    """The noise levels and the kind of prediction that a scheduler's network was trained for."""
    schedule, prediction_type = NoiseSchedule.of(scheduler), scheduler.config.get("prediction_type")
    return schedule, check_choice("scheduler: prediction_type", prediction_type, PREDICTION_TYPES)


def prepare_scheduler(
    scheduler: Any, steps: int | list[int], eta: float, init_strength: float, device: torch.device | str
) -> Steps:
    """Sets the timesteps of a diffusers scheduler, by their number or one by one."""
    kind, known = type(scheduler).__name__, inspect.signature(scheduler.set_timesteps).parameters
    name = "num_inference_steps" if isinstance(steps, int) else "timesteps"
    words = f"`{name}` is {steps}"
    options: dict[str, Any] = {name: steps, "device": device}
    if name not in known:
        raise InvalidInputError(f"{words}, but {kind} chooses its own; pass `num_inference_steps`.")
    try:
        if "strength" in known:  # as of LCM and TCD
            options["strength"] = init_strength
        elif init_strength < 1.0:
            scheduler = begun_within(scheduler, init_strength)
        scheduler.set_timesteps(**options)
    except (ValueError, IndexError, ZeroDivisionError) as error:
        raise InvalidInputError(f"{words}, which {kind} cannot run: {error}") from error
    first, levels = float(scheduler.timesteps.max()), scheduler.config.num_train_timesteps
    # "leading" spacing starts too low with 1 step, or too high with 1000
    if init_strength == 1.0 and not levels / 3 <= first < levels:
        raise InvalidInputError(
            f"{words}, with which {kind} starts at timestep {first:g} of {levels}; take other steps or name a `solver`."
        )
    if hasattr(scheduler, "set_begin_index"):
        scheduler.set_begin_index(0)  # without it diffusers starts at the second of two equal timesteps
    count = scheduler.num_inference_steps if isinstance(steps, int) else len(steps)
    return Steps(kind, count, scheduler=scheduler, timesteps=scheduler.timesteps, eta=eta)


def begun_within(scheduler: Any, share: float) -> Any:
    """A copy of a diffusers scheduler that starts at a share of its spacing: its higher noise levels are cut off."""
    config, betas = scheduler.config, getattr(scheduler, "betas", None)
    if "trained_betas" not in config or config.get("use_flow_sigmas") or betas is None:
        raise ValueError(f"it starts at noise alone; pass no `init_strength`, which is {share:g}, or name a `solver`")
    scheduler.set_timesteps(100)
    spacing = scheduler.timesteps.unique()  # from the smallest
    levels = max(round(float(spacing[max(round(share * len(spacing)), 1) - 1])) + 1, 2)
    own = {"num_train_timesteps": levels, "trained_betas": betas[:levels].tolist(), "timestep_spacing": "trailing",
           "rescale_betas_zero_snr": False}  # fmt: skip
    return type(scheduler).from_config(config, **{name: value for name, value in own.items() if name in config})


# Guidance -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Guidance:
    """Classifier-free guidance by a scale s: u + s (c - u) (Ho & Salimans, 2022)."""

    scale: float

    @property
    def active(self) -> bool:
        """Whether the unconditional branch is needed: scale > 1, or NaN (which a callback may set)."""
        return not self.scale <= 1.0

    def combine(self, prediction: Tensor) -> Tensor:
        """(2 B, ...) unconditional and conditional predictions -> (B, ...)."""
        unconditional, conditional = prediction.chunk(2)
        return unconditional + self.scale * (conditional - unconditional)


# Runs -----------------------------------------------------------------------------------------------------------------

Network = Callable[[Tensor, Tensor], Tensor]
"""(variance-preserving z (B or 2 B, C, h, w), timestep) -> prediction of the same shape; unconditional half first."""

OnStep = Callable[[int, Tensor, Tensor, "Run"], Tensor | None]

DIVERGED_RMS = 10.0
"""RMS of z above which a sample counts as diverged. Networks are trained at RMS 1. The built-in family in 20 steps
reaches 1.3 at guidance 7.5, 7.4 at 100, and 10 to 24 at 1000."""


class _EndedError(Exception):
    """Ends a run before its last step, with a return code."""


@torch.no_grad()
def sample(
    network: Network, noise: Tensor, steps: Steps, report: RunReport, *, guidance: Guidance = Guidance(1.0),
    init: Tensor | None = None, generator: Any = None, throw: bool = True, on_step: OnStep | None = None,
    progress: Callable[[float], object] = lambda share: None,
) -> Tensor:  # fmt: skip
    """From noise to latents, float32 (B, C, h, w). Non-finite samples are returned as zeros.

    Args:
        network: Denoising network with its conditioning bound; called on 2 B states while guidance is active.
        noise: Unit-variance noise, (B, C, h, w).
        report: Filled in: solver, numbers of steps and evaluations, and a return code for each sample.
        init: Latents to start from, (B, C, h, w) (SDEdit; Meng et al., 2022).
        generator: One, or one for each sample, for DDIM and schedulers that draw noise.
        throw: Raise `NonFiniteError` or `NotConvergedError` where a sample fails; otherwise go on with the others.
        on_step: Called as `on_step(step, timestep, latents, run)` after each step (diffusers schedulers: after each
            evaluation). `latents` are variance-preserving (diffusers: in the scheduler's scale). It may return new
            latents, and set `run.guidance` and `run.interrupted`.
        progress: Called with the finished share of the run.
    """
    noise, init = noise.float(), None if init is None else init.float()
    report.solver, report.codes = steps.solver, [ReturnCode.SUCCESS] * len(noise)
    run = Run(network, steps, report, guidance, throw, on_step, progress, noise)
    try:
        latents = (run_solver if steps.scheduler is None else run_scheduler)(run, noise, init, generator)
    except _EndedError as ended:
        (code,) = ended.args
        interrupted = code is ReturnCode.INTERRUPTED
        if throw and not interrupted:  # an interruption is the user's own
            raise NotConvergedError(f"Stopped after {report.evaluations} evaluations. {code.message}") from None
        latents = run.zero_nonfinite(report.steps, run.latents if interrupted else run.denoised)
        report.codes = [code if each is ReturnCode.SUCCESS else each for each in report.codes]
    report.steps = steps.count or report.steps
    return latents


def run_scheduler(run: "Run", noise: Tensor, init: Tensor | None, generator: Any) -> Tensor:
    """diffusers' denoising loop, for any of its schedulers."""
    scheduler, timesteps = copy.deepcopy(run.steps.scheduler), run.steps.timesteps
    latents = noise * scheduler.init_noise_sigma
    if init is not None:
        latents = scheduler.add_noise(init, noise, timesteps[:1].expand(len(init)))
    known = inspect.signature(scheduler.step).parameters
    options = {"generator": generator, "eta": run.steps.eta}
    options = {name: value for name, value in options.items() if name in known}
    run.latents, z = latents, scheduler.scale_model_input(latents, timesteps[0])
    for step, timestep in enumerate(timesteps):
        latents = scheduler.step(run.predict(z, timestep), timestep, latents, **options, return_dict=False)[0]
        latents = z = run.end_step(step, timestep, latents)
        if step + 1 < len(timesteps):
            z = scheduler.scale_model_input(latents, timesteps[step + 1])
        run.mark_diverged(step, z)
        run.progress((step + 1) / len(timesteps))
    return latents


def run_solver(run: "Run", noise: Tensor, init: Tensor | None, generator: Any) -> Tensor:
    """Runs a named solver, or adaptive steps."""
    steps, sigma, codes = run.steps, run.steps.sigmas[0], run.report.codes
    x = noise * math.hypot(1.0, sigma) if init is None else init + sigma * noise
    run.latents, run.sigma = x * alpha(sigma), sigma
    if steps.tolerance is not None:
        ends, active = (sigma, steps.schedule.sigma_min), lambda: [code is ReturnCode.SUCCESS for code in codes]
        return sample_adaptive(run.denoise, x, ends, steps.tolerance, run.after_step, active)
    options: dict[str, Any] = {}
    if steps.solver == "ddim":
        options = {"eta": steps.eta, "draw": lambda x: randn_tensor(x.shape, generator, x.device, x.dtype)}
    return SOLVERS[steps.solver].sample(run.denoise, x, steps.sigmas, run.after_step, **options)


@dataclass(eq=False)
class Run:
    """The state of one call of `sample`; callbacks may set `guidance` for the next evaluation, and `interrupted`."""

    network: Network
    steps: Steps
    report: RunReport
    guidance: Guidance
    throw: bool
    on_step: OnStep | None
    progress: Callable[[float], object]
    latents: Tensor  # after the last step, (B, C, h, w)
    sigma: float = 0.0  # after the last step; unused by `run_scheduler`
    denoised: Tensor = field(init=False)  # last D(x, sigma); the result of an unfinished adaptive run
    interrupted: bool = False

    def predict(self, z: Tensor, timestep: Tensor) -> Tensor:
        """The guided prediction of the network (B, C, h, w)."""
        if self.interrupted:
            raise _EndedError(ReturnCode.INTERRUPTED)
        if self.report.evaluations == self.steps.max_evaluations:
            raise _EndedError(ReturnCode.MAX_EVALUATIONS)
        guided = self.guidance.active
        prediction = self.network(torch.cat([z] * 2) if guided else z, timestep).float()
        self.report.evaluations += 1
        self.report.guided += guided
        return self.guidance.combine(prediction) if guided else prediction

    def end_step(self, step: int, timestep: Tensor, state: Tensor, scale: float = 1.0) -> Tensor:
        """Calls `on_step` with latents = `scale` * `state`, then zeros samples that are not finite."""
        latents, self.report.steps = state * scale, step + 1
        changed = None if self.on_step is None else self.on_step(step, timestep, latents, self)
        if changed is not None:
            changed = check_tensor("callback_on_step_end: latents", changed, *state.shape, finite=False).to(state)
            if not torch.equal(changed, state * scale):  # `latents` itself may have been changed in place
                state = changed / scale
        state = self.zero_nonfinite(step, state)
        self.latents = state * scale
        return state

    def zero_nonfinite(self, step: int, latents: Tensor) -> Tensor:
        """Zeros samples that are or were non-finite; raises on a new one if `throw` is set."""
        codes = self.report.codes
        for row, finite in enumerate(latents.flatten(1).isfinite().all(dim=1).tolist()):
            if codes[row].finite and not finite:
                codes[row], self.report.failed_at[row] = ReturnCode.NON_FINITE, step
                if self.throw:
                    raise NonFiniteError(f"Sample {row} is not finite after step {step + 1}. {codes[row].message}")
        failed = torch.tensor([not code.finite for code in codes], device=latents.device)
        return latents.masked_fill(failed.view(-1, 1, 1, 1), 0.0)

    def mark_diverged(self, step: int, z: Tensor) -> None:
        """Marks samples whose RMS has just exceeded `DIVERGED_RMS`."""
        for row, rms in enumerate(z.flatten(1).square().mean(dim=1).sqrt().tolist()):  # inf where squares overflow
            if rms > DIVERGED_RMS and self.report.codes[row] is ReturnCode.SUCCESS:
                self.report.codes[row], self.report.failed_at[row] = ReturnCode.DIVERGED, step

    # Called by solvers and by adaptive steps.

    def denoise(self, x: Tensor, sigma: float) -> Tensor:
        """D(x, sigma) of the network, evaluated at the exact (fractional) timestep."""
        z = x * alpha(sigma)
        self.denoised = to_denoised(self.predict(z, self.timestep(sigma)), z, sigma, self.steps.prediction_type)
        return self.denoised

    def timestep(self, sigma: float) -> Tensor:
        return self.steps.schedule.timestep(sigma).to(self.latents.device, torch.float32)

    def after_step(self, step: int, x: Tensor, sigma: float) -> Tensor:
        """Solvers' `AfterStep`."""
        x = self.end_step(step, self.timestep(self.sigma), x, alpha(sigma))
        self.mark_diverged(step, self.latents)
        self.sigma, first, last = sigma, self.steps.sigmas[0], self.steps.schedule.sigma_min
        if self.steps.tolerance is None:
            self.progress((step + 1) / self.steps.count)
        else:
            self.progress(1.0 if sigma <= last else math.log(first / sigma) / math.log(first / last))
        return x
