"""Several processes as one: every process works on its rows of a batch, and all on the loss of the whole.

A run gives what one process would give for the same batch, to rounding: random numbers are those of the whole batch,
embeddings that losses compare are gathered with their gradients, and losses that are means over rows have gradients
that `DistributedDataParallel` averages. What a network computes over the rows of a batch, such as batch norm's
statistics, is of each process alone.

Where accelerate's configuration shards the weights themselves, by FSDP or DeepSpeed, a copy of the objective is
trained, and `whole_weights` brings what it has learned into the one that was given.
"""

from collections.abc import Callable, Sequence
from typing import Any

import torch
import torch.distributed as dist
from accelerate import Accelerator, DistributedType
from diffusers.training_utils import EMAModel
from torch import Tensor, nn
from torch.distributed.nn.functional import all_gather
from torch.distributed.tensor import DTensor, distribute_tensor
from torch.overrides import TorchFunctionMode

from unitouch_gen.errors import InvalidInputError

SHARDING = (DistributedType.FSDP, DistributedType.DEEPSPEED)
"""Ways of distribution in which a process may hold a part of each weight."""

DRAWS = (torch.rand, torch.randn, torch.randint)
LIKE = {torch.rand_like: torch.rand, torch.randn_like: torch.randn}


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


# Sharded weights ------------------------------------------------------------------------------------------------------


def check_sharding(accelerator: Accelerator, rows: int, accumulation: int, grad_clip: float, averaged: bool) -> None:
    """Tells a configuration of accelerate what is the recipe's to say.

    Args:
        accelerator: Before it has prepared anything.
        rows: Of a process at once.
        accumulation, grad_clip: The recipe's.
        averaged: Whether weights are averaged.

    Raises:
        InvalidInputError: If the two do not go together.
    """
    state = accelerator.state
    if accelerator.distributed_type == DistributedType.FSDP and not accelerator.is_fsdp2 and averaged:
        raise InvalidInputError(
            "`ema_decay` is not 0, as it has to be with FSDP 1; set it to 0, or say `fsdp_version: 2` to accelerate."
        )
    if accelerator.distributed_type != DistributedType.DEEPSPEED:
        return
    if accumulation > 1:
        raise InvalidInputError(f"`accumulation` is {accumulation}, which has to be 1 with DeepSpeed.")
    plugin = state.deepspeed_plugin
    if averaged and plugin.zero_stage == 3:
        raise InvalidInputError("`ema_decay` is not 0, as it has to be with DeepSpeed's stage 3; take 2, or FSDP.")
    for name, value in (("train_micro_batch_size_per_gpu", rows), ("gradient_clipping", grad_clip)):
        if plugin.deepspeed_config.get(name, "auto") == "auto":
            plugin.deepspeed_config[name] = value


def whole(tensor: Tensor) -> Tensor:
    """A weight of which each process holds a part, on the CPU; all processes have to ask for it."""
    return tensor.full_tensor().cpu() if isinstance(tensor, DTensor) else tensor


class AveragedWeights(EMAModel):
    """An average of weights, sharded as they are, whose checkpoints are whole."""

    shadow_params: list[Tensor]

    def state_dict(self) -> dict[str, Any]:
        state = super().state_dict()
        return {**state, "shadow_params": [whole(weight) for weight in self.shadow_params]}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        sharded: list[Tensor] = self.shadow_params
        super().load_state_dict(state_dict)
        self.shadow_params = [
            distribute_tensor(read.to(kept.device), kept.device_mesh, kept.placements)
            if isinstance(kept, DTensor)
            else read.to(kept.device)
            for kept, read in zip(sharded, self.shadow_params, strict=True)
        ]


def whole_weights(accelerator: Accelerator, prepared: nn.Module, into: nn.Module) -> None:
    """Brings the weights of a sharded network into one that is not, in the main process; all have to take part."""
    state = accelerator.get_state_dict(prepared)
    if accelerator.is_main_process:
        into.load_state_dict(state)


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
