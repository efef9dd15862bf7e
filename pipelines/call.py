"""One call of a pipeline: its settings, checked, and where they lead the sampling loop."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from diffusers.schedulers.scheduling_utils import SchedulerMixin
from torch import Tensor

from unitouch_gen.models.sensors import SensorMatch
from unitouch_gen.pipelines.checks import Generators
from unitouch_gen.plan import Plan
from unitouch_gen.report import RunReport
from unitouch_gen.sampling import Guidance, fixed_steps
from unitouch_gen.schedulers.adaptive import ADAPTIVE, AdaptiveSteps
from unitouch_gen.schedulers.estimate import UNCALIBRATED, Calibration
from unitouch_gen.schedulers.fitted import FITTED, FittedScheduler
from unitouch_gen.schedulers.schedule import NoiseSchedule, alpha
from unitouch_gen.schedulers.solvers import name_of
from unitouch_gen.schedulers.steps import Steps

StepEndCallback = Callable[[Any, int, Tensor, dict[str, Tensor]], dict[str, Tensor] | None]

MAX_EVALUATIONS = 1000
"""To a tolerance, where a call sets no bound."""


@dataclass
class Call:
    """The settings of one call, checked; the names are those of the pipelines' arguments.

    Attributes:
        scheduler: Fresh, with its timesteps set.
        timesteps: Of the scheduler; none where steps are chosen to a tolerance.
        shape: Of the latents, (B n, C, h, w).
        repeats: n, of samples for each input.
        calibration: Of the error indicator, if the checkpoint has one for this solver.
    """

    scheduler: SchedulerMixin
    timesteps: Tensor
    num_inference_steps: int
    guidance: Guidance
    shape: tuple[int, int, int, int]
    repeats: int
    solver: str | None
    tolerance: float | None
    max_evaluations: int
    calibration: Calibration | None
    eta: float
    generator: Generators
    latents: Tensor | None
    output_type: str
    callback: StepEndCallback | None
    callback_inputs: Sequence[str]
    throw: bool

    @property
    def name(self) -> str:
        """Of the solver."""
        return solver_name(self.solver, self.tolerance, self.scheduler)

    def report(self, plan: Plan, matches: Sequence[SensorMatch] = ()) -> RunReport:
        """A fresh report of this call."""
        return RunReport(
            solver=self.name,
            tolerance=self.tolerance,
            calibrated=self.calibration is not None,
            guidance_scale=self.guidance.scale,
            left_out=plan.left_out,
            sensors=[match.name for match in matches],
            sensor_distances=[match.distance for match in matches],
        )

    def steps(self, noise: Tensor, init: Tensor | None, init_strength: float) -> Steps:
        """Where the run goes: the scheduler's steps, or those to a tolerance, from noise or from given latents."""
        if self.tolerance is None:
            return fixed_steps(
                self.scheduler,
                self.timesteps,
                self.num_inference_steps,
                noise,
                init=init,
                init_strength=init_strength,
                generator=self.generator,
                eta=self.eta,
            )
        schedule, sigma, state = NoiseSchedule.of(self.scheduler), None, noise.float()
        if init is not None:
            sigma = schedule.karras(1.0 - init_strength)
            state = (init.float() + sigma * noise.float()) * alpha(sigma)
        return AdaptiveSteps(
            schedule,
            self.scheduler.config.prediction_type,
            state,
            self.tolerance,
            calibration=self.calibration or UNCALIBRATED,
            max_evaluations=self.max_evaluations,
            start_sigma=sigma,
            jumps=(self.guidance.interval or ()) if self.guidance.active else (),
        )


def solver_name(solver: str | None, tolerance: float | None, scheduler: SchedulerMixin) -> str:
    """What reports and calibrations call a solver: by the class of a pipeline's own where that is none of ours."""
    if tolerance is not None:
        return ADAPTIVE
    if isinstance(scheduler, FittedScheduler):
        return FITTED
    return solver or name_of(scheduler) or type(scheduler).__name__
