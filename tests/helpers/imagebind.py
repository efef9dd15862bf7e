"""ImageBind in plain PyTorch: its layout of keys, and what it computes, written down apart from the package.

Girdhar et al., 2023, "ImageBind: One embedding space to bind them all", with UniTouch's touch encoder beside.
"""

import math

import torch
import torch.nn.functional as F
from torch import nn


class Block(nn.Module):
    def __init__(self, width, heads, bias_kv):
        super().__init__()
        self.attn = nn.MultiheadAttention(width, heads, add_bias_kv=bias_kv)
        self.norm_1, self.norm_2 = nn.LayerNorm(width, eps=1e-6), nn.LayerNorm(width, eps=1e-6)
        self.mlp = nn.ModuleDict({"fc1": nn.Linear(width, 4 * width), "fc2": nn.Linear(4 * width, width)})

    def forward(self, x, mask):  # (T, B, width)
        normed = self.norm_1(x)
        x = x + self.attn(normed, normed, normed, need_weights=False, attn_mask=mask)[0]
        return x + self.mlp["fc2"](F.gelu(self.mlp["fc1"](self.norm_2(x))))


class Stem(nn.Module):
    def __init__(self, proj, norm=None):
        super().__init__()
        self.proj, self.norm_layer = proj, norm


class Positions(nn.Module):
    def __init__(self, tokens, width):
        super().__init__()
        self.pos_embed = nn.Parameter(torch.randn(1, tokens, width) * 0.1)


class Seen(nn.Module):
    """Preprocessor of pictures, touches and spectrograms."""

    def __init__(self, stem, tokens, width):
        super().__init__()
        self.cls_token = nn.Parameter(torch.randn(1, 1, width) * 0.1)
        self.rgbt_stem, self.pos_embedding_helper = stem, Positions(tokens, width)

    def forward(self, x):
        x = self.rgbt_stem.proj(x).flatten(2).transpose(1, 2)
        if self.rgbt_stem.norm_layer is not None:
            x = self.rgbt_stem.norm_layer(x)
        x = torch.cat([self.cls_token.expand(len(x), -1, -1), x], dim=1)
        return x + self.pos_embedding_helper.pos_embed


class Read(nn.Module):
    """Preprocessor of text."""

    def __init__(self, words, tokens, width):
        super().__init__()
        self.pos_embed = nn.Parameter(torch.randn(1, tokens, width) * 0.1)
        self.token_embedding = nn.Embedding(words, width)
        self.register_buffer("mask", torch.full((tokens, tokens), -math.inf).triu(1))

    def forward(self, ids):
        return self.token_embedding(ids) + self.pos_embed


class Trunk(nn.Module):
    def __init__(self, width, heads, depth, bias_kv, norm_before):
        super().__init__()
        self.pre_transformer_layer = nn.Sequential(nn.LayerNorm(width, eps=1e-6) if norm_before else nn.Identity())
        self.blocks = nn.ModuleList(Block(width, heads, bias_kv) for _ in range(depth))

    def forward(self, x, mask):
        x = self.pre_transformer_layer(x).transpose(0, 1)
        for block in self.blocks:
            x = block(x, mask)
        return x.transpose(0, 1)


class TextHead(nn.Module):
    def __init__(self, width, projected):
        super().__init__()
        self.proj = nn.Sequential(nn.LayerNorm(width, eps=1e-6), nn.Linear(width, projected, bias=False))


class Scale(nn.Module):
    def __init__(self, scale, learned):
        super().__init__()
        value = torch.tensor([math.log(scale)])
        if learned:
            self.log_logit_scale = nn.Parameter(value)
        else:
            self.register_buffer("log_logit_scale", value)

    def forward(self, x):
        return x * self.log_logit_scale.exp().clamp(max=100)


def stem_over_frames(width, patch):
    return Stem(nn.Sequential(nn.Identity(), nn.Conv3d(3, width, (2, patch, patch), (2, patch, patch), bias=False)))


class ImageBind(nn.Module):
    """ImageBind at the sizes of a `UniTouchConfig`, with random weights, larger than at a start so that all matters.

    Args:
        config: The sizes.
        modalities: Some of "vision", "text", "audio", "touch" and "depth".
        text_scale: Learned scale of the text's logits.
    """

    def __init__(self, config, modalities=("vision", "text", "audio", "depth"), text_scale=14.0):
        super().__init__()
        vision, text, audio, touch = (getattr(config, f"{n}_config") for n in ("vision", "text", "audio", "touch"))
        projected = config.projection_dim
        grid = (vision.image_size // vision.patch_size) ** 2
        make = {
            "vision": lambda: Seen(
                stem_over_frames(vision.hidden_size, vision.patch_size), grid + 1, vision.hidden_size
            ),
            "touch": lambda: Seen(
                stem_over_frames(touch.hidden_size, touch.patch_size), math.prod(touch.grid) + 1, touch.hidden_size
            ),
            "depth": lambda: Seen(stem_over_frames(16, 4), 5, 16),
            "text": lambda: Read(text.vocab_size, text.max_position_embeddings, text.hidden_size),
            "audio": lambda: Seen(
                Stem(
                    nn.Conv2d(1, audio.hidden_size, audio.patch_size, audio.patch_stride, bias=False),
                    nn.LayerNorm(audio.hidden_size),
                ),
                math.prod(audio.grid) + 1,
                audio.hidden_size,
            ),
        }
        sizes = {
            name: (part.hidden_size, part.num_attention_heads, part.num_hidden_layers)
            for name, part in (("vision", vision), ("text", text), ("audio", audio), ("touch", touch))
        } | {"depth": (16, 2, 1)}
        self.modality_preprocessors = nn.ModuleDict({name: make[name]() for name in modalities})
        self.modality_trunks = nn.ModuleDict(
            {
                name: Trunk(*sizes[name], bias_kv=name in ("audio", "touch", "depth"), norm_before=name == "vision")
                for name in modalities
            }
        )
        self.modality_heads = nn.ModuleDict()
        self.modality_postprocessors = nn.ModuleDict()
        for name in modalities:
            width = sizes[name][0]
            self.modality_heads[name] = (
                TextHead(width, projected)
                if name == "text"
                else nn.Sequential(
                    nn.LayerNorm(width, eps=1e-6), nn.Identity(), nn.Linear(width, projected, bias=False)
                )
            )
            scales = {"text": (text_scale, True), "audio": (20.0, False), "touch": (5.0, False)}
            after = [nn.Identity(), Scale(*scales[name])] if name in scales else [nn.Identity()]
            self.modality_postprocessors[name] = nn.Sequential(*after)
        generator = torch.Generator().manual_seed(0)
        with torch.no_grad():
            for name, weight in self.named_parameters():
                if weight.ndim == 1 and "log_logit_scale" not in name:
                    offset = 1.0 if name.endswith("weight") else 0.0
                    weight.copy_(offset + 0.1 * torch.randn(weight.shape, generator=generator))
                elif name.endswith(("bias_k", "bias_v")):
                    weight.copy_(torch.randn(weight.shape, generator=generator))
        self.eval()

    @torch.no_grad()
    def embed(self, name, x):
        """(features before normalisation, what the published model returns), each (B, D)."""
        tokens = self.modality_preprocessors[name](x)
        mask = self.modality_preprocessors[name].mask if name == "text" else None
        tokens = self.modality_trunks[name](tokens, mask)
        if name == "text":
            last = tokens[torch.arange(len(x)), x.argmax(dim=1)]  # the end token has the highest id
            features = self.modality_heads[name].proj(last)
        else:
            head = self.modality_heads[name]
            features = head[2](head[0](tokens[:, 0]))
        return features, self.modality_postprocessors[name](F.normalize(features, dim=-1))
