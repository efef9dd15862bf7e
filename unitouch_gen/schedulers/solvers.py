"""Solvers by name: diffusers schedulers with the settings that let each reach its order and end without noise.

Karras spacing (Karras et al., 2022, Eq. 5) takes the uniform-in-time tail away that holds multistep solvers at first
order; the state is kept in float32 by the loop, whatever the network's dtype. The classes mend what holds diffusers'
own above an error of 1e-3: networks are asked at the exact, continuous timestep of each noise level, not at a rounded
one; Euler and Heun start where the others do; DDIM's steps end where the next begin; and where a class says
`second_order_end`, the loop makes the step from the smallest noise level to none in second order (see
`exponential.FinalExtrapolation`).
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import diffusers
import torch
from diffusers import (
    DDIMScheduler,
    DEISMultistepScheduler,
    DPMSolverMultistepScheduler,
    EulerDiscreteScheduler,
    HeunDiscreteScheduler,
    SchedulerMixin,  # diffusers looks for this name where it loads a scheduler from
    UniPCMultistepScheduler,
)
from diffusers.schedulers.scheduling_ddim import DDIMSchedulerOutput
from diffusers.utils.torch_utils import randn_tensor
from torch import Tensor

from unitouch_gen.errors import InvalidInputError, check_choice, check_kind
from unitouch_gen.files import saved_whole
from unitouch_gen.schedulers.schedule import PURE_NOISE, NoiseSchedule, epsilon_from_denoised, to_denoised

# diffusers' deterministic schedulers, mended --------------------------------------------------------------------------


class ExactTimesteps:
    """For multistep schedulers: the network is asked at the timestep of each noise level, whole or not."""

    second_order_end = True
    save_pretrained = saved_whole(SchedulerMixin.save_pretrained)

    def set_timesteps(self, num_inference_steps: int, device: Any = None, **options: Any) -> None:
        """As the scheduler's; `timesteps` (steps,) are those of `sigmas` in float32."""
        super().set_timesteps(num_inference_steps, device=device, **options)  # type: ignore[misc]
        exact = NoiseSchedule.of(self).timestep(self.sigmas[: len(self.timesteps)])  # type: ignore[arg-type, attr-defined, has-type]
        self.timesteps = exact.to(device=device, dtype=torch.float32)
        self.set_begin_index(0)  # type: ignore[attr-defined]  # rather than to look timesteps up


class ContinuousDPMSolverScheduler(ExactTimesteps, DPMSolverMultistepScheduler):
    """DPM-Solver++ at exact timesteps."""


class ContinuousUniPCScheduler(ExactTimesteps, UniPCMultistepScheduler):
    """UniPC at exact timesteps."""


class ContinuousDEISScheduler(ExactTimesteps, DEISMultistepScheduler):
    """DEIS at exact timesteps that ends without noise.

    diffusers' own spends its last evaluation on a step from the smallest sigma to itself, so noise of that size stays
    in the picture. Here that step is the first-order one to sigma = 0, as `final_sigmas_type="zero"` makes elsewhere,
    until the loop makes it one of second order.
    """

    def set_timesteps(self, num_inference_steps: int, *args: Any, **kwargs: Any) -> None:
        """As DEIS's; the last of `sigmas` (steps + 1,) is 0."""
        super().set_timesteps(num_inference_steps, *args, **kwargs)
        self.sigmas[-1] = 0.0

    def deis_first_order_update(self, model_output: Tensor, *args: Any, sample: Tensor, **kwargs: Any) -> Tensor:
        """x_t = (alpha_t / alpha_s) (x - sigma_s n) + sigma_t n, which is DDIM and holds for sigma_t = 0, too."""
        alpha_t, sigma_t = self._sigma_to_alpha_sigma_t(self.sigmas[self.step_index + 1])
        alpha_s, sigma_s = self._sigma_to_alpha_sigma_t(self.sigmas[self.step_index])
        return alpha_t / alpha_s * (sample - sigma_s * model_output) + sigma_t * model_output

    def multistep_deis_second_order_update(
        self, model_output_list: list[Tensor], *args: Any, sample: Tensor, **kwargs: Any
    ) -> Tensor:
        """As DEIS's, but of first order to sigma = 0, where polynomials in log sigma have no value."""
        if self.sigmas[self.step_index + 1] == 0.0:
            return self.deis_first_order_update(model_output_list[-1], sample=sample)
        return super().multistep_deis_second_order_update(model_output_list, *args, sample=sample, **kwargs)


class SameStart:
    """For schedulers in sigma: from the same state as those in alpha, x = n sqrt(1 + sigma^2)."""

    save_pretrained = saved_whole(SchedulerMixin.save_pretrained)

    @property
    def init_noise_sigma(self) -> Tensor:
        """What unit-variance noise is multiplied by."""
        return (self.sigmas.max() ** 2 + 1.0) ** 0.5  # type: ignore[attr-defined]


class ContinuousEulerScheduler(SameStart, EulerDiscreteScheduler):
    """Euler in sigma from where the others start."""


class ContinuousHeunScheduler(SameStart, HeunDiscreteScheduler):
    """Heun in sigma from where the others start."""

    second_order_end = True


class ContinuousDDIMScheduler(DDIMScheduler):
    """DDIM whose steps end where the next ones begin, for any number of them.

    diffusers steps back by the whole number T // steps, which misses the next timestep where T is no multiple of it.
    """

    save_pretrained = saved_whole(SchedulerMixin.save_pretrained)

    def step(
        self,
        model_output: Tensor,
        timestep: Tensor | int,
        sample: Tensor,
        eta: float = 0.0,
        generator: Any = None,
        variance_noise: Tensor | None = None,
        return_dict: bool = True,
        **options: Any,
    ) -> DDIMSchedulerOutput | tuple:
        """One step of Equation 12 of Song et al. (2021).

        Args:
            model_output: Prediction, (B, C, h, w).
            timestep: One of `timesteps`.
            sample: Variance-preserving state, (B, C, h, w).
            eta: Weight of the noise that is added, [0, 1].
            generator, variance_noise: Of that noise.
            return_dict: Whether to return an output object rather than a tuple.
        """
        place = int((self.timesteps == timestep).nonzero()[0])
        last = place + 1 == len(self.timesteps)
        abar = self.alphas_cumprod[int(timestep)].clamp_min(PURE_NOISE**2)
        before = self.final_alpha_cumprod if last else self.alphas_cumprod[int(self.timesteps[place + 1])]
        sigma = ((1 - abar) / abar) ** 0.5
        denoised = to_denoised(model_output, sample, sigma, self.config.prediction_type)
        noise = epsilon_from_denoised(denoised, sample, sigma)
        spread = eta * ((1 - before) / (1 - abar)) ** 0.5 * (1 - abar / before) ** 0.5  # Equation 16
        state = before**0.5 * denoised + (1 - before - spread**2) ** 0.5 * noise
        if eta > 0.0:
            if variance_noise is None:
                variance_noise = randn_tensor(
                    sample.shape, generator=generator, device=sample.device, dtype=sample.dtype
                )
            state = state + spread * variance_noise
        return DDIMSchedulerOutput(state, denoised) if return_dict else (state, denoised)


# By name --------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Solver:
    """A scheduler class, its settings and its nominal order of convergence.

    Attributes:
        scheduler: The diffusers class, or one made of it.
        order: Nominal.
        settings: Laid over the configuration of the pipeline's own scheduler.
        zero_snr: Whether the class copes with a schedule whose last level is pure noise; the others ignore such a
            schedule or end in an index error.
    """

    scheduler: type[SchedulerMixin]
    order: int
    settings: dict[str, Any] = field(default_factory=dict)
    zero_snr: bool = False


KARRAS: dict[str, Any] = {"use_karras_sigmas": True, "timestep_spacing": "linspace"}
MULTISTEP: dict[str, Any] = {**KARRAS, "solver_order": 2, "final_sigmas_type": "zero", "thresholding": False}

SOLVERS: dict[str, Solver] = {
    # Song et al. (2021): "trailing" starts from pure noise, which "leading" does not.
    "ddim": Solver(
        ContinuousDDIMScheduler,
        1,
        {"timestep_spacing": "trailing", "clip_sample": False, "set_alpha_to_one": True},
        zero_snr=True,
    ),
    # Karras et al. (2022), Algorithm 1; Euler is its first half.
    "euler": Solver(ContinuousEulerScheduler, 1, KARRAS, zero_snr=True),
    "heun": Solver(ContinuousHeunScheduler, 2, KARRAS),
    # Lu et al. (2022), DPM-Solver++(2M).
    "dpm++2m": Solver(ContinuousDPMSolverScheduler, 2, {**MULTISTEP, "algorithm_type": "dpmsolver++"}),
    # Zhao et al. (2023); the corrector adds one order. B_1(h) divides by zero at the last step, B_2(h) does not.
    "unipc": Solver(ContinuousUniPCScheduler, 3, {**MULTISTEP, "solver_type": "bh2"}),
    # Zhang & Chen (2023); order 3 blows up at many steps, see `schedulers.defects`.
    "deis": Solver(
        ContinuousDEISScheduler, 2, {key: value for key, value in MULTISTEP.items() if key != "final_sigmas_type"}
    ),
}


def name_of(scheduler: SchedulerMixin) -> str | None:
    """What its class is called in `SOLVERS`, or `None` for others."""
    return next((name for name, solver in SOLVERS.items() if solver.scheduler is type(scheduler)), None)


def make_scheduler(own: SchedulerMixin, solver: str | None) -> SchedulerMixin:
    """A fresh scheduler for one call: the pipeline's own settings, or those of a solver by name.

    Args:
        own: The pipeline's scheduler; it is never changed, so calls may run side by side.
        solver: A name in `SOLVERS`, or `None` for the pipeline's own.

    Raises:
        InvalidTypeError: If `own` is no scheduler.
        InvalidInputError: If the name is unknown, or the solver breaks on the pipeline's schedule.
    """
    check_kind("own", own, SchedulerMixin)
    if not (solver is None or isinstance(solver, str)):
        check_choice("solver", solver, SOLVERS)  # which refuses it; others may not be comparable
    if solver is None:
        return type(own).from_config(own.config)
    chosen = SOLVERS[check_choice("solver", solver, SOLVERS)]
    if own.config.get("rescale_betas_zero_snr"):
        able = ", ".join(repr(name) for name, other in SOLVERS.items() if other.zero_snr)
        if not chosen.zero_snr:
            raise InvalidInputError(
                f"`solver` is {solver!r}, which breaks on this pipeline's schedule of zero terminal SNR; use {able}."
            )
    # A configuration remembers which of its values were defaults; only what was set is carried over.
    return chosen.scheduler.from_config({**schedule_settings(own), **chosen.settings})


def schedule_settings(own: SchedulerMixin) -> dict[str, Any]:
    """What a network was trained on, out of a scheduler's configuration; the rest is the scheduler's own."""
    shared = ("num_train_timesteps", "beta_start", "beta_end", "beta_schedule", "trained_betas", "prediction_type",
              "rescale_betas_zero_snr", "steps_offset")  # fmt: skip
    return {key: own.config[key] for key in shared if key in own.config}


def read_scheduler(folder: Path) -> SchedulerMixin:
    """The scheduler of a checkpoint: a solver by name, or any of diffusers.

    Raises:
        InvalidInputError: If it is none of them.
    """
    kinds = {solver.scheduler.__name__: solver.scheduler for solver in SOLVERS.values()}
    name = DDIMScheduler.load_config(folder)["_class_name"]  # of any class, which only says where it looks
    kind: Any = kinds.get(name, getattr(diffusers, name, None))
    if not issubclass(kind if isinstance(kind, type) else object, SchedulerMixin):
        raise InvalidInputError(f"`{folder}` names the scheduler {name!r}, which diffusers does not have.")
    return kind.from_pretrained(folder)
