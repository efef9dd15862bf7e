"""Problems whose answer is known, by name: a plain set, and a stiff and extreme one.

All are deterministic. Latents have four channels as those of Stable Diffusion, but few pixels: what makes a problem
hard is its spectrum, not its size.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache, cached_property
from typing import Any

import torch
from diffusers import DDIMScheduler
from torch import Tensor

from unitouch_gen.errors import InvalidInputError, check_choice, check_integer, check_number
from unitouch_gen.numerics.cache import fingerprint
from unitouch_gen.numerics.exact import ExactNetwork, GaussianMixture, check_same_space, guided_denoise
from unitouch_gen.numerics.flow import Flow
from unitouch_gen.numerics.gaussian_flow import gaussian_flow, has_flow
from unitouch_gen.sampling import Guidance
from unitouch_gen.schedulers.schedule import PREDICTION_TYPES, NoiseSchedule

STABLE_DIFFUSION = {"beta_start": 0.00085, "beta_end": 0.012, "beta_schedule": "scaled_linear"}
BELOW = 1e-4
"""Noise level that a flow to sigma = 0 ends at, in units of the data's smallest deviation: what its last step leaves
out is of the order BELOW^4."""


@dataclass(frozen=True, eq=False)
class Problem:
    """Data, a schedule and guidance: everything that a solver is run on.

    Attributes:
        name: To find it by.
        description: One line.
        shape: Of a sample's latents, (C, h, w).
        data: What is sampled; with guidance, what the condition stands for.
        unconditional: The other branch of guidance.
        guidance_scale: g in D_u + g (D_c - D_u); up to 1 there is none.
        schedule_config: Settings of the noise schedule, of any diffusers scheduler.
        prediction_type: Of the network: "epsilon", "v_prediction" or "sample".
        stiff: Whether it belongs to the stiff and extreme set.

    Raises:
        InvalidInputError: If these do not fit each other.
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
        check_same_space(self.data, self.unconditional)
        if torch.Size(self.shape).numel() != self.data.dimensions:
            raise InvalidInputError(
                f"`shape` is {self.shape}, but the data has {self.data.dimensions} dimensions; pass (C, h, w) of as "
                "many latents."
            )
        if self.guidance.active and self.unconditional is None:
            raise InvalidInputError(
                f"`guidance_scale` is {self.guidance_scale:g} without `unconditional`; pass the data of that branch."
            )

    @property
    def guidance(self) -> Guidance:
        """For the sampling loop."""
        return Guidance(self.guidance_scale)

    def scheduler(self) -> DDIMScheduler:
        """A scheduler of this problem, in the place of a pipeline's own; see `diffusion.solvers.make_scheduler`."""
        return DDIMScheduler(**self.schedule_config, prediction_type=self.prediction_type, clip_sample=False)

    @cached_property
    def schedule(self) -> NoiseSchedule:
        """Noise levels as a continuous curve."""
        return NoiseSchedule.of(self.scheduler())

    def network(self) -> ExactNetwork:
        """The best possible network, for the sampling loop or in place of a UNet."""
        return ExactNetwork(
            self.data,
            self.schedule,
            self.prediction_type,
            self.unconditional,
            guided=self.guidance.active,
            config={"in_channels": self.shape[0], "out_channels": self.shape[0], "sample_size": self.shape[1:]},
        )

    def noise(self, batch_size: int, seed: int = 0) -> Tensor:
        """Unit-variance noise to start from, (B, C, h, w).

        float64 that float32 holds exactly, so that solvers and references start from the same; rows do not depend on
        their number.
        """
        check_integer("batch_size", batch_size, 1)
        generator = torch.Generator().manual_seed(seed)
        return torch.stack([torch.randn(self.shape, generator=generator) for _ in range(batch_size)]).double()

    def denoise(self, x: Tensor, sigma: Tensor | float) -> Tensor:
        """The guided prediction of x_0 from x = x_0 + sigma n, (B, C, h, w) float64; `sigma` is one or one a row."""
        return guided_denoise(self.data, self.unconditional, self.guidance_scale, x, sigma)

    @cached_property
    def flow(self) -> Flow:
        """The probability-flow ODE, for `solve_reference`."""
        active = (self.data, self.unconditional) if self.guidance.active else (self.data,)
        smallest = min(data.smallest_deviation for data in active if data is not None)
        return Flow(
            self.denoise,
            self.schedule,
            fingerprint(self.data, self.unconditional, self.guidance_scale),
            scale=self.data.root_mean_square,
            last_sigma=min(BELOW * smallest, self.schedule.sigma_min),
        )

    @property
    def has_solution(self) -> bool:
        """Whether the flow has a closed form."""
        return has_flow(self.data, self.unconditional if self.guidance.active else None)

    def solution(self, noise: Tensor, sigma: float = 0.0) -> Tensor:
        """The exact flow from noise, as x at a noise level from 0 to the largest, float64 (B, C, h, w).

        Args:
            noise: Unit-variance, the variance-preserving state at the largest noise level, (B, C, h, w).
            sigma: Where to go.

        Raises:
            InvalidInputError: If it has no closed form.
        """
        return gaussian_flow(
            self.data,
            self.flow.start(noise),
            self.schedule.sigma_max,
            sigma,
            unconditional=self.unconditional,
            guidance_scale=self.guidance_scale,
        )


# The data of the problems ---------------------------------------------------------------------------------------------

SMALL = (4, 2, 2)


def random_rotation(dimensions: int, seed: int = 0) -> Tensor:
    """An orthogonal matrix (d, d), float64."""
    generator = torch.Generator().manual_seed(seed)
    return torch.linalg.qr(torch.randn(dimensions, dimensions, generator=generator, dtype=torch.float64))[0]


def spectrum(conditioning: float, dimensions: int = 16, mean: Tensor | float = 0.0, seed: int = 0) -> GaussianMixture:
    """A Gaussian whose variances fall from 1 to 1 / conditioning, evenly in their logarithm, along rotated axes."""
    variances = torch.logspace(0, -torch.tensor(conditioning).log10(), dimensions, dtype=torch.float64)
    means = torch.zeros(1, dimensions, dtype=torch.float64) + mean
    return GaussianMixture(means, variances[None], rotation=random_rotation(dimensions, seed))


def modes(deviation: float, distance: float = 1.0, dimensions: int = 16) -> GaussianMixture:
    """Four round Gaussians about means that are drawn from N(0, distance^2) in every coordinate."""
    generator = torch.Generator().manual_seed(0)
    means = distance * torch.randn(4, dimensions, generator=generator, dtype=torch.float64)
    return GaussianMixture(means, torch.full_like(means, deviation**2))


def first_two(mixture: GaussianMixture) -> GaussianMixture:
    """What is left of a mixture under a condition that names its first two components."""
    return GaussianMixture(mixture.means[:2], mixture.variances[:2], rotation=mixture.rotation)


def _guided_modes(name: str, scale: float, stiff: bool = False) -> Problem:
    mixture = modes(0.25)
    return Problem(
        name,
        f"16 dimensions, two of four modes of deviation 0.25, guidance {scale:g}",
        SMALL,
        first_two(mixture),
        mixture,
        scale,
        stiff=stiff,
    )


def _guided_gaussians(name: str, scale: float, stiff: bool = False) -> Problem:
    wide, axes = spectrum(10.0, mean=0.2), random_rotation(16)
    narrow = GaussianMixture(wide.means + 0.3 * axes[:, 3], wide.variances * 0.25, rotation=axes)
    return Problem(
        name,
        f"16 dimensions, from a wide to a narrow Gaussian, guidance {scale:g}, solved in closed form",
        SMALL,
        narrow,
        wide,
        scale,
        stiff=stiff,
    )


def _conditioned(name: str, conditioning: float) -> Problem:
    return Problem(
        name,
        f"Gaussian with variances from 1 down to {1 / conditioning:.0e}",
        SMALL,
        spectrum(conditioning),
        stiff=True,
    )


PROBLEMS: dict[str, Callable[[str], Problem]] = {
    "gaussian": lambda name: Problem(
        name, "256 dimensions, Gaussian, variances from 1 to 0.01", (4, 8, 8), spectrum(100.0, 256, mean=0.1)
    ),
    "gaussian-guided": lambda name: _guided_gaussians(name, 7.5),
    "gaussian-50-levels": lambda name: Problem(
        name,
        "Gaussian on a schedule of 50 levels, data predicted",
        SMALL,
        spectrum(100.0, mean=0.1),
        schedule_config={"num_train_timesteps": 50, "beta_start": 0.005, "beta_end": 0.3, "beta_schedule": "linear"},
        prediction_type="sample",
    ),
    "mixture": lambda name: Problem(
        name, "16 dimensions, four modes of deviation 0.25, no guidance", SMALL, modes(0.25)
    ),
    "mixture-1": lambda name: _guided_modes(name, 1.0),
    "mixture-3": lambda name: _guided_modes(name, 3.0),
    "mixture-7.5": lambda name: _guided_modes(name, 7.5),
    "conditioning-1e2": lambda name: _conditioned(name, 1e2),
    "conditioning-1e4": lambda name: _conditioned(name, 1e4),
    "conditioning-1e8": lambda name: _conditioned(name, 1e8),
    "conditioning-1e12": lambda name: _conditioned(name, 1e12),
    "far-modes": lambda name: Problem(
        name, "Four modes of deviation 0.05, a hundred times that apart", SMALL, modes(0.05, 5.0 / 32**0.5), stiff=True
    ),
    "near-delta": lambda name: Problem(
        name,
        "Gaussian of variance 1e-12 about one point",
        SMALL,
        GaussianMixture(modes(1.0).means[:1], torch.full((1, 16), 1e-12)),
        stiff=True,
    ),
    "near-deltas": lambda name: Problem(name, "Four points, each of variance 1e-12", SMALL, modes(1e-6), stiff=True),
    "mixture-30": lambda name: _guided_modes(name, 30.0, stiff=True),
    "gaussian-guided-30": lambda name: _guided_gaussians(name, 30.0, stiff=True),
    "gaussian-cosine": lambda name: Problem(
        name,
        "Gaussian on the cosine schedule, from noise level 20 000",
        SMALL,
        spectrum(100.0, mean=0.1),
        schedule_config={"beta_schedule": "squaredcos_cap_v2"},
        prediction_type="v_prediction",
        stiff=True,
    ),
    "pure-noise": lambda name: Problem(
        name,
        "Gaussian on a schedule of zero terminal SNR, from noise level 4096",
        SMALL,
        spectrum(100.0, mean=0.1),
        schedule_config={**STABLE_DIFFUSION, "rescale_betas_zero_snr": True},
        prediction_type="v_prediction",
        stiff=True,
    ),
}
"""Made when first asked for: see `make_problem`."""


@cache
def make_problem(name: str) -> Problem:
    """The problem of a name in `PROBLEMS`.

    Raises:
        InvalidInputError: If there is none.
    """
    return PROBLEMS[check_choice("name", name, PROBLEMS)](name)


def all_problems(stiff: bool | None = None) -> list[Problem]:
    """All problems, or only the stiff and extreme ones, or only the plain ones."""
    problems = [make_problem(name) for name in PROBLEMS]
    return [problem for problem in problems if stiff is None or problem.stiff is stiff]
