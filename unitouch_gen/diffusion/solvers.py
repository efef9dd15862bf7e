"""Solvers by name: diffusers schedulers with the settings that let each reach its order and end without noise.

Karras spacing (Karras et al., 2022, Eq. 5) takes the uniform-in-time tail away that holds multistep solvers at first
order; networks are asked at the exact, continuous timestep of each noise level; the state is kept in float32 by the
loop, whatever the network's dtype; and the jump from the smallest noise level to none is of second order in it, but for
DDIM and Euler (see `diffusion.exponential.LastJump`).
"""

from dataclasses import dataclass, field
from typing import Any

from diffusers.schedulers.scheduling_utils import SchedulerMixin

from unitouch_gen.diffusion.continuous import (
    ContinuousDDIMScheduler,
    ContinuousDEISScheduler,
    ContinuousDPMSolverScheduler,
    ContinuousEulerScheduler,
    ContinuousHeunScheduler,
    ContinuousUniPCScheduler,
)
from unitouch_gen.errors import InvalidInputError, check_choice


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


def make_scheduler(own: SchedulerMixin, solver: str | None) -> SchedulerMixin:
    """A fresh scheduler for one call: the pipeline's own settings, or those of a solver by name.

    Args:
        own: The pipeline's scheduler; it is never changed, so calls may run side by side.
        solver: A name in `SOLVERS`, or `None` for the pipeline's own.

    Raises:
        InvalidInputError: If the name is unknown, or the solver breaks on the pipeline's schedule.
    """
    if solver is None:
        return type(own).from_config(own.config)
    chosen = SOLVERS[check_choice("solver", solver, SOLVERS)]
    if own.config.get("rescale_betas_zero_snr"):
        able = ", ".join(repr(name) for name, other in SOLVERS.items() if other.zero_snr)
        if not chosen.zero_snr:
            raise InvalidInputError(
                f"`solver` is {solver!r}, which breaks on this pipeline's schedule of zero terminal SNR; use {able}."
            )
    # A configuration remembers which of its values were defaults; only what was set is carried over.
    shared = ("num_train_timesteps", "beta_start", "beta_end", "beta_schedule", "trained_betas", "prediction_type",
              "rescale_betas_zero_snr", "steps_offset")  # fmt: skip
    carried = {key: own.config[key] for key in shared if key in own.config}
    return chosen.scheduler.from_config({**carried, **chosen.settings})
