"""Sensor tokens and their retrieval (Section 3.2 of the paper, "Inference")."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from unitouch_gen.errors import InvalidInputError, InvalidTypeError, check_choice, describe

Sensors = str | Sequence[str | None] | None
"""A name for all images, one for each, or `None` to retrieve them."""


@dataclass(frozen=True)
class SensorMatch:
    """The sensor whose tokens an image gets, `None` for one outside of the bank; and its `SensorBank.distances` from
    that sensor, or from the nearest, `None` where the bank has no prototype."""

    name: str | None
    distance: float | None


def layout_distances(images: Tensor, prototype: Tensor) -> Tensor:
    """Mean absolute differences of 8 x 8 areas' colours, of images (B, 3, S, S) to a prototype (3, P, P), (B,).

    By these none of 1,200 touches of other sensors is within reach; by the colours of all pixels some are.
    """
    areas, known = (F.adaptive_avg_pool2d(pixels, 8) for pixels in (images, prototype))
    return (areas - known).abs().mean(dim=(1, 2, 3))


class SensorBank(nn.Module):
    """L learnable tokens for each of K sensors, with each sensor's prototype: the mean of the images that it took.

    Args:
        names: Names of the K sensors; K may be 0, which means no prefix.
        tokens: L, tokens for each sensor.
        width: Width of the transformer that the tokens enter.
        prototype_size: Side S of the raw images, in [0, 1], behind the prototypes, pixels.
        reaches: How far a sensor's own touches lie from its prototype, by name; see `layout_distances`. With them, an
            image that is farther from every sensor is of none; without, the nearest is taken.
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
            raise InvalidInputError(f"`sensor` is {name!r}; this model has no sensor tokens, so leave `sensor` out.")
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

        That is the nearest prototype by L1 distance (as in the paper) of mean colours of 8 x 8 areas. Where the bank
        has `reaches`, it is none where the image is out of reach of all, unless the `nearest` is asked for.
        """
        if not (sensor is None or isinstance(sensor, str | list | tuple)):
            raise InvalidTypeError(f"`sensor` is {describe(sensor)}; it has to be a name or a list of names.")
        wanted = sensor if isinstance(sensor, list | tuple) else [sensor] * len(raw_pixels)
        if len(wanted) != len(raw_pixels):
            counts = f"a list of {len(wanted)} for {len(raw_pixels)} touch images"
            raise InvalidInputError(f"`sensor` is {counts}; pass one name, one each, or None to retrieve them.")
        indices = [None if name is None else self.index(name) for name in wanted]
        if not self.names:
            return [SensorMatch(None, None)] * len(raw_pixels)
        if None in indices and not bool(self.known.any()):
            stored = "this model stores no prototypes to retrieve one by"
            raise InvalidInputError(f"`sensor` is None, but {stored}; name one of {self.names}.")
        matches = []
        for index, row in zip(indices, self.distances(raw_pixels), strict=True):
            chosen = int(row.argmin()) if index is None else index
            out_of_reach = index is None and self.reaches and not nearest and row[chosen] > 1.0
            distance = row[chosen].item() if row[chosen].isfinite() else None
            matches.append(SensorMatch(None if out_of_reach else self.names[chosen], distance))
        return matches

    def distances(self, raw_pixels: Tensor) -> Tensor:
        """`layout_distances` of images (B, 3, S, S) to each prototype, (B, K), over the sensors' reaches where there
        are any; infinite where a prototype or a reach is unknown."""
        looks = self.prototypes.float().unflatten(1, (3, self.prototype_size, -1))
        reaches = looks.new_tensor([self.reaches.get(name, 0.0) if self.reaches else 1.0 for name in self.names])
        distances = torch.stack([layout_distances(raw_pixels.to(looks), look) for look in looks], dim=1)
        return (distances / reaches.clamp_min(1e-6)).masked_fill(~self.known | (reaches == 0.0), float("inf"))

    def encode(self, encoder: Callable[..., Tensor], inputs: Tensor, indices: Tensor) -> Tensor:
        """An encoder's output for inputs (B, ...) with the tokens of their sensors; index -1 has none."""
        known, others = (rows.nonzero()[:, 0] for rows in (indices >= 0, indices < 0))
        parts = [encoder(inputs[known], self.tokens[indices[known].long()])] if len(known) else []
        parts += [encoder(inputs[others], None)] if len(others) else []
        return torch.cat(parts)[torch.cat([known, others]).argsort()]
