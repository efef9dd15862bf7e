"""CompVis' latent diffusion in plain PyTorch, for comparison: the networks of Rombach et al. (2022) with modules named
as in their checkpoints, in as few lines as that takes. Nothing here is of diffusers.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn


def group_norm(channels: int, eps: float) -> nn.GroupNorm:
    return nn.GroupNorm(32, channels, eps=eps)


class Named(nn.Module):
    """Modules by name, None left out."""

    def __init__(self, **modules: nn.Module | None):
        super().__init__()
        for name, module in modules.items():
            if module is not None:
                self.add_module(name, module)


# UNet -----------------------------------------------------------------------------------------------------------------


class ResBlock(nn.Module):
    def __init__(self, channels: int, out: int, width: int, scale_shift: bool):
        super().__init__()
        self.scale_shift = scale_shift
        self.in_layers = nn.Sequential(group_norm(channels, 1e-5), nn.SiLU(), nn.Conv2d(channels, out, 3, padding=1))
        self.emb_layers = nn.Sequential(nn.SiLU(), nn.Linear(width, 2 * out if scale_shift else out))
        self.out_layers = nn.Sequential(
            group_norm(out, 1e-5), nn.SiLU(), nn.Dropout(0.0), nn.Conv2d(out, out, 3, padding=1)
        )
        self.skip_connection = nn.Identity() if channels == out else nn.Conv2d(channels, out, 1)

    def forward(self, x: Tensor, emb: Tensor, context: Tensor) -> Tensor:
        h, emb = self.in_layers(x), self.emb_layers(emb)[..., None, None]
        if self.scale_shift:
            scale, shift = emb.chunk(2, dim=1)
            h = self.out_layers[1:](self.out_layers[0](h) * (1 + scale) + shift)
        else:
            h = self.out_layers(h + emb)
        return self.skip_connection(x) + h


class CrossAttention(nn.Module):
    def __init__(self, channels: int, context: int, heads: int):
        super().__init__()
        self.heads = heads
        self.to_q = nn.Linear(channels, channels, bias=False)
        self.to_k = nn.Linear(context, channels, bias=False)
        self.to_v = nn.Linear(context, channels, bias=False)
        self.to_out = nn.Sequential(nn.Linear(channels, channels), nn.Dropout(0.0))

    def forward(self, x: Tensor, context: Tensor) -> Tensor:
        q, k, v = (
            part.unflatten(-1, (self.heads, -1)).transpose(1, 2)  # (B, heads, tokens, C / heads)
            for part in (self.to_q(x), self.to_k(context), self.to_v(context))
        )
        weights = (q @ k.transpose(-1, -2) / math.sqrt(q.shape[-1])).softmax(dim=-1)
        return self.to_out((weights @ v).transpose(1, 2).flatten(2))


class GatedLinear(nn.Module):
    def __init__(self, channels: int, out: int):
        super().__init__()
        self.proj = nn.Linear(channels, 2 * out)

    def forward(self, x: Tensor) -> Tensor:
        value, gate = self.proj(x).chunk(2, dim=-1)
        return value * F.gelu(gate)


class TransformerBlock(nn.Module):
    def __init__(self, channels: int, context: int, heads: int):
        super().__init__()
        self.attn1 = CrossAttention(channels, channels, heads)
        wide = 4 * channels
        self.ff = Named(net=nn.Sequential(GatedLinear(channels, wide), nn.Dropout(0.0), nn.Linear(wide, channels)))
        self.attn2 = CrossAttention(channels, context, heads)
        self.norm1, self.norm2, self.norm3 = (nn.LayerNorm(channels) for _ in range(3))

    def forward(self, x: Tensor, context: Tensor) -> Tensor:
        h = self.norm1(x)
        x = x + self.attn1(h, h)
        x = x + self.attn2(self.norm2(x), context)
        return x + self.ff.net(self.norm3(x))


class SpatialTransformer(nn.Module):
    def __init__(self, channels: int, context: int, heads: int, depth: int, linear: bool):
        super().__init__()
        self.linear = linear
        self.norm = group_norm(channels, 1e-6)
        self.proj_in, self.proj_out = (
            nn.Linear(channels, channels) if linear else nn.Conv2d(channels, channels, 1) for _ in range(2)
        )
        self.transformer_blocks = nn.ModuleList(TransformerBlock(channels, context, heads) for _ in range(depth))

    def forward(self, x: Tensor, emb: Tensor, context: Tensor) -> Tensor:
        def tokens(h: Tensor) -> Tensor:  # (B, C, H, W) -> (B, H W, C)
            return h.flatten(2).transpose(1, 2)

        def pixels(h: Tensor) -> Tensor:
            return h.transpose(1, 2).unflatten(2, x.shape[2:])

        h = self.norm(x)
        h = self.proj_in(tokens(h)) if self.linear else tokens(self.proj_in(h))
        for block in self.transformer_blocks:
            h = block(h, context)
        return x + (pixels(self.proj_out(h)) if self.linear else self.proj_out(pixels(h)))


class Downsample(nn.Module):
    def __init__(self, channels: int):
        super().__init__()
        self.op = nn.Conv2d(channels, channels, 3, stride=2, padding=1)

    def forward(self, x: Tensor, *_: Tensor) -> Tensor:
        return self.op(x)


class Upsample(nn.Module):
    def __init__(self, channels: int):
        super().__init__()
        self.conv = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: Tensor, *_: Tensor) -> Tensor:
        return self.conv(x.repeat_interleave(2, dim=2).repeat_interleave(2, dim=3))


class First(nn.Conv2d):
    def forward(self, x: Tensor, *_: Tensor) -> Tensor:
        return super().forward(x)


def run(block: nn.Module, x: Tensor, emb: Tensor, context: Tensor) -> Tensor:
    for layer in block:
        x = layer(x, emb, context)
    return x


class UNet(nn.Module):
    """Latents (B, C, h, w), timesteps (B,) and context (B, N, D) -> (B, C, h, w); settings as in the YAML file."""

    def __init__(self, settings: dict):
        super().__init__()
        channels, levels = settings["model_channels"], settings["channel_mult"]
        layers, factors = settings["num_res_blocks"], settings["attention_resolutions"]
        self.channels, width = channels, 4 * channels
        scale_shift = settings.get("use_scale_shift_norm", False)

        def res(inside: int, out: int) -> ResBlock:
            return ResBlock(inside, out, width, scale_shift)

        def attention(inside: int) -> SpatialTransformer:
            size = settings.get("num_head_channels", -1)
            heads = settings["num_heads"] if size == -1 else inside // size
            linear = settings.get("use_linear_in_transformer", False)
            return SpatialTransformer(inside, settings["context_dim"], heads, settings["transformer_depth"], linear)

        self.time_embed = nn.Sequential(nn.Linear(channels, width), nn.SiLU(), nn.Linear(width, width))
        now, skips, factor = channels, [channels], 1
        self.input_blocks = nn.ModuleList([nn.ModuleList([First(settings["in_channels"], channels, 3, padding=1)])])
        for level, multiple in enumerate(levels):
            for _ in range(layers):
                block = [res(now, channels * multiple)]
                now = channels * multiple
                self.input_blocks.append(nn.ModuleList(block + [attention(now)] * (factor in factors)))
                skips.append(now)
            if level < len(levels) - 1:
                self.input_blocks.append(nn.ModuleList([Downsample(now)]))
                skips.append(now)
                factor *= 2
        self.middle_block = nn.ModuleList([res(now, now), attention(now), res(now, now)])
        self.output_blocks = nn.ModuleList()
        for level, multiple in reversed(list(enumerate(levels))):
            for layer in range(layers + 1):
                block = [res(now + skips.pop(), channels * multiple)]
                now = channels * multiple
                block += [attention(now)] * (factor in factors)
                if level and layer == layers:
                    block.append(Upsample(now))
                    factor //= 2
                self.output_blocks.append(nn.ModuleList(block))
        self.out = nn.Sequential(
            group_norm(now, 1e-5), nn.SiLU(), nn.Conv2d(now, settings["out_channels"], 3, padding=1)
        )

    def forward(self, x: Tensor, timesteps: Tensor, context: Tensor) -> Tensor:
        half = self.channels // 2
        rates = torch.exp(-math.log(10_000) * torch.arange(half) / half)
        phases = timesteps[:, None].float() * rates
        emb, skips = self.time_embed(torch.cat([phases.cos(), phases.sin()], dim=1)), []
        for block in self.input_blocks:
            x = run(block, x, emb, context)
            skips.append(x)
        x = run(self.middle_block, x, emb, context)
        for block in self.output_blocks:
            x = run(block, torch.cat([x, skips.pop()], dim=1), emb, context)
        return self.out(x)


# Autoencoders ---------------------------------------------------------------------------------------------------------


class ResnetBlock(nn.Module):
    def __init__(self, channels: int, out: int):
        super().__init__()
        self.norm1, self.norm2 = group_norm(channels, 1e-6), group_norm(out, 1e-6)
        self.conv1, self.conv2 = nn.Conv2d(channels, out, 3, padding=1), nn.Conv2d(out, out, 3, padding=1)
        if channels != out:
            self.nin_shortcut = nn.Conv2d(channels, out, 1)

    def forward(self, x: Tensor) -> Tensor:
        h = self.conv2(F.silu(self.norm2(self.conv1(F.silu(self.norm1(x))))))
        return h + (self.nin_shortcut(x) if hasattr(self, "nin_shortcut") else x)


class AttnBlock(nn.Module):
    def __init__(self, channels: int):
        super().__init__()
        self.norm = group_norm(channels, 1e-6)
        self.q, self.k, self.v, self.proj_out = (nn.Conv2d(channels, channels, 1) for _ in range(4))

    def forward(self, x: Tensor) -> Tensor:
        h = self.norm(x)
        q, k, v = (part(h).flatten(2) for part in (self.q, self.k, self.v))  # (B, C, pixels)
        weights = (q.transpose(1, 2) @ k / math.sqrt(q.shape[1])).softmax(dim=-1)
        return x + self.proj_out((v @ weights.transpose(1, 2)).unflatten(2, x.shape[2:]))


class Halve(nn.Module):
    def __init__(self, channels: int):
        super().__init__()
        self.conv = nn.Conv2d(channels, channels, 3, stride=2)

    def forward(self, x: Tensor) -> Tensor:
        return self.conv(F.pad(x, (0, 1, 0, 1)))  # right and below


def middle(channels: int) -> Named:
    return Named(
        block_1=ResnetBlock(channels, channels), attn_1=AttnBlock(channels), block_2=ResnetBlock(channels, channels)
    )


def through(mid: Named, h: Tensor) -> Tensor:
    return mid.block_2(mid.attn_1(mid.block_1(h)))


def chain(channels: int, out: int, count: int) -> nn.ModuleList:
    return nn.ModuleList(ResnetBlock(out if number else channels, out) for number in range(count))


class Encoder(nn.Module):
    def __init__(self, settings: dict, out: int):
        super().__init__()
        widths = [settings["ch"] * multiple for multiple in settings["ch_mult"]]
        self.conv_in = nn.Conv2d(settings["in_channels"], widths[0], 3, padding=1)
        self.down, now = nn.ModuleList(), widths[0]
        for level, width in enumerate(widths):
            smaller = Halve(width) if level < len(widths) - 1 else None
            self.down.append(Named(block=chain(now, width, settings["num_res_blocks"]), downsample=smaller))
            now = width
        self.mid, self.norm_out = middle(now), group_norm(now, 1e-6)
        self.conv_out = nn.Conv2d(now, out, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        h = self.conv_in(x)
        for level in self.down:
            for block in level.block:
                h = block(h)
            h = level.downsample(h) if hasattr(level, "downsample") else h
        return self.conv_out(F.silu(self.norm_out(through(self.mid, h))))


class Decoder(nn.Module):
    def __init__(self, settings: dict):
        super().__init__()
        widths = [settings["ch"] * multiple for multiple in settings["ch_mult"]]
        now = widths[-1]
        self.conv_in, self.mid = nn.Conv2d(settings["z_channels"], now, 3, padding=1), middle(now)
        levels = []
        for level, width in reversed(list(enumerate(widths))):
            larger = Upsample(width) if level else None
            levels.append(Named(block=chain(now, width, settings["num_res_blocks"] + 1), upsample=larger))
            now = width
        self.up = nn.ModuleList(reversed(levels))  # numbered from the largest, run from the smallest
        self.norm_out, self.conv_out = group_norm(now, 1e-6), nn.Conv2d(now, settings["out_ch"], 3, padding=1)

    def forward(self, z: Tensor) -> Tensor:
        h = through(self.mid, self.conv_in(z))
        for level in reversed(self.up):
            for block in level.block:
                h = block(h)
            h = level.upsample(h) if hasattr(level, "upsample") else h
        return self.conv_out(F.silu(self.norm_out(h)))


class Autoencoder(nn.Module):
    """KL, or VQ if the settings have a codebook: pixels (B, 3, H, W) -> latents (B, C, h, w) and back."""

    def __init__(self, settings: dict):
        super().__init__()
        networks, width = settings["ddconfig"], settings["embed_dim"]
        parts = 1 if "n_embed" in settings else 2  # a KL model encodes mean and logarithm of the variance
        self.encoder, self.decoder = Encoder(networks, parts * networks["z_channels"]), Decoder(networks)
        self.quant_conv = nn.Conv2d(parts * networks["z_channels"], parts * width, 1)
        self.post_quant_conv = nn.Conv2d(width, networks["z_channels"], 1)
        if "n_embed" in settings:
            self.quantize = Named(embedding=nn.Embedding(settings["n_embed"], width))
            self.loss = Named(discriminator=nn.Conv2d(3, 4, 4))

    def encode(self, pixels: Tensor) -> Tensor:
        """The mode of a KL model, and latents of a VQ model before they are quantised."""
        moments = self.quant_conv(self.encoder(pixels))
        return moments if hasattr(self, "quantize") else moments.chunk(2, dim=1)[0]

    def decode(self, z: Tensor) -> Tensor:
        if hasattr(self, "quantize"):
            codes = self.quantize.embedding.weight  # (K, C)
            distances = (z[:, None] - codes[None, :, :, None, None]).square().sum(dim=2)  # (B, K, h, w)
            z = codes[distances.argmin(dim=1)].permute(0, 3, 1, 2)
        return self.decoder(self.post_quant_conv(z))


def random_weights(module: nn.Module, seed: int) -> nn.Module:
    """Every tensor drawn, so that none may be exchanged for another; values stay near 1 through the layers."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, tensor in module.named_parameters():
            scale = 1 / math.sqrt(tensor[0].numel()) if tensor.ndim > 1 and "embedding" not in name else 0.3
            start = 1.0 if tensor.ndim == 1 and name.endswith("weight") else 0.0  # of normalisation
            tensor.copy_(start + scale * torch.randn(tensor.shape, generator=generator))
    return module.eval()
