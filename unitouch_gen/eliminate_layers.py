"""What stands in for the forward pass of a layer in which a request leaves work out.

The `forward` of a stand-in takes the place of one module's for the time of a request. It does what the module does,
unless the `Evaluation` that runs says that a part of that is not needed. `eliminate_plan` says which layers get one.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from unitouch_gen.models.casting import casts

Forward = Callable[..., Any]


@dataclass
class Evaluation:
    """What holds in the evaluation of the network that runs; outside of one nothing does.

    Attributes:
        running: The conditions are the request's own copies, which nobody changes.
        single: They are one token.
        one_time: All rows have one timestep.
        shared: What both halves of the batch have in common: "nothing"; the "stem", which sees only the latents; or the
            "prefix", all layers before the first that attends to the condition.
    """

    running: bool = False
    single: bool = False
    one_time: bool = False
    shared: str = "nothing"


class StandIn:
    """What all have in common.

    Args:
        original: The module's own `forward`, which also runs the hooks of accelerate.
        evaluation: The one that runs.
    """

    def __init__(self, original: Forward, evaluation: Evaluation) -> None:
        self.original, self.evaluation = original, evaluation

    def forward(self, *inputs: Any, **named: Any) -> Any:
        return self.original(*inputs, **named)


class Kept(StandIn):
    """A function of a condition alone: computed once, and kept for as long as the same tensor comes."""

    condition: Tensor | None = None
    value: Any = None

    def forward(self, condition: Tensor) -> Any:
        if not self.evaluation.running:
            return self.original(condition)
        if condition is not self.condition:
            self.value, self.condition = self.original(condition), condition
        return self.value


class AttendToOne(StandIn):
    """Attention over one token: softmax over one key is 1, so every pixel gets to_out(to_v(token)).

    Args:
        attention: A diffusers `Attention`.
    """

    def __init__(self, attention: Any, evaluation: Evaluation) -> None:
        super().__init__(attention.forward, evaluation)
        self.layers = (attention.to_v, *attention.to_out)
        self.kept = Kept(self.output, evaluation)

    def output(self, condition: Tensor) -> Tensor:
        """(B, 1, D) -> (B, 1, C)."""
        for layer in self.layers:
            condition = layer(condition)
        return condition

    def forward(self, hidden_states: Tensor, encoder_hidden_states: Tensor | None = None, **others: Any) -> Tensor:
        """(B, 1, C) in place of (B, pixels, C), as the block does no more than add it."""
        if self.evaluation.single and encoder_hidden_states is not None:
            return self.kept.forward(encoder_hidden_states)
        return self.original(hidden_states, encoder_hidden_states=encoder_hidden_states, **others)


class Unread(StandIn):
    """The norm before an attention that does not look at the pixels."""

    def forward(self, hidden_states: Tensor) -> Tensor:
        return hidden_states if self.evaluation.single else self.original(hidden_states)


class OneTime(StandIn):
    """The features of one timestep, (1, C), which broadcast over the batch."""

    def forward(self, timesteps: Tensor) -> Tensor:
        return self.original(timesteps[:1] if self.evaluation.one_time else timesteps)


class Halved(StandIn):
    """A module whose input is the same in both halves of the batch: it runs on one.

    Args:
        shared: Values of `Evaluation.shared` under which the input is the same.
        take: The input comes with both halves.
        give: The output goes on with both halves.
    """

    def __init__(
        self, original: Forward, evaluation: Evaluation, shared: tuple[str, ...], take: bool = True, give: bool = True
    ) -> None:
        super().__init__(original, evaluation)
        self.shared, self.take, self.give = shared, take, give

    def forward(self, *inputs: Any, **named: Any) -> Any:
        if self.evaluation.shared not in self.shared:
            return self.original(*inputs, **named)
        if self.take:
            inputs = tuple(first_half(value) for value in inputs)
            named = {key: first_half(value) for key, value in named.items()}
        output = self.original(*inputs, **named)
        return both_halves(output) if self.give else output


class SplitConvolution(StandIn):
    """A convolution over channels of which the last ones are the same in both halves of the batch.

    It is the sum of one over the first channels and one over the last, and the latter is made for one half.

    Args:
        convolution: A `Conv2d` of one group that pads with zeros.
        shared: Values of `Evaluation.shared` under which the last channels are the same.
        own: Number of the channels before them.
    """

    def __init__(self, convolution: Any, evaluation: Evaluation, shared: tuple[str, ...], own: int) -> None:
        super().__init__(convolution.forward, evaluation)
        self.convolution, self.shared, self.own = convolution, shared, own
        self.weights: tuple[Tensor, Tensor] | None = None

    def forward(self, hidden_states: Tensor) -> Tensor:
        if self.evaluation.shared not in self.shared:
            return self.original(hidden_states)
        layer = self.convolution
        geometry = (layer.stride, layer.padding, layer.dilation)
        own, common = hidden_states[:, : self.own], first_half(hidden_states[:, self.own :])
        if casts(layer):  # of weights that are kept small, no copies are kept
            dtype = hidden_states.dtype
            bias = None if layer.bias is None else layer.bias.to(dtype)
            output = F.conv2d(own, layer.weight[:, : self.own].to(dtype), None, *geometry)
            shared = F.conv2d(common, layer.weight[:, self.own :].to(dtype), bias, *geometry)
        else:
            if self.weights is None:
                self.weights = layer.weight[:, : self.own].contiguous(), layer.weight[:, self.own :].contiguous()
            output = F.conv2d(own, self.weights[0], None, *geometry)
            shared = F.conv2d(common, self.weights[1], layer.bias, *geometry)
        output.unflatten(0, (2, -1)).add_(shared)
        return output


def first_half(value: Any) -> Any:
    """The first half of a batch; one row, which broadcasts over both halves, stays."""
    return value[: len(value) // 2] if isinstance(value, Tensor) and len(value) > 1 else value


def both_halves(value: Any) -> Any:
    """(B, ...) -> (2 B, ...), of each tensor in what a block returns."""
    if isinstance(value, tuple):
        return tuple(both_halves(item) for item in value)
    return torch.cat([value, value])
