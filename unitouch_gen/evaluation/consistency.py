"""Material consistency: does a generated image show the material it was asked for? (Yang et al., 2023.)

The judge is a classifier trained on real images with labels. It shares no weights and no embedding with what
conditioned the generator.
"""

import torch
from torch import Tensor
from transformers import ResNetForImageClassification

from unitouch_gen.models.images import normalise_pixels


@torch.no_grad()
def named(judge: ResNetForImageClassification, images: Tensor, batch_size: int = 256) -> Tensor:
    """Class the judge gives each image, int64 (N,).

    Args:
        judge: Takes pixels normalised as the joint space's.
        images: (N, 3, H, W) in [0, 1].
        batch_size: Images judged at once.
    """
    parts = [judge(normalise_pixels(part)).logits.argmax(dim=1) for part in images.split(batch_size)]
    return torch.cat(parts)


def consistency(judge: ResNetForImageClassification, images: Tensor, labels: Tensor) -> float:
    """Share of images (N, 3, H, W) in [0, 1] that the judge names as their labels (N,)."""
    return (named(judge, images) == labels).float().mean().item()


def agreement(judge: ResNetForImageClassification, one: Tensor, other: Tensor) -> float:
    """Share of pairs of images (N, 3, H, W) that the judge names alike (Section 4.6 of the paper)."""
    return (named(judge, one) == named(judge, other)).float().mean().item()
