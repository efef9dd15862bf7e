"""Where a run goes next: the steps of a diffusers scheduler, seen by the sampling loop."""

import inspect
from typing import Any, Protocol

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

from unitouch_gen.report import ReturnCode
from unitouch_gen.schedulers.estimate import ErrorIndicator
from unitouch_gen.schedulers.exponential import FinalExtrapolation
from unitouch_gen.schedulers.fitted import FittedScheduler
from unitouch_gen.schedulers.schedule import PREDICTION_TYPES, NoiseSchedule, to_denoised

DETERMINISTIC = (
    DDIMScheduler,
    DEISMultistepScheduler,
    DPMSolverMultistepScheduler,
    EulerDiscreteScheduler,
    HeunDiscreteScheduler,
    KDPM2DiscreteScheduler,
    LMSDiscreteScheduler,
    UniPCMultistepScheduler,
    FittedScheduler,
)


class Steps(Protocol):
    """What the sampling loop asks of a solver.

    Attributes:
        latents: The state (B, C, h, w) in float32, as callbacks see and may replace it; after the last step, the
            result.
        steps: Those asked for, or accepted so far.
        rejected: Steps that were refused.
        planned: Units of progress, all of them.
    """

    latents: Tensor
    steps: int
    rejected: int
    planned: int

    @property
    def code(self) -> ReturnCode | None:
        """How it ended, for all samples that are finite; `None` while there is more to do."""

    @property
    def done(self) -> int:
        """Units of progress so far."""

    @property
    def number(self) -> int:
        """Of the step that the next evaluation belongs to, from 0."""

    def next(self) -> tuple[Tensor, Tensor] | None:
        """State as the network sees it (B, C, h, w), and its timestep; `None` at the end."""

    def take(self, prediction: Tensor, alive: Tensor) -> bool:
        """Goes on by one guided prediction (B, C, h, w).

        Args:
            prediction: Of the network for the last `next()`.
            alive: Which samples still count, bool (B,).

        Returns:
            Whether `latents` moved: not for a step that is refused.
        """

    def state(self) -> Tensor:
        """`latents` as networks see them, variance-preserving; after the last step the result."""

    def jump(self) -> None:
        """Says that the prediction of the last `next()` does not continue those before it, as guidance changed."""

    def indicator(self) -> Tensor | None:
        """Of the error of each sample, (B,), or `None` where the solver gives none."""


class FixedSteps:
    """The timesteps of a diffusers scheduler, one after the other.

    Args:
        scheduler: With its timesteps set.
        timesteps: Those that are left of them, one for each evaluation.
        num_inference_steps: Of the solver; Heun's take two evaluations, and the first of PNDM as well.
        latents: State at the first timestep, (B, C, h, w).
        generator, eta: For schedulers that draw noise.
    """

    def __init__(
        self,
        scheduler: SchedulerMixin,
        timesteps: Tensor,
        num_inference_steps: int,
        latents: Tensor,
        generator: Any = None,
        eta: float = 0.0,
    ):
        self.scheduler, self.timesteps, self.latents = scheduler, timesteps, latents
        self.steps, self.planned = num_inference_steps, len(timesteps)
        self.options = step_options(scheduler, generator, eta)
        self.order = scheduler.order  # type: ignore[attr-defined]
        self.warm_up = max(len(timesteps) - num_inference_steps * self.order, 0)  # as diffusers counts
        self.done = self.rejected = 0
        self.sigmas: list[float] | None = None  # at the timesteps
        self.errors = ErrorIndicator() if follows_the_flow(scheduler, eta) else None
        jumps = self.errors is not None and getattr(scheduler, "second_order_end", False)
        self.end = FinalExtrapolation() if jumps else None

    @property
    def code(self) -> ReturnCode | None:
        return ReturnCode.SUCCESS if self.done == len(self.timesteps) else None

    @property
    def number(self) -> int:
        return max(self.done - self.warm_up, 0) // self.order

    def state(self) -> Tensor:
        if self.done == len(self.timesteps):
            return self.latents
        return self.scheduler.scale_model_input(self.latents, self.timesteps[self.done])  # type: ignore[attr-defined]

    def next(self) -> tuple[Tensor, Tensor] | None:
        if self.done == len(self.timesteps):
            return None
        self.seen = self.state()
        return self.seen, self.timesteps[self.done]

    def jump(self) -> None:
        if self.errors is not None:
            self.errors.restart()
        if self.end is not None:
            self.end = FinalExtrapolation()

    def take(self, prediction: Tensor, alive: Tensor) -> bool:
        timestep = self.timesteps[self.done]
        if self.errors is not None:
            self._remember(prediction)
        self.latents = self.scheduler.step(prediction, timestep, self.latents, **self.options, return_dict=False)[0]  # type: ignore[attr-defined]
        self.done += 1
        if self.end is not None and self.done == len(self.timesteps):
            self.latents = self.end.result()
        return True

    def _remember(self, prediction: Tensor) -> None:
        """D at this evaluation's noise level, for the estimate and for the last jump."""
        assert self.errors is not None
        if self.sigmas is None:
            self.sigmas = NoiseSchedule.of(self.scheduler).sigma(self.timesteps.cpu()).tolist()
        sigma = self.sigmas[self.done]
        denoised = to_denoised(prediction, self.seen, sigma, self.scheduler.config.prediction_type)  # type: ignore[attr-defined]
        self.errors.add(sigma, denoised)
        if self.end is not None:
            self.end.add(sigma, denoised)

    def indicator(self) -> Tensor | None:
        return None if self.errors is None else self.errors.of(self.latents)


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


def step_options(scheduler: SchedulerMixin, generator: Any, eta: float) -> dict[str, Any]:
    """Of `generator` and `eta`, what this scheduler's `step` takes."""
    accepted = inspect.signature(scheduler.step).parameters  # type: ignore[attr-defined]
    options = {"generator": generator, "eta": eta}
    return {key: value for key, value in options.items() if key in accepted}
