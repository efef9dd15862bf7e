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


class Seen(nn.Module):
    """Preprocessor of pictures, touches and spectrograms."""

    def __init__(self, convolution, grid, width, **norm):
        super().__init__()
        self.cls_token = nn.Parameter(torch.randn(1, 1, width) * 0.1)
        self.rgbt_stem = nn.ModuleDict({"proj": convolution, **norm})
        position = nn.Parameter(torch.randn(1, math.prod(grid) + 1, width) * 0.1)
        self.pos_embedding_helper = nn.ParameterDict({"pos_embed": position})

    def forward(self, x):
        x = self.rgbt_stem["proj"](x).flatten(2).transpose(1, 2)
        if "norm_layer" in self.rgbt_stem:
            x = self.rgbt_stem["norm_layer"](x)
        x = torch.cat([self.cls_token.expand(len(x), -1, -1), x], dim=1)
        return x + self.pos_embedding_helper["pos_embed"]


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


class ImageBind(nn.Module):
    """ImageBind at the sizes of a `UniTouchConfig`, with random weights, larger than at a start so that all matters.

    Args:
        config: The sizes.
        modalities: Some of "vision", "text", "audio" and "touch".
        text_scale: Learned scale of the text's logits.
    """

    def __init__(self, config, modalities=("vision", "text", "audio"), text_scale=14.0):
        super().__init__()
        parts = {name: getattr(config, f"{name}_config") for name in ("vision", "text", "audio", "touch")}
        self.modality_preprocessors, self.modality_trunks = nn.ModuleDict(), nn.ModuleDict()
        self.modality_heads, self.modality_postprocessors = nn.ModuleDict(), nn.ModuleDict()
        for name in modalities:
            part = parts[name]
            width = parts[name].hidden_size
            head = [nn.LayerNorm(width, eps=1e-6), nn.Linear(width, config.projection_dim, bias=False)]
            after = [nn.Identity()]
            if name == "text":
                self.modality_preprocessors[name] = Read(part.vocab_size, part.max_position_embeddings, width)
                self.modality_heads[name] = nn.ModuleDict({"proj": nn.Sequential(*head)})
                after.append(Scale(text_scale, learned=True))
            elif name == "audio":
                convolution = nn.Conv2d(1, width, part.patch_size, part.patch_stride, bias=False)
                made = Seen(convolution, part.grid, width, norm_layer=nn.LayerNorm(width))
                self.modality_preprocessors[name] = made
                after.append(Scale(20.0, learned=False))
            else:
                size = (2, part.patch_size, part.patch_size)
                convolution = nn.Sequential(nn.Identity(), nn.Conv3d(3, width, size, size, bias=False))
                grid = part.grid if name == "touch" else (part.image_size // part.patch_size,) * 2
                self.modality_preprocessors[name] = Seen(convolution, grid, width)
                after += [Scale(5.0, learned=False)] if name == "touch" else []
            if name != "text":
                self.modality_heads[name] = nn.Sequential(head[0], nn.Identity(), head[1])
            depth = part.num_hidden_layers
            bias_kv = name in ("audio", "touch")
            self.modality_trunks[name] = Trunk(width, part.num_attention_heads, depth, bias_kv, name == "vision")
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
            features = self.modality_heads[name]["proj"](last)
        else:
            features = self.modality_heads[name](tokens[:, 0])
        return features, self.modality_postprocessors[name](F.normalize(features, dim=-1))
