"""diffusers' deterministic schedulers without what holds them above an error of 1e-3.

diffusers rounds the timesteps of most schedulers to whole numbers, though the noise levels between them are the ones it
steps over; starts Euler and Heun a little elsewhere than the others; counts DDIM's steps back by a whole number; and
jumps from the smallest noise level to none in first order. Where a class says `second_order_end`, the sampling loop
makes that jump: see `diffusion.exponential.LastJump`.
"""

from typing import Any

import torch
from diffusers import (
    DDIMScheduler,
    DEISMultistepScheduler,
    DPMSolverMultistepScheduler,
    EulerDiscreteScheduler,
    HeunDiscreteScheduler,
    SchedulerMixin,  # noqa: F401  # diffusers looks for this name where it loads a scheduler from
    UniPCMultistepScheduler,
)
from diffusers.schedulers.scheduling_ddim import DDIMSchedulerOutput
from diffusers.utils.torch_utils import randn_tensor
from torch import Tensor

from unitouch_gen.schedulers.prediction import epsilon_from_denoised, to_denoised
from unitouch_gen.schedulers.schedule import PURE_NOISE, NoiseSchedule
from unitouch_gen.schedulers.unipc import FloatUpdates


class ExactTimesteps:
    """For multistep schedulers: the network is asked at the timestep of each noise level, whole or not."""

    second_order_end = True

    def set_timesteps(self, num_inference_steps: int, device: Any = None, **options: Any) -> None:
        """As the scheduler's; `timesteps` (steps,) are those of `sigmas` in float32."""
        super().set_timesteps(num_inference_steps, device=device, **options)  # type: ignore[misc]
        exact = NoiseSchedule.of(self).timestep(self.sigmas[: len(self.timesteps)])  # type: ignore[arg-type, attr-defined, has-type]
        self.timesteps = exact.to(device=device, dtype=torch.float32)
        self.set_begin_index(0)  # type: ignore[attr-defined]  # rather than to look timesteps up


class ContinuousDPMSolverScheduler(ExactTimesteps, DPMSolverMultistepScheduler):
    """DPM-Solver++ at exact timesteps."""


class ContinuousUniPCScheduler(FloatUpdates, ExactTimesteps, UniPCMultistepScheduler):
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
