"""`LanguageBridge`: an embedding of the joint space as an adapter token in every attention of a language model.

It computes T_j^q = h_zero F' + T_j^q (Section 4.6 of the paper) as the paper's release does, after ImageBind-LLM (Han
et al., 2023, "ImageBind-LLM: Multi-modality Instruction Tuning"). A single adapter token in each layer needs no
softmax. Its value is scaled by a gate for each head, and added to the output of the attention at every token.
"""

from contextlib import ExitStack
from typing import Any, Self

import torch
import torch.nn.functional as F
from diffusers import ConfigMixin, ModelMixin
from diffusers.configuration_utils import register_to_config
from torch import Tensor, nn
from transformers import PreTrainedModel

from unitouch_gen.errors import InvalidInputError, NonFiniteError, check_equal
from unitouch_gen.saving import saved_whole


class SwiGLU(nn.Module):
    """A residual block, x + W2 (silu(W1 n(x)) * W3 n(x)), with n an RMSNorm; with `legacy` a LayerNorm, and biases."""

    def __init__(self, width: int, hidden: int, legacy: bool):
        super().__init__()
        self.norm = nn.LayerNorm(width) if legacy else nn.RMSNorm(width, eps=1e-6)
        self.w1 = nn.Linear(width, hidden, bias=legacy)
        self.w2 = nn.Linear(hidden, width, bias=legacy)
        self.w3 = nn.Linear(width, hidden, bias=legacy)

    def forward(self, x: Tensor) -> Tensor:
        normed = self.norm(x)
        return x + self.w2(F.silu(self.w1(normed)) * self.w3(normed))


class LanguageBridge(ModelMixin, ConfigMixin):
    """Projection, residual blocks, a query for each layer, and a zero-initialised gate for each head.

    F' = blocks(W e + b), with e at unit length; a_l = F' + q_l. Before `o_proj` of layer l, tanh(g_lh) (W_v a_l)_h is
    added to head h of every token, with W_v the layer's own value projection. Gates of zero change nothing.

    Args:
        embedding_dim: D, width of the embeddings e.
        hidden_size: C, width of the language model.
        num_layers: L, number of its attentions.
        num_heads: H, number of its query heads.
        num_blocks: Number of residual blocks.
        intermediate_size: Width inside of the residual blocks; 4 C if left out.
        legacy: Blocks with LayerNorm and biases.
        value_rank: Rank of a low-rank pair that is part of W_v for words, but not for a_l. The release fine-tunes W_v
            for words only.
    """

    save_pretrained = saved_whole(ModelMixin.save_pretrained)

    @register_to_config
    def __init__(
        self,
        embedding_dim: int,
        hidden_size: int,
        num_layers: int,
        num_heads: int,
        num_blocks: int = 3,
        intermediate_size: int | None = None,
        legacy: bool = False,
        value_rank: int = 0,
    ):
        super().__init__()
        hidden = intermediate_size or 4 * hidden_size
        self.projection = nn.Linear(embedding_dim, hidden_size)
        self.blocks = nn.Sequential(*(SwiGLU(hidden_size, hidden, legacy) for _ in range(num_blocks)))
        self.queries = nn.Parameter(torch.randn(num_layers, hidden_size))
        self.gates = nn.Parameter(torch.zeros(num_layers, num_heads))
        self.value_down = self.value_up = None
        if value_rank:
            self.value_down = nn.Parameter(torch.zeros(num_layers, value_rank, hidden_size))
            self.value_up = nn.Parameter(torch.zeros(num_layers, hidden_size, value_rank))

    @classmethod
    def for_model(
        cls,
        language_model: PreTrainedModel,
        embedding_dim: int,
        num_blocks: int = 3,
        intermediate_size: int | None = None,
    ) -> Self:
        """A new bridge into a language model."""
        config = language_model.config.get_text_config()
        return cls(
            embedding_dim,
            hidden_size=config.hidden_size,
            num_layers=len(attentions_of(language_model)),
            num_heads=config.num_attention_heads,
            num_blocks=num_blocks,
            intermediate_size=intermediate_size,
        )

    def forward(self, embeds: Tensor) -> Tensor:
        """Adapter tokens a_l (B, L, C) of embeddings (B, D); only their direction matters."""
        projected = self.projection(F.normalize(embeds.float(), dim=-1).to(self.projection.weight))
        return self.blocks(projected)[:, None] + self.queries

    def check_fits(self, language_model: PreTrainedModel) -> list[Any]:
        """The language model's attentions; raises `InvalidInputError` if it has no `o_proj`, or other sizes."""
        attentions = attentions_of(language_model)
        config = language_model.config.get_text_config()
        sizes = {
            "num_layers": len(attentions),
            "hidden_size": config.hidden_size,
            "num_heads": config.num_attention_heads,
        }
        for name, size in sizes.items():
            check_equal("language_bridge", f"`{name}`", self.config[name], size, "as the language model has")
        return attentions

    def attach(self, language_model: PreTrainedModel, embeds: Tensor) -> ExitStack:
        """Adds adapter tokens of embeddings (B, D), one for each input, to a language model.

        The end of a `with` block, or `close()`, removes them. `generate` may repeat each input, as for beams and
        several answers. If gradients are enabled, they reach the bridge. Threads must not share a language model: each
        would see the adapters of all.

        Raises:
            InvalidInputError: If the language model does not fit.
            NonFiniteError: If an adapter token is not finite.
        """
        attentions = self.check_fits(language_model)
        adapters = self(embeds)
        attached = ExitStack()
        if not bool(adapters.isfinite().all()):
            raise NonFiniteError("The adapter of an embedding is not finite; run the bridge in float32 or bfloat16.")
        for layer, attention in enumerate(attentions):
            hook = AdapterHook(self, attention, layer, adapters[:, layer])
            attached.callback(attention.o_proj.register_forward_pre_hook(hook).remove)
        return attached


class AdapterHook:
    """Adds the gated values of an adapter token (B, C) to the input of a layer's `o_proj`, (B n, T, H d)."""

    def __init__(self, bridge: LanguageBridge, attention: Any, layer: int, adapter: Tensor):
        self.bridge = bridge
        self.attention = attention
        self.layer = layer
        self.adapter = adapter
        self.value: Tensor | None = None  # computed in the first forward, when offloaded weights are on the device

    def __call__(self, o_proj: nn.Module, inputs: tuple[Tensor]) -> Tensor:
        (states,) = inputs
        value = self.gated_value(states) if self.value is None else self.value
        self.value = None if torch.is_grad_enabled() else value
        if len(value) != len(states):
            value = value.repeat_interleave(len(states) // len(value), dim=0)
        return states + value

    def gated_value(self, states: Tensor) -> Tensor:
        """tanh(g_h) (W_v a)_h of all heads, (B, 1, H d)."""
        bridge = self.bridge
        attention = self.attention
        adapter = self.adapter.to(states)
        gates = bridge.gates[self.layer].tanh().to(states)
        size = states.shape[-1] // len(gates)  # d, width of a head
        value_heads = attention.config.num_key_value_heads
        project = attention.v_proj if hasattr(attention, "v_proj") else attention.qkv_proj  # the last part is v
        value = project(adapter)[:, -value_heads * size :]
        if bridge.value_down is not None and bridge.value_up is not None:
            down = bridge.value_down[self.layer].to(states)
            up = bridge.value_up[self.layer].to(states)
            value = value - adapter @ down.T @ up.T
        value = value.unflatten(1, (value_heads, size)).repeat_interleave(len(gates) // value_heads, dim=1)
        return (gates[:, None] * value).flatten(1).to(states)[:, None]


def attentions_of(language_model: PreTrainedModel) -> list[Any]:
    """The attentions of a causal language model in order; raises `InvalidInputError` if none ends in `o_proj`."""
    attentions = list[Any]()
    for module in language_model.modules():
        has_values = hasattr(module, "v_proj") or hasattr(module, "qkv_proj")
        if has_values and hasattr(module, "o_proj"):
            attentions.append(module)
    if not attentions:
        kind = type(language_model).__name__
        raise InvalidInputError(f"`language_model` is a {kind}, whose attention has no `o_proj`; pass one like LLaMA.")
    return attentions
