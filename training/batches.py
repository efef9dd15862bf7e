"""Batches: columns of samples, the sample indices of each step (Eq. 4 of the paper), augmentations."""

import math
from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from pydantic import PositiveInt
from torch import Tensor

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.training.recipe import Settings, Share

Batch = dict[str, Tensor]


class ArrayDataset:
    """Columns of samples: tensors, arrays, or sequences of arrays. A sequence is read as its concatenation.

    `dataset[indices]` is a batch: a copy of these rows of every column.
    """

    def __init__(self, **columns: np.ndarray | Tensor | Sequence[np.ndarray]):
        self.columns = columns

    def __len__(self) -> int:
        values = next(iter(self.columns.values()))
        if isinstance(values, np.ndarray | Tensor):
            return len(values)
        return sum(map(len, values))

    def __getitem__(self, indices: Sequence[int]) -> Batch:
        return {name: _rows(values, np.asarray(indices)) for name, values in self.columns.items()}


def _rows(values: np.ndarray | Tensor | Sequence[np.ndarray], index: np.ndarray) -> Tensor:
    if isinstance(values, Tensor):
        return values[torch.from_numpy(index)]
    parts = [values] if isinstance(values, np.ndarray) else values
    starts = np.cumsum([0, *map(len, parts)])
    part_of = np.searchsorted(starts, index, side="right") - 1
    rows = np.empty((len(index), *parts[0].shape[1:]), parts[0].dtype)
    for part in np.unique(part_of):
        inside = part_of == part
        rows[inside] = parts[part][index[inside] - starts[part]]
    return torch.from_numpy(rows)


# Indices of a step: a function of its number --------------------------------------------------------------------------


class SamplerSettings(Settings):
    """How `in_batch_indices` draws a batch of B."""

    # Share from one data set (paper: 0.75). At 0 the whole batch is from the others, as the paper's formula says. With
    # null the batch is uniform over the union.
    sigma: Share | None = None
    group: PositiveInt = 1  # similar examples of that data set that are drawn together, as hard negatives


def in_batch_indices(
    step: int,
    sizes: Sequence[int],
    batch_size: int,
    settings: SamplerSettings,
    seed: int = 0,
    near: np.ndarray | None = None,
) -> list[int]:
    """round(sigma B) examples of one data set, the rest from all the others (Eq. 4 of the paper).

    The data set is chosen with probability proportional to its size. Indices are into the concatenation of the data
    sets, whose `sizes` are passed. A group is an example and some of its nearest neighbours, by vectors `near` (N, D)
    of all examples.
    """
    rng = np.random.default_rng((seed, step))
    total = int(sum(sizes))
    count = share_of(settings.sigma, batch_size, len(sizes))
    if count is None:
        return _draw(rng, total, batch_size).tolist()
    chosen = int(rng.choice(len(sizes), p=np.asarray(sizes) / total))
    start = int(sum(sizes[:chosen]))
    size = int(sizes[chosen])
    grouped = settings.group > 1 and size > 4 * settings.group
    if near is None or not grouped:
        inside = _draw(rng, size, count)
    else:
        inside = _draw_groups(rng, near[start : start + size], count, settings.group)
    outside = _draw(rng, total - size, batch_size - count)
    outside = np.where(outside >= start, outside + size, outside)  # skip the chosen data set
    return np.concatenate([start + inside, outside]).tolist()


def share_of(sigma: float | None, batch_size: int, count: int) -> int | None:
    """How many of a batch are from one of `count` data sets; `None` if the batch is uniform over all."""
    if sigma is None:
        return None
    share = round(sigma * batch_size)
    if share < batch_size and count < 2:
        raise InvalidInputError(f"`sampler.sigma` is {sigma}, with no other data set to draw from; set it to 1.")
    return share


def shuffled_indices(step: int, size: int, batch_size: int, seed: int = 0) -> list[int]:
    """A uniform batch, without replacement within an epoch."""
    if size < batch_size:
        raise InvalidInputError(f"`batch_size` is {batch_size}, but there are {size} samples; take a smaller one.")
    epoch, place = divmod(step, size // batch_size)
    order = np.random.default_rng((seed, epoch)).permutation(size)
    return order[place * batch_size : (place + 1) * batch_size].tolist()


def two_part_indices(step: int, in_first: np.ndarray, share: float, batch_size: int, seed: int = 0) -> list[int]:
    """round(share B) of the samples where `in_first` (N,) is true, the rest from the others.

    If one of the two parts is empty, the whole batch is from the other.
    """
    rng = np.random.default_rng((seed, step))
    first = np.flatnonzero(in_first)
    second = np.flatnonzero(~in_first)
    count = round(share * batch_size)
    if len(first) == 0 or len(second) == 0:
        count = batch_size if len(first) else 0
    chosen = [first[_draw(rng, len(first), count)], second[_draw(rng, len(second), batch_size - count)]]
    return np.concatenate(chosen).tolist()


def _draw(rng: np.random.Generator, size: int, count: int) -> np.ndarray:
    """`count` of `size` indices, without repetition where that is possible."""
    if count == 0:
        return np.zeros(0, dtype=np.int64)
    return rng.choice(size, count, replace=count > size)


def _draw_groups(rng: np.random.Generator, near: np.ndarray, count: int, group: int) -> np.ndarray:
    """`count` rows of `near` (N, D), in groups of a row and some of the 4 `group` rows that are nearest to it."""
    seeds = _draw(rng, len(near), math.ceil(count / group))
    similarity = near[seeds] @ near.T
    neighbours = np.argsort(-similarity, axis=1)[:, 1 : 4 * group]  # the first is the row itself
    others = [rng.choice(row, group - 1, replace=False) for row in neighbours]
    return np.concatenate([seeds[:, None], others], axis=1).reshape(-1)[:count]


# Augmentations of raw pixels (B, 3, S, S) in [0, 1], drawn for each sample --------------------------------------------


def shift_pixels(images: Tensor, reach: int) -> Tensor:
    """Moves each image by up to `reach` pixels along both axes; the border is repeated."""
    padded = F.pad(images, (reach,) * 4, mode="replicate")
    corner = torch.randint(0, 2 * reach + 1, (len(images), 2), device=images.device)
    rows, columns = (corner[..., None] + torch.arange(images.shape[-1], device=images.device)).unbind(1)  # (B, S)
    batch = torch.arange(len(images), device=images.device)[:, None, None]
    return padded[batch, :, rows[:, :, None], columns[:, None, :]].permute(0, 3, 1, 2)


def jitter_colours(images: Tensor, gain: float, offset: float) -> Tensor:
    """Scales each channel by 1 +- gain and shifts it by +- offset (uniform)."""
    scale = 2 * torch.rand(len(images), 3, 1, 1, device=images.device) - 1
    shift = 2 * torch.rand(len(images), 3, 1, 1, device=images.device) - 1
    return (images * (1.0 + gain * scale) + offset * shift).clamp(0.0, 1.0)


def permute_channels(images: Tensor, probability: float) -> Tensor:
    """Permutes the channels of some images, as lights of other colours would."""
    chosen = torch.rand(len(images), device=images.device) < probability
    order = torch.rand(len(images), 3, device=images.device).argsort(dim=1)
    order = torch.where(chosen[:, None], order, torch.arange(3, device=images.device))
    return images.gather(1, order[:, :, None, None].expand_as(images))


def blur_some(images: Tensor, probability: float) -> Tensor:
    """Blurs some images by a 3 x 3 binomial kernel, as a softer gel would."""
    kernel = torch.tensor([1.0, 2.0, 1.0], device=images.device)
    kernel = (kernel[:, None] * kernel[None, :] / 16).expand(3, 1, 3, 3)
    soft = F.conv2d(F.pad(images, (1, 1, 1, 1), mode="replicate"), kernel, groups=3)
    chosen = torch.rand(len(images), 1, 1, 1, device=images.device) < probability
    return torch.where(chosen, soft, images)


def add_noise(images: Tensor, deviation: float) -> Tensor:
    """Adds Gaussian noise of up to `deviation`, at one level for each image."""
    level = deviation * torch.rand(len(images), 1, 1, 1, device=images.device)
    return (images + level * torch.randn_like(images)).clamp(0.0, 1.0)


def in_deviations(values: np.ndarray, axes: int | tuple[int, ...] = 0) -> np.ndarray:
    """z-scores over `axes`, clipped to +- 5; float32."""
    mean = values.mean(axis=axes, dtype=np.float64, keepdims=True)
    deviation = values.std(axis=axes, dtype=np.float64, keepdims=True)
    return ((values - mean) / deviation.clip(1e-3)).clip(-5.0, 5.0).astype(np.float32)
