"""Contacts: what was seen, heard and said of each, what it is, and what encoders and controls make of it."""

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

SPLITS = ("train", "val", "test")  # that probes are fitted to, that their strength is chosen by, and that is measured


@dataclass
class Contacts:
    """N contacts of one split. Images are uint8 (N, 3, S, S); `None` or empty is what is not known of all of them.

    Attributes:
        touch, second: Touch images by the contacts' own sensors, and by another one.
        sensors: Names of the first; `None` where nobody named one.
        objects: No two splits share one; retrieval finds contacts of the same one. int64 (N,).
        labels, classes: By name, such as "material": int64 (N,), -1 if unknown; and what each number stands for.
        image: Pictures of the contact.
        audio, text: Log-mel clips (N, 1, mel_bins, frames), and captions.
        gel: What each sensor sees untouched.
        attributes: `unitouch_gen.world.ATTRIBUTES` by either sensor, float32 (N, 2, K).
        maps: `unitouch_gen.world.MAPS` in each part of the view, float16 (N, 2, 4, 8, 8).
        sounds: Gives the sounds, as pipelines take them.
        relit: Gives the pictures under another lamp, float32 in [0, 1].
        asked: Gives, by topic, a question about each contact, and answers that are true.
        features: (N, D) by name; see `embed`.
        fingerprint: Changes with any of what was rendered or decoded.
    """

    touch: Any  # such arrays are mapped into memory, or computed row by row
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
        """int64 (N,); all -1 where no material is known."""
        return self.labels.get("material", torch.full_like(self.objects, -1))


Splits = Mapping[str, Contacts]  # by some of `SPLITS`


def float_pixels(images: Any) -> Tensor:
    """Images (N, 3, S, S) in [0, 1], of bytes or of floats that are so already."""
    values = torch.from_numpy(np.array(images))
    return values if values.is_floating_point() else values.float() / 255


@torch.no_grad()
def embed(
    model: UniTouchModel, processor: UniTouchProcessor, contacts: Contacts, classifier: ContactClassifier
) -> dict[str, Tensor]:
    """Features (N, D) of contacts by name.

    Of the joint space: "touch", and "image", "audio" and "text" where contacts and model have them. Controls: plain
    "statistics" of the touch, an "untrained" encoder, the untouched "gel", and "supervised", a classifier of touches
    trained with labels.
    """
    touch = contacts.touch
    gel = contacts.gel
    sensors = contacts.sensors
    known = model.known_modalities
    at_rest = np.broadcast_to(np.mean(touch, axis=0, dtype=np.float32), touch.shape) if gel is None else gel

    def plain(rows: slice) -> np.ndarray:
        change = np.asarray(touch[rows], np.float32) - at_rest[rows]
        return statistics(list(np.moveaxis(change, 1, -1)))

    def heard(rows: slice) -> Tensor:
        return model.get_audio_features(float_pixels(contacts.audio[rows]).float()[:, None].to(model.device))

    found = {
        "touch": image_embeddings(model, "touch", touch, sensors),
        "untrained": image_embeddings(untrained_like(model), "touch", touch, sensors),
        "statistics": in_batches(len(touch), plain),
        "supervised": in_batches(len(touch), lambda rows: classifier.observe(float_pixels(touch[rows])).features),
    }
    if gel is not None:
        found["gel"] = image_embeddings(model, "touch", gel, sensors)
    if contacts.image is not None and "image" in known:
        found["image"] = image_embeddings(model, "image", contacts.image)
    if contacts.audio is not None and "audio" in known:
        found["audio"] = in_batches(len(touch), heard)
    if contacts.text and "text" in known:
        found["text"] = in_batches(len(touch), lambda rows: text_embeddings(model, processor, contacts.text[rows]))
    return found


@torch.no_grad()
def image_embeddings(model: UniTouchModel, modality: str, images: Any, sensors: Sequence[str | None] = ()) -> Tensor:
    """Features (N, D) of pictures or touches (N, 3, S, S); a sensor that the model does not know is retrieved."""
    known = [name if name in model.config.sensors else None for name in sensors or [None] * len(images)]

    def encode(rows: slice) -> Tensor:
        pixels = normalise_pixels(float_pixels(images[rows])).to(model.device)
        if modality == "image":
            return model.get_image_features(pixels)
        return model.get_touch_features(pixels, model.sensor_ids(model.match_sensors(pixels, known[rows])))

    return in_batches(len(images), encode)


def in_batches(count: int, encode: Callable[[slice], Any], size: int = 128) -> Tensor:
    """Float rows of what `encode` makes of slices of `count` samples."""
    starts = tqdm(range(0, count, size), mininterval=5.0, leave=False, disable=None)
    return torch.cat([torch.as_tensor(encode(slice(start, start + size))).float().cpu() for start in starts])
