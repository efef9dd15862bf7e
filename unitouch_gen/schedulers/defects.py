"""Ways in which diffusers' schedulers go wrong without a word, and a check that refuses them.

Solvers by name are set up so that none of these can happen; a pipeline's own scheduler may be configured into any of
them. Each was reproduced in diffusers 0.42 on data whose solution is known, and is again by the tests.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from diffusers import (
    DDIMScheduler,
    DEISMultistepScheduler,
    DPMSolverMultistepScheduler,
    PNDMScheduler,
    UniPCMultistepScheduler,
)
from torch import Tensor

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.schedulers.solvers import ContinuousDDIMScheduler

MULTISTEP = (DEISMultistepScheduler, DPMSolverMultistepScheduler, UniPCMultistepScheduler)

DEIS_LIMIT = 140
"""Steps from which order 3 gets worse with more of them."""


@dataclass(frozen=True)
class Defect:
    """Something that goes wrong with some schedulers.

    Attributes:
        occurs: Whether it does, of a scheduler with its timesteps set and their number.
        reason: What goes wrong, after "`num_inference_steps` is 50, with which X"; may name the `first` timestep and
            the number of `levels`.
        remedy: What to do.
    """

    occurs: Callable[[Any, int], bool]
    reason: str
    remedy: str


def check_scheduler(scheduler: Any, num_inference_steps: int) -> None:
    """Refuses a scheduler that would give no result, or a wrong one.

    Args:
        scheduler: Of diffusers, with its timesteps set.
        num_inference_steps: Their number, as asked for.

    Raises:
        InvalidInputError: With what would go wrong, and what to do.
    """
    for defect in DEFECTS.values():
        if defect.occurs(scheduler, num_inference_steps):
            reason = defect.reason.format(first=float(scheduler.timesteps.max()), levels=_levels(scheduler))
            raise InvalidInputError(
                f"`num_inference_steps` is {num_inference_steps}, with which {type(scheduler).__name__} {reason}; "
                f"{defect.remedy}."
            )


def is_undefined(scheduler: Any, steps: int) -> bool:
    """Noise levels that float32 cannot hold make timesteps that are no numbers."""
    return not all(
        bool(torch.as_tensor(values).isfinite().all())
        for values in (scheduler.timesteps, getattr(scheduler, "sigmas", 0.0))
    )


def has_other_levels(scheduler: Any, steps: int) -> bool:
    """`trained_betas` of another number than `num_train_timesteps` says: an index error, or a start half way."""
    return len(getattr(scheduler, "alphas_cumprod", range(_levels(scheduler)))) != _levels(scheduler)


def starts_beyond(scheduler: Any, steps: int) -> bool:
    """Leading spacing with an offset, as many steps as levels: an index error."""
    return float(scheduler.timesteps.max()) >= _levels(scheduler)


def starts_near_the_end(scheduler: Any, steps: int) -> bool:
    """One step of leading or linspace spacing is at the lowest level, where what comes out is the noise."""
    share = float(scheduler.timesteps.max()) / _levels(scheduler)
    return share < (0.9 if steps == 1 else 1 / 3)


def starts_too_low(scheduler: Any, steps: int) -> bool:
    """Leading spacing rounds its stride down, and the more steps there are the more is missing at the start.

    Of two that start at 951, one with a stride of 50 is as it has to be, and one with a stride of 19 is not. DDIM and
    PNDM have one stride less to miss, and are not held to the last few levels.
    """
    levels = _levels(scheduler)
    spare = 0.0 if isinstance(scheduler, MULTISTEP) else 0.1 * levels
    return float(scheduler.timesteps.max()) < levels * (1 - 1.5 / steps) - 1 - spare


def repeats_a_level(scheduler: Any, steps: int) -> bool:
    """A multistep formula through one level twice divides by zero."""
    if not isinstance(scheduler, MULTISTEP):
        return False
    sigmas = scheduler.sigmas[: len(scheduler.timesteps)]
    return bool((sigmas[1:] == sigmas[:-1]).any())


def misses_the_next_timestep(scheduler: Any, steps: int) -> bool:
    """DDIM and PNDM go back by T // N and take the result for what the next timestep wants."""
    if not isinstance(scheduler, DDIMScheduler | PNDMScheduler) or isinstance(scheduler, ContinuousDDIMScheduler):
        return False
    # PNDM repeats some timesteps, and puts others between.
    timesteps = torch.as_tensor(getattr(scheduler, "_timesteps", scheduler.timesteps)).cpu().unique()
    return bool((timesteps.diff() != _levels(scheduler) // steps).any())


def divides_by_no_noise(scheduler: Any, steps: int) -> bool:
    """B_1(h) = h, which is infinite for a last step to sigma = 0."""
    if not isinstance(scheduler, UniPCMultistepScheduler):
        return False
    return scheduler.config.solver_type == "bh1" and float(scheduler.sigmas[-1]) == 0.0


def blows_up(scheduler: Any, steps: int) -> bool:
    """DEIS of order 3 cancels ever more digits as its steps become shorter."""
    return isinstance(scheduler, DEISMultistepScheduler) and scheduler.config.solver_order > 2 and steps >= DEIS_LIMIT


def cannot_tell_data_from_noise(scheduler: Any, steps: int) -> bool:
    """x_0 = (z - s n) / alpha with alpha = 0."""
    if scheduler.config.get("prediction_type") != "epsilon" or not _zero_snr(scheduler):
        return False
    alphas: Tensor = scheduler.alphas_cumprod
    return float(alphas[int(scheduler.timesteps.max())]) == 0.0


def rounds_pure_noise(scheduler: Any, steps: int) -> bool:
    """Between pure noise and the level before it there are no whole timesteps for Karras' noise levels."""
    karras = isinstance(scheduler, MULTISTEP) and scheduler.config.get("use_karras_sigmas", False)
    return bool(karras and _zero_snr(scheduler))


def _levels(scheduler: Any) -> int:
    return scheduler.config.num_train_timesteps


def _zero_snr(scheduler: Any) -> bool:
    return bool(scheduler.config.get("rescale_betas_zero_snr", False))


DEFECTS: dict[str, Defect] = {
    "is undefined": Defect(
        is_undefined, "has timesteps that are not finite", "take a schedule whose noise levels float32 can hold"
    ),
    "has other levels": Defect(
        has_other_levels,
        "says that it has {levels} noise levels, and has another number of them",
        "set `num_train_timesteps` to that of `trained_betas`",
    ),
    "starts beyond the schedule": Defect(
        starts_beyond, "starts beyond the last of its {levels} noise levels", "take fewer steps, or pass a `solver`"
    ),
    "starts near the end": Defect(
        starts_near_the_end,
        "starts at noise level {first:.0f} of {levels}, too low for pure noise",
        "take more steps, or pass `solver='dpm++2m'`",
    ),
    "starts too low": Defect(
        starts_too_low,
        "starts at noise level {first:.0f} of {levels}, though its input is pure noise",
        "set `timestep_spacing='trailing'`, take fewer steps, or pass a `solver` such as 'dpm++2m' or 'unipc'",
    ),
    "repeats a level": Defect(
        repeats_a_level,
        "has one noise level twice, and divides by the nothing between",
        "take fewer steps, or pass a `solver` such as 'dpm++2m' or 'unipc'",
    ),
    "misses the next timestep": Defect(
        misses_the_next_timestep,
        "steps back by whole {levels} // steps and misses its next timestep",
        "pass `solver='ddim'`, or take `timestep_spacing='leading'`, or 'trailing' with steps that {levels} is a "
        "multiple of",
    ),
    "divides by no noise": Defect(
        divides_by_no_noise,
        "and `solver_type='bh1'` divides by zero where the noise ends",
        "set `solver_type='bh2'`, or pass `solver='unipc'`",
    ),
    "is unstable": Defect(
        blows_up, "of order 3 is unstable", f"take fewer than {DEIS_LIMIT} steps, or pass `solver='deis'`"
    ),
    "cannot tell data from noise": Defect(
        cannot_tell_data_from_noise,
        "starts where there is nothing but noise, of which `prediction_type='epsilon'` tells nothing about the picture",
        "pass `solver='euler'` or `tolerance`, set `timestep_spacing='leading'`, or use a network that predicts v",
    ),
    "rounds pure noise": Defect(
        rounds_pure_noise,
        "has `use_karras_sigmas` on a schedule of zero terminal SNR, whose last levels lie between no whole timesteps",
        "pass `solver='ddim'` or 'euler'",
    ),
}
"""By what the scheduler does, in the order of the check."""
