"""What a figure has to be read beside: class means, other samples, and what real images get."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor


@dataclass(frozen=True)
class Controlled:
    """A figure with its controls; `None` where one says nothing.

    Attributes:
        value: What was measured.
        class_mean: The same where all that is known of a sample is its class.
        shuffled: The same with what was made of another sample.
        ceiling: The same of what is real.
    """

    value: float
    class_mean: float | None = None
    shuffled: float | None = None
    ceiling: float | None = None


def class_means(values: Tensor, labels: Tensor, asked: Tensor | None = None) -> Tensor:
    """The mean of each sample's class in place of its own values.

    Args:
        values: (N, ...).
        labels: Classes of these, int64 (N,).
        asked: Classes to give means of, (M,), where they are of other samples: a mean that holds a sample itself agrees
            with it, the more so the fewer there are.
    """
    member = F.one_hot(labels, int(labels.max() if asked is None else max(labels.max(), asked.max())) + 1).to(values)
    means = (member / member.sum(dim=0).clamp_min(1.0)).T @ values.flatten(1)
    return means[labels if asked is None else asked].view(-1, *values.shape[1:])


def others(count: int, seed: int = 0) -> Tensor:
    """For each of `count` rows another one, each once, int64 (count,)."""
    order = torch.randperm(count, generator=torch.Generator().manual_seed(seed))
    return torch.empty_like(order).scatter_(0, order, order.roll(1))
