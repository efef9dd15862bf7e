"""In-batch sampling over several data sets (Eq. 4 of the paper)."""

from collections.abc import Sequence

import numpy as np

from unitouch_gen.errors import InvalidInputError, check_integer, check_number


class InBatchSampler:
    """round(sigma B) examples of one data set, chosen with probability by size; the rest from all the others.

    Called with a step number it returns that step's indices into the concatenation of the data sets. With sigma = 0
    nothing is chosen and the whole batch is uniform over the union.

    Args:
        sizes: Examples in each data set.
        batch_size: B.
        sigma: Share from the chosen data set (paper: 0.75).
        seed: Of all steps.

    Raises:
        InvalidInputError: If a size is below 1, sigma is outside [0, 1], or the others needed do not exist.
    """

    def __init__(self, sizes: Sequence[int], batch_size: int, sigma: float = 0.75, seed: int = 0):
        self.sizes = np.asarray([check_integer(f"sizes[{i}]", size, 1) for i, size in enumerate(sizes)])
        self.batch_size = check_integer("batch_size", batch_size, 1)
        self.sigma = check_number("sigma", sigma, 0.0, 1.0)
        self.seed = seed
        self.share = round(self.sigma * self.batch_size)
        if 0 < self.share < self.batch_size and len(self.sizes) < 2:
            raise InvalidInputError(
                f"`sigma` is {sigma} with {len(self.sizes)} data set; a share below 1 needs another data set to draw "
                "the rest from."
            )
        self.starts = np.concatenate([[0], np.cumsum(self.sizes)])

    def __call__(self, step: int) -> list[int]:
        rng = np.random.default_rng((self.seed, step))
        total = int(self.starts[-1])
        if self.share == 0:
            return _draw(rng, total, self.batch_size).tolist()
        chosen = int(rng.choice(len(self.sizes), p=self.sizes / total))
        start, size = int(self.starts[chosen]), int(self.sizes[chosen])
        inside = start + _draw(rng, size, self.share)
        outside = _draw(rng, total - size, self.batch_size - self.share)
        outside = np.where(outside >= start, outside + size, outside)  # skips over the chosen one
        return np.concatenate([inside, outside]).tolist()


class ShuffledSampler:
    """Uniform batches without replacement within an epoch, as a function of the step alone."""

    def __init__(self, size: int, batch_size: int, seed: int = 0):
        self.size = check_integer("size", size, 1)
        self.batch_size = min(check_integer("batch_size", batch_size, 1), size)
        self.seed = seed

    def __call__(self, step: int) -> list[int]:
        per_epoch = self.size // self.batch_size
        epoch, place = divmod(step, per_epoch)
        order = np.random.default_rng((self.seed, epoch)).permutation(self.size)
        return order[place * self.batch_size : (place + 1) * self.batch_size].tolist()


def _draw(rng: np.random.Generator, size: int, count: int) -> np.ndarray:
    """`count` of `size` indices, without repetition where that is possible."""
    return rng.choice(size, count, replace=count > size) if count else np.zeros(0, dtype=np.int64)
