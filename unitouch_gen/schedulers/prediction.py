"""What networks predict - noise, velocity or data - and the conversions between the three.

A network sees z = alpha x_0 + s n with alpha = 1 / sqrt(1 + sigma^2), s = sigma alpha, sigma = s / alpha; so
x = z / alpha = x_0 + sigma n. Given z, each of the three predictions is an affine function of each other, the same for
both branches of guidance: guiding one of them guides them all.

Every `sigma` here is a number > 0 or a tensor that broadcasts against the states, and results have the dtype torch
promotes to.
"""

from torch import Tensor

from unitouch_gen.errors import check_choice

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


def from_denoised(denoised: Tensor, z: Tensor, sigma: Tensor | float, prediction_type: str) -> Tensor:
    """The output of a network that stands for a prediction of x_0; undoes `to_denoised`.

    Raises:
        InvalidInputError: If there is no such type.
    """
    check_choice("prediction_type", prediction_type, PREDICTION_TYPES)
    if prediction_type == "epsilon":
        return epsilon_from_denoised(denoised, z, sigma)
    return velocity_from_denoised(denoised, z, sigma) if prediction_type == "v_prediction" else denoised


def denoised_from_epsilon(epsilon: Tensor, z: Tensor, sigma: Tensor | float) -> Tensor:
    """x_0 = (z - s n) / alpha (Ho et al., 2020, Equation 15)."""
    return z / data_scale(sigma) - sigma * epsilon


def epsilon_from_denoised(denoised: Tensor, z: Tensor, sigma: Tensor | float) -> Tensor:
    """n = (z - alpha x_0) / s (Ho et al., 2020, Equation 15, solved for the noise)."""
    return (z / data_scale(sigma) - denoised) / sigma


def denoised_from_velocity(velocity: Tensor, z: Tensor, sigma: Tensor | float) -> Tensor:
    """x_0 = alpha z - s v (Salimans & Ho, 2022, Section 4)."""
    alpha = data_scale(sigma)
    return alpha * (z - sigma * velocity)


def velocity_from_denoised(denoised: Tensor, z: Tensor, sigma: Tensor | float) -> Tensor:
    """v = (alpha z - x_0) / s (Salimans & Ho, 2022, Section 4, solved for the velocity)."""
    alpha = data_scale(sigma)
    return (alpha * z - denoised) / (sigma * alpha)


def velocity_of(denoised: Tensor, epsilon: Tensor, sigma: Tensor | float) -> Tensor:
    """v = alpha n - s x_0, of which both are known (Salimans & Ho, 2022, Section 4)."""
    return data_scale(sigma) * (epsilon - sigma * denoised)


def data_scale(sigma: Tensor | float) -> Tensor | float:
    """alpha, the weight of x_0 in z (abar = alpha^2 in Ho et al., 2020)."""
    return (1 + sigma**2) ** -0.5
