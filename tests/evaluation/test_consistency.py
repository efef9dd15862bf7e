"""Material consistency, on a classifier whose answer is known."""

import torch
from torch import Tensor, nn
from transformers import ResNetConfig, ResNetForImageClassification
from transformers.modeling_outputs import ImageClassifierOutput

from unitouch_gen.evaluation.consistency import agreement, consistency, named


class BrightestChannel(nn.Module):
    """Names an image by its brightest channel."""

    def forward(self, pixels: Tensor):
        return ImageClassifierOutput(logits=pixels.mean(dim=(2, 3)))


def coloured(*channels: int) -> Tensor:
    images = torch.zeros(len(channels), 3, 4, 4)
    images[torch.arange(len(channels)), list(channels)] = 1.0
    return images


def test_each_image_is_named_whatever_the_batch() -> None:
    images = coloured(0, 2, 1, 1, 0)
    for size in (1, 2, 256):
        assert named(BrightestChannel(), images, batch_size=size).tolist() == [0, 2, 1, 1, 0]


def test_consistency_is_the_share_named_right() -> None:
    assert consistency(BrightestChannel(), coloured(0, 2, 1, 1), torch.tensor([0, 2, 1, 0])) == 0.75


def test_agreement_is_the_share_named_alike() -> None:
    assert agreement(BrightestChannel(), coloured(0, 2, 1, 1), coloured(0, 2, 2, 0)) == 0.5


def test_a_classifier_of_transformers_will_do() -> None:
    config = ResNetConfig(embedding_size=8, hidden_sizes=[8], depths=[1], layer_type="basic", num_labels=4)
    classifier = ResNetForImageClassification(config).eval()
    labels = named(classifier, torch.rand(5, 3, 32, 32))
    assert labels.shape == (5,) and labels.max() < 4
