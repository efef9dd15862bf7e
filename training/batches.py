"""How batches are put together: columns of samples, the indices of each step (Eq. 4 of the paper), augmentations."""

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
    """Columns of samples: tensors, arrays, or sequences of arrays, which are read as their concatenation.

    `dataset[indices]` is a batch: a copy of these rows of every column.
    """

    def __init__(self, **columns: np.ndarray | Tensor | Sequence[np.ndarray]):
        self.columns = columns

    def __len__(self) -> int:
        values = next(iter(self.columns.values()))
        return len(values) if isinstance(values, np.ndarray | Tensor) else sum(map(len, values))

    def __getitem__(self, indices: Sequence[int]) -> Batch:
        return {name: _rows(values, np.asarray(indices)) for name, values in self.columns.items()}


def _rows(values: np.ndarray | Tensor | Sequence[np.ndarray], index: np.ndarray) -> Tensor:
    if isinstance(values, Tensor):
        return values[torch.from_numpy(index)]
    parts = [values] if isinstance(values, np.ndarray) else values
    starts = np.cumsum([0, *map(len, parts)])
    which = np.searchsorted(starts, index, side="right") - 1
    rows = np.empty((len(index), *parts[0].shape[1:]), parts[0].dtype)
    for part in np.unique(which):
        rows[which == part] = parts[part][index[which == part] - starts[part]]
    return torch.from_numpy(rows)


# Indices of a step, which follow from its number ----------------------------------------------------------------------


class SamplerSettings(Settings):
    """How `in_batch_indices` draws a batch of B."""

    # Share from one data set (paper: 0.75). At 0 the whole batch is from the others, as the paper's formula says; null
    # chooses none: the batch is uniform over the union.
    sigma: Share | None = None
    group: PositiveInt = 1  # examples of the chosen one that are alike, the negatives that are hardest to tell apart


def in_batch_indices(
    step: int,
    sizes: Sequence[int],
    batch_size: int,
    settings: SamplerSettings,
    seed: int = 0,
    near: np.ndarray | None = None,
) -> list[int]:
    """round(sigma B) examples of one data set, chosen with probability by size; the rest from all the others (Eq. 4).

    Indices are into the concatenation of the data sets, of some `sizes`. Groups are of an example and others of those
    nearest to it, by vectors `near` (N, D) of all examples.
    """
    rng = np.random.default_rng((seed, step))
    total = int(sum(sizes))
    count = share_of(settings.sigma, batch_size, len(sizes))
    if count is None:
        return _draw(rng, total, batch_size).tolist()
    chosen = int(rng.choice(len(sizes), p=np.asarray(sizes) / total))
    start = int(sum(sizes[:chosen]))
    size = int(sizes[chosen])
    if near is None or settings.group == 1 or size <= 4 * settings.group:
        inside = _draw(rng, size, count)
    else:
        inside = _draw_groups(rng, near[start : start + size], count, settings.group)
    outside = _draw(rng, total - size, batch_size - count)
    outside = np.where(outside >= start, outside + size, outside)  # skips over the chosen one
    return np.concatenate([start + inside, outside]).tolist()


def share_of(sigma: float | None, batch_size: int, count: int) -> int | None:
    """How many of a batch are from the chosen one of `count` data sets; `None` where none is chosen."""
    share = None if sigma is None else round(sigma * batch_size)
    if share is not None and share < batch_size and count < 2:
        raise InvalidInputError(f"`sampler.sigma` is {sigma}, with no other data set to draw from; set it to 1.")
    return share


def shuffled_indices(step: int, size: int, batch_size: int, seed: int = 0) -> list[int]:
    """A uniform batch, without replacement within an epoch."""
    if size < batch_size:
        raise InvalidInputError(f"`batch_size` is {batch_size}, but there are {size} samples; take a smaller one.")
    epoch, place = divmod(step, size // batch_size)
    order = np.random.default_rng((seed, epoch)).permutation(size)
    return order[place * batch_size : (place + 1) * batch_size].tolist()


def _draw(rng: np.random.Generator, size: int, count: int) -> np.ndarray:
    """`count` of `size` indices, without repetition where that is possible."""
    return rng.choice(size, count, replace=count > size) if count else np.zeros(0, dtype=np.int64)


def _draw_groups(rng: np.random.Generator, near: np.ndarray, count: int, group: int) -> np.ndarray:
    """`count` rows of `near` (N, D), in groups of a row and others of the 4 `group` that are nearest to it."""
    seeds = _draw(rng, len(near), -(-count // group))
    nearest = np.argsort(-(near[seeds] @ near.T), axis=1)[:, 1 : 4 * group]
    others = [rng.choice(row, group - 1, replace=False) for row in nearest]
    return np.concatenate([seeds[:, None], others], axis=1).reshape(-1)[:count]


# Augmentations of raw pixels (B, 3, S, S) in [0, 1], each with its own draw for every sample --------------------------


def shift_pixels(images: Tensor, reach: int) -> Tensor:
    """Moves each image by up to `reach` pixels along both axes; the border is repeated."""
    padded = F.pad(images, (reach,) * 4, mode="replicate")
    corner = torch.randint(0, 2 * reach + 1, (len(images), 2), device=images.device)
    rows, columns = (corner[..., None] + torch.arange(images.shape[-1], device=images.device)).unbind(1)  # (B, S)
    batch = torch.arange(len(images), device=images.device)[:, None, None]
    return padded[batch, :, rows[:, :, None], columns[:, None, :]].permute(0, 3, 1, 2)


def jitter_colours(images: Tensor, gain: float, offset: float) -> Tensor:
    """Scales each channel by 1 +- gain and shifts it by +- offset (uniform)."""
    scale, shift = (2 * torch.rand(len(images), 3, 1, 1, device=images.device) - 1 for _ in range(2))
    return (images * (1.0 + gain * scale) + offset * shift).clamp(0.0, 1.0)


def permute_channels(images: Tensor, probability: float) -> Tensor:
    """Exchanges the colours of some images: lights of other colours."""
    chosen = torch.rand(len(images), device=images.device) < probability
    order = torch.rand(len(images), 3, device=images.device).argsort(dim=1)
    order = torch.where(chosen[:, None], order, torch.arange(3, device=images.device))
    return images.gather(1, order[:, :, None, None].expand_as(images))


def blur_some(images: Tensor, probability: float) -> Tensor:
    """Softens some images by a 3 x 3 binomial kernel: softer gels."""
    kernel = torch.tensor([1.0, 2.0, 1.0], device=images.device)
    kernel = (kernel[:, None] * kernel[None, :] / 16).expand(3, 1, 3, 3)
    soft = F.conv2d(F.pad(images, (1, 1, 1, 1), mode="replicate"), kernel, groups=3)
    chosen = torch.rand(len(images), 1, 1, 1, device=images.device) < probability
    return torch.where(chosen, soft, images)


def add_noise(images: Tensor, deviation: float) -> Tensor:
    """Camera noise of up to `deviation`, a level for each image."""
    level = deviation * torch.rand(len(images), 1, 1, 1, device=images.device)
    return (images + level * torch.randn_like(images)).clamp(0.0, 1.0)


def in_deviations(values: np.ndarray, axes: int | tuple[int, ...] = 0) -> np.ndarray:
    """Measures around their mean over some axes, in units of their deviation, at most 5; float32."""
    mean, deviation = (reduce(axis=axes, dtype=np.float64, keepdims=True) for reduce in (values.mean, values.std))
    return ((values - mean) / deviation.clip(1e-3)).clip(-5.0, 5.0).astype(np.float32)
