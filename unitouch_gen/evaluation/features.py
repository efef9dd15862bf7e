"""Features of contacts that tables are made of, by a joint space and by controls."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from unitouch_gen.evaluation.contacts import EvaluatedContacts, Splits
from unitouch_gen.evaluation.controls import statistics, untrained_like
from unitouch_gen.models import UniTouchModel, UniTouchProcessor
from unitouch_gen.models.classifier import ContactClassifier
from unitouch_gen.models.features import float_pixels, image_embeddings, in_batches, text_embeddings


@torch.no_grad()
def embed(
    model: UniTouchModel, processor: UniTouchProcessor, contacts: EvaluatedContacts, classifier: ContactClassifier
) -> dict[str, Tensor]:
    """Features (N, D) of contacts by name.

    Of the joint space: "touch", and "image", "audio" and "text", if contacts and model have them. Controls: plain
    "statistics" of the touch, an "untrained" encoder, the untouched "gel", and "supervised", a classifier of touches
    trained with labels.
    """
    touch = contacts.touch
    gel = contacts.gel
    sensors = contacts.sensors
    modalities = model.known_modalities
    at_rest = gel
    if gel is None:
        at_rest = np.broadcast_to(np.mean(touch, axis=0, dtype=np.float32), touch.shape)

    def statistics_of(rows: slice) -> np.ndarray:
        change = np.asarray(touch[rows], np.float32) - at_rest[rows]
        return statistics(list(np.moveaxis(change, 1, -1)))

    def classifier_features(rows: slice) -> Any:
        return classifier.observe(float_pixels(touch[rows])).features

    def audio_features(rows: slice) -> Tensor:
        clips = float_pixels(contacts.audio[rows]).float()[:, None]
        return model.get_audio_features(clips.to(model.device))

    def text_features(rows: slice) -> Tensor:
        return text_embeddings(model, processor, contacts.text[rows])

    features = {
        "touch": image_embeddings(model, "touch", touch, sensors),
        "untrained": image_embeddings(untrained_like(model), "touch", touch, sensors),
        "statistics": in_batches(len(touch), statistics_of),
        "supervised": in_batches(len(touch), classifier_features),
    }
    if gel is not None:
        features["gel"] = image_embeddings(model, "touch", gel, sensors)
    if contacts.image is not None and "image" in modalities:
        features["image"] = image_embeddings(model, "image", contacts.image)
    if contacts.audio is not None and "audio" in modalities:
        features["audio"] = in_batches(len(touch), audio_features)
    if contacts.text and "text" in modalities:
        features["text"] = in_batches(len(touch), text_features)
    return features


def embed_all(
    model: UniTouchModel, processor: UniTouchProcessor, splits: Splits, classifier: ContactClassifier
) -> None:
    """Gives the contacts of all splits their features."""
    for contacts in splits.values():
        contacts.features = embed(model, processor, contacts, classifier)
