"""The one guided sampling loop, which every pipeline runs.

It owns the rules that hold everywhere: the state is float32, `latents` are unit-variance noise, guidance is
u + s (c - u), a sample that is not finite stops here, and one that grows beyond all data is called diverged.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from diffusers.schedulers.scheduling_utils import SchedulerMixin
from torch import Tensor

from unitouch_gen.errors import InvalidInputError, NonFiniteError, NotConvergedError, describe
from unitouch_gen.report import ReturnCode, RunReport
from unitouch_gen.schedulers.defects import check_scheduler
from unitouch_gen.schedulers.steps import FixedSteps, Steps

Denoiser = Callable[[Tensor, Tensor], Tensor]
"""(noisy latents (B or 2 B, C, h, w), timestep) -> prediction of the same shape; unconditional half first."""

StepCallback = Callable[[int, Tensor, dict[str, Tensor]], dict[str, Tensor]]
"""(evaluation, timestep, {"latents": ...}) -> tensors to put in their place."""


DIVERGED_SIZE = 10.0
"""Root mean square of a state, variance-preserving, from which its sample is diverged.

A network is trained on states of RMS 1, as latents have unit variance by diffusers' scaling factor. Measured on the
built-in family: the latents of pictures are at 0.7 to 1.6, those of black-and-white noise at 2.0. In 20 steps of any
solver the largest states are at 1.3 at guidance 7.5, 2.8 at 20 and 7.4 at 100, and from 10 to 24 at 1,000; in five
steps at 3.4, 6.2 and 25 at the first three. On problems with known solutions sound runs of 50 steps stay below 1.5;
those that blow up pass 10,000.
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


def prepare_steps(scheduler: SchedulerMixin, num_inference_steps: int, device: torch.device) -> Tensor:
    """Sets a scheduler's timesteps and returns them.

    Raises:
        InvalidInputError: If the scheduler cannot make this number of steps, or would go wrong with them.
    """
    if num_inference_steps < 1:
        raise InvalidInputError(
            f"`num_inference_steps` is {num_inference_steps}, which {type(scheduler).__name__} cannot make: take at "
            "least one."
        )
    try:
        scheduler.set_timesteps(num_inference_steps, device=device)  # type: ignore[attr-defined]
    except (ValueError, IndexError, ZeroDivisionError) as error:
        raise InvalidInputError(
            f"`num_inference_steps` is {num_inference_steps}, which {type(scheduler).__name__} cannot make: {error}"
        ) from error
    if hasattr(scheduler, "set_begin_index"):
        scheduler.set_begin_index(0)  # looked up by its timestep, a first one that is there twice is the second
    check_scheduler(scheduler, num_inference_steps)
    return scheduler.timesteps  # type: ignore[attr-defined]


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
    steps = min(max(round(strength * num_inference_steps), 1), num_inference_steps)
    first = (num_inference_steps - steps) * scheduler.order  # type: ignore[attr-defined]
    if steps < num_inference_steps:
        timesteps = timesteps[first:]
        if hasattr(scheduler, "set_begin_index"):
            scheduler.set_begin_index(first)
    state = scheduler.add_noise(latents.float(), noise.float(), timesteps[:1].expand(len(latents)))  # type: ignore[attr-defined]
    return timesteps, steps, state


def fixed_steps(
    scheduler: SchedulerMixin,
    timesteps: Tensor,
    num_inference_steps: int,
    noise: Tensor,
    *,
    init: Tensor | None = None,
    init_strength: float = 1.0,
    **options: Any,
) -> FixedSteps:
    """The steps of a scheduler, from noise or from given latents.

    Args:
        scheduler, timesteps, num_inference_steps: See `prepare_steps`.
        noise: Unit-variance, (B, C, h, w).
        init, init_strength: Latents to start from, and how much of them to replace: see `start_from`.
        options: Of `FixedSteps`.
    """
    if init is None:
        state = noise.float() * scheduler.init_noise_sigma  # type: ignore[attr-defined]
        return FixedSteps(scheduler, timesteps, num_inference_steps, state, **options)
    return FixedSteps(
        scheduler, *start_from(scheduler, timesteps, num_inference_steps, init, noise, init_strength), **options
    )


@torch.no_grad()
def integrate(
    denoise: Denoiser,
    steps: Steps,
    guidance: Callable[[], Guidance],
    report: RunReport,
    *,
    throw: bool = True,
    on_step: StepCallback | None = None,
    progress: Callable[[], Any] | None = None,
    interrupted: Callable[[], bool] = lambda: False,
) -> Tensor:
    """Integrates from noise to latents.

    Args:
        denoise: The network with its conditions bound.
        steps: Where to evaluate it, and what to make of that.
        guidance: Asked for before every evaluation, as a callback may change it.
        report: Gets the numbers of steps and evaluations, the return codes and the error indicator.
        throw: Raise where a sample breaks or cannot be finished; otherwise go on with the others and leave a code.
        on_step: Called after every step, of Heun's after every evaluation; may replace the latents.
        progress: Called after every evaluation.
        interrupted: Asked before every evaluation. An interrupt is never raised.

    Returns:
        float32 latents (B, C, h, w). Rows whose code is not finite are zeros. A sample of `DIVERGED_SIZE` or more goes
        on, and is told by its code.

    Raises:
        NonFiniteError: If a sample is not finite and `throw` is set; the message names step and sample.
        NotConvergedError: If `steps` gave up, or a sample is of `HOPELESS_SIZE`, and `throw` is set.
    """
    alive = torch.ones(len(steps.latents), dtype=torch.bool, device=steps.latents.device)
    stable = alive.clone()
    before = None
    while (request := steps.next()) is not None and not interrupted():
        (state, timestep), number = request, steps.number
        now = guidance().at(timestep)
        if before is not None and now != before:
            steps.jump()
        before = now
        prediction = denoise(torch.cat([state] * 2) if now.active else state, timestep).float()
        index, report.evaluations = report.evaluations, report.evaluations + 1
        if now.active:
            prediction = now.combine(prediction)
            report.guided += 1
        if steps.take(prediction, alive & stable):
            steps.latents = _drop_broken(steps.latents, alive, number, report, throw)
            if on_step is not None:
                changed = on_step(index, timestep, {"latents": steps.latents}).get("latents")
                if changed is not None:
                    changed = _replacement(changed, steps.latents)
                    steps.latents = _drop_broken(changed, alive, number, report, throw)
            if steps.code in (None, ReturnCode.SUCCESS):  # what is given up is no state, and has its own code
                _mark_diverged(steps.state(), alive, stable, number, report, throw)
        if progress is not None:
            progress()
    ended = steps.code or ReturnCode.INTERRUPTED
    if throw and ended not in (ReturnCode.SUCCESS, ReturnCode.INTERRUPTED):  # an interrupt is the user's wish
        raise NotConvergedError(f"Stopped after {report.evaluations} evaluations. {ended.message}")
    steps.latents = _drop_broken(steps.latents, alive, steps.number, report, throw)  # what is given up may be broken
    report.codes = [
        (ended if steady else ReturnCode.DIVERGED) if ok else ReturnCode.NON_FINITE
        for ok, steady in zip(alive.tolist(), stable.tolist(), strict=True)
    ]
    report.steps, report.rejected = steps.steps, steps.rejected
    indicator = steps.indicator() if ended is ReturnCode.SUCCESS else None
    if indicator is not None:
        report.error_indicator = indicator.masked_fill(~(alive & stable), math.nan).tolist()
    return steps.latents


def _replacement(changed: Any, latents: Tensor) -> Tensor:
    """What a callback puts in the place of the latents."""
    if not isinstance(changed, Tensor) or changed.shape != latents.shape:
        raise InvalidInputError(
            f"`callback_on_step_end` returned `latents` that are {describe(changed)}; return a tensor of shape "
            f"{tuple(latents.shape)}."
        )
    return changed.to(latents)


def _drop_broken(latents: Tensor, alive: Tensor, step: int, report: RunReport, throw: bool) -> Tensor:
    """Raises at a sample that has just broken, or marks it; broken ones are zeros from there on."""
    finite = torch.isfinite(latents.flatten(1)).all(dim=1)
    if bool((finite & alive).all()):
        return latents
    rows = torch.nonzero(alive & ~finite)[:, 0].tolist()
    if rows and throw:
        raise NonFiniteError(f"Sample {rows[0]} is not finite after step {step + 1}. {ReturnCode.NON_FINITE.message}")
    report.failed_at.update(dict.fromkeys(rows, step))
    alive &= finite
    return torch.where(alive.view(-1, 1, 1, 1), latents, 0.0)


def _mark_diverged(state: Tensor, alive: Tensor, stable: Tensor, step: int, report: RunReport, throw: bool) -> None:
    """Marks samples that have just grown beyond all data, or raises where nothing could come of one.

    Args:
        state: Variance-preserving, (B, C, h, w).
        alive, stable: Which samples are finite, and of reasonable size so far; bool (B,).
    """
    size = state.flatten(1).square().mean(dim=1).sqrt()  # may be infinite where the state is not
    if float(size.max()) <= DIVERGED_SIZE:
        return
    if throw and bool((size > HOPELESS_SIZE).any()):
        row = int(size.argmax())
        raise NotConvergedError(
            f"Sample {row} grew to {float(size[row]):.3g} times the size of a picture's latents in step {step + 1}. "
            f"{ReturnCode.DIVERGED.message}"
        )
    grown = alive & stable & (size > DIVERGED_SIZE)
    report.failed_at.update(dict.fromkeys(torch.nonzero(grown)[:, 0].tolist(), step))
    stable &= ~grown
