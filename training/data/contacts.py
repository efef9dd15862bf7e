"""Contacts: their touches, pictures, sounds and texts, and their labels."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from unitouch_gen.world import ATTRIBUTES

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
        features: (N, D) by name; see `unitouch_gen.evaluation.features`.
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

    @property
    def is_touching(self) -> Tensor:
        """Whether both sensors are touched, bool (N,); all true if attributes are unknown."""
        if self.attributes is None:
            return torch.ones(len(self), dtype=torch.bool)
        return (self.attributes[:, :, ATTRIBUTES.index("cover")] > 0.01).all(dim=1)


Splits = Mapping[str, Contacts]  # by names in `SPLITS`
