"""A bar of bytes written."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def bytes_written() -> Iterator[Callable[[int, int], None]]:
    """What to tell how many bytes of how many are written; the bar goes when the block ends, and where no one looks."""
    from tqdm import tqdm

    with tqdm(unit="B", unit_scale=True, desc="Writing", leave=False, disable=None) as bar:

        def written(done: int, whole: int) -> None:
            bar.total = whole
            bar.update(done - bar.n)

        yield written
