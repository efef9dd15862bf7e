"""The noise schedule as a continuous curve, and what networks predict along it.

In the variance-exploding frame x = x_0 + sigma n (Karras et al., 2022) every diffusers schedule is one curve
sigma(t) = sqrt((1 - abar_t) / abar_t). Networks see the variance-preserving state z = alpha x = alpha x_0 + s n with
alpha = 1 / sqrt(1 + sigma^2) and s = sigma alpha. Given z, predictions of noise, velocity and data are affine functions
of each other, the same for both branches of guidance: guiding one of them guides them all.
"""

from dataclasses import dataclass

import torch
from diffusers.schedulers.scheduling_utils import SchedulerMixin
from torch import Tensor

from unitouch_gen.errors import InvalidInputError, check_choice

PURE_NOISE = 2.0**-24
"""abar in place of the 0 at the end of a schedule of zero terminal SNR, as in diffusers' `EulerDiscreteScheduler`."""


@dataclass(frozen=True)
class NoiseSchedule:
    """Noise levels of a diffusers schedule, between training levels linear in log sigma, as diffusers interpolates.

    Attributes:
        log_sigmas: Of the training levels, increasing, float64 (T,).
    """

    log_sigmas: Tensor

    @classmethod
    def of(cls, scheduler: SchedulerMixin) -> "NoiseSchedule":
        """The schedule of any diffusers scheduler that has `alphas_cumprod`.

        Raises:
            InvalidInputError: If its noise levels do not rise from level to level, or are not finite, in float32.
        """
        alphas = scheduler.alphas_cumprod.detach().cpu().clone()  # type: ignore[attr-defined]
        if alphas[-1] < 1e-12:
            alphas[-1] = alphas[-2:-1].div(4).clamp(max=PURE_NOISE)  # still the noisiest
        log_sigmas = (((1 - alphas) / alphas) ** 0.5).double().log()  # the ratio in float32: as schedulers compute it
        if len(log_sigmas) < 2 or not bool((log_sigmas.diff() > 0).all()) or not bool(log_sigmas.isfinite().all()):
            raise InvalidInputError(
                f"`scheduler` is {type(scheduler).__name__} with {len(log_sigmas)} noise levels that do not rise in "
                "float32; take at least two, no `beta` under 1e-6, and all noise at the last one at the earliest."
            )
        return cls(log_sigmas)

    @property
    def sigma_min(self) -> float:
        """The smallest noise level a network was trained on."""
        return self.log_sigmas[0].exp().item()

    @property
    def sigma_max(self) -> float:
        """The level that sampling starts from."""
        return self.log_sigmas[-1].exp().item()

    def timestep(self, sigma: Tensor | float) -> Tensor:
        """Continuous timesteps in [0, T - 1] of noise levels > 0, float64; levels beyond the ends are at the ends."""
        log_sigma = torch.as_tensor(sigma, dtype=torch.float64).log()
        upper = torch.searchsorted(self.log_sigmas, log_sigma).clamp(1, len(self.log_sigmas) - 1)
        low, high = self.log_sigmas[upper - 1], self.log_sigmas[upper]
        return (upper - 1) + ((log_sigma - low) / (high - low)).clamp(0.0, 1.0)

    def sigma(self, timestep: Tensor | float) -> Tensor:
        """Noise levels of timesteps in [0, T - 1], whole or not, float64."""
        timestep = torch.as_tensor(timestep, dtype=torch.float64).clamp(0, len(self.log_sigmas) - 1)
        lower = timestep.long().clamp(max=len(self.log_sigmas) - 2)
        low, high = self.log_sigmas[lower], self.log_sigmas[lower + 1]
        return torch.lerp(low, high, timestep - lower).exp()

    def karras(self, share: float, rho: float = 7.0) -> float:
        """The noise level a share of the way from the largest to the smallest one (Karras et al., 2022, Equation 5).

        Args:
            share: From 0 to 1.
            rho: The larger, the closer levels lie near the smallest one; 1 spaces them evenly.
        """
        high, low = self.sigma_max ** (1 / rho), self.sigma_min ** (1 / rho)
        return min(max((high + share * (low - high)) ** rho, self.sigma_min), self.sigma_max)


# Predictions. Every `sigma` is a number > 0 or a tensor that broadcasts; results have the dtype torch promotes to.

PREDICTION_TYPES = ("epsilon", "v_prediction", "sample")
"""As diffusers' schedulers call them."""


def to_denoised(prediction: Tensor, z: Tensor, sigma: Tensor | float, prediction_type: str) -> Tensor:
    """The prediction of x_0 that a network's output stands for.

    Args:
        prediction: Of the network, (B, C, h, w).
        z: Variance-preserving state that it saw, (B, C, h, w).
        sigma: Noise level of that state.
        prediction_type: One of `PREDICTION_TYPES`.

    Raises:
        InvalidInputError: If there is no such type.
    """
    check_choice("prediction_type", prediction_type, PREDICTION_TYPES)
    if prediction_type == "epsilon":
        return denoised_from_epsilon(prediction, z, sigma)
    return denoised_from_velocity(prediction, z, sigma) if prediction_type == "v_prediction" else prediction


def denoised_from_epsilon(epsilon: Tensor, z: Tensor, sigma: Tensor | float) -> Tensor:
    """x_0 = (z - s n) / alpha (Ho et al., 2020, Equation 15)."""
    return z / alpha(sigma) - sigma * epsilon


def epsilon_from_denoised(denoised: Tensor, z: Tensor, sigma: Tensor | float) -> Tensor:
    """n = (z - alpha x_0) / s (Ho et al., 2020, Equation 15, solved for the noise)."""
    return (z / alpha(sigma) - denoised) / sigma


def denoised_from_velocity(velocity: Tensor, z: Tensor, sigma: Tensor | float) -> Tensor:
    """x_0 = alpha z - s v (Salimans & Ho, 2022, Section 4)."""
    return alpha(sigma) * (z - sigma * velocity)


def velocity_of(denoised: Tensor, epsilon: Tensor, sigma: Tensor | float) -> Tensor:
    """v = alpha n - s x_0, of which both are known (Salimans & Ho, 2022, Section 4)."""
    return alpha(sigma) * (epsilon - sigma * denoised)


def alpha(sigma: Tensor | float) -> Tensor | float:
    """alpha, the weight of x_0 in z (abar = alpha^2 in Ho et al., 2020)."""
    return (1 + sigma**2) ** -0.5
