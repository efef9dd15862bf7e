"""The vision transformer of touch and audio.

Pre-norm blocks with exact GELU (Dosovitskiy et al., 2021) and two additions: prefix tokens that enter between the
class token and the patches (the paper's sensor tokens, Section 3.2), and one learned key and value appended to every
attention (`nn.MultiheadAttention(add_bias_kv=True)`), which ImageBind's audio and the published touch trunk have.

With weights of half precision the residual stream and the norms stay in float32. Rounding the stream after each of its
48 terms raises the error of the full size's embeddings from 0.9 % to 1.6 % in bfloat16.
"""

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from transformers import CLIPVisionConfig, CLIPVisionModelWithProjection
from transformers.models.clip.modeling_clip import CLIPVisionEmbeddings

from unitouch_gen.models.config import UniTouchViTConfig
from unitouch_gen.models.images import local_mean
from unitouch_gen.models.relief import RELIEF_CHANNELS, ConcatRelief
from unitouch_gen.models.texture import Texture


class StreamNorm(nn.LayerNorm):
    """A norm of the residual stream: computed in the stream's dtype, returned in the weights'."""

    def forward(self, x: Tensor) -> Tensor:
        weight = self.weight.to(x.dtype)
        bias = self.bias.to(x.dtype)
        return F.layer_norm(x, self.normalized_shape, weight, bias, self.eps).to(self.weight.dtype)


class Block(nn.Module):
    """Attention and MLP, each behind a norm, (B, T, width) -> the same."""

    def __init__(self, config: UniTouchViTConfig):
        super().__init__()
        width = config.hidden_size
        hidden = int(config.mlp_ratio * width)
        self.norm_1 = StreamNorm(width, eps=config.layer_norm_eps)
        self.attention = nn.MultiheadAttention(
            width, config.num_attention_heads, add_bias_kv=config.add_bias_kv, batch_first=True
        )
        self.norm_2 = StreamNorm(width, eps=config.layer_norm_eps)
        self.mlp = nn.Sequential(nn.Linear(width, hidden), nn.GELU(), nn.Linear(hidden, width))

    def forward(self, x: Tensor) -> Tensor:
        normed = self.norm_1(x)
        x = x + self.attention(normed, normed, normed, need_weights=False)[0]
        return x + self.mlp(self.norm_2(x))


class LocalContrast(nn.Module):
    """An image and its detail, (B, C, H, W) -> (B, 2 C, H, W).

    Detail is the difference from the mean over 6 % of the side, divided by its deviation in the image. The smooth part
    and the contrast of a touch depend on lamps and gel; the rest depends on what presses into the gel.
    """

    def __init__(self, side: int):
        super().__init__()
        self.reach = int(0.06 * side) // 2

    def forward(self, pixels: Tensor) -> Tensor:
        detail = pixels - local_mean(local_mean(pixels, self.reach), self.reach)
        deviation = detail.square().mean(dim=(1, 2, 3), keepdim=True).sqrt()
        detail = (detail / (deviation + 0.03)).clamp(-4.0, 4.0)  # a deviation of 0.03 is about the noise
        return torch.cat([pixels, detail], dim=1)


class Residual(nn.Module):
    """A residual convolution (He et al., 2016), (B, C, H, W) -> the same."""

    def __init__(self, channels: int):
        super().__init__()
        self.convolution = nn.Conv2d(channels, channels, 3, padding=1, bias=False)
        self.norm = nn.BatchNorm2d(channels)

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(x + self.norm(self.convolution(x)))


def residual_stem(config: Any, side: int) -> list[nn.Module]:
    """Layers from an image to its patches: local contrast or relief, convolutions that halve it, a projection.

    Each halving is a stride-2 convolution and a residual one. Norms are over the batch: a norm over the sample removes
    its contrast, and touches of random sensors are then hardly distinguished. `side` is the images' shorter side.
    """
    layers: list[nn.Module]
    if getattr(config, "stem", "residual") == "relief":
        layers = [ConcatRelief()]
        channels = config.num_channels + RELIEF_CHANNELS
    else:
        layers = [LocalContrast(side)]
        channels = 2 * config.num_channels
    halvings = config.patch_size.bit_length() - 1
    for level in range(halvings):
        width = max(config.hidden_size >> (halvings - 1 - level), 16)  # doubles at each level, up to `hidden_size`
        layers += [
            nn.Conv2d(channels, width, 3, stride=2, padding=1, bias=False),
            nn.BatchNorm2d(width),
            nn.ReLU(),
            Residual(width),
        ]
        channels = width
    # The last norm removes what all images share, which would be most of the patches' mean.
    return [*layers, nn.Conv2d(channels, config.hidden_size, 1), nn.BatchNorm2d(config.hidden_size)]


class PatchProjection(nn.Module):
    """A position-wise head on patches that is added to the embedding, (B, patches, width) -> (B, D).

    The class token of a small transformer learns what is in a view long before it learns where it is.
    """

    def __init__(self, config: Any, patches: int):
        super().__init__()
        self.norm = StreamNorm(config.hidden_size, eps=config.layer_norm_eps)
        self.reduce = nn.Linear(config.hidden_size, config.patch_channels)
        self.project = nn.Linear(patches * config.patch_channels, config.projection_dim, bias=False)

    def forward(self, patches: Tensor) -> Tensor:
        return self.project(F.gelu(self.reduce(self.norm(patches))).flatten(1))


class UniTouchViT(nn.Module):
    """One encoder with projection: (B, C, H, W) -> (B, D), not normalised.

    With the stems "residual" and "relief" the class token starts at the mean of the patches.
    """

    def __init__(self, config: UniTouchViTConfig):
        super().__init__()
        width = config.hidden_size
        self.starts_at_mean = config.stem != "patch"
        if self.starts_at_mean:
            side = min(config.image_height, config.image_width)
            self.stem: nn.Module = nn.Sequential(*residual_stem(config, side))
        else:  # without a bias, as in CLIP
            self.stem = nn.Conv2d(config.num_channels, width, config.patch_size, config.patch_stride, bias=False)
        self.stem_norm = nn.LayerNorm(width, eps=1e-5) if config.stem_norm else None
        rows, columns = config.grid
        self.class_token = nn.Parameter(torch.zeros(1, 1, width))
        self.position = nn.Parameter(torch.zeros(1, 1 + rows * columns, width))
        self.blocks = nn.ModuleList(Block(config) for _ in range(config.num_hidden_layers))
        self.norm = StreamNorm(width, eps=config.layer_norm_eps)
        self.projection = nn.Linear(width, config.projection_dim, bias=False)
        self.patch_projection = PatchProjection(config, rows * columns) if config.patch_channels else None
        self.texture = Texture(config.texture_width, config.projection_dim) if config.texture_width else None

    def forward(self, pixels: Tensor, prefix: Tensor | None = None) -> Tensor:
        """Embeddings (B, D), not normalised, of normalised pixels (B, C, H, W).

        The prefix, (B, L, width), is put between class token and patches; it carries no position.
        """
        embeds = self.embed(self.tokens(self.stem(pixels), prefix))
        return embeds if self.texture is None else embeds + self.texture(pixels)

    def embed(self, tokens: Tensor) -> Tensor:
        """Embeddings (B, D) of the blocks' output, see `tokens`, with or without the prefix."""
        embeds = self.projection(self.norm(tokens[:, 0]))
        if self.patch_projection is not None:
            embeds = embeds + self.patch_projection(tokens[:, 1 - self.position.shape[1] :])
        return embeds

    def tokens(self, patches: Tensor, prefix: Tensor | None = None) -> Tensor:
        """Output of the blocks, (B, 1 + L + patches, width), of the stem's, (B, width, h, w).

        In order: class token, prefix, patches by rows; see `forward`.
        """
        x = patches.flatten(2).transpose(1, 2)  # (B, patches, width)
        if self.stem_norm is not None:
            x = self.stem_norm(x)
        x = torch.cat([self.class_token.to(x.dtype).expand(len(x), -1, -1), x], dim=1)
        if self.starts_at_mean:
            x = start_at_mean(x)
        x = x.to(torch.promote_types(x.dtype, torch.float32)) + self.position
        if prefix is not None:
            x = torch.cat([x[:, :1], prefix.to(x.dtype), x[:, 1:]], dim=1)
        for block in self.blocks:
            x = block(x)
        return x


def start_at_mean(tokens: Tensor) -> Tensor:
    """Adds the mean of the patch tokens to the class token, (B, 1 + patches, width) -> the same.

    With the class token alone, the blocks would first have to learn to attend to the patches.
    """
    class_token = tokens[:, :1]
    patches = tokens[:, 1:]
    return torch.cat([class_token + patches.mean(dim=1, keepdim=True), patches], dim=1)


def initialise(module: nn.Module) -> None:
    """Truncated normals for weights and tokens, with a deviation of 0.02, and zeros for biases (as in ViT and CLIP)."""
    if isinstance(module, nn.Linear | nn.Conv2d):
        std = 0.02 if isinstance(module, nn.Linear) else module.weight[0].numel() ** -0.5
        nn.init.trunc_normal_(module.weight, std=std)
        if module.bias is not None:
            nn.init.zeros_(module.bias)
    for name in ("in_proj_weight", "bias_k", "bias_v", "class_token", "position"):
        parameter = getattr(module, name, None)
        if isinstance(parameter, nn.Parameter):
            nn.init.trunc_normal_(parameter, std=0.02)


# CLIP's vision tower behind a stem of convolutions --------------------------------------------------------------------


class Stem(nn.Sequential):
    """`residual_stem` in the place of CLIP's convolution, whose `weight` transformers reads the dtype of."""

    @property
    def weight(self) -> Tensor:
        return self[-2].weight  # type: ignore[return-value]


class StemmedEmbeddings(CLIPVisionEmbeddings):
    """Patch tokens from a stem of convolutions; the class token starts at their mean."""

    def __init__(self, config: Any):
        super().__init__(config)
        self.patch_embedding = Stem(*residual_stem(config, config.image_size)).apply(initialise)  # type: ignore[assignment]

    def forward(self, pixel_values: Tensor, interpolate_pos_encoding: bool = False) -> Tensor:
        tokens = super().forward(pixel_values, interpolate_pos_encoding=interpolate_pos_encoding)
        return start_at_mean(tokens)


class StemmedCLIPVisionModel(CLIPVisionModelWithProjection):
    """`CLIPVisionModelWithProjection` with patches from residual convolutions (Xiao et al., 2021).

    Args:
        config: With a `patch_size` that is a power of two and divides `image_size`, and perhaps `patch_channels` and
            `texture_width`, as `UniTouchViTConfig` has them.
    """

    def __init__(self, config: CLIPVisionConfig):
        super().__init__(config)
        self.vision_model.embeddings = StemmedEmbeddings(config)
        self.patch_projection: PatchProjection | None = None
        if getattr(config, "patch_channels", 0):
            patches = self.vision_model.embeddings.num_patches
            self.patch_projection = PatchProjection(config, patches).apply(initialise)
        self.texture: Texture | None = None
        if getattr(config, "texture_width", 0):
            self.texture = Texture(config.texture_width, config.projection_dim)

    def forward(self, pixel_values: Tensor, **options: Any) -> Any:
        output: Any = super().forward(pixel_values, **options)
        if self.patch_projection is not None:
            patches = output.last_hidden_state[:, 1:]
            output.image_embeds = output.image_embeds + self.patch_projection(patches)
        if self.texture is not None:
            output.image_embeds = output.image_embeds + self.texture(pixel_values)
        return output
