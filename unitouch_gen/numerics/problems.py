"""Problems whose flow is known: Gaussian mixtures with their optimal denoisers, their flows, and a set of them by name.

Given x = x_0 + sigma n, the optimal prediction of data x_0 ~ sum_k N(m_k, diag v_k) / K is a mean of linear
predictions, weighted by the probabilities of the components. All computations are in float64. Latents have four
channels, as in Stable Diffusion, but few pixels: a problem is hard by its spectrum, not by its size. Solvers treat all
axes alike, so Gaussians along the pixels represent those along any axes.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import torch
from diffusers import DDIMScheduler
from scipy.integrate import solve_ivp
from torch import Tensor

from unitouch_gen.arguments import SamplingArguments
from unitouch_gen.errors import NotConvergedError, check_fields
from unitouch_gen.sampling import Denoiser, Guidance, ReturnCode, RunReport, SampleStatus, prepare_steps, solve
from unitouch_gen.schedule import NoiseSchedule, alpha
from unitouch_gen.solvers import MIN_LEVEL_RATIO, Callback, Denoise, denoised_at_zero

Network = Callable[[Tensor, Tensor], Tensor]
"""(variance-preserving z (B or 2 B, C, h, w), timestep) -> prediction of the same shape; unconditional half first."""

STABLE_DIFFUSION: dict[str, Any] = {"beta_start": 0.00085, "beta_end": 0.012, "beta_schedule": "scaled_linear"}


@dataclass(frozen=True, eq=False)
class GaussianMixture:
    """K equally probable Gaussians of d dimensions (latents, flattened)."""

    means: Tensor  # (K, d) float64
    variances: Tensor  # (K, d) float64, > 0

    def posterior_means(self, x: Tensor, sigma: Tensor | float) -> tuple[Tensor, Tensor]:
        """E[x_0 | x] and E[n | x] = -sigma grad log p(x; sigma) (Tweedie's formula), (B, ...) float64.

        Computing the second from the first would lose digits at a small sigma.
        """
        offset = x.double().flatten(1).unsqueeze(1) - self.means  # (B, K, d)
        spread = self.variances + sigma**2  # (K, d)
        log_likelihood = -0.5 * (offset**2 / spread + spread.log()).sum(dim=2)
        weight = log_likelihood.softmax(dim=1).unsqueeze(2)  # (B, K, 1)
        denoised = (weight * (self.means + self.variances / spread * offset)).sum(dim=1)
        noise = (weight * sigma * offset / spread).sum(dim=1)
        return denoised.view(x.shape), noise.view(x.shape)


@dataclass(frozen=True, eq=False)
class Problem:
    """Data, a noise schedule and guidance, on which a solver is run."""

    name: str
    data: GaussianMixture  # with guidance, the data given the condition
    unconditional: GaussianMixture | None = None  # with guidance, the data without condition
    guidance_scale: float = 1.0
    schedule_config: Mapping[str, Any] = field(default_factory=lambda: STABLE_DIFFUSION)
    prediction_type: str = "epsilon"
    stiff: bool = False  # stiff, or otherwise extreme

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape of a sample's latents, (4, h, h)."""
        side = math.isqrt(self.data.means.shape[1] // 4)
        return 4, side, side

    @property
    def guidance(self) -> Guidance:
        return Guidance(self.guidance_scale)

    @property
    def smallest_deviation(self) -> float:
        """The smallest deviation along any axis of any component."""
        mixtures = [data for data in (self.data, self.unconditional) if data is not None]
        return min(data.variances.min().sqrt().item() for data in mixtures)

    @property
    def is_gaussian(self) -> bool:
        """Whether the flow is linear, that is, the data is Gaussian, with guidance in both branches."""
        return len(self.data.means) == 1 and (self.unconditional is None or len(self.unconditional.means) == 1)

    @cached_property
    def schedule(self) -> NoiseSchedule:
        return NoiseSchedule.of(self.scheduler())

    def scheduler(self) -> DDIMScheduler:
        """A scheduler of diffusers with this noise schedule."""
        return DDIMScheduler(**self.schedule_config, prediction_type=self.prediction_type, clip_sample=False)

    def noise(self, batch_size: int) -> Tensor:
        """Unit-variance noise to start from, (B, 4, h, h) float64, exactly representable in float32."""
        generator = torch.Generator().manual_seed(0)
        return torch.stack([torch.randn(self.shape, generator=generator) for _ in range(batch_size)]).double()

    def denoise(self, x: Tensor, sigma: float) -> Tensor:
        """D(x, sigma), guided (Ho & Salimans, 2022), float64."""
        conditional, _ = self.data.posterior_means(x, sigma)
        if self.unconditional is None or not self.guidance.active:
            return conditional
        unconditional, _ = self.unconditional.posterior_means(x, sigma)
        return self.guidance.combine(torch.cat([unconditional, conditional]))

    def network(self, batch_size: int) -> Network:
        """The optimal network for B samples; of 2 B states the first half is unconditional."""

        def predict(z: Tensor, timestep: Tensor) -> Tensor:
            sigma = self.schedule.sigma(timestep)
            branches = [self.unconditional or self.data, self.data][-len(z) // batch_size :]
            states = (z.double() / alpha(sigma)).chunk(len(branches))
            posteriors = [data.posterior_means(x, sigma) for data, x in zip(branches, states, strict=True)]
            denoised = torch.cat([data_mean for data_mean, _ in posteriors])
            noise = torch.cat([noise_mean for _, noise_mean in posteriors])
            predictions = {
                "epsilon": noise,
                "v_prediction": alpha(sigma) * (noise - sigma * denoised),  # (Salimans & Ho, 2022, Section 4)
                "sample": denoised,
            }
            return predictions[self.prediction_type].to(z.dtype)

        return predict

    def denoiser(self, network: Network) -> Denoiser:
        """What samples with a network, guided."""

        def unet(z: Tensor, timestep: Tensor, return_dict: bool) -> tuple[Tensor]:
            return (network(z, timestep),)

        return Denoiser(unet, self.schedule, {}, self.guidance)

    def run(
        self,
        noise: Tensor,
        solver: str | None = None,
        *,
        network: Network | None = None,
        scheduler: Any = None,
        throw: bool = True,
        **arguments: Any,
    ) -> tuple[Tensor, RunReport]:
        """Latents and report of one run from unit-variance noise; `arguments` are `SamplingArguments`."""
        given = check_fields(SamplingArguments, {"solver": solver, **arguments})
        steps, _ = prepare_steps(scheduler or self.scheduler(), given)
        denoise = self.denoiser(network or self.network(len(noise)))
        status = SampleStatus(len(noise), noise.device)
        report = RunReport()

        def note(step: int, x: Tensor, sigma: float) -> Tensor:
            status.update(step, x * alpha(sigma))
            report.steps = step + 1
            return x

        with report.stage("denoising"), torch.no_grad():
            if isinstance(steps, list):
                start = noise.float() * math.hypot(1.0, steps[0])
                latents, ended = solve(denoise, start, steps, given, note)
            else:
                latents = run_scheduler(denoise, noise.float(), steps, note)
                ended = ReturnCode.SUCCESS
        status.conclude(report, denoise, ended, throw)
        return latents, report

    def path(self, noise: Tensor, sigmas: list[float]) -> list[Tensor]:
        """States of the exact flow at descending noise levels, (B, 4, h, h) float64 each.

        For one Gaussian, dx/dtau = (x - m) / (2 (v + tau)) with tau = sigma^2, so x - m is proportional to sqrt(v +
        tau).
        """
        first = self.schedule.sigma_max
        start = noise.double() * math.hypot(1.0, first)
        if not self.is_gaussian or self.guidance.active:
            lower = [sigma for sigma in sigmas if sigma < 0.999999 * first]
            return solve_flow(self.denoise, start, [first, *lower], rtol=1e-10)[-len(sigmas) :]
        mean = self.data.means[0].view(self.shape)
        variance = self.data.variances[0].view(self.shape)
        states = list[Tensor]()
        for sigma in sigmas:
            scale = ((variance + sigma**2) / (variance + first**2)).sqrt()
            states.append(mean + scale * (start - mean))
        return states

    def solution(self, noise: Tensor) -> Tensor:
        """The end of the exact flow; D is extrapolated from its last levels to sigma = 0, as solvers do it."""
        if self.is_gaussian and not self.guidance.active:
            return self.path(noise, [0.0])[0]
        last = min(1e-4 * self.smallest_deviation, self.schedule.sigma_min)
        levels = [MIN_LEVEL_RATIO * last, last]
        states = zip(levels, self.path(noise, levels), strict=True)
        return denoised_at_zero([(sigma, self.denoise(x, sigma)) for sigma, x in states])


def run_scheduler(denoise: Denoiser, noise: Tensor, scheduler: Any, callback: Callback) -> Tensor:
    """diffusers' denoising loop with a scheduler that keeps states variance-preserving and has its timesteps set."""
    latents = noise
    for step, timestep in enumerate(scheduler.timesteps):
        prediction = denoise.predict(latents, timestep)
        latents = scheduler.step(prediction, timestep, latents, return_dict=False)[0]
        callback(step, latents, 0.0)
    return latents


def relative_rms(value: Tensor, truth: Tensor) -> Tensor:
    """Root-mean-square error of each sample (B, ...), relative to the truth's RMS, float64 (B,)."""
    truth = truth.double().flatten(1)
    return (value.double().flatten(1) - truth).norm(dim=1) / truth.norm(dim=1)


def solve_flow(denoise: Denoise, x: Tensor, sigmas: Sequence[float], rtol: float) -> list[Tensor]:
    """x at each of descending noise levels, (B, C, h, w) float64, from x at the first of them.

    It is solved by scipy's DOP853, an explicit Runge-Kutta method of order 8, in u = log sigma, where the linear part
    of the flow has rates between 0 and 1, however ill-conditioned the data is. The state is z = alpha x, whose root
    mean square stays near 1 along the path,

        dz/du = alpha^2 z - alpha D(z / alpha, sigma),

    so one tolerance serves as the relative and the absolute one.

    Args:
        denoise: D(x, sigma) of float64 states.
        rtol: Tolerance of a step, relative to the RMS of each sample, from 1e-12.

    Raises:
        NotConvergedError: If no step is small enough.
    """

    def slope(u: float, z: np.ndarray) -> np.ndarray:
        sigma = math.exp(u)
        denoised = denoise(torch.from_numpy(z.reshape(x.shape)) / alpha(sigma), sigma)
        return alpha(sigma) ** 2 * z - alpha(sigma) * denoised.numpy().reshape(-1)

    levels = [math.log(sigma) for sigma in sigmas]
    start = (x.double() * alpha(sigmas[0])).reshape(-1).numpy()
    # scipy's norm is over the whole batch. Divided by sqrt(B), the tolerance bounds the error of every sample.
    tolerance = max(rtol / math.sqrt(len(x)), 1e-13)
    result = solve_ivp(
        slope,
        t_span=(levels[0], levels[-1]),
        y0=start,
        method="DOP853",
        t_eval=levels,
        rtol=tolerance,
        atol=tolerance,
    )
    if not result.success:
        raise NotConvergedError(f"The reference stopped after {result.nfev} evaluations: {result.message}")
    return [torch.from_numpy(z.reshape(x.shape)) / alpha(sigma) for z, sigma in zip(result.y.T, sigmas, strict=True)]


# The problems by name -------------------------------------------------------------------------------------------------


def gaussian(smallest: float, dimensions: int = 16, mean: float = 0.1, largest: float = 1.0) -> GaussianMixture:
    """A Gaussian whose variances fall from the largest to the smallest one, evenly in their logarithm."""
    variances = torch.linspace(math.log(largest), math.log(smallest), dimensions, dtype=torch.float64).exp()
    return GaussianMixture(torch.full((1, dimensions), mean, dtype=torch.float64), variances[None])


def modes(deviation: float, distance: float = 1.0, count: int = 4) -> GaussianMixture:
    """Isotropic Gaussians around means drawn from N(0, distance^2) in each of 16 dimensions."""
    means = distance * torch.randn(4, 16, generator=torch.Generator().manual_seed(0), dtype=torch.float64)[:count]
    return GaussianMixture(means, torch.full_like(means, deviation**2))


WIDE = gaussian(0.1, mean=0.2)
NARROW = gaussian(0.025, mean=0.275, largest=0.25)
FEW_LEVELS = {"num_train_timesteps": 50, "beta_start": 0.005, "beta_end": 0.3, "beta_schedule": "linear"}
COSINE = {"beta_schedule": "squaredcos_cap_v2"}  # starts at noise level 20 000
ZERO_SNR = {**STABLE_DIFFUSION, "rescale_betas_zero_snr": True}  # starts at noise level 4096


def _problems() -> list[Problem]:
    """All problems; those that are `stiff` are cases of `stability`."""
    return [
        Problem("gaussian", gaussian(0.01, 256)),
        Problem("gaussian-guided", NARROW, WIDE, 7.5),
        Problem("gaussian-50-levels", gaussian(0.01), schedule_config=FEW_LEVELS, prediction_type="sample"),
        Problem("mixture", modes(0.25)),
        Problem("mixture-3", modes(0.25, count=2), modes(0.25), 3.0),  # two of four modes, guidance 3
        Problem("mixture-7.5", modes(0.25, count=2), modes(0.25), 7.5),
        Problem("mixture-30", modes(0.25, count=2), modes(0.25), 30.0, stiff=True),
        Problem("gaussian-guided-30", NARROW, WIDE, 30.0, stiff=True),
        *(Problem(f"conditioning-1e{power}", gaussian(10.0**-power, mean=0.0), stiff=True) for power in (2, 6, 12)),
        Problem("far-modes", modes(0.05, 5.0 / 32**0.5), stiff=True),  # a hundred deviations apart
        Problem("near-delta", modes(1e-6, count=1), stiff=True),
        Problem("near-deltas", modes(1e-6), stiff=True),
        Problem("gaussian-cosine", gaussian(0.01), schedule_config=COSINE, prediction_type="v_prediction", stiff=True),
        Problem("pure-noise", gaussian(0.01), schedule_config=ZERO_SNR, prediction_type="v_prediction", stiff=True),
    ]


PROBLEMS = {problem.name: problem for problem in _problems()}
