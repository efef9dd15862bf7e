"""Stability: stiff problems and extreme calls of pipelines, each with an a-priori bound.

A case measures one number, which may be at most its bound. The bound follows from the problem: a tolerance, a number of
roundings. An error is infinite where a sample ends with an unexpected return code, or where a value that is not finite
leaves as a result.
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
        return self.measure(), self.bound() if callable(self.bound) else self.bound


def cases(load: Callable[..., Any], kinds: Sequence[str]) -> list[Case]:
    """All cases, with those of some pipelines; `load(kind, dtype=...)` returns one when a case first needs it."""
    kept = cache(lambda kind, dtype: load(kind, dtype=dtype))
    pipelines = [case for kind in kinds for case in pipeline_cases(partial(kept, kind), kind)]
    why = "tolerance, and the step to sigma 0"
    problems = [problem for problem in PROBLEMS.values() if problem.stiff]
    stiff = [Case(f"{p.name}, tolerance 0.01", partial(adaptive_error, p), partial(within, p), why) for p in problems]
    return [*stiff, *pipelines]


def error(
    found: Tensor, codes: Sequence[ReturnCode], expected: Any = ReturnCode.SUCCESS, exact: Tensor | None = None
) -> float:
    """Relative RMS error of the worst sample, 0 without an exact result; `expected` is one code or one a sample."""
    wanted = [expected] * len(codes) if isinstance(expected, ReturnCode) else expected
    if list(codes) != wanted or not bool(found.isfinite().all()):
        return math.inf
    return 0.0 if exact is None else relative_rms(found, exact).max().item()


def adaptive_error(problem: Problem, tolerance: float = 0.01) -> float:
    """Relative error of adaptive steps from four noises, of the worst sample."""
    noise = problem.noise(4)
    found, report = problem.run(noise, throw=False, tolerance=tolerance)
    return error(found, report.codes, exact=problem.solution(noise))


def within(problem: Problem, tolerance: float = 0.01) -> float:
    """A tolerance, and on Gaussian data the error of the step to sigma = 0 along the exact flow."""
    if not problem.is_gaussian:
        return tolerance
    noise = problem.noise(4)
    last = problem.schedule.sigma_min
    ends = [2 * last, last]
    levels = [(sigma, problem.denoise(x, sigma)) for sigma, x in zip(ends, problem.path(noise, ends), strict=True)]
    return tolerance + relative_rms(denoised_at_zero(levels), problem.solution(noise)).max().item()


def pipeline_cases(load: Callable[[torch.dtype], Any], kind: str) -> Iterator[Case]:
    """Extreme guidance and latents, and half precision in calls of a pipeline."""
    touch = example("brick")
    photo = example("wood", "image")
    of_kinds: dict[str, dict[str, Any]] = {
        "touch-to-image": {"touch": touch},
        "stylization": {"touch": touch, "image": photo},
        "x-to-touch": {"image": photo},
    }

    def call(dtype: torch.dtype = torch.float32, size: float = 1.0, **changed: Any) -> tuple[Tensor, list[ReturnCode]]:
        """Latents and codes of one call, from latents that are plus or minus a size everywhere."""
        pipe = load(dtype)
        pipe.set_progress_bar_config(disable=True)
        shape = (1, pipe.unet.config.out_channels, 8, 8)
        side = 8 * pipe.vae_scale_factor
        latents = size * torch.randn(shape, generator=torch.Generator().manual_seed(1)).sign()
        given = {"num_inference_steps": 2, "guidance_scale": 2.0, "latents": latents, "height": side, "width": side}
        given |= {"output_type": "latent", "throw": False, "generator": torch.Generator().manual_seed(0)}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UnfamiliarInputWarning)
            output = pipe(**given | of_kinds[kind] | changed)
        return output.images, output.report.codes

    def same(name: str, one: dict[str, Any], other: dict[str, Any], bound: Any, reason: str) -> Case:
        return Case(f"{kind}: {name}", lambda: error(*call(**one), exact=call(**other)[0]), bound, reason)

    def coded(name: str, code: ReturnCode, **changed: Any) -> Case:
        return Case(f"{kind}: {name}", lambda: error(*call(**changed), code))

    equal = 1e-4, "equal calls, some thousand roundings of float32 in another order"
    yield same("guidance_scale 0", {"guidance_scale": 0.0}, {"guidance_scale": 1.0}, *equal)
    yield same("latents of size 1e-40", {"size": 1e-40}, {"size": 0.0}, *equal)
    yield coded("guidance_scale 1e6", ReturnCode.DIVERGED, guidance_scale=1e6)
    yield coded("latents of size 1e3", ReturnCode.DIVERGED, size=1e3)
    yield coded("latents of size 3e38", ReturnCode.NON_FINITE, size=3e38)

    def roundings(dtype: torch.dtype) -> float:
        layers = sum(any(True for _ in each.parameters(recurse=False)) for each in load(torch.float32).unet.modules())
        return torch.finfo(dtype).eps / 2 * math.sqrt(8 * layers)

    eight: Any = {"num_inference_steps": 8}
    for dtype in (torch.float16, torch.bfloat16):
        bound = partial(roundings, dtype)
        yield same(str(dtype), {**eight, "dtype": dtype}, eight, bound, "independent roundings of its layers")
