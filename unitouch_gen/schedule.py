"""The noise schedule as a continuous curve, and predictions of the data from a network's output.

In the variance-exploding frame x = x_0 + sigma n (Karras et al., 2022) every diffusers schedule is one curve
sigma(t) = sqrt((1 - abar_t) / abar_t). Networks see the variance-preserving state z = alpha x = alpha x_0 + s n, with
alpha = 1 / sqrt(1 + sigma^2) and s = sigma alpha. Given z, predictions of noise, velocity and data are affine functions
of each other, the same for both branches of guidance: guiding one of them guides them all.
"""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from unitouch_gen.errors import InvalidInputError, check_choice

PREDICTION_TYPES = ("epsilon", "v_prediction", "sample")
"""As diffusers' schedulers call them."""


TRAINED = ("num_train_timesteps", "beta_start", "beta_end", "beta_schedule", "trained_betas", "prediction_type")
"""Settings of a diffusers scheduler that its network was trained with; the others are of sampling."""


@dataclass(frozen=True, eq=False)
class NoiseSchedule:
    """Noise levels that a network was trained at, and what it predicts there.

    Between training levels it is linear in log sigma, as diffusers interpolates.
    """

    log_sigmas: Tensor  # of the T training levels, increasing, float64 (T,)
    prediction_type: str  # one of `PREDICTION_TYPES`

    @classmethod
    def of(cls, scheduler: Any) -> "NoiseSchedule":
        """The schedule of a diffusers scheduler with `alphas_cumprod`; the levels have to rise in float32."""
        name = type(scheduler).__name__
        if not hasattr(scheduler, "alphas_cumprod"):
            raise InvalidInputError(
                f"`scheduler` is {name}, which has no noise levels to choose from; pass no `solver`, "
                "`tolerance` or `layout`."
            )
        alphas = scheduler.alphas_cumprod.detach().cpu().clone()
        if alphas[-1] < 1e-12:  # zero terminal SNR; 2^-24 as in diffusers' `EulerDiscreteScheduler`
            alphas[-1] = alphas[-2:-1].div(4).clamp(max=2.0**-24)  # still the noisiest
        log_sigmas = (((1 - alphas) / alphas) ** 0.5).double().log()  # the ratio in float32, as schedulers compute it
        if len(log_sigmas) < 2 or not bool((log_sigmas.diff() > 0).all() and log_sigmas.isfinite().all()):
            raise InvalidInputError(
                f"`scheduler` is {name} with {len(log_sigmas)} noise levels that do not rise in float32; take at least "
                "two, no `beta` under 1e-6, and all noise at the last one at the earliest."
            )
        prediction_type = scheduler.config.get("prediction_type")
        return cls(log_sigmas, check_choice("scheduler: prediction_type", prediction_type, PREDICTION_TYPES))

    @property
    def sigma_min(self) -> float:
        """The smallest noise level that a network was trained on."""
        return self.log_sigmas[0].exp().item()

    @property
    def sigma_max(self) -> float:
        """The level that sampling starts from."""
        return self.log_sigmas[-1].exp().item()

    def timestep(self, sigma: Tensor | float) -> Tensor:
        """Continuous timesteps in [0, T - 1] of noise levels > 0, float64; clamped at the ends."""
        log_sigma = torch.as_tensor(sigma, dtype=torch.float64).log()
        upper = torch.searchsorted(self.log_sigmas, log_sigma).clamp(1, len(self.log_sigmas) - 1)
        low = self.log_sigmas[upper - 1]
        high = self.log_sigmas[upper]
        return (upper - 1) + ((log_sigma - low) / (high - low)).clamp(0.0, 1.0)

    def sigma(self, timestep: Tensor | float) -> Tensor:
        """Noise levels of continuous timesteps in [0, T - 1], float64."""
        timestep = torch.as_tensor(timestep, dtype=torch.float64).clamp(0, len(self.log_sigmas) - 1)
        lower = timestep.long().clamp(max=len(self.log_sigmas) - 2)
        return torch.lerp(self.log_sigmas[lower], self.log_sigmas[lower + 1], timestep - lower).exp()

    # Spacings: falling noise levels, one a step, over a share of the way from data (0) to noise (1); the last step goes
    # from the smallest of them to 0.

    def trailing(self, steps: int, share: float = 1.0) -> list[float]:
        """Even in time, from the last timestep, rounded as diffusers does (Lin et al., 2024, Section 3.3)."""
        levels = len(self.log_sigmas)
        timesteps = [round(share * levels * (steps - step) / steps) - 1 for step in range(steps)]
        return self.sigma(torch.tensor(timesteps)).tolist()

    def karras(self, steps: int, share: float = 1.0) -> list[float]:
        """Even in sigma^(1/7) (Karras et al., 2022, Equation 5), down to share / steps or `sigma_min`, the larger one.

        The step from there to 0 has an error of about sigma^2 / 2, which is small beside those of few steps.
        """
        start = self.karras_level(1.0 - share)
        end = max(self.sigma_min, min(share / steps, start / 2))
        return (torch.linspace(start ** (1 / 7), end ** (1 / 7), steps, dtype=torch.float64) ** 7).tolist()

    def karras_level(self, share: float) -> float:
        """The noise level at a share of the Karras spacing, from 0 (largest) to 1 (smallest)."""
        high = self.sigma_max ** (1 / 7)
        low = self.sigma_min ** (1 / 7)
        return (high + share * (low - high)) ** 7


def to_denoised(prediction: Tensor, z: Tensor, sigma: Tensor | float, prediction_type: str) -> Tensor:
    """The prediction of x_0 from a network's output at the variance-preserving state z, (B, C, h, w)."""
    if prediction_type == "epsilon":  # x_0 = (z - s n) / alpha (Ho et al., 2020, Equation 15)
        return z / alpha(sigma) - sigma * prediction
    if prediction_type == "v_prediction":  # x_0 = alpha z - s v (Salimans & Ho, 2022, Section 4)
        return alpha(sigma) * (z - sigma * prediction)
    return prediction


def to_prediction(denoised: Tensor, z: Tensor, sigma: Tensor | float, prediction_type: str) -> Tensor:
    """The network's output that would mean a prediction of x_0: the inverse of `to_denoised`."""
    if prediction_type == "epsilon":
        return (z / alpha(sigma) - denoised) / sigma
    if prediction_type == "v_prediction":
        return (z - denoised / alpha(sigma)) / sigma
    return denoised


def alpha(sigma: Tensor | float) -> Any:
    """alpha, the weight of x_0 in z (abar = alpha^2 in Ho et al., 2020)."""
    return (1 + sigma**2) ** -0.5
