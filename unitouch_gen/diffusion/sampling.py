"""The one guided sampling loop, which every pipeline runs.

It owns the rules that hold everywhere: the state is float32, `latents` are unit-variance noise, guidance is
u + s (c - u), and a sample that is not finite stops here.
"""

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from diffusers.schedulers.scheduling_utils import SchedulerMixin
from torch import Tensor

from unitouch_gen.diffusion.report import ReturnCode, RunReport
from unitouch_gen.errors import InvalidInputError, NonFiniteError

Denoiser = Callable[[Tensor, Tensor], Tensor]
"""(noisy latents (B or 2 B, C, h, w), timestep) -> prediction of the same shape; unconditional half first."""

StepCallback = Callable[[int, Tensor, dict[str, Tensor]], dict[str, Tensor]]
"""(evaluation, timestep, {"latents": ...}) -> tensors to put in their place."""


@dataclass(frozen=True)
class Guidance:
    """Classifier-free guidance (Ho & Salimans, 2022).

    Attributes:
        scale: s in u + s (c - u).
    """

    scale: float

    @property
    def active(self) -> bool:
        """At scale 1 the unconditional branch cancels, and is left out."""
        return self.scale > 1.0

    def combine(self, prediction: Tensor) -> Tensor:
        """(2 B, ...) unconditional and conditional predictions -> (B, ...)."""
        unconditional, conditional = prediction.chunk(2)
        return unconditional + self.scale * (conditional - unconditional)


def prepare_steps(scheduler: SchedulerMixin, num_inference_steps: int, device: torch.device) -> Tensor:
    """Sets a scheduler's timesteps and returns them.

    Raises:
        InvalidInputError: If the scheduler cannot make this number of steps.
    """
    try:
        scheduler.set_timesteps(num_inference_steps, device=device)  # type: ignore[attr-defined]
    except (ValueError, IndexError, ZeroDivisionError) as error:
        raise InvalidInputError(
            f"`num_inference_steps` is {num_inference_steps}, which {type(scheduler).__name__} cannot make: {error}"
        ) from error
    timesteps = scheduler.timesteps  # type: ignore[attr-defined]
    levels = scheduler.config.num_train_timesteps  # type: ignore[attr-defined]
    request = f"`num_inference_steps` is {num_inference_steps}, with which {type(scheduler).__name__} starts"
    if timesteps.max() >= levels:  # "leading" spacing with an offset, as many steps as levels
        raise InvalidInputError(f"{request} beyond the last of its {levels} noise levels; take fewer steps.")
    if timesteps.max() < levels / 3:  # one step, "leading" or "linspace": what comes out would be the noise
        raise InvalidInputError(
            f"{request} at noise level {timesteps.max():.0f} of {levels}, too low for pure noise; take more steps."
        )
    return timesteps


def start_from(
    scheduler: SchedulerMixin,
    timesteps: Tensor,
    num_inference_steps: int,
    latents: Tensor,
    noise: Tensor,
    strength: float,
) -> tuple[Tensor, Tensor, int]:
    """The state to start from so that something of given latents is kept (SDEdit; Meng et al., 2022).

    Args:
        scheduler: With its timesteps set; begins later from here on.
        timesteps, num_inference_steps: Of the scheduler.
        latents: To start from, (B, C, h, w).
        noise: Unit-variance, (B, C, h, w).
        strength: Share of the steps that are made, from 0 to 1: at 1 all of them, which leaves next to nothing of the
            latents; at 0 only the last one.

    Returns:
        The state (B, C, h, w), the timesteps that remain, and the number of steps.
    """
    steps = min(max(round(strength * num_inference_steps), 1), num_inference_steps)
    first = (num_inference_steps - steps) * scheduler.order  # type: ignore[attr-defined]
    if steps < num_inference_steps:
        timesteps = timesteps[first:]
        if hasattr(scheduler, "set_begin_index"):
            scheduler.set_begin_index(first)
    state = scheduler.add_noise(latents.float(), noise.float(), timesteps[:1].expand(len(latents)))  # type: ignore[attr-defined]
    return state, timesteps, steps


@torch.no_grad()
def sample(
    denoise: Denoiser,
    scheduler: SchedulerMixin,
    noise: Tensor,
    guidance: Callable[[], Guidance],
    report: RunReport,
    *,
    timesteps: Tensor,
    num_inference_steps: int,
    start: Tensor | None = None,
    generator: torch.Generator | list[torch.Generator] | None = None,
    eta: float = 0.0,
    throw: bool = True,
    on_step: StepCallback | None = None,
    progress: Callable[[], Any] | None = None,
    interrupted: Callable[[], bool] = lambda: False,
) -> Tensor:
    """Integrates from noise to latents.

    Args:
        denoise: The network with its conditions bound.
        scheduler: With its timesteps set.
        noise: Unit-variance noise, (B, C, h, w).
        guidance: Asked for before every evaluation, as a callback may change it.
        report: Gets the numbers of steps and evaluations and the return codes.
        timesteps: Of the scheduler, one for each evaluation.
        num_inference_steps: Of the solver; Heun's take two evaluations, and the first of PNDM as well.
        start: State at the first timestep in place of the noise scaled to it; see `start_from`.
        generator, eta: For schedulers that draw noise.
        throw: Raise where a sample breaks; otherwise go on with the others and leave a code.
        on_step: Called after every evaluation; may replace the latents.
        progress: Called after every evaluation.
        interrupted: Asked before every evaluation.

    Returns:
        float32 latents (B, C, h, w). Rows whose code is not SUCCESS are zeros.

    Raises:
        NonFiniteError: If a sample is not finite and `throw` is set; the message names step and sample.
    """
    report.steps = num_inference_steps
    order = scheduler.order  # type: ignore[attr-defined]
    warm_up = max(len(timesteps) - num_inference_steps * order, 0)  # as diffusers counts
    options = step_options(scheduler, generator, eta)
    latents = noise.float() * scheduler.init_noise_sigma if start is None else start.float()  # type: ignore[attr-defined]
    alive = torch.ones(len(latents), dtype=torch.bool, device=latents.device)
    for index, timestep in enumerate(timesteps):
        if interrupted():
            break
        step, now = max(index - warm_up, 0) // order, guidance()
        state = torch.cat([latents] * 2) if now.active else latents
        prediction = denoise(scheduler.scale_model_input(state, timestep), timestep).float()  # type: ignore[attr-defined]
        report.evaluations += 1
        if now.active:
            prediction = now.combine(prediction)
        latents = scheduler.step(prediction, timestep, latents, **options, return_dict=False)[0]  # type: ignore[attr-defined]
        latents = _drop_broken(latents, alive, step, report, throw)
        if on_step is not None:
            latents = on_step(index, timestep, {"latents": latents}).get("latents", latents).to(latents)
            latents = _drop_broken(latents, alive, step, report, throw)
        if progress is not None:
            progress()
    report.codes = [ReturnCode.SUCCESS if ok else ReturnCode.NON_FINITE for ok in alive.tolist()]
    return latents


def _drop_broken(latents: Tensor, alive: Tensor, step: int, report: RunReport, throw: bool) -> Tensor:
    """Raises at a sample that has just broken, or marks it; broken ones are zeros from there on."""
    finite = torch.isfinite(latents.flatten(1)).all(dim=1)
    rows = torch.nonzero(alive & ~finite)[:, 0].tolist()
    if rows and throw:
        raise NonFiniteError(f"Sample {rows[0]} is not finite after step {step + 1}. {ReturnCode.NON_FINITE.message}")
    report.failed_at.update(dict.fromkeys(rows, step))
    alive &= finite
    return torch.where(alive.view(-1, 1, 1, 1), latents, 0.0)


def step_options(scheduler: SchedulerMixin, generator: Any, eta: float) -> dict[str, Any]:
    """Of `generator` and `eta`, what this scheduler's `step` takes."""
    accepted = inspect.signature(scheduler.step).parameters  # type: ignore[attr-defined]
    options = {"generator": generator, "eta": eta}
    return {key: value for key, value in options.items() if key in accepted}
