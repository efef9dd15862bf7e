"""Contacts that a model is held against: what it makes of them, what they are, and which of them may be fitted to."""

from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor

SPLITS = ("train", "val", "test")
"""What probes are fitted to, what their strength is chosen by, and what figures are of."""


@dataclass(frozen=True)
class Contacts:
    """Contacts of one split.

    Attributes:
        features: By name, (N, D) each: of the joint space "touch", "image", "audio" and "text", as far as there are
            such; of controls "statistics", "relief", "untrained" (and "untrained 1" and so on, by seed) and "gel".
        labels: By name, such as "material", int64 (N,): -1 where one is not known.
        objects: What splits do not share and retrieval looks for, int64 (N,).
    """

    features: Mapping[str, Tensor]
    labels: Mapping[str, Tensor]
    objects: Tensor

    def __len__(self) -> int:
        return len(self.objects)

    def by_seed(self, name: str) -> list[Tensor]:
        """Features of a name by each seed that there are some of."""
        return [values for known, values in self.features.items() if known.partition(" ")[0] == name]


@dataclass(frozen=True)
class EvaluationSet:
    """A data set, or the contacts of one world by one sensor.

    Attributes:
        name: Of the set; the same for all seeds of the world.
        known: Whether the model was trained on its sensor: "in domain".
        classes: Names of the classes of each label, by number.
        splits: Some of `SPLITS`.
        seed: Of the world; 0 of a data set.
        fingerprint: What changes when the contacts do.
    """

    name: str
    known: bool
    classes: Mapping[str, tuple[str, ...]]
    splits: Mapping[str, Contacts]
    seed: int = 0
    fingerprint: str = ""
