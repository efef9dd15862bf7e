"""Controls of figures: class means, other samples, plain statistics, an untrained encoder."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from unitouch_gen.models import UniTouchModel

Figures = dict[str, float]  # measured values by name


def with_controls(measure: Callable[[Tensor], Figures], columns: Mapping[str, Tensor]) -> dict[str, Figures]:
    """Figures of samples and of their controls, by figure, then by column.

    Args:
        measure: Returns figures of N samples.
        columns: Samples (N, ...): "value" is measured, "class_mean" is a control that knows the class only, "ceiling"
            is real. "shuffled", the value of another sample for each, is added.
    """
    value = columns["value"]
    columns = {**columns, "shuffled": value[others(len(value))]}
    by_column = {name: measure(samples) for name, samples in columns.items()}
    by_figure: dict[str, Figures] = {}
    for figure in by_column["value"]:
        by_figure[figure] = {name: figures[figure] for name, figures in by_column.items()}
    return by_figure


def others(count: int) -> Tensor:
    """For each of `count` rows another row, all different, int64 (count,)."""
    order = torch.randperm(count, generator=torch.Generator().manual_seed(0))
    return torch.empty_like(order).scatter_(0, order, order.roll(1))


def class_means(values: Tensor, labels: Tensor, asked: Tensor | None = None) -> Tensor:
    """The mean of each sample's class, of values (N, ...) with labels from 0, int64 (N,).

    With `asked`, classes (M,) of other samples, their means are returned, since a mean that contains a sample agrees
    with it.
    """
    asked = labels if asked is None else asked
    classes = int(max(labels.max(), asked.max())) + 1
    members = F.one_hot(labels, classes).to(values)  # (N, classes)
    means = (members / members.sum(dim=0).clamp_min(1.0)).T @ values.flatten(1)
    return means[asked].view(-1, *values.shape[1:])


def statistics(differences: Sequence[np.ndarray]) -> np.ndarray:
    """Plain statistics of N differences of touches from the gel at rest: of gradients, of bands, and of colours.

    Differences are (H, W, 3), in units of 1/255; statistics are float64 (N, 22).
    """
    rows = []
    for difference in differences:
        grey = difference.mean(axis=2)
        gradient = np.hypot(*np.gradient(grey))
        row = [gradient.mean(), gradient.std(), np.abs(difference).mean(), difference.std()]
        row += np.percentile(gradient, [50, 75, 90, 99]).tolist()
        for side in (2, 4, 8, 16):
            height = grey.shape[0] // side
            width = grey.shape[1] // side
            blocks = grey[: height * side, : width * side].reshape(height, side, width, side).mean(axis=(1, 3))
            row += [blocks.std(), np.abs(np.diff(blocks, axis=0)).mean()]
        colours = difference.reshape(-1, 3)
        rows.append([*row, *colours.mean(axis=0), *colours.std(axis=0)])
    return np.array(rows, dtype=np.float64)


def untrained_like(model: UniTouchModel, seed: int = 0) -> UniTouchModel:
    """A model with the same sensors and an untrained touch encoder of the same sizes."""
    _, bank = model.load("touch")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        fresh = UniTouchModel(model.config, modalities=("touch",)).eval()  # type: ignore[arg-type]
    _, fresh_bank = fresh.load("touch")
    fresh_bank.load_state_dict(bank.state_dict())
    return fresh.to(model.device)  # type: ignore[arg-type]
