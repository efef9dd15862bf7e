"""Classifiers of contacts with random weights."""

from transformers import ResNetConfig

from unitouch_gen.models.classifier import ContactClassifier


def classifier(*attributes: str) -> ContactClassifier:
    """One that reads attributes; three of them if none is named."""
    names = list(attributes) or ["cover", "grain x", "grain y"]
    scale = {"attribute_means": [0.0] * len(names), "attribute_deviations": [1.0] * len(names)}
    config = ResNetConfig(embedding_size=8, hidden_sizes=[8], depths=[1], layer_type="basic", attributes=names, **scale)
    return ContactClassifier(config).eval()
