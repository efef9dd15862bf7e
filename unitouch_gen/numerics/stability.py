"""Stability: stiff problems and extreme calls of pipelines, each with an a-priori bound.

A case measures an error that has to be within a bound. The bound is derived from the problem: a tolerance, or a number
of roundings. The error is infinite if a sample has an unexpected return code, or if a result is not finite.
"""

import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import torch
from torch import Tensor

from unitouch_gen.errors import UnfamiliarInputWarning
from unitouch_gen.examples import example
from unitouch_gen.numerics.problems import PROBLEMS, Problem, relative_rms
from unitouch_gen.sampling import ReturnCode
from unitouch_gen.solvers import denoised_at_zero


@dataclass(frozen=True)
class Case:
    """One stiff or extreme case."""

    name: str
    measure: Callable[[], float]
    bound: float | Callable[[], float] = 0.0
    reason: str = "ends with its code, no NaN or Inf comes out"

    @torch.no_grad()
    def run(self) -> tuple[float, float]:
        """(value measured, bound)."""
        value = self.measure()
        bound = self.bound() if callable(self.bound) else self.bound
        return value, bound


def cases(load: Callable[..., Any], kinds: Sequence[str]) -> list[Case]:
    """All cases, with those of some pipelines; `load(kind, dtype=...)` returns one when a case first needs it."""
    load_once = cache(lambda kind, dtype: load(kind, dtype=dtype))
    stiff = list[Case]()
    for problem in PROBLEMS.values():
        if problem.stiff:
            name = f"{problem.name}, tolerance 0.01"
            measure = partial(adaptive_error, problem)
            bound = partial(within, problem)
            stiff.append(Case(name, measure, bound, reason="tolerance, and the step to sigma 0"))
    pipelines = list[Case]()
    for kind in kinds:
        pipelines += pipeline_cases(partial(load_once, kind), kind)
    return [*stiff, *pipelines]


def error(
    found: Tensor, codes: Sequence[ReturnCode], expected: Any = ReturnCode.SUCCESS, exact: Tensor | None = None
) -> float:
    """Relative RMS error of the worst sample; 0 without an exact result, infinite if codes are unexpected.

    `expected` is one code, or one for each sample.
    """
    expected_codes = [expected] * len(codes) if isinstance(expected, ReturnCode) else expected
    if list(codes) != expected_codes or not bool(found.isfinite().all()):
        return math.inf
    return 0.0 if exact is None else relative_rms(found, exact).max().item()


def adaptive_error(problem: Problem, tolerance: float = 0.01) -> float:
    """Relative error of adaptive steps from four noises, of the worst sample."""
    noise = problem.noise(4)
    latents, report = problem.run(noise, throw=False, tolerance=tolerance)
    return error(latents, report.codes, exact=problem.solution(noise))


def within(problem: Problem, tolerance: float = 0.01) -> float:
    """The bound of a tolerance: on Gaussian data it adds the error of the step to sigma = 0 along the exact flow."""
    if not problem.is_gaussian:
        return tolerance
    noise = problem.noise(4)
    last = problem.schedule.sigma_min
    sigmas = [2 * last, last]
    states = zip(sigmas, problem.path(noise, sigmas), strict=True)
    levels = [(sigma, problem.denoise(x, sigma)) for sigma, x in states]
    return tolerance + relative_rms(denoised_at_zero(levels), problem.solution(noise)).max().item()


def pipeline_cases(load: Callable[[torch.dtype], Any], kind: str) -> Iterator[Case]:
    """Extreme guidance and latents, and half precision in calls of a pipeline."""
    touch = example("brick")
    photo = example("wood", "image")
    conditions: dict[str, dict[str, Any]] = {
        "touch-to-image": {"touch": touch},
        "stylization": {"touch": touch, "image": photo},
        "x-to-touch": {"image": photo},
    }

    def call(dtype: torch.dtype = torch.float32, size: float = 1.0, **changes: Any) -> tuple[Tensor, list[ReturnCode]]:
        """Latents and codes of one call, from latents that are plus or minus `size` everywhere."""
        pipe = load(dtype)
        pipe.set_progress_bar_config(disable=True)
        shape = (1, pipe.unet.config.out_channels, 8, 8)
        side = 8 * pipe.vae_scale_factor
        latents = size * torch.randn(shape, generator=torch.Generator().manual_seed(1)).sign()
        arguments = {
            "num_inference_steps": 2,
            "guidance_scale": 2.0,
            "latents": latents,
            "height": side,
            "width": side,
            "output_type": "latent",
            "throw": False,
            "generator": torch.Generator().manual_seed(0),
            **conditions[kind],
        }
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UnfamiliarInputWarning)
            output = pipe(**arguments | changes)
        return output.images, output.report.codes

    def same(name: str, arguments: dict[str, Any], other_arguments: dict[str, Any], bound: Any, reason: str) -> Case:
        """A case of two calls with equal results."""

        def measure() -> float:
            latents, codes = call(**arguments)
            exact, _ = call(**other_arguments)
            return error(latents, codes, exact=exact)

        return Case(f"{kind}: {name}", measure, bound, reason)

    def coded(name: str, code: ReturnCode, **arguments: Any) -> Case:
        """A case of a call that ends with a code."""

        def measure() -> float:
            latents, codes = call(**arguments)
            return error(latents, codes, code)

        return Case(f"{kind}: {name}", measure)

    def roundings(dtype: torch.dtype) -> float:
        """The error of independent roundings of all layers in 8 steps."""
        modules = load(torch.float32).unet.modules()
        layers = sum(any(True for _ in module.parameters(recurse=False)) for module in modules)
        return torch.finfo(dtype).eps / 2 * math.sqrt(8 * layers)

    equal = (1e-4, "equal calls, some thousand roundings of float32 in another order")
    yield same("guidance_scale 0", {"guidance_scale": 0.0}, {"guidance_scale": 1.0}, *equal)
    yield same("latents of size 1e-40", {"size": 1e-40}, {"size": 0.0}, *equal)
    yield coded("guidance_scale 1e6", ReturnCode.DIVERGED, guidance_scale=1e6)
    yield coded("latents of size 1e3", ReturnCode.DIVERGED, size=1e3)
    yield coded("latents of size 3e38", ReturnCode.NON_FINITE, size=3e38)
    steps: dict[str, Any] = {"num_inference_steps": 8}
    for dtype in (torch.float16, torch.bfloat16):
        bound = partial(roundings, dtype)
        yield same(str(dtype), {**steps, "dtype": dtype}, steps, bound, "independent roundings of its layers")
