"""What a network that was trained on photos says of the texture of an image, for the encoders of image and touch.

The trunk is EfficientNet-Lite0 (Tan & Le, 2019, "EfficientNet: Rethinking model scaling for convolutional neural
networks"; "Lite" leaves out squeeze-and-excitation and clips activations at 6) up to its eleventh block, where an image
of 128 pixels has 8 x 8 places. Means and deviations of three of its layers describe a texture wherever it lies (after
Gatys et al., 2015, "Texture synthesis using convolutional neural networks", who take all covariances).
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from unitouch_gen.models.images import denormalise_pixels

STAGES = ((16, 3, 1, 1, 1), (24, 3, 2, 6, 2), (40, 5, 2, 6, 2), (80, 3, 2, 6, 3), (112, 5, 1, 6, 3))
"""Channels, kernel, stride, expansion and number of the blocks of each stage."""

DESCRIBED = (4, 8, 10)
"""Blocks whose outputs are described: the fifth, ninth and eleventh, of 40, 112 and 112 channels."""

STATISTICS = 2 * (40 + 112 + 112)


class SamePadded(nn.Conv2d):
    """A convolution of TensorFlow: what padding an odd number of pixels needs is put behind and below."""

    def forward(self, x: Tensor) -> Tensor:
        kernel, stride = self.kernel_size[0], self.stride[0]
        rows, columns = (max((-(-side // stride) - 1) * stride + kernel - side, 0) for side in x.shape[-2:])
        padded = F.pad(x, (columns // 2, columns - columns // 2, rows // 2, rows - rows // 2))
        return super().forward(padded)


class InvertedResidual(nn.Module):
    """Expansion, depthwise convolution and projection (Sandler et al., 2018, "MobileNetV2"), norms folded into them."""

    def __init__(self, channels: int, out_channels: int, kernel: int, stride: int, expansion: int):
        super().__init__()
        hidden = channels * expansion
        self.expand = nn.Conv2d(channels, hidden, 1) if expansion > 1 else None
        self.depthwise = SamePadded(hidden, hidden, kernel, stride, groups=hidden)
        self.project = nn.Conv2d(hidden, out_channels, 1)
        self.has_skip = stride == 1 and channels == out_channels

    def forward(self, x: Tensor) -> Tensor:
        hidden = x if self.expand is None else F.relu6(self.expand(x))
        out = self.project(F.relu6(self.depthwise(hidden)))
        return x + out if self.has_skip else out


class TextureTrunk(nn.Module):
    """Texture statistics (B, 528) of raw images (B, 3, H, W) in [0, 1]; frozen."""

    def __init__(self) -> None:
        super().__init__()
        channels = 32
        self.stem = SamePadded(3, channels, 3, 2)
        self.blocks = nn.ModuleList()
        for out_channels, kernel, stride, expansion, count in STAGES:
            for number in range(count):
                block = InvertedResidual(channels, out_channels, kernel, stride if number == 0 else 1, expansion)
                self.blocks.append(block)
                channels = out_channels
        self.requires_grad_(False)

    def layers(self, images: Tensor) -> list[Tensor]:
        """Outputs (B, C, h, w) of the `DESCRIBED` blocks."""
        x = F.relu6(self.stem((images * 255.0 - 127.0) / 128.0))  # as it was trained
        outputs = []
        for number, block in enumerate(self.blocks):
            x = block(x)
            if number in DESCRIBED:
                outputs.append(x)
        return outputs

    def forward(self, images: Tensor) -> Tensor:
        statistics = list[Tensor]()
        for layer in self.layers(images):
            statistics += [layer.mean(dim=(2, 3)), layer.std(dim=(2, 3))]
        return torch.cat(statistics, dim=1)


class TextureHead(nn.Module):
    """What texture adds to an embedding, (B, 528) -> (B, D): nothing at first, as its last layer begins at zero.

    Statistics are brought to the mean and deviation that they have over the training data, which `fit` stores.
    """

    mean: Tensor
    deviation: Tensor

    def __init__(self, width: int, projection_dim: int):
        super().__init__()
        self.register_buffer("mean", torch.zeros(STATISTICS))
        self.register_buffer("deviation", torch.ones(STATISTICS))
        self.hidden = nn.Linear(STATISTICS, width)
        self.project = nn.Linear(width, projection_dim)
        nn.init.zeros_(self.project.weight)
        nn.init.zeros_(self.project.bias)

    @torch.no_grad()
    def fit(self, statistics: Tensor) -> None:
        """Stores mean and deviation of the training data's statistics (N, 528)."""
        self.mean.copy_(statistics.mean(dim=0))
        self.deviation.copy_(statistics.std(dim=0).clamp_min(1e-3))

    def forward(self, statistics: Tensor) -> Tensor:
        return self.project(F.gelu(self.hidden((statistics - self.mean) / self.deviation)))


class Texture(nn.Module):
    """Trunk and head: what the texture of images adds to their embeddings, (B, 3, H, W) normalised -> (B, D).

    Args:
        width: Hidden units of the head.
        projection_dim: D.
    """

    def __init__(self, width: int, projection_dim: int):
        super().__init__()
        self.trunk = TextureTrunk()
        self.head = TextureHead(width, projection_dim)

    def forward(self, pixel_values: Tensor) -> Tensor:
        return self.head(self.trunk(denormalise_pixels(pixel_values)))
