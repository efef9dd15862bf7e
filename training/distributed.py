"""Several processes as one: every process works on its rows of a batch, and all on the loss of the whole.

A run gives what one process would give for the same batch, to rounding: random numbers are those of the whole batch,
embeddings that losses compare are gathered with their gradients, and losses that are means over rows have gradients
that `DistributedDataParallel` averages. What a network computes over the rows of a batch, such as batch norm's
statistics, is of each process alone.
"""

from collections.abc import Callable, Sequence
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor
from torch.distributed.nn.functional import all_gather
from torch.overrides import TorchFunctionMode

from unitouch_gen.errors import InvalidInputError

DRAWS = (torch.rand, torch.randn, torch.randint)
LIKE = {torch.rand_like: torch.rand, torch.randn_like: torch.randn}


def process_count() -> int:
    """W, how many processes train together."""
    return dist.get_world_size() if dist.is_available() and dist.is_initialized() else 1


def gathered(rows: Tensor) -> Tensor:
    """Rows of all processes in the order of the batch, (W b, ...) of (b, ...); gradients go back to each."""
    return rows if process_count() == 1 else torch.cat(all_gather(rows))


def rows_of(batch_size: int, process: int, count: int) -> slice:
    """Rows of a batch that a process works on.

    Raises:
        InvalidInputError: If the batch cannot be shared out evenly.
    """
    if batch_size % count:
        raise InvalidInputError(
            f"`batch_size` is {batch_size}, which {count} processes cannot share evenly. It is of all of them "
            f"together; take a multiple of {count}."
        )
    share = batch_size // count
    return slice(process * share, (process + 1) * share)


class JointDraws(TorchFunctionMode):
    """Within it, random numbers for each row of a batch are those of the whole batch, of which a process gets its rows.

    That goes for `torch.rand`, `randn`, `randint` and their `_like`, where the first dimension is that of the rows.

    Args:
        rows: The process's.
        batch_size: Of the whole batch.
    """

    def __init__(self, rows: slice, batch_size: int):
        super().__init__()
        self.rows, self.batch_size = rows, batch_size

    def __torch_function__(
        self, function: Callable[..., Any], types: Any, args: Sequence[Any] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        options = dict(kwargs or {})
        if function in LIKE:
            options = {"dtype": args[0].dtype, "device": args[0].device, **options}
            function, args = LIKE[function], (args[0].shape,)
        if function not in DRAWS:
            return function(*args, **options)
        *bounds, shape = args if isinstance(args[-1], Sequence) else (args,)  # rand(2, 3) is rand((2, 3))
        if not shape or shape[0] != self.rows.stop - self.rows.start:
            raise RuntimeError(f"Random numbers of shape {tuple(shape)} are not of the rows {self.rows} of a batch.")
        whole: Any = function(*bounds, (self.batch_size, *shape[1:]), **options)  # type: ignore[call-overload]
        return whole[self.rows]
