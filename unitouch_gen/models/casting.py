"""Weights kept in half precision and cast up layer by layer: half the memory for the same numbers."""

from typing import Any

import torch
import torch.nn.functional as F
from diffusers.hooks import HookRegistry
from diffusers.hooks.layerwise_casting import LayerwiseCastingHook
from torch import Tensor, nn

CASTING = "layerwise_casting"
"""What diffusers calls the hook, by which a model knows that it computes in another dtype than it stores."""


class CastCopies(LayerwiseCastingHook):
    """diffusers' layerwise casting, of copies.

    Its own casts a layer's weights up and down again in place: twice the work, and between the two sizes of every
    weight the heap fragments, which costs more memory than the casting saves in a small model. Here the stored weights
    stay where they are, mapped from their file if they come from one, and the copy goes when the layer is done.
    """

    def initialize_hook(self, module: nn.Module) -> nn.Module:
        return module

    def pre_forward(self, module: nn.Module, *inputs: Any, **named: Any) -> Any:
        return inputs, named

    def post_forward(self, module: nn.Module, output: Any) -> Any:
        return output

    def new_forward(self, module: Any, input: Tensor) -> Tensor:
        weight = module.weight.to(self.compute_dtype)
        bias = None if module.bias is None else module.bias.to(self.compute_dtype)
        if isinstance(module, nn.Linear):
            return F.linear(input, weight, bias)
        return module._conv_forward(input, weight, bias)


def compute_in(network: nn.Module, dtype: torch.dtype = torch.float32) -> nn.Module:
    """Makes a network compute in a wider dtype than its linear and convolutional weights are stored in.

    Norms, embeddings and the like, which are small, are cast for good. From weights that were stored in float16, a
    network computes in float32 what it would after casting all of them, value by value.

    Args:
        network: A network of diffusers or plain torch, in the dtype that its weights keep.
        dtype: Dtype of computation.
    """
    for layer in network.modules():
        if type(layer) in (nn.Linear, nn.Conv2d):
            if layer.weight.dtype != dtype:
                registry = HookRegistry.check_if_exists_or_initialize(layer)
                if registry.get_hook(CASTING) is None:
                    registry.register_hook(CastCopies(layer.weight.dtype, dtype, non_blocking=False), CASTING)
        else:
            for tensor in (*layer.parameters(recurse=False), *layer.buffers(recurse=False)):
                if tensor.is_floating_point():
                    tensor.data = tensor.data.to(dtype)
    return network
