"""Material consistency: does a generated image show the material it was asked for? (Yang et al., 2023.)

The classifier that answers was trained on real images with labels. It shares no weights and no embedding with what
conditioned the generator.
"""

import torch
from torch import Tensor

from unitouch_gen.models.classifier import ContactClassifier, ContactClassifierOutput
from unitouch_gen.models.images import normalise_pixels


@torch.no_grad()
def observed(classifier: ContactClassifier, images: Tensor, batch_size: int = 256) -> ContactClassifierOutput:
    """What the classifier says of images.

    Args:
        classifier: Takes pixels normalised as the joint space's.
        images: (N, 3, H, W) in [0, 1].
        batch_size: Images classified at once.
    """
    parts = [classifier(normalise_pixels(part)) for part in images.split(batch_size)]
    return type(parts[0])(**{key: torch.cat([part[key] for part in parts]) for key in parts[0]})


def named(classifier: ContactClassifier, images: Tensor, batch_size: int = 256) -> Tensor:
    """Class the classifier gives each image, int64 (N,); see `observed`."""
    return observed(classifier, images, batch_size).logits.argmax(dim=1)


def consistency(classifier: ContactClassifier, images: Tensor, labels: Tensor) -> float:
    """Share of images (N, 3, H, W) in [0, 1] that the classifier names as their labels (N,)."""
    return (named(classifier, images) == labels).float().mean().item()


def agreement(classifier: ContactClassifier, one: Tensor, other: Tensor) -> float:
    """Share of pairs of images (N, 3, H, W) that the classifier names alike (Section 4.6 of the paper)."""
    return (named(classifier, one) == named(classifier, other)).float().mean().item()
