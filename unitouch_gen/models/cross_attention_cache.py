"""What the cross-attentions of a UNet make of the condition alone, computed once a call and not in every evaluation.

- Attention over one token is a constant: the softmax over one key is 1, so every pixel gets `to_out(to_v(token))`, and
  neither queries, keys nor softmax are computed.
- Of a longer condition, keys and values are computed once.

Nothing is approximated: predictions differ by the rounding of another order of sums. A call has its own cache, which it
hands to the UNet with every evaluation, so nothing of a call lies on the UNet:

    install_cache_processors(unet)  # once, when the pipeline is built

    cache = cross_attention_cache(unet, encoder_hidden_states)  # once a call, again if the condition changes
    for timestep in timesteps:
        unet(latents, timestep, encoder_hidden_states, **cache_arguments(cache, len(latents)))
"""

from typing import Any

import torch
import torch.nn.functional as F
from diffusers import UNet2DConditionModel
from diffusers.models.attention import BasicTransformerBlock
from diffusers.models.attention_processor import Attention, AttnProcessor2_0
from diffusers.models.unets import unet_2d_condition
from torch import Tensor, nn

from unitouch_gen.models.casting import CASTING

Cache = dict[str, Tensor | tuple[Tensor, Tensor]]
"""By the name of a cross-attention: its output for one token, (B, 1, C), or its keys and values, (B, heads, T, d)."""


class CacheAttnProcessor(AttnProcessor2_0):
    """diffusers' own processor, unless `cross_attention_kwargs` bring what the layer would compute from the condition.

    Args:
        name: Name of the layer, under which caches have its part.
    """

    def __init__(self, name: str = "") -> None:
        super().__init__()
        self.name = name

    def __call__(
        self,
        attn: Attention,
        hidden_states: Tensor,
        encoder_hidden_states: Tensor | None = None,
        attention_mask: Tensor | None = None,
        temb: Tensor | None = None,
        cross_attention_cache: Cache | None = None,
        *args: Any,
        **kwargs: Any,
    ) -> Tensor:
        """As diffusers' own; `cross_attention_cache` has one row, or as many as `hidden_states` (B, pixels, C)."""
        cached = None if cross_attention_cache is None else cross_attention_cache.get(self.name)
        if cached is None or attention_mask is not None:
            return super().__call__(attn, hidden_states, encoder_hidden_states, attention_mask, temb, *args, **kwargs)
        if isinstance(cached, Tensor):
            return cached.expand_as(hidden_states)
        query = _split_heads(attn, attn.to_q(hidden_states))
        key, value = (tensor.expand(len(query), -1, -1, -1) for tensor in cached)
        attended = F.scaled_dot_product_attention(query, key, value).transpose(1, 2).flatten(2)
        return attn.to_out[1](attn.to_out[0](attended))


# `unet.set_default_attn_processor()` replaces processors of diffusers' list alone, and raises on others.
unet_2d_condition.CROSS_ATTENTION_PROCESSORS += (CacheAttnProcessor,)  # type: ignore[assignment]


def install_cache_processors(unet: nn.Module) -> None:
    """Gives the attention layers of a UNet a `CacheAttnProcessor` in place of diffusers' default; others stay.

    The self-attentions get one too, because diffusers passes `cross_attention_kwargs` to all, and warns where a
    processor does not know one. Weights, configuration and what is saved stay as they are.
    """
    for name, layer in unet.named_modules():
        if isinstance(layer, Attention) and type(layer.processor) is AttnProcessor2_0:
            layer.set_processor(CacheAttnProcessor(name))


def cross_attention_cache(unet: nn.Module, encoder_hidden_states: Tensor) -> Cache:
    """What each cross-attention makes of a condition.

    It holds while the condition and the weights stay as they are. It is empty where it would not be exact or not safe:
    for another network than a `UNet2DConditionModel`, with attention processors of the user's or diffusers' others,
    with hooks (of the user's, or of offloading, which bring weights only while the UNet runs), for blocks compiled one
    by one, in training mode, and while gradients are recorded.

    Args:
        unet: After `install_cache_processors`; compiled or not.
        encoder_hidden_states: Condition, (B, T, D), in the dtype of the UNet.
    """
    network = getattr(unet, "_orig_mod", unet)  # of `torch.compile`
    if not isinstance(network, UNet2DConditionModel) or not _cacheable(network):
        return {}
    cache: Cache = {}
    for block in network.modules():
        layer = block.attn2 if isinstance(block, BasicTransformerBlock) else None
        if layer is None or not _plain_cross_attention(layer):
            continue
        value = layer.to_v(encoder_hidden_states)
        if encoder_hidden_states.shape[1] == 1:
            cache[layer.processor.name] = layer.to_out[0](value)
        else:
            key = layer.to_k(encoder_hidden_states)
            cache[layer.processor.name] = _split_heads(layer, key), _split_heads(layer, value)
    return cache


def cache_arguments(cache: Cache, rows: int) -> dict[str, Any]:
    """What to call the UNet with for the last rows of the condition, such as the conditional half of a guided batch.

    Args:
        cache: From `cross_attention_cache`.
        rows: B of the evaluation, at most as many as the condition had; any number if that was one.
    """
    if not cache:
        return {}
    last = {
        name: part[-rows:] if isinstance(part, Tensor) else (part[0][-rows:], part[1][-rows:])
        for name, part in cache.items()
    }
    return {"cross_attention_kwargs": {"cross_attention_cache": last}}


def _split_heads(layer: Attention, tensor: Tensor) -> Tensor:
    """(B, T, heads d) -> (B, heads, T, d)."""
    return tensor.unflatten(-1, (layer.heads, -1)).transpose(1, 2)


def _cacheable(unet: UNet2DConditionModel) -> bool:
    """Whether its attention layers see the condition as it was passed, and may be called on their own."""
    return (
        not torch.is_grad_enabled()
        and not unet.training
        and unet.config.encoder_hid_dim_type is None  # others project the condition
        and all(isinstance(processor, CacheAttnProcessor) for processor in unet.attn_processors.values())
        and not any(_hooked(module) for module in unet.modules())
        and all(module._compiled_call_impl is None for module in unet.modules() if module is not unet)
    )


def _hooked(module: Any) -> bool:
    """Whether it does more than its class says, other than casting its weights."""
    if module._forward_hooks or module._forward_pre_hooks:
        return True
    casts = hasattr(module, "_diffusers_hook") and list(module._diffusers_hook.hooks) == [CASTING]
    return "forward" in vars(module) and not casts


def _plain_cross_attention(layer: Attention) -> bool:
    """Whether it is an output layer after softmax(Q K) V, and nothing besides."""
    absent = ("group_norm", "spatial_norm", "norm_cross", "norm_q", "norm_k", "added_kv_proj_dim")
    return (
        layer.is_cross_attention
        and all(getattr(layer, name) is None for name in absent)
        and not layer.residual_connection
        and layer.rescale_output_factor == 1.0
    )
