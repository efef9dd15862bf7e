"""Several processes as one: each works on its rows of a batch, and losses that compare samples compare those of all."""

import torch
import torch.distributed as dist
from torch import Tensor
from torch.distributed.nn.functional import all_gather

from unitouch_gen.errors import InvalidInputError


def gathered(rows: Tensor) -> Tensor:
    """Rows of all W processes in the order of the batch, (W b, ...) of (b, ...); gradients go back to each."""
    several = dist.is_available() and dist.is_initialized() and dist.get_world_size() > 1
    return torch.cat(all_gather(rows)) if several else rows


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
