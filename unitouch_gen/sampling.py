"""The one guided sampling loop, which every pipeline runs, its return codes and its report.

It owns the rules that hold everywhere: the state is float32, `latents` are unit-variance noise, guidance is
u + s (c - u), a sample that is not finite stops here, and one that grows beyond all data is called diverged. What a run
has come to lies in a `Run`, which is the call's own.
"""

import inspect
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from typing import Any

import torch
from diffusers import (
    DDIMScheduler,
    DEISMultistepScheduler,
    DPMSolverMultistepScheduler,
    EulerDiscreteScheduler,
    HeunDiscreteScheduler,
    KDPM2DiscreteScheduler,
    LMSDiscreteScheduler,
    UniPCMultistepScheduler,
)
from diffusers.schedulers.scheduling_utils import SchedulerMixin
from torch import Tensor

from unitouch_gen.errors import InvalidInputError, NonFiniteError, NotConvergedError, check_integer, describe
from unitouch_gen.schedulers.adaptive import adaptive_steps
from unitouch_gen.schedulers.defects import check_scheduler
from unitouch_gen.schedulers.exponential import FinalExtrapolation
from unitouch_gen.schedulers.schedule import PREDICTION_TYPES, NoiseSchedule, alpha, to_denoised
from unitouch_gen.schedulers.solvers import SOLVERS

MAX_EVALUATIONS = 1000
"""To a tolerance, where nothing sets a bound."""

Denoiser = Callable[[Tensor, Tensor], Tensor]
"""(noisy latents (B or 2 B, C, h, w), timestep) -> prediction of the same shape; unconditional half first."""

DIVERGED_SIZE = 10.0
"""Root mean square of a state, variance-preserving, from which its sample is diverged.

A network is trained on states of RMS 1, as latents have unit variance by diffusers' scaling factor. Measured on an
earlier built-in family: the latents of pictures are at 0.7 to 1.6, those of black-and-white noise at 2.0. In 20 steps
of any solver the largest states are at 1.3 at guidance 7.5, 2.8 at 20 and 7.4 at 100, and from 10 to 24 at 1,000; in
five steps at 3.4, 6.2 and 25 at the first three. On problems with known solutions sound runs of 50 steps stay below
1.5; those that blow up pass 10,000.
"""

HOPELESS_SIZE = 100.0
"""From which a call raises: seven times what is left of noise of the usual schedules (RMS 15) where a network takes
none of it away, and four times the largest state at guidance 1,000 that still left anything to see in the picture."""


@dataclass(frozen=True)
class Guidance:
    """Classifier-free guidance (Ho & Salimans, 2022).

    Attributes:
        scale: s in u + s (c - u).
        interval: Lowest and highest timestep at which it is on (Kynkäänniemi et al., 2024); at all of them when `None`.
    """

    scale: float
    interval: tuple[float, float] | None = None

    def at(self, timestep: Tensor) -> "Guidance":
        """What it is at one timestep: outside of its interval, the conditional prediction alone."""
        if self.interval is None or self.interval[0] <= float(timestep) <= self.interval[1]:
            return self
        return Guidance(1.0)

    @property
    def active(self) -> bool:
        """At scale 1 the unconditional branch cancels, and is left out; NaN, which a callback may set, is not."""
        return not self.scale <= 1.0

    def combine(self, prediction: Tensor) -> Tensor:
        """(2 B, ...) unconditional and conditional predictions -> (B, ...)."""
        unconditional, conditional = prediction.chunk(2)
        return unconditional + self.scale * (conditional - unconditional)


MOST_STEPS = 100_000
"""Steps, which schedulers keep arrays of."""


def _set_steps(
    scheduler: SchedulerMixin, num_inference_steps: int, device: torch.device, **chosen: Sequence[float]
) -> Tensor:
    """Sets a scheduler's timesteps and returns them.

    Args:
        scheduler: A fresh one.
        num_inference_steps: How many, where none are chosen.
        device: Where the timesteps go.
        chosen: Its steps themselves, `timesteps` or `sigmas`, as diffusers' `set_timesteps` takes them.

    Raises:
        InvalidInputError: If the scheduler cannot make these steps, or would go wrong with them.
    """
    kind: Any = type(scheduler)
    if chosen:
        (name,) = chosen
        if not takes(kind, name):
            able = ", ".join(repr(key) for key, solver in SOLVERS.items() if takes(solver.scheduler, name))
            raise InvalidInputError(
                f"`{name}` came, but {kind.__name__} makes steps of its own; leave it out, or name a `solver` that "
                f"takes it: {able}."
            )
        words = f"`{name}` is {describe(chosen[name])}"
        options: dict[str, Any] = {"num_inference_steps": None, **chosen}
    else:
        options = {"num_inference_steps": check_integer("num_inference_steps", num_inference_steps, 1, MOST_STEPS)}
        words = f"`num_inference_steps` is {num_inference_steps}"
    try:
        scheduler.set_timesteps(**options, device=device)  # type: ignore[attr-defined]
    except (ValueError, IndexError, ZeroDivisionError) as error:
        raise InvalidInputError(f"{words}, which {kind.__name__} cannot make: {error}") from error
    if hasattr(scheduler, "set_begin_index"):
        scheduler.set_begin_index(0)  # looked up by its timestep, a first one that is there twice is the second
    check_scheduler(scheduler, int(scheduler.num_inference_steps))  # type: ignore[attr-defined]
    return scheduler.timesteps  # type: ignore[attr-defined]


def takes(kind: type, name: str) -> bool:
    """Whether a scheduler class, or one that it is made of, can be told `timesteps` or `sigmas`."""
    return any(
        name in inspect.signature(vars(above)["set_timesteps"]).parameters
        for above in kind.__mro__
        if "set_timesteps" in vars(above)
    )


def steps_made(num_inference_steps: int, strength: float) -> int:
    """How many steps a share of them is, at least one."""
    return min(max(round(strength * num_inference_steps), 1), num_inference_steps)


def start_from(
    scheduler: SchedulerMixin,
    timesteps: Tensor,
    num_inference_steps: int,
    latents: Tensor,
    noise: Tensor,
    strength: float,
) -> tuple[Tensor, int, Tensor]:
    """The state to start from so that something of given latents is kept (SDEdit; Meng et al., 2022).

    Args:
        scheduler: With its timesteps set; begins later from here on.
        timesteps, num_inference_steps: Of the scheduler.
        latents: To start from, (B, C, h, w).
        noise: Unit-variance, (B, C, h, w).
        strength: Share of the steps that are made, from 0 to 1: at 1 all of them, which leaves next to nothing of the
            latents; at 0 only the last one.

    Returns:
        The timesteps that remain, the number of steps, and the state (B, C, h, w).
    """
    steps = steps_made(num_inference_steps, strength)
    first = (num_inference_steps - steps) * scheduler.order  # type: ignore[attr-defined]
    if steps < num_inference_steps:
        timesteps = timesteps[first:]
        if hasattr(scheduler, "set_begin_index"):
            scheduler.set_begin_index(first)
    state = scheduler.add_noise(latents.float(), noise.float(), timesteps[:1].expand(len(latents)))  # type: ignore[attr-defined]
    return timesteps, steps, state


@dataclass(eq=False)
class Run:
    """One run from noise to latents: what it was given, and what it has come to.

    Attributes:
        denoise: The network with its conditions bound.
        latents: The state, (B, C, h, w) in float32; callbacks may replace it.
        report: Gets the numbers of steps and evaluations, and the return codes.
        guidance: Of the next evaluation; callbacks may change it.
        throw: Raise where a sample breaks or cannot be finished; otherwise go on with the others and leave a code.
        on_step: Called as `on_step(run, evaluation, timestep)` after every evaluation, or to a tolerance after every
            accepted step; may change `latents`, `guidance` and `interrupted`.
        progress: Called after every evaluation with the share of the run that is done.
        interrupted: Ends the run before its next evaluation. An interrupt is never raised.
        discontinuous: Whether guidance changed with the last evaluation, so that its prediction does not continue those
            before it.
        finite, stable: Which samples are finite, and of reasonable size so far; bool (B,).
    """

    denoise: Denoiser
    latents: Tensor
    report: "RunReport"
    guidance: Guidance = Guidance(1.0)
    throw: bool = True
    on_step: "Callable[[Run, int, Tensor], object] | None" = None
    progress: Callable[[float], object] | None = None
    interrupted: bool = False
    discontinuous: bool = False

    def __post_init__(self) -> None:
        self.latents = self.latents.float()
        self.finite = torch.ones(len(self.latents), dtype=torch.bool, device=self.latents.device)
        self.stable = self.finite.clone()
        self._guidance: Guidance | None = None  # of the last evaluation

    def evaluate(self, state: Tensor, timestep: Tensor) -> Tensor:
        """The guided prediction (B, C, h, w) for a state as networks see it."""
        now = self.guidance.at(timestep)
        self.discontinuous = self._guidance is not None and now != self._guidance
        self._guidance = now
        prediction = self.denoise(torch.cat([state] * 2) if now.active else state, timestep).float()
        self.report.evaluations += 1
        if now.active:
            prediction = now.combine(prediction)
            self.report.guided += 1
        return prediction

    def settle(self, step: int, timestep: Tensor) -> None:
        """After `latents` moved: stops samples that have just broken, and lets the callback look at the others.

        Raises:
            NonFiniteError: If a sample is not finite and `throw` is set; the message names step and sample.
        """
        self._stop_broken(step)
        if self.on_step is None:
            return
        settled = self.latents
        self.on_step(self, self.report.evaluations - 1, timestep)
        if not isinstance(self.latents, Tensor) or self.latents.shape != settled.shape:
            raise InvalidInputError(
                f"`callback_on_step_end` returned `latents` that are {describe(self.latents)}; return a tensor of "
                f"shape {tuple(settled.shape)}."
            )
        self.latents = self.latents.to(settled)
        self._stop_broken(step)

    def check_size(self, state: Tensor, step: int) -> None:
        """Marks samples that have just grown beyond all data, by their state as networks see it (B, C, h, w).

        Raises:
            NotConvergedError: If a sample is of `HOPELESS_SIZE` and `throw` is set.
        """
        size = state.flatten(1).square().mean(dim=1).sqrt()  # may be infinite where the state is not
        if float(size.max()) <= DIVERGED_SIZE:
            return
        if self.throw and bool((size > HOPELESS_SIZE).any()):
            row = int(size.argmax())
            raise NotConvergedError(
                f"Sample {row} grew to {float(size[row]):.3g} times the size of a picture's latents in step "
                f"{step + 1}. {ReturnCode.DIVERGED.message}"
            )
        grown = self.finite & self.stable & (size > DIVERGED_SIZE)
        self.report.failed_at.update(dict.fromkeys(torch.nonzero(grown)[:, 0].tolist(), step))
        self.stable &= ~grown

    def finish(self, code: "ReturnCode", steps: int, rejected: int) -> Tensor:
        """Notes how the run ended, and returns its latents.

        Raises:
            NotConvergedError: If it was given up and `throw` is set.
        """
        report = self.report
        if self.throw and code not in (ReturnCode.SUCCESS, ReturnCode.INTERRUPTED):  # an interrupt is the user's wish
            raise NotConvergedError(f"Stopped after {report.evaluations} evaluations. {code.message}")
        self._stop_broken(steps)  # what is given up may be broken
        report.codes = [
            (code if stable else ReturnCode.DIVERGED) if finite else ReturnCode.NON_FINITE
            for finite, stable in zip(self.finite.tolist(), self.stable.tolist(), strict=True)
        ]
        report.steps, report.rejected = steps, rejected
        return self.latents

    def _stop_broken(self, step: int) -> None:
        """Raises at a sample that has just broken, or marks it; broken ones are zeros from there on."""
        finite = torch.isfinite(self.latents.flatten(1)).all(dim=1)
        if bool((finite & self.finite).all()):
            return
        rows = torch.nonzero(self.finite & ~finite)[:, 0].tolist()
        if rows and self.throw:
            raise NonFiniteError(
                f"Sample {rows[0]} is not finite after step {step + 1}. {ReturnCode.NON_FINITE.message}"
            )
        self.report.failed_at.update(dict.fromkeys(rows, step))
        self.finite &= finite
        self.latents = torch.where(self.finite.view(-1, 1, 1, 1), self.latents, 0.0)


@torch.no_grad()
def _sample_steps(
    denoise: Denoiser,
    noise: Tensor,
    scheduler: SchedulerMixin,
    report: "RunReport",
    *,
    init: Tensor | None = None,
    init_strength: float = 1.0,
    generator: Any = None,
    eta: float = 0.0,
    **options: Any,
) -> Tensor:
    """From noise to latents by the steps of a diffusers scheduler.

    Args:
        denoise: The network with its conditions bound.
        noise: Unit-variance, (B, C, h, w).
        scheduler: With its timesteps set by `_set_steps`; used up by the run.
        report: Gets the numbers of steps and evaluations, and the return codes.
        init, init_strength: Latents to start from, and how much of them to replace: see `start_from`.
        generator, eta: For schedulers that draw noise.
        options: `guidance`, `throw`, `on_step` and `progress`: see `Run`.

    Returns:
        float32 latents (B, C, h, w). Rows whose code is not finite are zeros. A sample of `DIVERGED_SIZE` or more goes
        on, and is told by its code.

    Raises:
        NonFiniteError: If a sample is not finite and `throw` is set; the message names step and sample.
        NotConvergedError: If a sample is of `HOPELESS_SIZE`, and `throw` is set.
    """
    solver: Any = scheduler  # its methods are those of each class
    timesteps, steps = solver.timesteps, int(solver.num_inference_steps)
    if init is None:
        latents = noise.float() * solver.init_noise_sigma
    else:
        timesteps, steps, latents = start_from(scheduler, timesteps, steps, init, noise, init_strength)
    run = Run(denoise, latents, report, **options)
    accepted = inspect.signature(solver.step).parameters
    drawn = {name: value for name, value in (("generator", generator), ("eta", eta)) if name in accepted}
    extrapolated = getattr(solver, "second_order_end", False) and follows_the_flow(scheduler, eta)
    sigmas = NoiseSchedule.of(scheduler).sigma(timesteps.cpu()).tolist() if extrapolated else []
    final = FinalExtrapolation()
    warm_up = max(len(timesteps) - steps * solver.order, 0)  # evaluations that are no steps, as diffusers counts
    state = solver.scale_model_input(run.latents, timesteps[0])
    for place, timestep in enumerate(timesteps):
        if run.interrupted:
            break
        step = max(place - warm_up, 0) // solver.order
        prediction = run.evaluate(state, timestep)
        if extrapolated:
            if run.discontinuous:
                final = FinalExtrapolation()
            denoised = to_denoised(prediction, state, sigmas[place], solver.config.prediction_type)
            final.add(sigmas[place], denoised)
        run.latents = solver.step(prediction, timestep, run.latents, **drawn, return_dict=False)[0]
        last = place + 1 == len(timesteps)
        if last and extrapolated:
            run.latents = final.result()
        run.settle(step, timestep)
        state = run.latents if last else solver.scale_model_input(run.latents, timesteps[place + 1])
        run.check_size(state, step)
        if run.progress is not None:
            run.progress((place + 1) / len(timesteps))
    else:
        return run.finish(ReturnCode.SUCCESS, steps, 0)
    return run.finish(ReturnCode.INTERRUPTED, steps, 0)


@torch.no_grad()
def sample_to_tolerance(
    denoise: Denoiser,
    noise: Tensor,
    schedule: NoiseSchedule,
    prediction_type: str,
    tolerance: float,
    report: "RunReport",
    *,
    init: Tensor | None = None,
    init_strength: float = 1.0,
    max_evaluations: int = MAX_EVALUATIONS,
    discontinuities: Sequence[float] = (),
    **options: Any,
) -> Tensor:
    """From noise to latents by steps that are chosen as the run goes: see `schedulers.adaptive`.

    Args:
        schedule, prediction_type: Of the network.
        tolerance: Relative RMS error of the result.
        init, init_strength: Latents to start from, and the share of the way, in Karras spacing, that is made.
        max_evaluations: After which the run ends where it is.
        discontinuities: Timesteps at which the prediction is discontinuous, in [0, T - 1].
        denoise, noise, report, options: See `sample`.

    Returns:
        As `sample`.

    Raises:
        NonFiniteError: As `sample`.
        NotConvergedError: If the tolerance is not reached, too, and `throw` is set.
    """
    sigma, state = schedule.sigma_max, noise.float()
    if init is not None:
        sigma = schedule.karras(1.0 - init_strength)
        state = (init.float() + sigma * noise.float()) * alpha(sigma)
    run = Run(denoise, state, report, **options)
    code, steps, rejected = adaptive_steps(
        run,
        schedule,
        prediction_type,
        tolerance,
        start=sigma,
        max_evaluations=max_evaluations,
        discontinuities=discontinuities,
    )
    return run.finish(ReturnCode(code), steps, rejected)


DETERMINISTIC = (
    DDIMScheduler,
    DEISMultistepScheduler,
    DPMSolverMultistepScheduler,
    EulerDiscreteScheduler,
    HeunDiscreteScheduler,
    KDPM2DiscreteScheduler,
    LMSDiscreteScheduler,
    UniPCMultistepScheduler,
)


def follows_the_flow(scheduler: SchedulerMixin, eta: float) -> bool:
    """Whether a scheduler integrates the probability-flow ODE, at noise levels that are known, and adds no noise."""
    config = scheduler.config  # type: ignore[attr-defined]
    return (
        isinstance(scheduler, DETERMINISTIC)
        and eta == 0.0
        and not str(config.get("algorithm_type", "")).startswith("sde")
        and config.get("prediction_type") in PREDICTION_TYPES
        and not config.get("use_flow_sigmas", False)
    )


# How it ended ---------------------------------------------------------------------------------------------------------


class ReturnCode(StrEnum):
    """How one sample ended."""

    SUCCESS = "success"
    NON_FINITE = "non_finite"
    MAX_EVALUATIONS = "max_evaluations"
    STEP_TOO_SMALL = "step_too_small"
    DIVERGED = "diverged"
    INTERRUPTED = "interrupted"

    @property
    def finite(self) -> bool:
        """Whether there is a sample to return, finished or not."""
        return self is not ReturnCode.NON_FINITE

    @property
    def message(self) -> str:
        """What it means and what to try next."""
        return MESSAGES[self]


MESSAGES: dict[ReturnCode, str] = {
    ReturnCode.SUCCESS: "The sample is finite.",
    ReturnCode.NON_FINITE: (
        "The latents left the range of floating-point numbers. Lower `guidance_scale` or `strength`, raise "
        "`num_inference_steps`, or run the network in float32."
    ),
    ReturnCode.MAX_EVALUATIONS: (
        "The tolerance was not reached within `max_evaluations`; the sample is finite, but unfinished. Allow more "
        "evaluations, or a larger `tolerance`."
    ),
    ReturnCode.STEP_TOO_SMALL: (
        "No step was small enough for the tolerance; the sample is finite, but unfinished. Allow a larger `tolerance`, "
        "lower `guidance_scale`, or run the network in float32."
    ),
    ReturnCode.DIVERGED: (
        "The latents grew far beyond those of any picture, where the network was never trained; the sample is finite, "
        "but not to be trusted. Lower `guidance_scale`, keep it to a `guidance_interval`, or take more steps."
    ),
    ReturnCode.INTERRUPTED: (
        "The call was interrupted; the sample is finite, but unfinished, with noise left in it. Call again without the "
        "interrupt to finish it."
    ),
}


@dataclass
class RunReport:
    """What a pipeline call did.

    Attributes:
        solver: Name of the solver, or class of the pipeline's own scheduler.
        steps: Solver steps asked for, or accepted to a tolerance.
        rejected: Steps that were tried and refused, to a tolerance.
        evaluations: Calls of the denoising network that were made; with guidance one call holds both branches.
        guided: How many of them held both branches of guidance.
        guidance_scale: At the start; a callback may change it.
        seconds: Wall-clock time of each stage.
        codes: One return code for each sample.
        failed_at: Step at which a sample broke or became diverged, from 0, by its index; the number of steps if it
            broke in decoding.
        sensors: Sensor whose tokens each touch got; `None` where none were used.
        sensor_distances: L1 distance to that sensor's prototype, or the nearest one, in units of full scale.
        unknown: Why the model abstains from naming each input, such as "unlike anything known", `None` where it does
            not; by modality, of those that the model stores out-of-distribution scores of.
        chosen: Index of the sample that each picture is of, where it was chosen among candidates.
        scores: Of those: cosine of their embedding to the condition.
        left_out: What the request did not need and was not run.
        tolerance: Relative RMS error of the latents that was asked for.
    """

    solver: str = ""
    steps: int = 0
    rejected: int = 0
    evaluations: int = 0
    guided: int = 0
    guidance_scale: float = 1.0
    seconds: dict[str, float] = field(default_factory=dict)
    codes: list[ReturnCode] = field(default_factory=list)
    failed_at: dict[int, int] = field(default_factory=dict)
    sensors: list[str | None] = field(default_factory=list)
    sensor_distances: list[float | None] = field(default_factory=list)
    unknown: dict[str, list[str | None]] = field(default_factory=dict)
    chosen: list[int] = field(default_factory=list)
    scores: list[float] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    tolerance: float | None = None

    @property
    def success(self) -> bool:
        """Whether every sample ended well."""
        return all(code is ReturnCode.SUCCESS for code in self.codes)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Adds the time spent inside to a stage."""
        started = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - started

    @classmethod
    def joined(cls, reports: Sequence["RunReport"]) -> "RunReport":
        """One report of several calls with the same arguments: their samples in a row, evaluations and seconds
        summed.

        Args:
            reports: At least one.
        """
        first = reports[0]
        whole = cls(
            first.solver,
            max(report.steps for report in reports),
            guidance_scale=first.guidance_scale,
            left_out=list(dict.fromkeys(item for report in reports for item in report.left_out)),
            tolerance=first.tolerance,
        )
        for report in reports:
            whole.evaluations += report.evaluations
            whole.rejected += report.rejected
            whole.guided += report.guided
            for stage, seconds in report.seconds.items():
                whole.seconds[stage] = whole.seconds.get(stage, 0.0) + seconds
            whole.failed_at |= {len(whole.codes) + sample: step for sample, step in report.failed_at.items()}
            whole.chosen += [len(whole.codes) + sample for sample in report.chosen]
            whole.codes += report.codes
            whole.scores += report.scores
            whole.sensors += report.sensors
            whole.sensor_distances += report.sensor_distances
            for modality, reasons in report.unknown.items():
                whole.unknown[modality] = [*whole.unknown.get(modality, []), *reasons]
        return whole

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        values = asdict(self)
        values["codes"] = [code.value for code in self.codes]
        return values

    def __str__(self) -> str:
        total = sum(self.seconds.values())
        stages = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in self.seconds.items())
        ended = "all finite" if self.success else ", ".join(code.value for code in self.codes)
        abstained = sum(reason is not None for reasons in self.unknown.values() for reason in reasons)
        if abstained:
            ended = f"{ended}; {abstained} {'input is' if abstained == 1 else 'inputs are'} unknown to the model"
        refused = f" ({self.rejected} rejected)" if self.rejected else ""
        steps = f"{self.steps} steps{refused}, {self.evaluations} evaluations"
        return f"{self.solver}: {steps}, {total:.2f} s ({stages}); {ended}"


# The new contract, on the old loop -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Steps:
    scheduler: Any
    solver: str
    evaluations: int
    tolerance: float | None
    max_evaluations: int
    eta: float
    init_strength: float


def prepare_steps(
    scheduler: Any, *, solver=None, num_inference_steps=50, timesteps=None, sigmas=None, tolerance=None,
    max_evaluations=None, eta=0.0, init_strength=1.0, device="cpu",
):
    from unitouch_gen.errors import check_number
    from unitouch_gen.schedulers.solvers import make_scheduler, name_of

    made = make_scheduler(scheduler, solver)
    check_number("eta", eta, 0.0, 1.0)
    if tolerance is not None:
        check_number("tolerance", tolerance, 1e-5, 1.0)
        return Steps(made, "adaptive", 100, tolerance, max_evaluations or MAX_EVALUATIONS, eta, init_strength)
    chosen = {k: v for k, v in (("timesteps", timesteps), ("sigmas", sigmas)) if v is not None}
    if chosen:
        spaced = {f"use_{name}_sigmas": False for name in ("karras", "exponential", "beta")}
        made = type(made).from_config(made.config, **{k: v for k, v in spaced.items() if k in made.config})
    _set_steps(made, num_inference_steps, device, **chosen)
    steps = int(made.num_inference_steps)
    skipped = steps - steps_made(steps, init_strength)
    name = solver or name_of(made) or type(made).__name__
    return Steps(made, name, len(made.timesteps) - skipped * made.order, None, 0, eta, init_strength)


def sample(network, noise, steps, report, *, guidance=Guidance(1.0), init=None, generator=None, throw=True,
           on_step=None, progress=None):
    def settle(run, evaluation, timestep):
        run.latents = on_step(evaluation, timestep, run.latents, run)

    report.solver, report.tolerance, report.guidance_scale = steps.solver, steps.tolerance, guidance.scale
    options = {"guidance": guidance, "throw": throw, "on_step": settle if on_step else None, "progress": progress,
               "init": init, "init_strength": steps.init_strength}
    if steps.tolerance is None:
        return _sample_steps(network, noise, steps.scheduler, report, generator=generator, eta=steps.eta, **options)
    config = steps.scheduler.config
    return sample_to_tolerance(network, noise, NoiseSchedule.of(steps.scheduler), config.prediction_type,
                               steps.tolerance, report, max_evaluations=steps.max_evaluations,
                               discontinuities=(guidance.interval or ()) if guidance.active else (), **options)
