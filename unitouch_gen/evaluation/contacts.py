"""What tables read of contacts. `unitouch_gen.training.data.Contacts` has all of it."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

from torch import Tensor


class EvaluatedContacts(Protocol):
    """N contacts of one split, with the attributes of `unitouch_gen.training.data.Contacts`."""

    touch: Any
    sensors: Sequence[str | None]
    objects: Tensor
    labels: Mapping[str, Tensor]
    classes: Mapping[str, Sequence[str]]
    image: Any
    audio: Any
    text: Sequence[str]
    gel: Any
    second: Any
    sounds: Callable[[], Any] | None
    relit: Callable[[], Tensor] | None
    asked: Callable[[], Sequence[Mapping[str, tuple[str, Sequence[str]]]]]
    features: dict[str, Tensor]

    @property
    def material(self) -> Tensor: ...

    @property
    def is_touching(self) -> Tensor: ...


Splits = Mapping[str, EvaluatedContacts]
"""Contacts by split: "train" to fit probes, "val" to choose their penalty, and "test" to measure."""
