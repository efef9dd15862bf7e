"""A scheduler whose noise levels and multistep weights were fitted to a checkpoint: see `numerics.fit`.

With D at the levels so far, a step from sigma to sigma' is

    x' = r x + (1 - r) (D + sum over earlier levels of w_j (D_j - D)),   r = sigma' / sigma, and 0 at the end,

which is first order where all w_j are 0, and the exponential multistep method of any order for others. Levels and
weights of guidance scales between two that were fitted lie between theirs.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from diffusers import ConfigMixin, DDPMScheduler, SchedulerMixin
from diffusers.configuration_utils import register_to_config
from diffusers.schedulers.scheduling_utils import SchedulerOutput
from torch import Tensor

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.files import saved_whole
from unitouch_gen.schedulers.schedule import NoiseSchedule, alpha, to_denoised

FITTED, DISTILLED = "fitted", "distilled"
"""What reports and calibrations call this solver; and what reports call it where the network was distilled to it."""


@dataclass(frozen=True)
class Fit:
    """A number of steps at a guidance scale.

    Attributes:
        guidance_scale: It was fitted at.
        sigmas: Noise level of each evaluation, falling.
        weights: For each step one number for each evaluation before.
    """

    guidance_scale: float
    sigmas: tuple[float, ...]
    weights: tuple[tuple[float, ...], ...]

    def __post_init__(self) -> None:
        falling = all(high > low > 0 for high, low in pairwise(self.sigmas))
        if not self.sigmas or not falling or [len(row) for row in self.weights] != list(range(len(self.sigmas))):
            raise InvalidInputError(
                f"A fit has {len(self.sigmas)} noise levels and {len(self.weights)} rows of weights; it takes falling "
                "levels above 0, and a row for each, of as many weights as there are levels before."
            )

    @property
    def steps(self) -> int:
        return len(self.sigmas)

    @classmethod
    def of(cls, values: dict[str, Any]) -> "Fit":
        """From plain values."""
        return cls(float(values["guidance_scale"]), tuple(values["sigmas"]), tuple(map(tuple, values["weights"])))

    @classmethod
    def between(cls, low: "Fit", high: "Fit", guidance_scale: float) -> "Fit":
        """What lies between two fits of as many steps, by the logarithm of a guidance scale between theirs."""
        share = math.log(guidance_scale / low.guidance_scale) / math.log(high.guidance_scale / low.guidance_scale)
        sigmas = (start * (end / start) ** share for start, end in zip(low.sigmas, high.sigmas, strict=True))
        rows = (
            tuple(start + share * (end - start) for start, end in zip(*both, strict=True))
            for both in zip(low.weights, high.weights, strict=True)
        )
        return cls(guidance_scale, tuple(sigmas), tuple(rows))


class Fits(list):
    """Fits as plain values, as configurations hold them; in few words where diffusers tells of what it ignores."""

    def __repr__(self) -> str:
        return f"<{len(self)} fits>"


def combined(values: Sequence[Tensor], weights: Sequence[float]) -> Tensor:
    """D + sum of w_j (D_j - D) of D at all levels so far, (B, C, h, w), the last one last."""
    *earlier, now = values
    total = (1 - sum(weights)) * now
    for weight, value in zip(weights, earlier, strict=True):
        total = total + weight * value
    return total


class FittedScheduler(SchedulerMixin, ConfigMixin):
    """A multistep scheduler with the steps that a checkpoint brings.

    Args:
        num_train_timesteps, beta_start, beta_end, beta_schedule, trained_betas, rescale_betas_zero_snr: Noise schedule
            that the network was trained on, see `DDPMScheduler`.
        prediction_type: Of the network.
        fits: See `Fit`, as plain values.
        guidance_scale: Of this run, where there are fits at several.
        otherwise: Named solver that pipelines take for what nothing was fitted to; `None` for a network that was
            distilled to these steps and takes no others.
    """

    order = 1
    init_noise_sigma = 1.0
    save_pretrained = saved_whole(SchedulerMixin.save_pretrained)

    @register_to_config
    def __init__(
        self,
        num_train_timesteps: int = 1000,
        beta_start: float = 0.00085,
        beta_end: float = 0.012,
        beta_schedule: str = "scaled_linear",
        trained_betas: list[float] | None = None,
        rescale_betas_zero_snr: bool = False,
        prediction_type: str = "epsilon",
        fits: Sequence[dict[str, Any]] = (),
        guidance_scale: float | None = None,
        otherwise: str | None = "dpm++2m",
    ):
        trained = DDPMScheduler(
            num_train_timesteps=num_train_timesteps,
            beta_start=beta_start,
            beta_end=beta_end,
            beta_schedule=beta_schedule,
            trained_betas=trained_betas,
            rescale_betas_zero_snr=rescale_betas_zero_snr,
        )
        self.betas, self.alphas_cumprod = trained.betas, trained.alphas_cumprod
        self.register_to_config(fits=Fits(fits))
        self.fits = [Fit.of(values) for values in fits]
        self.timesteps = trained.timesteps
        self.fit: Fit | None = None
        self.values: list[Tensor] = []

    def find(self, steps: int, guidance_scale: float | None) -> Fit | None:
        """The fit of a number of steps at a guidance scale, or what lies between the two around it.

        `None` if there is none, the scale lies outside of those that were fitted, or there are several and nothing says
        which. Guidance is off up to 1.
        """
        fits = sorted((fit for fit in self.fits if fit.steps == steps), key=lambda fit: fit.guidance_scale)
        if guidance_scale is None or not fits:
            return fits[0] if len(fits) == 1 else None
        scale = max(guidance_scale, 1.0) if fits[0].guidance_scale == 1.0 else guidance_scale
        for fit in fits:
            if fit.guidance_scale == scale:
                return fit
        around = [(low, high) for low, high in pairwise(fits) if low.guidance_scale < scale < high.guidance_scale]
        return Fit.between(*around[0], scale) if around else None

    @property
    def distilled(self) -> bool:
        """Whether the network takes these steps alone."""
        return self.config.otherwise is None

    @property
    def known(self) -> list[str]:
        """What there are fits of, in words: "8, 12 steps at guidance 1 to 12"."""
        scales: dict[int, list[float]] = {}
        for fit in self.fits:
            scales.setdefault(fit.steps, []).append(fit.guidance_scale)
        steps: dict[str, list[int]] = {}
        for number, found in sorted(scales.items()):
            ends = dict.fromkeys((f"{min(found):g}", f"{max(found):g}"))
            steps.setdefault(" to ".join(ends), []).append(number)
        return [f"{', '.join(map(str, found))} steps at guidance {between}" for between, found in steps.items()]

    def set_timesteps(self, num_inference_steps: int, device: Any = None) -> None:
        """Sets `timesteps` (steps,), which are continuous, in float32.

        Raises:
            ValueError: If nothing was fitted to that number of steps, and this guidance.
        """
        fit = self.find(num_inference_steps, self.config.guidance_scale)
        if fit is None:
            raise ValueError(f"fitted to {', '.join(self.known) or 'nothing'}; name a guidance between these.")
        self.fit, self.num_inference_steps = fit, fit.steps
        self.values = []
        exact = NoiseSchedule.of(self).timestep(torch.tensor(fit.sigmas, dtype=torch.float64))
        self.timesteps = exact.to(device=device, dtype=torch.float32)

    def scale_model_input(self, sample: Tensor, *args: Any, **kwargs: Any) -> Tensor:
        """As it is: the state is variance-preserving."""
        return sample

    def step(
        self, model_output: Tensor, timestep: Tensor | float, sample: Tensor, return_dict: bool = True
    ) -> SchedulerOutput | tuple:
        """The next step, in order from the first.

        Args:
            model_output: Prediction, guided, (B, C, h, w).
            timestep: Not needed, as steps have one order.
            sample: Variance-preserving state, (B, C, h, w).
            return_dict: Whether to return an output object rather than a tuple.

        Raises:
            ValueError: If `set_timesteps` was not called, or all steps are made.
        """
        if self.fit is None or len(self.values) == self.fit.steps:
            raise ValueError("There is no step left; call `set_timesteps` first.")
        place = len(self.values)
        sigma = self.fit.sigmas[place]
        self.values.append(to_denoised(model_output, sample, sigma, self.config.prediction_type))
        mean = combined(self.values, self.fit.weights[place])
        if place + 1 < self.fit.steps:
            following = self.fit.sigmas[place + 1]
            kept = following / sigma
            mean = (kept / alpha(sigma) * sample + (1 - kept) * mean) * alpha(following)
        return SchedulerOutput(mean) if return_dict else (mean,)

    def __len__(self) -> int:
        return self.config.num_train_timesteps
