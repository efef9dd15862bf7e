"""Solvers by name: diffusers schedulers with the settings that let each reach its order and end without noise.

Karras spacing (Karras et al., 2022, Eq. 5) takes the uniform-in-time tail away that holds multistep solvers at first
order; the state is kept in float32 by the loop, whatever the network's dtype.
"""

from dataclasses import dataclass, field
from typing import Any

from diffusers import (
    DDIMScheduler,
    DEISMultistepScheduler,
    DPMSolverMultistepScheduler,
    EulerDiscreteScheduler,
    HeunDiscreteScheduler,
    UniPCMultistepScheduler,
)
from diffusers.schedulers.scheduling_utils import SchedulerMixin
from torch import Tensor

from unitouch_gen.errors import InvalidInputError, check_choice


@dataclass(frozen=True)
class Solver:
    """A scheduler class, its settings and its nominal order of convergence.

    Attributes:
        scheduler: The diffusers class.
        order: Nominal.
        settings: Laid over the configuration of the pipeline's own scheduler.
        zero_snr: Whether the class copes with a schedule whose last level is pure noise; the others ignore such a
            schedule or end in an index error.
    """

    scheduler: type[SchedulerMixin]
    order: int
    settings: dict[str, Any] = field(default_factory=dict)
    zero_snr: bool = False


class DEISToZeroScheduler(DEISMultistepScheduler):
    """DEIS that ends without noise.

    diffusers' own spends its last evaluation on a step from the smallest sigma to itself, so noise of that size stays
    in the picture. Here that step is the first-order one to sigma = 0, as `final_sigmas_type="zero"` makes elsewhere.
    """

    def set_timesteps(self, num_inference_steps: int, *args: Any, **kwargs: Any) -> None:
        """As DEIS's; the last of `sigmas` (steps + 1,) is 0."""
        super().set_timesteps(num_inference_steps, *args, **kwargs)
        self.sigmas[-1] = 0.0

    def deis_first_order_update(self, model_output: Tensor, *args: Any, sample: Tensor, **kwargs: Any) -> Tensor:
        """x_t = (alpha_t / alpha_s) (x - sigma_s n) + sigma_t n, which is DDIM and holds for sigma_t = 0, too."""
        alpha_t, sigma_t = self._sigma_to_alpha_sigma_t(self.sigmas[self.step_index + 1])
        alpha_s, sigma_s = self._sigma_to_alpha_sigma_t(self.sigmas[self.step_index])
        return alpha_t / alpha_s * (sample - sigma_s * model_output) + sigma_t * model_output

    def multistep_deis_second_order_update(
        self, model_output_list: list[Tensor], *args: Any, sample: Tensor, **kwargs: Any
    ) -> Tensor:
        """As DEIS's, but of first order to sigma = 0, where polynomials in log sigma have no value."""
        if self.sigmas[self.step_index + 1] == 0.0:
            return self.deis_first_order_update(model_output_list[-1], sample=sample)
        return super().multistep_deis_second_order_update(model_output_list, *args, sample=sample, **kwargs)


SOLVERS: dict[str, Solver] = {
    # Song et al. (2021): "trailing" starts from pure noise, which "leading" does not.
    "ddim": Solver(
        DDIMScheduler,
        1,
        {"timestep_spacing": "trailing", "clip_sample": False, "set_alpha_to_one": True},
        zero_snr=True,
    ),
    # Karras et al. (2022), Algorithm 2 without churn; Euler is its first half.
    "euler": Solver(
        EulerDiscreteScheduler, 1, {"use_karras_sigmas": True, "timestep_spacing": "linspace"}, zero_snr=True
    ),
    "heun": Solver(HeunDiscreteScheduler, 2, {"use_karras_sigmas": True, "timestep_spacing": "linspace"}),
    # Lu et al. (2022), DPM-Solver++(2M).
    "dpm++2m": Solver(
        DPMSolverMultistepScheduler,
        2,
        {
            "algorithm_type": "dpmsolver++",
            "solver_order": 2,
            "use_karras_sigmas": True,
            "timestep_spacing": "linspace",
            "final_sigmas_type": "zero",
            "thresholding": False,
        },
    ),
    # Zhao et al. (2023); B_1(h) divides by zero at the last step, B_2(h) does not.
    "unipc": Solver(
        UniPCMultistepScheduler,
        2,
        {
            "solver_type": "bh2",
            "solver_order": 2,
            "use_karras_sigmas": True,
            "timestep_spacing": "linspace",
            "final_sigmas_type": "zero",
            "thresholding": False,
        },
    ),
    # Zhang & Chen (2023); order 3 blows up from 160 steps on.
    "deis": Solver(
        DEISToZeroScheduler,
        2,
        {"solver_order": 2, "use_karras_sigmas": True, "timestep_spacing": "linspace", "thresholding": False},
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
    if own.config.get("rescale_betas_zero_snr") and not chosen.zero_snr:
        able = ", ".join(repr(name) for name, other in SOLVERS.items() if other.zero_snr)
        raise InvalidInputError(
            f"`solver` is {solver!r}, which breaks on this pipeline's schedule of zero terminal SNR; use {able}."
        )
    # A configuration remembers which of its values were defaults; only what was set is carried over.
    shared = ("num_train_timesteps", "beta_start", "beta_end", "beta_schedule", "trained_betas", "prediction_type",
              "rescale_betas_zero_snr", "steps_offset")  # fmt: skip
    carried = {key: own.config[key] for key in shared if key in own.config}
    return chosen.scheduler.from_config({**carried, **chosen.settings})
