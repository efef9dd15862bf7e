"""How many touches a second the touch encoder takes, beside the same network written with `nn.MultiheadAttention`."""

import copy
import statistics
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from tests.benchmarks import Figures
from tests.benchmarks.turns import in_turns, ratio_of, seconds_of
from unitouch_gen.models import UniTouchConfig, UniTouchModel, UniTouchViT, UniTouchViTConfig
from unitouch_gen.models.config import FULL_SIZES
from unitouch_gen.pipelines.presets import made_in


class PlainBlock(nn.Module):
    """A pre-norm block with one learned key and value, in torch's own layers, (B, T, width) -> the same."""

    def __init__(self, config: UniTouchViTConfig):
        super().__init__()
        width, hidden = config.hidden_size, int(config.mlp_ratio * config.hidden_size)
        self.norm_1 = nn.LayerNorm(width, eps=config.layer_norm_eps)
        self.attention = nn.MultiheadAttention(
            width, config.num_attention_heads, add_bias_kv=config.add_bias_kv, batch_first=True
        )
        self.norm_2 = nn.LayerNorm(width, eps=config.layer_norm_eps)
        self.mlp = nn.Sequential(nn.Linear(width, hidden), nn.GELU(), nn.Linear(hidden, width))

    def forward(self, x: Tensor) -> Tensor:
        y = self.norm_1(x)
        x = x + self.attention(y, y, y, need_weights=False)[0]
        return x + self.mlp(self.norm_2(x))


class PlainViT(nn.Module):
    """`UniTouchViT` in torch's own layers, without prefix and `stem_norm`: (B, C, H, W) -> (B, D)."""

    def __init__(self, config: UniTouchViTConfig):
        super().__init__()
        width, (rows, columns) = config.hidden_size, config.grid
        self.stem = nn.Conv2d(config.num_channels, width, config.patch_size, config.patch_stride, bias=False)
        self.class_token = nn.Parameter(torch.zeros(1, 1, width))
        self.position = nn.Parameter(torch.zeros(1, 1 + rows * columns, width))
        self.blocks = nn.Sequential(*(PlainBlock(config) for _ in range(config.num_hidden_layers)))
        self.norm = nn.LayerNorm(width, eps=config.layer_norm_eps)
        self.projection = nn.Linear(width, config.projection_dim, bias=False)

    def forward(self, pixels: Tensor) -> Tensor:
        x = self.stem(pixels).flatten(2).transpose(1, 2)
        x = torch.cat([self.class_token.expand(len(x), -1, -1), x], dim=1) + self.position
        return self.projection(self.norm(self.blocks(x)[:, 0]))


ATTENTION = {"qkv.weight": "in_proj_weight", "qkv.bias": "in_proj_bias", "out": "out_proj"}
"""What our parts of the attention are called in torch's."""


def plain_of(encoder: UniTouchViT, config: UniTouchViTConfig) -> PlainViT:
    """The same network with the same weights, in the encoder's dtype."""
    state = {}
    for name, tensor in encoder.state_dict().items():
        for ours, theirs in ATTENTION.items():
            name = name.replace(f"attention.{ours}", f"attention.{theirs}")
        state[name] = tensor
    plain = PlainViT(config).to(encoder.projection.weight.dtype)
    plain.load_state_dict(state)
    return plain.eval()


def throughput_figures(repeats: int = 7, batch: int = 8, settings: Mapping[str, Any] | None = None) -> Figures:
    """Touches a second of the touch encoder and of its plain transcription, and how many times as fast it is.

    Weights are random, so the error of bfloat16 is that of such weights; it is relative to the plain network in
    float32, over the batch.

    Args:
        repeats: Timed turns, in which all four take part, after a first one.
        batch: Touches in a call.
        settings: Of the joint space's `UniTouchConfig`; those of "unitouch-vit-l" when left out.
    """
    joint = UniTouchConfig(**(FULL_SIZES["unitouch-vit-l"] if settings is None else settings))
    config: Any = joint.touch_config
    with made_in("cpu", torch.float32, seed=0):
        ours = UniTouchModel(joint, modalities=("touch",)).eval().touch_model
        pixels = torch.randn(batch, config.num_channels, config.image_height, config.image_width)
    networks: dict[str, nn.Module] = {"plain_float32": plain_of(ours, config), "ours_float32": ours}
    for name in ("plain", "ours"):
        networks[f"{name}_bfloat16"] = copy.deepcopy(networks[f"{name}_float32"]).bfloat16()

    calls: dict[str, Callable[[], Tensor]] = {
        name: partial(network, pixels.bfloat16() if name.endswith("bfloat16") else pixels)
        for name, network in networks.items()
    }
    with torch.no_grad():
        expected = calls["plain_float32"]()
        errors = {name: _error(call(), expected) for name, call in calls.items() if name != "plain_float32"}
        seen = in_turns({name: partial(seconds_of, call) for name, call in calls.items()}, repeats)
    return {
        "batch": batch,
        "repeats": repeats,
        "parameters": sum(weight.numel() for weight in ours.parameters()),
        "touches_per_second": {
            name: {"median": batch / statistics.median(times), "low": batch / max(times), "high": batch / min(times)}
            for name, times in seen.items()
        },
        "times_as_fast": {
            "float32": ratio_of(seen["plain_float32"], seen["ours_float32"]),
            "bfloat16": ratio_of(seen["plain_float32"], seen["ours_bfloat16"]),
            "bfloat16_of_plain_bfloat16": ratio_of(seen["plain_bfloat16"], seen["ours_bfloat16"]),
        },
        "relative_error": errors,
    }


def _error(found: Tensor, expected: Tensor) -> float:
    """Relative, of embeddings (B, D)."""
    return ((found.float() - expected).norm() / expected.norm()).item()
