"""Steps fitted to a checkpoint: where to evaluate its network, and how to weigh what it said before.

Named solvers take D between two evaluations for a polynomial. What a given network does is known better than that: from
exact paths of some conditions, each step's weights follow by least squares, one step after the other, each from the
states that the steps before it lead to, so that it makes up for their errors as far as it can. That takes one run of
the network for each number of steps, and no gradients. (Solvers fitted end to end, to a given number of evaluations,
are in Shaul et al., 2024, "Bespoke Non-Stationary Solvers".)
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from unitouch_gen.numerics.flow import Flow
from unitouch_gen.numerics.reference import relative_rms
from unitouch_gen.schedulers.exponential import FinalExtrapolation, advance, exponential_integral
from unitouch_gen.schedulers.fitted import Fit, combined

PATH_EVALUATIONS = 250
"""Of an exact path; its own error is some thousandths on the built-in networks, far below that of what is fitted."""

SPACINGS = (3.0, 4.0, 5.0)
"""rho of the noise levels that are tried (Karras et al., 2022, Equation 5)."""

LAST_LEVEL = 2.0
"""Of the noise levels, in units of the schedule's smallest: the last step, to none, is fitted as well."""

RIDGE = 1e-3
"""Of the mean square of each of D's differences: keeps weights small that the data says nothing of. Differences between
near levels are small, and weigh as much as others where steps are many."""

ROUNDS = 4
"""Of weighing samples by their errors, after which the weights no longer change."""

FLOOR = 1e-6
"""Of squared errors, relative to the result: nearer samples weigh alike."""


@dataclass(frozen=True, eq=False)
class Path:
    """An exact path of a batch.

    Attributes:
        levels: log sigma, falling, (K,).
        states: x at each, (K, B, C, h, w), float32.
        end: x at sigma = 0, float64 (B, C, h, w).
        noise: It starts from, (B, C, h, w).
    """

    levels: Tensor
    states: Tensor
    end: Tensor
    noise: Tensor

    def at(self, sigma: float) -> Tensor:
        """x at a noise level, float64 (B, C, h, w), linear in log sigma between two known ones."""
        level = math.log(sigma)
        place = int(torch.searchsorted(-self.levels, -level)) - 1
        place = min(max(place, 0), len(self.levels) - 2)
        high, low = self.levels[place : place + 2].tolist()
        return torch.lerp(self.states[place].double(), self.states[place + 1].double(), (level - high) / (low - high))


def exact_path(flow: Flow, noise: Tensor, evaluations: int = PATH_EVALUATIONS) -> Path:
    """Follows a flow closely, from noise to sigma = 0.

    The formulas are those of `diffusion.adaptive`: order three after a prediction of order two.

    Args:
        flow: Of a network with its conditions, or exact.
        noise: Unit-variance, (B, C, h, w).
        evaluations: At levels of Karras spacing.
    """
    sigmas = [flow.schedule.karras(number / (evaluations - 1)) for number in range(evaluations)]
    levels = [-math.log(sigma) for sigma in sigmas]
    state, jump = flow.start(noise), FinalExtrapolation()
    values, states = [flow.denoise(state, sigmas[0])], [state.float()]
    for number in range(1, evaluations):
        step = levels[number] - levels[number - 1]
        nodes = [levels[number - 1 - back] - levels[number - 1] for back in range(len(values))]
        predicted = advance(state, step, exponential_integral(step, nodes, values))
        value = flow.denoise(predicted, sigmas[number])
        state = advance(state, step, exponential_integral(step, [step, *nodes], [value, *values]))
        values = [value, *values[:1]]
        states.append(state.float())
        jump.add(sigmas[number], value)
    return Path(-torch.tensor(levels, dtype=torch.float64), torch.stack(states), jump.result(), noise)


def fit_steps(flow: Flow, path: Path, guidance_scale: float, steps: int) -> tuple[Fit, float]:
    """The best fit of a number of steps, over spacings.

    Args:
        flow: Of a network with the conditions to fit on.
        path: Of it.
        guidance_scale: Of it.
        steps: At least one.

    Returns:
        The fit, and the geometric mean of the relative RMS errors that it leaves on the path's samples.
    """
    fits = [fit_weights(flow, path, guidance_scale, noise_levels(flow, steps, rho)) for rho in SPACINGS]
    return min(fits, key=lambda found: found[1])


def noise_levels(flow: Flow, steps: int, rho: float) -> list[float]:
    """Noise levels of a number of evaluations, falling."""
    last = LAST_LEVEL * flow.schedule.sigma_min
    return [flow.schedule.karras(number / max(steps - 1, 1), rho, last) for number in range(steps)]


def fit_weights(flow: Flow, path: Path, guidance_scale: float, sigmas: Sequence[float]) -> tuple[Fit, float]:
    """Weights for given noise levels, falling; see `fit_steps`."""
    state, values, rows = flow.start(path.noise), [], []
    for number, sigma in enumerate(sigmas):
        values.append(flow.denoise(state, sigma))
        last = number + 1 == len(sigmas)
        target, kept = (path.end, 0.0) if last else (path.at(sigmas[number + 1]), sigmas[number + 1] / sigma)
        rows.append(_row((target - kept * state) / (1 - kept), values, path.end))
        state = kept * state + (1 - kept) * combined(values, rows[-1])
    fit = Fit(guidance_scale, tuple(sigmas), tuple(map(tuple, rows)))
    return fit, relative_rms(state, path.end).log().mean().exp().item()


def _row(mean: Tensor, values: Sequence[Tensor], end: Tensor) -> list[float]:
    """Weights of earlier values of D, such that D and its differences to them come close to its mean over the step.

    Samples are weighed by one over their squared error, as it is relative errors and their median that count, and some
    paths bend more than others by far.
    """
    *earlier, now = values
    if not earlier:
        return []
    differences = torch.stack([(value - now).flatten(1) for value in earlier], dim=-1)  # (B, n, number)
    wanted = (mean - now).flatten(1)[..., None]
    products, sides = differences.mT @ differences, differences.mT @ wanted
    size = end.flatten(1).square().sum(dim=1)
    trust, weights = 1 / size, torch.zeros(0)
    for _ in range(ROUNDS):
        matrix, side = (trust[:, None, None] * products).sum(0), (trust[:, None, None] * sides).sum(0)
        ridge = RIDGE * matrix.diagonal().diag()
        weights = torch.linalg.solve(matrix + ridge, side)
        left = (wanted - differences @ weights).flatten(1).square().sum(dim=1)
        trust = 1 / (left + FLOOR * size)
    return [float(f"{weight:.6g}") for weight in weights[:, 0].tolist()]
