"""Contacts: their touches, pictures, sounds and texts, their labels, and features of encoders and controls."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm.auto import tqdm

from unitouch_gen.evaluation.controls import statistics, untrained_like
from unitouch_gen.evaluation.zero_shot import text_embeddings
from unitouch_gen.models import UniTouchModel, UniTouchProcessor
from unitouch_gen.models.classifier import ContactClassifier
from unitouch_gen.models.images import normalise_pixels

SPLITS = ("train", "val", "test")  # to fit probes, to choose their penalty, and to measure


@dataclass
class Contacts:
    """N contacts of one split. Images are uint8 (N, 3, S, S). Columns that not all contacts have are `None` or empty.

    Attributes:
        touch, second: Touch images by the contacts' own sensors, and by another sensor.
        sensors: Names of the own sensors; `None` for a sensor without a name.
        objects: Numbers of objects, int64 (N,). No two splits share one. Retrieval looks for contacts of the same one.
        labels, classes: By name, such as "material": int64 (N,), -1 if unknown, and the names of the numbers.
        image: Pictures of the contact.
        audio, text: Log-mel clips (N, 1, mel_bins, frames), and captions.
        gel: Untouched images of the sensors.
        attributes: `unitouch_gen.world.ATTRIBUTES` by either sensor, float32 (N, 2, K).
        maps: `unitouch_gen.world.MAPS` in each part of the view, float16 (N, 2, 4, 8, 8).
        sounds: Returns the sounds, as pipelines take them.
        relit: Returns the pictures under another lamp, float32 in [0, 1].
        asked: Returns, by topic, a question about each contact and its true answers.
        features: (N, D) by name; see `embed`.
        fingerprint: A hash that changes with whatever was rendered or decoded.
    """

    touch: Any  # arrays like this one are mapped into memory, or computed row by row
    sensors: Sequence[str | None]
    objects: Tensor
    labels: Mapping[str, Tensor]
    classes: Mapping[str, Sequence[str]]
    image: Any = None
    audio: Any = None
    text: Sequence[str] = ()
    gel: Any = None
    second: Any = None
    attributes: Any = None
    maps: Any = None
    sounds: Callable[[], Any] | None = None
    relit: Callable[[], Tensor] | None = None
    asked: Callable[[], Sequence[Mapping[str, tuple[str, Sequence[str]]]]] = tuple
    features: dict[str, Tensor] = field(default_factory=dict)
    fingerprint: str = ""

    def __len__(self) -> int:
        return len(self.objects)

    @property
    def material(self) -> Tensor:
        """Numbers of materials, int64 (N,); all -1 if they are unknown."""
        return self.labels.get("material", torch.full_like(self.objects, -1))


Splits = Mapping[str, Contacts]  # by names in `SPLITS`


def float_pixels(images: Any) -> Tensor:
    """Images (N, 3, S, S) in [0, 1], from uint8 or from floats in [0, 1]."""
    values = torch.from_numpy(np.array(images))
    return values if values.is_floating_point() else values.float() / 255


@torch.no_grad()
def embed(
    model: UniTouchModel, processor: UniTouchProcessor, contacts: Contacts, classifier: ContactClassifier
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


@torch.no_grad()
def image_embeddings(model: UniTouchModel, modality: str, images: Any, sensors: Sequence[str | None] = ()) -> Tensor:
    """Features (N, D) of pictures or touches (N, 3, S, S); a sensor that the model does not know is retrieved."""
    named = [name if name in model.config.sensors else None for name in sensors or [None] * len(images)]

    def encode(rows: slice) -> Tensor:
        pixels = normalise_pixels(float_pixels(images[rows])).to(model.device)
        if modality == "image":
            return model.get_image_features(pixels)
        sensor_ids = model.sensor_ids(model.match_sensors(pixels, named[rows]))
        return model.get_touch_features(pixels, sensor_ids)

    return in_batches(len(images), encode)


def in_batches(count: int, encode: Callable[[slice], Any], size: int = 128) -> Tensor:
    """Applies `encode` to slices of `count` samples, and joins its rows as floats on the CPU."""
    rows = list[Tensor]()
    for start in tqdm(range(0, count, size), mininterval=5.0, leave=False, disable=None):
        batch = encode(slice(start, start + size))
        rows.append(torch.as_tensor(batch).float().cpu())
    return torch.cat(rows)
