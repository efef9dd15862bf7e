"""Sensor tokens and their retrieval (Section 3.2 of the paper, "Inference")."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import NoneType

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from unitouch_gen.errors import InvalidInputError, check_choice, check_kind, describe, one_each

Sensors = str | Sequence[str | None] | None
"""A name for all images, one for each, or `None` to retrieve them."""


@dataclass(frozen=True)
class SensorMatch:
    """The sensor of one image."""

    name: str | None  # the sensor whose tokens the image gets; `None` for a sensor outside of the bank
    distance: float | None  # its `SensorBank.distances` from that sensor, or the nearest; `None` without a prototype


def layout_distances(images: Tensor, prototype: Tensor) -> Tensor:
    """Mean absolute difference of images (B, 3, S, S) from a prototype (3, P, P), both pooled to 8 x 8 cells, (B,).

    By these distances none of 1,200 touches of other sensors is within reach. By the colours of all pixels some are.
    """
    image_cells = F.adaptive_avg_pool2d(images, 8)
    prototype_cells = F.adaptive_avg_pool2d(prototype, 8)
    return (image_cells - prototype_cells).abs().mean(dim=(1, 2, 3))


class SensorBank(nn.Module):
    """L learnable tokens for each of K sensors, and each sensor's prototype, the mean of its images.

    Args:
        names: Names of the K sensors; K may be 0, which means no prefix.
        tokens: L, tokens for each sensor.
        width: Width of the transformer that the tokens enter.
        prototype_size: Side S of the raw images, in [0, 1], behind the prototypes, pixels.
        reaches: Distance from each sensor's prototype within which its own touches lie, by name; see
            `layout_distances`. An image that is out of reach of all sensors has none of them. Without reaches, the
            nearest sensor is taken.
    """

    tokens: nn.Parameter
    prototypes: Tensor
    known: Tensor

    def __init__(
        self,
        names: Sequence[str],
        tokens: int,
        width: int,
        prototype_size: int,
        reaches: Mapping[str, float] | None = None,
    ):
        super().__init__()
        self.names = tuple(names)
        self.prototype_size = prototype_size
        self.reaches = dict(reaches or {})
        self.tokens = nn.Parameter(torch.randn(len(self.names), tokens, width) * 0.02)  # (K, L, width)
        self.register_buffer("prototypes", torch.zeros(len(self.names), 3 * prototype_size**2))
        self.register_buffer("known", torch.zeros(len(self.names), dtype=torch.bool))  # which have a prototype

    def index(self, name: str) -> int:
        """Index of a sensor; raises an `InvalidInputError` if the bank does not hold it."""
        if not self.names:
            raise InvalidInputError(f"`sensor` is {describe(name)}, but this model has no sensor tokens; leave it out.")
        hint = "For the touches of any other, leave `sensor` out." if bool(self.known.any()) else ""
        return self.names.index(check_choice("sensor", name, self.names, hint=hint))

    def set_prototype(self, name: str, mean_pixels: Tensor) -> None:
        """Stores the mean raw image (3, S, S), in [0, 1], of one sensor."""
        index = self.index(name)
        self.prototypes[index] = mean_pixels.flatten().to(self.prototypes)
        self.known[index] = True

    def prototype(self, name: str) -> Tensor:
        """Mean raw image of a sensor, in [0, 1], (3, S, S); zeros until it is set."""
        return self.prototypes[self.index(name)].view(3, self.prototype_size, self.prototype_size)

    def match(self, raw_pixels: Tensor, sensor: Sensors = None, *, nearest: bool = False) -> list[SensorMatch]:
        """The sensor of each image (B, 3, S, S) in [0, 1]: the one named, or the one that is retrieved.

        The sensor with the nearest prototype is retrieved, by L1 distance (as in the paper) of the mean colours of
        8 x 8 cells. If the bank has `reaches`, an image out of reach of all sensors has none, unless `nearest` is set.
        """
        check_kind("sensor", sensor, str, list, tuple, NoneType)
        names = one_each("sensor", sensor if isinstance(sensor, list | tuple) else [sensor], len(raw_pixels))
        indices = [None if name is None else self.index(name) for name in names]
        if not self.names:
            return [SensorMatch(None, None)] * len(raw_pixels)
        if None in indices and not bool(self.known.any()):
            stored = "this model stores no prototypes to retrieve one by"
            raise InvalidInputError(f"`sensor` is None, but {stored}; name one of {self.names}.")
        matches = []
        for index, distances in zip(indices, self.distances(raw_pixels), strict=True):
            chosen = int(distances.argmin()) if index is None else index
            distance = distances[chosen]
            out_of_reach = index is None and self.reaches and not nearest and distance > 1.0
            name = None if out_of_reach else self.names[chosen]
            matches.append(SensorMatch(name, distance.item() if distance.isfinite() else None))
        return matches

    def distances(self, raw_pixels: Tensor) -> Tensor:
        """`layout_distances` of images (B, 3, S, S) to each prototype, in units of the sensor's reach, (B, K).

        Without reaches the unit is 1. A distance is infinite if the prototype or the reach is unknown.
        """
        prototypes = self.prototypes.float().unflatten(1, (3, self.prototype_size, -1))
        images = raw_pixels.to(prototypes)
        distances = torch.stack([layout_distances(images, prototype) for prototype in prototypes], dim=1)
        reaches = prototypes.new_ones(len(self.names))
        if self.reaches:
            reaches = prototypes.new_tensor([self.reaches.get(name, 0.0) for name in self.names])
        unknown = ~self.known | (reaches == 0.0)
        return (distances / reaches.clamp_min(1e-6)).masked_fill(unknown, float("inf"))

    def encode(self, encoder: Callable[..., Tensor], inputs: Tensor, indices: Tensor) -> Tensor:
        """An encoder's output for inputs (B, ...) with the tokens of their sensors; those of index -1 get no tokens."""
        with_tokens = (indices >= 0).nonzero()[:, 0]
        without_tokens = (indices < 0).nonzero()[:, 0]
        outputs = list[Tensor]()
        if len(with_tokens):
            outputs.append(encoder(inputs[with_tokens], self.tokens[indices[with_tokens].long()]))
        if len(without_tokens):
            outputs.append(encoder(inputs[without_tokens], None))
        order = torch.cat([with_tokens, without_tokens]).argsort()
        return torch.cat(outputs)[order]
