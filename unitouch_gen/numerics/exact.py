"""Data whose denoiser is known in closed form, and networks that are that denoiser.

For data x_0 ~ sum_k w_k N(m_k, C_k) and x = x_0 + sigma n, the best prediction of the data is a mean of linear ones,
each weighted by how probable its component is given x. All of it is computed in float64.
"""

from dataclasses import dataclass
from functools import cached_property

import torch
from diffusers.configuration_utils import FrozenDict
from diffusers.models.unets.unet_2d_condition import UNet2DConditionOutput
from torch import Tensor, nn

from unitouch_gen.errors import InvalidInputError, check_choice, check_finite, describe
from unitouch_gen.schedulers.schedule import PREDICTION_TYPES, NoiseSchedule, alpha, velocity_of


@dataclass(frozen=True, eq=False)
class GaussianMixture:
    """A mixture of K Gaussians in a space of d dimensions (latents, flattened); with K = 1, a Gaussian.

    Component k is N(m_k, R diag(v_k) R^T) with one rotation R for all.

    Attributes:
        means: (K, d).
        variances: Along the axes of R, > 0, (K, d).
        weights: >= 0, brought to the sum 1 here, (K,); equal ones by default.
        rotation: R, orthogonal, its columns are the axes, (d, d); by default those of the space.

    Raises:
        InvalidInputError: If shapes do not fit, or values are out of range.
    """

    means: Tensor
    variances: Tensor
    weights: Tensor | None = None
    rotation: Tensor | None = None

    def __post_init__(self) -> None:
        for name in ("means", "variances", "weights", "rotation"):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, check_finite(name, torch.as_tensor(value).detach().double()))
        if self.means.ndim != 2 or 0 in self.means.shape:
            raise InvalidInputError(f"`means` is {describe(self.means)}; pass (components, dimensions).")
        components, dimensions = self.means.shape
        if self.variances.shape != self.means.shape or not bool((self.variances > 0).all()):
            raise InvalidInputError(
                f"`variances` is {describe(self.variances)}; pass values > 0 of shape {tuple(self.means.shape)}."
            )
        weights = torch.ones(components, dtype=torch.float64) if self.weights is None else self.weights
        if weights.shape != (components,) or bool((weights < 0).any()) or weights.sum() == 0:
            raise InvalidInputError(
                f"`weights` is {describe(weights)}; pass values >= 0, not all 0, of shape ({components},)."
            )
        object.__setattr__(self, "weights", weights / weights.sum())
        if self.rotation is not None:
            square = self.rotation.shape == (dimensions, dimensions)
            if not square or (self.rotation.T @ self.rotation - torch.eye(dimensions)).abs().max() > 1e-10:
                raise InvalidInputError(
                    f"`rotation` is {describe(self.rotation)}; pass an orthogonal matrix ({dimensions}, {dimensions})."
                )

    @property
    def dimensions(self) -> int:
        """d."""
        return self.means.shape[1]

    @property
    def is_gaussian(self) -> bool:
        """Whether there is one component."""
        return len(self.means) == 1

    @property
    def smallest_deviation(self) -> float:
        """The smallest standard deviation along any axis of any component."""
        return self.variances.min().sqrt().item()

    @property
    def root_mean_square(self) -> float:
        """sqrt(E|x_0|^2 / d), the size of a coordinate."""
        assert self.weights is not None
        return (self.weights @ (self.means**2 + self.variances).mean(dim=1)).sqrt().item()

    def denoise(self, x: Tensor, sigma: Tensor | float) -> Tensor:
        """E[x_0 | x], float64.

        Args:
            x: x_0 + sigma n, (B, ...) with d values a row.
            sigma: Noise level >= 0, one or one a row (B,).

        Raises:
            InvalidInputError: If rows of `x` have another size.
        """
        return self.posterior_means(x, sigma)[0]

    def noise(self, x: Tensor, sigma: Tensor | float) -> Tensor:
        """E[n | x] = -sigma grad log p(x; sigma), float64 (Tweedie's formula); arguments as of `denoise`.

        Not from E[x_0 | x], from which a small sigma would leave few digits.
        """
        return self.posterior_means(x, sigma)[1]

    def posterior_means(self, x: Tensor, sigma: Tensor | float) -> tuple[Tensor, Tensor]:
        """E[x_0 | x] and E[n | x], both as `x` in shape and float64; arguments as of `denoise`."""
        sigma = torch.as_tensor(sigma, dtype=torch.float64, device=x.device).reshape(-1, 1, 1)
        axes = self.to_axes(x).unsqueeze(1)  # (B, 1, d)
        means, variances = self.axis_means.to(x.device), self.variances.to(x.device)
        assert self.weights is not None
        away, spread = axes - means, variances + sigma**2  # (B, K, d)
        fit = -0.5 * (away**2 / spread + spread.log()).sum(dim=2)
        probable = (self.weights.to(x.device).log() + fit).softmax(dim=1).unsqueeze(2)  # (B, K, 1)
        denoised = (probable * (variances * axes + sigma**2 * means) / spread).sum(dim=1)
        noise = (probable * sigma * away / spread).sum(dim=1)
        return self.from_axes(denoised, x.shape), self.from_axes(noise, x.shape)

    @cached_property
    def axis_means(self) -> Tensor:
        """Means in the coordinates of the axes, (K, d)."""
        return self.means if self.rotation is None else self.means @ self.rotation

    def to_axes(self, x: Tensor) -> Tensor:
        """(B, ...) -> coordinates along the axes (B, d), float64.

        Raises:
            InvalidInputError: If rows have another size.
        """
        flat = x.double().flatten(1)
        if flat.shape[1] != self.dimensions:
            raise InvalidInputError(
                f"`x` is {describe(x)}; pass states with {self.dimensions} values a row, as the data has."
            )
        return flat if self.rotation is None else flat @ self.rotation.to(x.device)

    def from_axes(self, coordinates: Tensor, shape: torch.Size) -> Tensor:
        """Undoes `to_axes`."""
        if self.rotation is not None:
            coordinates = coordinates @ self.rotation.to(coordinates.device).T
        return coordinates.reshape(shape)


def guided_denoise(
    data: GaussianMixture,
    unconditional: GaussianMixture | None,
    guidance_scale: float,
    x: Tensor,
    sigma: Tensor | float,
) -> Tensor:
    """D_u + g (D_c - D_u), float64, or D_c where there is no guidance (Ho & Salimans, 2022); see `denoise`."""
    conditional = data.denoise(x, sigma)
    if unconditional is None or guidance_scale <= 1.0:
        return conditional
    other = unconditional.denoise(x, sigma)
    return other + guidance_scale * (conditional - other)


class ExactNetwork(nn.Module):
    """The best possible network for known data, in place of a trained one.

    The sampling loop calls it as `network(state, timestep)`, pipelines call it as they call a `UNet2DConditionModel`.

    With guidance the batch is doubled, the unconditional half first (`diffusion.sampling`). A network cannot see that
    from its input, so it is told: where `guided` is set, the first half is denoised with `unconditional` and the second
    with `data`; else all rows with `data`. Who switches guidance between steps switches `guided` as well.

    Args:
        data: What the condition stands for.
        schedule: Of noise levels; timesteps may be whole or not.
        prediction_type: "epsilon", "v_prediction" or "sample".
        unconditional: What there is without the condition.
        guided: By default, whether `unconditional` is there.
        config: Entries of a UNet's configuration that a pipeline reads, such as `in_channels` and `sample_size`.

    Raises:
        InvalidInputError: If there is no such type, or `guided` without `unconditional`, or their dimensions differ.
    """

    _place: Tensor

    def __init__(
        self,
        data: GaussianMixture,
        schedule: NoiseSchedule,
        prediction_type: str = "epsilon",
        unconditional: GaussianMixture | None = None,
        guided: bool | None = None,
        config: dict | None = None,
    ):
        super().__init__()
        check_choice("prediction_type", prediction_type, PREDICTION_TYPES)
        if guided and unconditional is None:
            raise InvalidInputError("`guided` is True without `unconditional`; pass the data of that branch as well.")
        check_same_space(data, unconditional)
        self.data, self.unconditional, self.schedule = data, unconditional, schedule
        self.prediction_type = prediction_type
        self.guided = unconditional is not None if guided is None else guided
        self.config = FrozenDict(config or {})
        # No weights; this only remembers where `to` put the network. The mathematics stays in float64.
        self.register_buffer("_place", torch.empty(0), persistent=False)

    @property
    def dtype(self) -> torch.dtype:
        """Of the states that a pipeline passes."""
        return self._place.dtype

    @property
    def device(self) -> torch.device:
        return self._place.device

    def forward(
        self,
        sample: Tensor,
        timestep: Tensor | float,
        encoder_hidden_states: Tensor | None = None,
        class_labels: Tensor | None = None,
        return_dict: bool | None = None,
    ) -> Tensor | tuple[Tensor] | UNet2DConditionOutput:
        """The prediction, in the shape and dtype of `sample`.

        Args:
            sample: Variance-preserving states (B, ...), or (2 B, ...) where `guided`.
            timestep: In [0, T - 1], whole or not, one or one a row.
            encoder_hidden_states, class_labels: Ignored: the condition is `data`.
            return_dict: `None` returns the tensor, `False` a tuple of it, `True` diffusers' output class.

        Raises:
            InvalidInputError: If `guided` and the rows have no two halves, or rows have another size than the data.
        """
        if self.guided and len(sample) % 2:
            raise InvalidInputError(
                f"`sample` has {len(sample)} rows, but the network is `guided`; pass unconditional and conditional "
                "halves, or set `guided` to False."
            )
        timestep = timestep.detach().cpu() if isinstance(timestep, Tensor) else timestep
        sigma = self.schedule.sigma(timestep).expand(len(sample)).to(sample.device)
        column = sigma.view(-1, *[1] * (sample.ndim - 1))
        x = sample.double() / alpha(column)
        if self.guided:
            assert self.unconditional is not None
            half = len(sample) // 2
            halves = [
                self.unconditional.posterior_means(x[:half], sigma[:half]),
                self.data.posterior_means(x[half:], sigma[half:]),
            ]
            denoised, noise = (torch.cat(both) for both in zip(*halves))
        else:
            denoised, noise = self.data.posterior_means(x, sigma)
        if self.prediction_type == "v_prediction":
            prediction = velocity_of(denoised, noise, column)
        else:
            prediction = noise if self.prediction_type == "epsilon" else denoised
        prediction = prediction.to(sample.dtype)
        if return_dict is None:
            return prediction
        return UNet2DConditionOutput(sample=prediction) if return_dict else (prediction,)


def check_same_space(data: GaussianMixture, unconditional: GaussianMixture | None) -> None:
    """Refuses two distributions of different dimensions.

    Raises:
        InvalidInputError: Naming both.
    """
    if unconditional is not None and unconditional.dimensions != data.dimensions:
        raise InvalidInputError(
            f"`unconditional` has {unconditional.dimensions} dimensions and `data` {data.dimensions}; take the same."
        )
