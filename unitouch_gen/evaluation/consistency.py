"""Material consistency: does a generated image show the material it was asked for? (Yang et al., 2023.)

The classifier that answers was trained on real images with labels. It shares no weights and no embedding with what
conditioned the generator.
"""

import torch
from torch import Tensor
from transformers import ResNetForImageClassification

from unitouch_gen.models.images import normalise_pixels


@torch.no_grad()
def named(classifier: ResNetForImageClassification, images: Tensor, batch_size: int = 256) -> Tensor:
    """Class the classifier gives each image, int64 (N,).

    Args:
        classifier: Takes pixels normalised as the joint space's.
        images: (N, 3, H, W) in [0, 1].
        batch_size: Images classified at once.
    """
    parts = [classifier(normalise_pixels(part)).logits.argmax(dim=1) for part in images.split(batch_size)]
    return torch.cat(parts)


def consistency(classifier: ResNetForImageClassification, images: Tensor, labels: Tensor) -> float:
    """Share of images (N, 3, H, W) in [0, 1] that the classifier names as their labels (N,)."""
    return (named(classifier, images) == labels).float().mean().item()


def agreement(classifier: ResNetForImageClassification, one: Tensor, other: Tensor) -> float:
    """Share of pairs of images (N, 3, H, W) that the classifier names alike (Section 4.6 of the paper)."""
    return (named(classifier, one) == named(classifier, other)).float().mean().item()
