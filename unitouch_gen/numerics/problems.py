"""Problems whose answer is known: Gaussian mixtures, their best denoisers and flows in closed form, and a set by name.

For data x_0 ~ sum_k w_k N(m_k, C_k) and x = x_0 + sigma n, the best prediction of the data is a mean of linear ones,
each weighted by how probable its component is given x. All of it is computed in float64. Where the data is Gaussian,
the probability-flow ODE has a closed form as well; for mixtures see `reference.solve_reference`.

The problems by name are a plain set, and a stiff and extreme one. All are deterministic. Latents have four channels as
those of Stable Diffusion, but few pixels: what makes a problem hard is its spectrum, not its size.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any

import numpy as np
import torch
from diffusers import DDIMScheduler, SchedulerMixin
from diffusers.configuration_utils import FrozenDict
from torch import Tensor, nn

from unitouch_gen.errors import InvalidInputError, check_choice, check_finite, check_integer, check_number, describe
from unitouch_gen.numerics.reference import Flow
from unitouch_gen.sampling import Denoiser, Guidance, RunReport, prepare_steps, sample, sample_to_tolerance
from unitouch_gen.schedulers.schedule import PREDICTION_TYPES, NoiseSchedule, alpha, velocity_of
from unitouch_gen.schedulers.solvers import make_scheduler

STABLE_DIFFUSION = {"beta_start": 0.00085, "beta_end": 0.012, "beta_schedule": "scaled_linear"}

BELOW = 1e-4
"""Noise level that a flow to sigma = 0 ends at, in units of the data's smallest deviation: what its last step leaves
out is of the order BELOW^4."""

NODES = 12
PANELS = 8
"""Quadrature in `Problem.follow`: panels for each unit of log(v + tau), at least; the integrand changes by about
e^(1/2) across one, and nodes in each."""


# Data and its best prediction -----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class GaussianMixture:
    """A mixture of K Gaussians in a space of d dimensions (latents, flattened); with K = 1, a Gaussian.

    Component k is N(m_k, R diag(v_k) R^T) with one rotation R for all.

    Attributes:
        means: (K, d).
        variances: Along the axes of R, > 0, (K, d).
        weights: >= 0, brought to the sum 1 here, (K,); equal ones by default.
        rotation: R, orthogonal, its columns are the axes, (d, d); by default those of the space.
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
    def smallest_deviation(self) -> float:
        """Along any axis of any component."""
        return self.variances.min().sqrt().item()

    @property
    def root_mean_square(self) -> float:
        """sqrt(E|x_0|^2 / d), the size of a coordinate."""
        assert self.weights is not None
        return (self.weights @ (self.means**2 + self.variances).mean(dim=1)).sqrt().item()

    def denoise(self, x: Tensor, sigma: Tensor | float) -> Tensor:
        """E[x_0 | x], in the shape of `x`, float64; arguments as of `posterior_means`."""
        return self.posterior_means(x, sigma)[0]

    def posterior_means(self, x: Tensor, sigma: Tensor | float) -> tuple[Tensor, Tensor]:
        """E[x_0 | x] and E[n | x] = -sigma grad log p(x; sigma) (Tweedie's formula), in the shape of `x`, float64.

        The second is not computed from the first, from which a small sigma would leave few digits.

        Args:
            x: x_0 + sigma n, (B, ...) with d values a row.
            sigma: Noise level >= 0, one or one a row (B,).
        """
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
        """(B, ...) -> coordinates along the axes (B, d), float64."""
        flat = x.double().flatten(1)
        if flat.shape[1] != self.means.shape[1]:
            raise InvalidInputError(
                f"`x` is {describe(x)}; pass states with {self.means.shape[1]} values a row, as the data has."
            )
        return flat if self.rotation is None else flat @ self.rotation.to(x.device)

    def from_axes(self, coordinates: Tensor, shape: torch.Size) -> Tensor:
        """Undoes `to_axes`."""
        if self.rotation is not None:
            coordinates = coordinates @ self.rotation.to(coordinates.device).T
        return coordinates.reshape(shape)


# Problems -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Problem:
    """Data, a schedule and guidance: everything that a solver is run on.

    Attributes:
        name: To find it by.
        description: One line.
        shape: A sample's latents, (C, h, w).
        data: What is sampled; with guidance, what the condition stands for.
        unconditional: The other branch of guidance.
        guidance_scale: g in D_u + g (D_c - D_u); up to 1 there is none.
        schedule_config: Settings of the noise schedule, of any diffusers scheduler.
        prediction_type: What the network predicts: "epsilon", "v_prediction" or "sample".
        stiff: Whether it belongs to the stiff and extreme set.
    """

    name: str
    description: str
    shape: tuple[int, int, int]
    data: GaussianMixture
    unconditional: GaussianMixture | None = None
    guidance_scale: float = 1.0
    schedule_config: Mapping[str, Any] = field(default_factory=lambda: dict(STABLE_DIFFUSION))
    prediction_type: str = "epsilon"
    stiff: bool = False

    def __post_init__(self) -> None:
        check_choice("prediction_type", self.prediction_type, PREDICTION_TYPES)
        check_number("guidance_scale", self.guidance_scale)
        dimensions = self.data.means.shape[1]
        other = dimensions if self.unconditional is None else self.unconditional.means.shape[1]
        if other != dimensions:
            raise InvalidInputError(f"`unconditional` has {other} dimensions and `data` {dimensions}; take the same.")
        if torch.Size(self.shape).numel() != dimensions:
            raise InvalidInputError(
                f"`shape` is {self.shape}, but the data has {dimensions} dimensions; pass (C, h, w) of as many latents."
            )
        if self.guidance.active and self.unconditional is None:
            raise InvalidInputError(
                f"`guidance_scale` is {self.guidance_scale:g} without `unconditional`; pass the data of that branch."
            )

    @property
    def guidance(self) -> Guidance:
        """For the sampling loop."""
        return Guidance(self.guidance_scale)

    @property
    def other(self) -> GaussianMixture | None:
        """The other branch where guidance is on."""
        return self.unconditional if self.guidance.active else None

    def scheduler(self) -> DDIMScheduler:
        """A scheduler of this problem, in the place of a pipeline's own; see `schedulers.solvers.make_scheduler`."""
        return DDIMScheduler(**self.schedule_config, prediction_type=self.prediction_type, clip_sample=False)

    @cached_property
    def schedule(self) -> NoiseSchedule:
        """Noise levels as a continuous curve."""
        return NoiseSchedule.of(self.scheduler())

    def network(self) -> "ExactNetwork":
        """The best possible network, for the sampling loop or in place of a UNet."""
        return ExactNetwork(self)

    def noise(self, batch_size: int, seed: int = 0) -> Tensor:
        """Unit-variance noise to start from, (B, C, h, w).

        float64 that float32 holds exactly, so that solvers and references start from the same; rows do not depend on
        their number.
        """
        check_integer("batch_size", batch_size, 1)
        generator = torch.Generator().manual_seed(seed)
        return torch.stack([torch.randn(self.shape, generator=generator) for _ in range(batch_size)]).double()

    def run(
        self,
        noise: Tensor,
        solver: str | SchedulerMixin | None = None,
        steps: int = 50,
        *,
        tolerance: float | None = None,
        network: Denoiser | None = None,
        **options: Any,
    ) -> tuple[Tensor, RunReport]:
        """Latents and report of one run from unit-variance noise (B, C, h, w), by the loop that every pipeline runs.

        It is by a solver's name or a scheduler, or to a tolerance; a network may take the place of the exact one, and
        options are those of `sampling.sample` or `sampling.sample_to_tolerance`.
        """
        report, network = RunReport(guidance_scale=self.guidance_scale), network or self.network()
        options, noise = {"guidance": self.guidance, **options}, noise.float()
        with report.stage("denoising"):
            if tolerance is not None:
                known = (self.schedule, self.prediction_type, tolerance, report)
                return sample_to_tolerance(network, noise, *known, **options), report
            scheduler = solver if isinstance(solver, SchedulerMixin) else make_scheduler(self.scheduler(), solver)
            prepare_steps(scheduler, steps, noise.device)
            return sample(network, noise, scheduler, report, **options), report

    def denoise(self, x: Tensor, sigma: Tensor | float) -> Tensor:
        """D_u + g (D_c - D_u) of x = x_0 + sigma n, or D_c where there is no guidance (Ho & Salimans, 2022).

        float64 (B, C, h, w); `sigma` is one or one a row.
        """
        conditional = self.data.denoise(x, sigma)
        if self.other is None:
            return conditional
        unconditional = self.other.denoise(x, sigma)
        return unconditional + self.guidance_scale * (conditional - unconditional)

    @cached_property
    def flow(self) -> Flow:
        """The probability-flow ODE, for `solve_reference`."""
        smallest = min(data.smallest_deviation for data in (self.data, self.other or self.data))
        last_sigma = min(BELOW * smallest, self.schedule.sigma_min)
        return Flow(self.denoise, self.schedule, scale=self.data.root_mean_square, last_sigma=last_sigma)

    @property
    def has_solution(self) -> bool:
        """Whether the flow has a closed form: the data is one Gaussian, or with guidance two along the same axes."""
        if len(self.data.means) > 1 or self.other is None:
            return len(self.data.means) == 1
        one, other = self.data.rotation, self.other.rotation
        same = one is other if one is None or other is None else torch.equal(one, other)
        return len(self.other.means) == 1 and same

    def solution(self, noise: Tensor, sigma: float = 0.0) -> Tensor:
        """The exact flow from unit-variance noise (B, C, h, w) to a noise level, float64; see `follow`."""
        return self.follow(self.flow.start(noise), self.schedule.sigma_max, sigma)

    def follow(self, x: Tensor, sigma_from: float, sigma_to: float = 0.0) -> Tensor:
        """Where the probability-flow ODE takes states from one noise level to a lower one, in closed form.

        Along an axis of a Gaussian N(m, v), with tau = sigma^2, D(x) = (v x + tau m) / (v + tau), so the flow's
        dx/dsigma = (x - D) / sigma is linear: dx/dtau = (x - m) / (2 (v + tau)), and x - m goes as sqrt(v + tau).
        Guidance of scale g between two Gaussians that share their axes adds two such terms,

            dx/dtau = [(1 - g) (x - m_u) / (v_u + tau) + g (x - m_c) / (v_c + tau)] / 2,

        whose homogeneous solution is h(tau) = (v_u + tau)^((1 - g) / 2) (v_c + tau)^(g / 2). What the difference of the
        means adds is an integral (variation of constants), an incomplete beta function, taken here by Gauss-Legendre
        quadrature to rounding error.

        States x = x_0 + sigma n (B, ...) keep their shape, and become float64; `sigma_from` >= `sigma_to` >= 0.
        """
        check_number("sigma_to", sigma_to, 0.0)
        check_number("sigma_from", sigma_from, sigma_to, hint="The flow runs towards less noise.")
        if not self.has_solution:
            raise InvalidInputError(
                "`data` or `unconditional` is a mixture, or their axes differ, and such a flow has no closed form; "
                "solve it with `solve_reference`."
            )
        data, unconditional = self.data, self.other or self.data
        scale = 1.0 if self.other is None else self.guidance_scale
        high, low = sigma_from**2, sigma_to**2
        v_c, v_u = data.variances[0], unconditional.variances[0]
        mean, shift = data.axis_means[0], data.axis_means[0] - unconditional.axis_means[0]

        def growth(spread_u: Tensor, spread_c: Tensor) -> Tensor:
            """h(low) / h(tau), from v_u + tau and v_c + tau."""
            logarithm = (1 - scale) * ((v_u + low) / spread_u).log()
            return (0.5 * (logarithm + scale * ((v_c + low) / spread_c).log())).exp()

        integral = torch.zeros_like(v_u)  # of h(low) / (h(tau) (v_u + tau)) over tau from low to high
        if scale > 1.0 and low < high:
            # In p = log(smallest v + tau) the integrand is smooth everywhere: its nearest poles are pi away.
            smallest = torch.minimum(v_u, v_c)
            begin, end = (smallest + low).log(), (smallest + high).log()
            panels = math.ceil((end - begin).max().item() * max(PANELS, scale))
            nodes, weights = (torch.from_numpy(values) for values in np.polynomial.legendre.leggauss(NODES))
            places = ((torch.arange(panels, dtype=torch.float64)[:, None] + (nodes + 1) / 2) / panels).reshape(-1, 1)
            level = (begin + (end - begin) * places).exp()  # smallest v + tau, (n, d)
            spread_u = v_u - smallest + level
            values = growth(spread_u, v_c - smallest + level) / spread_u * level
            integral = (end - begin) * (weights.repeat(panels) @ values) / (2 * panels)
        kept, offset = growth(v_u + high, v_c + high), mean + 0.5 * (scale - 1) * shift * integral
        device = x.device
        return data.from_axes(offset.to(device) + kept.to(device) * (data.to_axes(x) - mean.to(device)), x.shape)


class ExactNetwork(nn.Module):
    """The best possible network of a problem, in place of a trained one.

    The sampling loop calls it as `network(state, timestep)`, pipelines call it as they call a `UNet2DConditionModel`.

    With guidance the batch is doubled, the unconditional half first. A network cannot see that from its input, so it is
    told: where `guided` is set, the first half is denoised with the unconditional data; it is set where the problem has
    guidance. Who switches guidance between steps switches `guided` as well.
    """

    _place: Tensor

    def __init__(self, problem: Problem):
        super().__init__()
        self.problem, self.schedule, self.guided = problem, problem.schedule, problem.guidance.active
        channels, *sides = problem.shape
        self.config = FrozenDict(in_channels=channels, out_channels=channels, sample_size=tuple(sides))
        # No weights; this only remembers where `to` put the network. The mathematics stays in float64.
        self.register_buffer("_place", torch.empty(0), persistent=False)

    @property
    def dtype(self) -> torch.dtype:
        """Dtype of the states that a pipeline passes."""
        return self._place.dtype

    @property
    def device(self) -> torch.device:
        return self._place.device

    def forward(
        self, sample: Tensor, timestep: Tensor | float, return_dict: bool = True, **conditions: Any
    ) -> Tensor | tuple[Tensor]:
        """The prediction, in the shape and dtype of `sample`; a tuple of it where `return_dict` is off.

        Args:
            sample: Variance-preserving states (B, C, ...), or (2 B, C, ...) where `guided`; what a pipeline shows its
                network in further channels is dropped.
            timestep: In [0, T - 1], whole or not, one or one a row.
            return_dict: As pipelines turn it off.
            conditions: Ignored: the condition is the problem's data.
        """
        if self.guided and len(sample) % 2:
            raise InvalidInputError(
                f"`sample` has {len(sample)} rows, but the network is `guided`; pass unconditional and conditional "
                "halves, or set `guided` to False."
            )
        sample = sample[:, : self.problem.shape[0]]
        timestep = timestep.detach().cpu() if isinstance(timestep, Tensor) else timestep
        sigma = self.schedule.sigma(timestep).expand(len(sample)).to(sample.device)
        column = sigma.view(-1, *[1] * (sample.ndim - 1))
        branches = [self.problem.unconditional, self.problem.data] if self.guided else [self.problem.data]
        x = sample.double() / alpha(column)
        parts = zip(branches, x.chunk(len(branches)), sigma.chunk(len(branches)), strict=True)
        found = [data.posterior_means(rows, levels) for data, rows, levels in parts if data is not None]
        denoised, noise = (torch.cat(halves) for halves in zip(*found, strict=True))
        prediction = denoised if self.problem.prediction_type == "sample" else noise
        if self.problem.prediction_type == "v_prediction":
            prediction = velocity_of(denoised, noise, column)
        prediction = prediction.to(sample.dtype)
        return prediction if return_dict else (prediction,)


# The problems by name -------------------------------------------------------------------------------------------------


def random_rotation(dimensions: int, seed: int = 0) -> Tensor:
    """An orthogonal matrix (d, d), float64."""
    generator = torch.Generator().manual_seed(seed)
    return torch.linalg.qr(torch.randn(dimensions, dimensions, generator=generator, dtype=torch.float64))[0]


def spectrum(conditioning: float, dimensions: int = 16, mean: Tensor | float = 0.0) -> GaussianMixture:
    """A Gaussian whose variances fall from 1 to 1 / conditioning, evenly in their logarithm, along rotated axes."""
    variances = torch.logspace(0, -torch.tensor(conditioning).log10(), dimensions, dtype=torch.float64)
    means = torch.zeros(1, dimensions, dtype=torch.float64) + mean
    return GaussianMixture(means, variances[None], rotation=random_rotation(dimensions))


def modes(deviation: float, distance: float = 1.0) -> GaussianMixture:
    """Four round Gaussians about means that are drawn from N(0, distance^2) in every coordinate."""
    generator = torch.Generator().manual_seed(0)
    means = distance * torch.randn(4, 16, generator=generator, dtype=torch.float64)
    return GaussianMixture(means, torch.full_like(means, deviation**2))


def _make_problems() -> Iterator[Problem]:
    small = partial(Problem, shape=(4, 2, 2))
    stiff = partial(small, stiff=True)
    gaussian, mixture, wide, axes = (
        spectrum(100.0, mean=0.1),
        modes(0.25),
        spectrum(10.0, mean=0.2),
        random_rotation(16),
    )
    few_levels = {"num_train_timesteps": 50, "beta_start": 0.005, "beta_end": 0.3, "beta_schedule": "linear"}

    def guided_modes(scale: float, kind: Callable[..., Problem] = small) -> Problem:
        words = f"16 dimensions, two of four modes of deviation 0.25, guidance {scale:g}"
        two = GaussianMixture(mixture.means[:2], mixture.variances[:2])
        return kind(f"mixture-{scale:g}", words, data=two, unconditional=mixture, guidance_scale=scale)

    def guided_gaussians(name: str, scale: float, kind: Callable[..., Problem] = small) -> Problem:
        words = f"16 dimensions, from a wide to a narrow Gaussian, guidance {scale:g}, solved in closed form"
        narrow = GaussianMixture(wide.means + 0.3 * axes[:, 3], wide.variances * 0.25, rotation=axes)
        return kind(name, words, data=narrow, unconditional=wide, guidance_scale=scale)

    words = "256 dimensions, Gaussian, variances from 1 to 0.01"
    yield Problem("gaussian", words, (4, 8, 8), spectrum(100.0, 256, mean=0.1))
    yield guided_gaussians("gaussian-guided", 7.5)
    words = "Gaussian on a schedule of 50 levels, data predicted"
    yield small("gaussian-50-levels", words, data=gaussian, schedule_config=few_levels, prediction_type="sample")
    yield small("mixture", "16 dimensions, four modes of deviation 0.25, no guidance", data=mixture)
    yield from map(guided_modes, (1.0, 3.0, 7.5))

    for power in (2, 4, 8, 12):
        words = f"Gaussian with variances from 1 down to 1e-{power:02}"
        yield stiff(f"conditioning-1e{power}", words, data=spectrum(10.0**power))
    far, point = modes(0.05, 5.0 / 32**0.5), GaussianMixture(modes(1.0).means[:1], torch.full((1, 16), 1e-12))
    yield stiff("far-modes", "Four modes of deviation 0.05, a hundred times that apart", data=far)
    yield stiff("near-delta", "Gaussian of variance 1e-12 about one point", data=point)
    yield stiff("near-deltas", "Four points, each of variance 1e-12", data=modes(1e-6))
    yield guided_modes(30.0, stiff)
    yield guided_gaussians("gaussian-guided-30", 30.0, stiff)
    velocity = partial(stiff, data=gaussian, prediction_type="v_prediction")
    words, cosine = "Gaussian on the cosine schedule, from noise level 20 000", {"beta_schedule": "squaredcos_cap_v2"}
    yield velocity("gaussian-cosine", words, schedule_config=cosine)
    words, zero_snr = (
        "Gaussian on a schedule of zero terminal SNR, from noise level 4096",
        {"rescale_betas_zero_snr": True},
    )
    yield velocity("pure-noise", words, schedule_config={**STABLE_DIFFUSION, **zero_snr})


PROBLEMS = {problem.name: problem for problem in _make_problems()}


def make_problem(name: str) -> Problem:
    """The problem of a name in `PROBLEMS`."""
    return PROBLEMS[check_choice("name", name, PROBLEMS)]


def all_problems(stiff: bool | None = None) -> list[Problem]:
    """All problems, or only the stiff and extreme ones, or only the plain ones."""
    return [problem for problem in PROBLEMS.values() if stiff is None or problem.stiff is stiff]
