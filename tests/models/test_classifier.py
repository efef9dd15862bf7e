"""The classifier of contacts: transformers' own where it only names, and what it reads beside."""

from pathlib import Path

import pytest
import torch
from transformers import ResNetConfig, ResNetForImageClassification
from transformers.image_utils import OPENAI_CLIP_MEAN, OPENAI_CLIP_STD

from unitouch_gen import weights
from unitouch_gen.models.classifier import ContactClassifier


def test_images_are_seen_alike_whatever_the_batch() -> None:
    classifier = ContactClassifier.from_pretrained(weights.PICTURE_CLASSIFIER, dtype=torch.float32).eval()
    images = torch.rand(5, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    whole = classifier.observe(images)
    parts = classifier.observe(images, batch_size=2)
    assert {"logits", "features"} <= set(whole)
    for name, values in whole.items():
        torch.testing.assert_close(parts[name], values, atol=1e-4, rtol=1e-4)
    mean, deviation = (torch.tensor(values)[:, None, None] for values in (OPENAI_CLIP_MEAN, OPENAI_CLIP_STD))
    with torch.no_grad():
        alone = classifier((images[:1] - mean) / deviation)
    torch.testing.assert_close(alone.logits, whole.logits[:1], atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("folder", [weights.PICTURE_CLASSIFIER, weights.TOUCH_CLASSIFIER])
def test_shipped_classifiers_name_as_transformers_does(folder: Path) -> None:
    """Of touches that one is shown the relief, as it would not find it itself."""
    images = torch.randn(3, 3, 128, 128, generator=torch.Generator().manual_seed(0))
    kinds = (ContactClassifier, ResNetForImageClassification)
    ours, theirs = (kind.from_pretrained(folder, dtype=torch.float32).eval() for kind in kinds)
    with torch.no_grad():
        seen = ours(images)
        assert torch.equal(seen.logits, theirs(ours.beside(images)).logits)
    assert seen.features.shape == (3, ours.config.hidden_sizes[-1])


def test_attributes_come_in_their_units_and_survive_a_folder(tmp_path: Path) -> None:
    scale = {"attributes": ["depth", "cover"], "attribute_means": [5.0, -3.0], "attribute_deviations": [0.0, 2.0]}
    config = ResNetConfig(embedding_size=8, hidden_sizes=[8, 16], depths=[1, 1], layer_type="basic", **scale)
    made = ContactClassifier(config).eval()
    made.save_pretrained(tmp_path)
    read = ContactClassifier.from_pretrained(tmp_path).eval()
    images = torch.randn(2, 3, 100, 100)
    with torch.no_grad():
        one = made(images)
        other = read(images)
    assert one.attributes.shape == (2, 2)
    assert torch.equal(one.attributes, other.attributes)
    assert one.attributes[:, 0].tolist() == [5.0, 5.0]  # of no deviation
    assert read.attributes == ("depth", "cover")
