"""Texture features of an ImageNet network, which the encoders of image and touch add to their embeddings.

The trunk is EfficientNet-Lite0 (Tan & Le, 2019, "EfficientNet: Rethinking model scaling for convolutional neural
networks"; "Lite" has no squeeze-and-excitation and clips activations at 6) up to its eleventh block, whose output is
8 x 8 for an image of 128 pixels. The features are the spatial means and standard deviations of three layers, as texture
is stationary (Gatys et al., 2015, "Texture synthesis using convolutional neural networks", take all covariances).
"""

from collections.abc import Sequence
from itertools import islice

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from unitouch_gen.models.images import denormalise_pixels

STAGES = ((16, 3, 1, 1, 1), (24, 3, 2, 6, 2), (40, 5, 2, 6, 2), (80, 3, 2, 6, 3), (112, 5, 1, 6, 3))
"""Channels, kernel, stride, expansion and number of the blocks of each stage."""

TAPPED = (4, 8, 10)
"""Indices of the blocks whose outputs are taken: of 40, 112 and 112 channels."""

STATISTICS = 2 * (40 + 112 + 112)
"""Number of features: a mean and a standard deviation of each channel."""


class SamePadded(nn.Conv2d):
    """A convolution with TensorFlow's "same" padding: of an odd number of pixels, the larger half is at the end."""

    def forward(self, x: Tensor) -> Tensor:
        kernel = self.kernel_size[0]
        stride = self.stride[0]
        rows, columns = (max((-(-side // stride) - 1) * stride + kernel - side, 0) for side in x.shape[-2:])
        padded = F.pad(x, (columns // 2, columns - columns // 2, rows // 2, rows - rows // 2))
        return super().forward(padded)


class InvertedResidual(nn.Module):
    """An inverted residual block (Sandler et al., 2018, "MobileNetV2"), with batch norms folded into convolutions."""

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
    """The frozen network: images (B, 3, H, W) in [0, 1] -> texture statistics (B, 528)."""

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

    def layers(self, images: Tensor, tapped: Sequence[int] = TAPPED) -> list[Tensor]:
        """Outputs (B, C, h, w) of the blocks with the indices `tapped`, in ascending order."""
        x = F.relu6(self.stem((images * 255.0 - 127.0) / 128.0))  # the normalisation it was trained with
        outputs = []
        for number, block in enumerate(islice(self.blocks, max(tapped) + 1)):
            x = block(x)
            if number in tapped:
                outputs.append(x)
        return outputs

    def forward(self, images: Tensor) -> Tensor:
        statistics = list[Tensor]()
        for layer in self.layers(images):
            statistics += [layer.mean(dim=(2, 3)), layer.std(dim=(2, 3))]
        return torch.cat(statistics, dim=1)


class TextureHead(nn.Module):
    """A two-layer perceptron, (B, 528) -> (B, D). Its output layer is initialised to zero, so it adds nothing at first.

    Statistics are standardised by the mean and deviation of the training data, which `fit` stores.
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
    """Trunk and head: normalised images (B, 3, H, W) -> what is added to their embeddings, (B, D).

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
