"""The updates of UniPC with scalars as Python's floats.

diffusers computes the few numbers by which an update weighs its tensors out of tensors themselves, some eighty
operations a step; beside a small network that is a share of the run that one can feel.
"""

import math
from typing import Any

from torch import Tensor


def updates(h: float, ratio: float | None, corrector: bool) -> tuple[float, float]:
    """Weights of the differences of D in a step of UniPC-B2 in data prediction, relative to -alpha_t (e^-h - 1).

    See Zhao et al. (2023), Equations 9 and 10 with B(h) = e^-h - 1; as diffusers, with 1/2 in place of the solution
    where the order leaves one weight.

    Args:
        h: Step in lambda = log(alpha / sigma), > 0.
        ratio: r = (lambda of the evaluation before the last - lambda of the last) / h, negative; `None` for order 1.
        corrector: Whether D at the end of the step is known.

    Returns:
        Weights of D before minus the last D, and of D at the end minus the last D.
    """
    if not corrector:
        return (0.0 if ratio is None else 0.5 / ratio), 0.0
    if ratio is None:
        return 0.0, 0.5
    first = (math.expm1(-h) / -h - 1) / math.expm1(-h)  # of Equation 6: sums of weights times powers of r
    second = 2 * ((math.expm1(-h) / -h - 1) / -h - 0.5) / math.expm1(-h)
    end = (second - ratio * first) / (1 - ratio)
    return (first - end) / ratio, end


class FloatUpdates:
    """For `UniPCMultistepScheduler`: order 1 or 2, B2, in data prediction; all else is left to diffusers."""

    def multistep_uni_p_bh_update(
        self, model_output: Tensor, *args: Any, sample: Any = None, order: Any = None
    ) -> Tensor:
        """As diffusers'; (B, C, h, w)."""
        if args or not self._known(order):
            return super().multistep_uni_p_bh_update(model_output, *args, sample=sample, order=order)  # type: ignore[misc]
        return self._update(self.step_index, sample, order, None)  # type: ignore[attr-defined]

    def multistep_uni_c_bh_update(
        self, this_model_output: Tensor, *args: Any, last_sample: Any = None, this_sample: Any = None, order: Any = None
    ) -> Tensor:
        """As diffusers'; (B, C, h, w)."""
        if args or not self._known(order):
            named = {"last_sample": last_sample, "this_sample": this_sample, "order": order}
            return super().multistep_uni_c_bh_update(this_model_output, *args, **named)  # type: ignore[misc]
        return self._update(self.step_index - 1, last_sample, order, this_model_output)  # type: ignore[attr-defined]

    def _known(self, order: Any) -> bool:
        config = self.config  # type: ignore[attr-defined]
        plain = config.predict_x0 and config.solver_type == "bh2" and not config.use_flow_sigmas
        return plain and order in (1, 2) and self.solver_p is None  # type: ignore[attr-defined]

    def _update(self, step: int, sample: Tensor, order: int, end: Tensor | None) -> Tensor:
        """From the beginning of a step to its end, with D there if it is known."""
        sigma_before, sigma, sigma_end = (float(self.sigmas[place]) for place in (max(step - 1, 0), step, step + 1))  # type: ignore[attr-defined]
        alpha, alpha_end = (1 / math.sqrt(level**2 + 1) for level in (sigma, sigma_end))
        last = self.model_outputs[-1]  # type: ignore[attr-defined]
        if sigma_end == 0.0:  # h is infinite, and the order 1
            return alpha_end * last
        h = math.log(sigma / sigma_end)
        ratio = None if order == 1 else math.log(sigma / sigma_before) / h
        of_before, of_end = updates(h, ratio, end is not None)
        gain = -alpha_end * math.expm1(-h)
        state = (sigma_end * alpha_end) / (sigma * alpha) * sample + gain * (1 - of_before - of_end) * last
        if of_before:
            state = state + gain * of_before * self.model_outputs[-2]  # type: ignore[attr-defined]
        return state if end is None else state + gain * of_end * end
