"""Solvers by name: diffusers schedulers with the settings that let each reach its order and end without noise.

Karras spacing (Karras et al., 2022, Eq. 5) takes the uniform-in-time tail away that holds multistep solvers at first
order; networks are asked at the exact, continuous timestep of each noise level; the state is kept in float32 by the
loop, whatever the network's dtype; and the jump from the smallest noise level to none is of second order in it, but for
DDIM and Euler (see `diffusion.exponential.LastJump`).
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import diffusers
from diffusers.schedulers.scheduling_utils import SchedulerMixin

from unitouch_gen.errors import InvalidInputError, check_choice
from unitouch_gen.schedulers.continuous import (
    ContinuousDDIMScheduler,
    ContinuousDEISScheduler,
    ContinuousDPMSolverScheduler,
    ContinuousEulerScheduler,
    ContinuousHeunScheduler,
    ContinuousUniPCScheduler,
)
from unitouch_gen.schedulers.fitted import FITTED, FittedScheduler


@dataclass(frozen=True)
class Solver:
    """A scheduler class, its settings and its nominal order of convergence.

    Attributes:
        scheduler: The diffusers class, or one made of it.
        order: Nominal.
        settings: Laid over the configuration of the pipeline's own scheduler.
        zero_snr: Whether the class copes with a schedule whose last level is pure noise; the others ignore such a
            schedule or end in an index error.
    """

    scheduler: type[SchedulerMixin]
    order: int
    settings: dict[str, Any] = field(default_factory=dict)
    zero_snr: bool = False


KARRAS: dict[str, Any] = {"use_karras_sigmas": True, "timestep_spacing": "linspace"}
MULTISTEP: dict[str, Any] = {**KARRAS, "solver_order": 2, "final_sigmas_type": "zero", "thresholding": False}

SOLVERS: dict[str, Solver] = {
    # Song et al. (2021): "trailing" starts from pure noise, which "leading" does not.
    "ddim": Solver(
        ContinuousDDIMScheduler,
        1,
        {"timestep_spacing": "trailing", "clip_sample": False, "set_alpha_to_one": True},
        zero_snr=True,
    ),
    # Karras et al. (2022), Algorithm 1; Euler is its first half.
    "euler": Solver(ContinuousEulerScheduler, 1, KARRAS, zero_snr=True),
    "heun": Solver(ContinuousHeunScheduler, 2, KARRAS),
    # Lu et al. (2022), DPM-Solver++(2M).
    "dpm++2m": Solver(ContinuousDPMSolverScheduler, 2, {**MULTISTEP, "algorithm_type": "dpmsolver++"}),
    # Zhao et al. (2023); the corrector adds one order. B_1(h) divides by zero at the last step, B_2(h) does not.
    "unipc": Solver(ContinuousUniPCScheduler, 3, {**MULTISTEP, "solver_type": "bh2"}),
    # Zhang & Chen (2023); order 3 blows up at many steps, see `diffusion.defects`.
    "deis": Solver(
        ContinuousDEISScheduler, 2, {key: value for key, value in MULTISTEP.items() if key != "final_sigmas_type"}
    ),
}


def name_of(scheduler: SchedulerMixin) -> str | None:
    """What its class is called in `SOLVERS`, or `None` for others."""
    return next((name for name, solver in SOLVERS.items() if solver.scheduler is type(scheduler)), None)


def make_scheduler(
    own: SchedulerMixin,
    solver: str | None,
    *,
    steps: int | None = None,
    guidance_scale: float | None = None,
    whole: bool = True,
) -> SchedulerMixin:
    """A fresh scheduler for one call: the pipeline's own settings, or those of a solver by name.

    Args:
        own: The pipeline's scheduler; it is never changed, so calls may run side by side.
        solver: A name in `SOLVERS`, "fitted", or `None` for the pipeline's own. Steps that were fitted to a checkpoint
            give way to the solver it names otherwise where they do not suit a call that did not ask for them.
        steps, guidance_scale: Of the call.
        whole: Whether it goes all the way from noise, at one guidance, as steps were fitted to.

    Raises:
        InvalidInputError: If the name is unknown, the solver breaks on the pipeline's schedule, or nothing was fitted
            to such a call.
    """
    if isinstance(own, FittedScheduler) and solver in (None, FITTED):
        if whole and steps is not None and own.find(steps, guidance_scale) is not None:
            return FittedScheduler.from_config(own.config, guidance_scale=guidance_scale)
        if solver is None:
            solver = own.config.otherwise
    if solver is None:
        return type(own).from_config(own.config)
    if solver == FITTED:
        raise InvalidInputError(f"`solver` is {solver!r}, but {_why_not(own, steps, guidance_scale)}")
    chosen = SOLVERS[check_choice("solver", solver, [*SOLVERS, FITTED])]
    if own.config.get("rescale_betas_zero_snr"):
        able = ", ".join(repr(name) for name, other in SOLVERS.items() if other.zero_snr)
        if not chosen.zero_snr:
            raise InvalidInputError(
                f"`solver` is {solver!r}, which breaks on this pipeline's schedule of zero terminal SNR; use {able}."
            )
    # A configuration remembers which of its values were defaults; only what was set is carried over.
    return chosen.scheduler.from_config({**schedule_settings(own), **chosen.settings})


def schedule_settings(own: SchedulerMixin) -> dict[str, Any]:
    """Of a scheduler's configuration, what its network was trained on; the rest is the scheduler's own."""
    shared = ("num_train_timesteps", "beta_start", "beta_end", "beta_schedule", "trained_betas", "prediction_type",
              "rescale_betas_zero_snr", "steps_offset")  # fmt: skip
    return {key: own.config[key] for key in shared if key in own.config}


def _why_not(own: SchedulerMixin, steps: int | None, guidance_scale: float | None) -> str:
    """Why a call gets no fitted steps, and what to do."""
    if not isinstance(own, FittedScheduler) or not own.fits:
        return f"this checkpoint brings no fitted steps; take one of {sorted(SOLVERS)}."
    if own.find(steps or 0, guidance_scale) is not None:
        return (
            "steps were fitted from noise to the end at one guidance; leave `guidance_interval` and start images out."
        )
    known = ", ".join(own.known)
    return f"nothing was fitted to {steps} steps at guidance {guidance_scale}; there are {known}."


def read_scheduler(folder: Path) -> SchedulerMixin:
    """The scheduler of a checkpoint: steps fitted to it, a solver by name, or any of diffusers.

    Raises:
        InvalidInputError: If it is none of them.
    """
    kinds = {kind.__name__: kind for kind in (FittedScheduler, *(solver.scheduler for solver in SOLVERS.values()))}
    name = FittedScheduler.load_config(folder)["_class_name"]
    kind: Any = kinds.get(name, getattr(diffusers, name, None))
    if not issubclass(kind if isinstance(kind, type) else object, SchedulerMixin):
        raise InvalidInputError(f"`{folder}` names the scheduler {name!r}, which diffusers does not have.")
    return kind.from_pretrained(folder)
