"""The checks that cases of the world's stiff set are made of."""

import torch
from torch import Tensor

from unitouch_gen.numerics.stability import Seen


def at_most(value: Tensor | float, bound: float) -> Seen:
    """Whether a figure, which is not NaN, stays at or below its bound."""
    number = float(value)
    return Seen(number <= bound, f"{number:.2g}, bound {bound:.2g}", number)


def apart(left: Tensor, right: Tensor, bound: float = 0.0) -> Seen:
    """Whether two results differ nowhere by more than `bound`."""
    return at_most((left - right).abs().max(), bound)


def rising(values: Tensor) -> Seen:
    """Whether values along the first dimension never fall, by their least step."""
    least = float(values.diff(dim=0).min())
    return Seen(least >= 0.0, f"least step {least:.2g}", least)


def in_range(images: Tensor, low: float = 0.0, high: float = 1.0) -> Seen:
    """Whether all values are finite and within [low, high], by how far the worst is out."""
    least, most = (float(value) for value in torch.aminmax(images))
    out = max(low - least, most - high, 0.0)
    return Seen(low <= least and most <= high, f"from {least:.2g} to {most:.2g}", out)
