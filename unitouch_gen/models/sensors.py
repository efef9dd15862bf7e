"""Sensor tokens and their retrieval (Section 3.2 of the paper, "Inference")."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from unitouch_gen.errors import InvalidInputError, InvalidTypeError, check_choice, check_tensor, describe

REACH = 0.2
"""Distance to a sensor's prototype beyond which an image is hardly a touch that it took, in units of full scale.

In the world of an earlier family a sensor's own touches stay within 0.09, those of two sensors never trained on
within 0.16, and recordings of real GelSights and DIGITs within 0.15; photographs of objects lie from 0.28 on, noise at
0.26."""

LAYOUT = 8
"""Areas a side whose mean colours tell sensors apart, where a model stores how far each sensor's own touches lie.

Among three sensors of the world, 99 % of their touches are within and none of 1,200 touches of drawn sensors, of four
calibrated ones and of real ones; by the colours of all pixels some are, and more without the gain of the colours."""


@dataclass(frozen=True)
class SensorMatch:
    """Which sensor's tokens an image gets.

    Attributes:
        name: Name of the sensor; `None` where it is none of the bank's.
        distance: Mean absolute difference to its prototype, in units of full scale [0, 1]; `None` if not compared.
    """

    name: str | None
    distance: float | None


def layout_distances(images: Tensor, prototype: Tensor) -> Tensor:
    """Mean absolute differences of the areas of images (B, 3, S, S) to those of a prototype (3, P, P), (B,)."""
    areas, known = (F.adaptive_avg_pool2d(pixels, LAYOUT) for pixels in (images, prototype))
    return (areas - known).abs().mean(dim=(1, 2, 3))


class SensorBank(nn.Module):
    """L learnable tokens for each of K sensors, with each sensor's prototype.

    A prototype is the mean of the raw pixels, in [0, 1], of the images a sensor took, flattened to 1-D.

    Args:
        names: Names of the K sensors; K may be 0, which means no prefix.
        tokens: L, tokens for each sensor.
        width: Width of the transformer that the tokens enter.
        prototype_size: Side S of the raw images behind the prototypes, pixels.
        reach: Distance to a sensor's prototype up to which an image may be a touch that it took.
        reaches: How far a sensor's own touches lie from its prototype, by name, in mean colours of `LAYOUT` x `LAYOUT`
            areas. With them, an image that is farther from every sensor is of none; without, the nearest is taken.
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
        reach: float = REACH,
        reaches: Mapping[str, float] | None = None,
    ):
        super().__init__()
        self.names = tuple(names)
        self.prototype_size, self.reach, self.reaches = prototype_size, reach, dict(reaches or {})
        self.encoders: dict[int, nn.Module] = {}  # of added sensors that bring their own, by index; saved with those
        self.tokens = nn.Parameter(torch.randn(len(self.names), tokens, width) * 0.02)  # (K, L, width)
        self.register_buffer("prototypes", torch.zeros(len(self.names), 3 * prototype_size**2))
        self.register_buffer("known", torch.zeros(len(self.names), dtype=torch.bool))

    def __len__(self) -> int:
        return len(self.names)

    def extended(
        self,
        name: str,
        tokens: Tensor,
        prototype: Tensor,
        encoder: nn.Module | None = None,
        reach: float | None = None,
    ) -> "SensorBank":
        """A bank of one sensor more, behind the others; this one stays as it is, as others may be using it.

        Args:
            name: That no other has.
            tokens: (L, width).
            prototype: Mean raw image, in [0, 1], (3, S, S).
            encoder: For touches of this sensor, in place of the one that all share.
            reach: How far its touches lie from the prototype; the widest of the others' if left out.

        Raises:
            InvalidInputError: If the name is taken, or a shape does not fit.
        """
        if name in self.names:
            raise InvalidInputError(f"`sensor` is {name!r}, which this model knows already; take another name.")
        check_tensor("tokens", tokens, *self.tokens.shape[1:])
        check_tensor("prototype", prototype, 3, self.prototype_size, self.prototype_size)
        count, width = self.tokens.shape[1:]
        reaches = dict(self.reaches)
        if reaches:
            reaches[name] = max(reaches.values()) if reach is None else reach
        bank = SensorBank((*self.names, name), count, width, self.prototype_size, self.reach, reaches)
        bank.tokens.data = torch.cat([self.tokens.data, tokens[None].to(self.tokens)])
        bank.prototypes = torch.cat([self.prototypes, prototype.flatten()[None].to(self.prototypes)])
        bank.known = torch.cat([self.known, self.known.new_ones(1)])
        bank.encoders = {**self.encoders, **({} if encoder is None else {len(self): encoder})}
        return bank.train(self.training).requires_grad_(self.tokens.requires_grad)

    def without(self, name: str) -> "SensorBank":
        """A bank of one sensor less; this one stays as it is.

        Raises:
            InvalidInputError: If the bank does not hold it.
        """
        index = self.index(name)
        kept = [row for row in range(len(self)) if row != index]
        count, width = self.tokens.shape[1:]
        names = [self.names[row] for row in kept]
        reaches = {other: self.reaches[other] for other in names if other in self.reaches}
        bank = SensorBank(names, count, width, self.prototype_size, self.reach, reaches)
        bank.tokens.data, bank.prototypes, bank.known = self.tokens.data[kept], self.prototypes[kept], self.known[kept]
        bank.encoders = {kept.index(row): encoder for row, encoder in self.encoders.items() if row != index}
        return bank.train(self.training).requires_grad_(self.tokens.requires_grad)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Takes the encoders of its sensors along."""
        for encoder in self.encoders.values():
            encoder._apply(fn)
        return super()._apply(fn, recurse)

    def set_prototype(self, name: str, mean_pixels: Tensor) -> None:
        """Stores the mean raw image (3, S, S), in [0, 1], of one sensor.

        Raises:
            InvalidInputError, InvalidTypeError: If the bank does not hold the sensor, or this is no such image.
        """
        index = self.index(name)
        check_tensor("mean_pixels", mean_pixels, 3, self.prototype_size, self.prototype_size)
        self.prototypes[index] = mean_pixels.flatten().to(self.prototypes)
        self.known[index] = True

    def index(self, name: str) -> int:
        """Index of a sensor.

        Raises:
            InvalidInputError: If the bank does not hold it.
        """
        if not self.names:
            raise InvalidInputError(f"`sensor` is {name!r}; this model has no sensor tokens, so leave `sensor` out.")
        hint = "For the touches of any other, leave `sensor` out."
        hint = hint if bool(self.known.any()) else ""
        return self.names.index(check_choice("sensor", name, self.names, hint=hint))

    def check_indices(self, name: str, indices: Any, count: int) -> None:
        """Refuses what are no indices of `count` images' sensors.

        Raises:
            InvalidInputError: If the shape does not fit, one is out of range, or the bank is empty.
            InvalidTypeError: If they are no tensor of integers.
        """
        if not self.names:
            raise InvalidInputError(f"`{name}` is {describe(indices)}; this model has no sensor tokens; pass None.")
        last = len(self) - 1
        hint = f"Pass the index of each image's sensor, integers ({count},) from 0 to {last}, or -1 for none; or None."
        found = check_tensor(name, indices, count, integers=True, hint=hint).long()
        if not -1 <= int(found.min()) <= int(found.max()) < len(self):
            raise InvalidInputError(f"`{name}` is {found.tolist()}. {hint}")

    def prototype(self, name: str) -> Tensor:
        """Mean raw image of a sensor, in [0, 1], (3, S, S); zeros until it is set.

        Raises:
            InvalidInputError: If the bank does not hold the sensor.
        """
        return self.prototypes[self.index(name)].view(3, self.prototype_size, self.prototype_size)

    def match(
        self, raw_pixels: Tensor, sensor: str | Sequence[str | None] | None = None, *, nearest: bool = False
    ) -> list[SensorMatch]:
        """The sensor of each image: the one named, or the one that is retrieved.

        That is the nearest prototype by L1 distance, as in the paper. Where the bank has `reaches`, it is the one whose
        own touches lie as far, in mean colours of areas, and none where the image is out of reach of all.

        Args:
            raw_pixels: Images in [0, 1], (B, 3, S, S).
            sensor: A name for all, one for each image, or `None` to retrieve.
            nearest: Whether to take the nearest sensor also where the image is out of reach of all.

        Raises:
            InvalidInputError: If a name is unknown, the list is of another length, or a sensor has to be found and no
                prototype is stored.
        """
        if not (sensor is None or isinstance(sensor, str | list | tuple)):
            raise InvalidTypeError(f"`sensor` is {describe(sensor)}; it has to be a name or a list of names.")
        wanted = sensor if isinstance(sensor, list | tuple) else [sensor] * len(raw_pixels)
        if len(wanted) != len(raw_pixels):
            raise InvalidInputError(
                f"`sensor` is a list of {len(wanted)} for {len(raw_pixels)} touch images; pass one name, one for each "
                "image, or None to retrieve them."
            )
        indices = [None if name is None else self.index(name) for name in wanted]
        if not self.names:
            return [SensorMatch(None, None)] * len(raw_pixels)
        if None in indices and not bool(self.known.any()):
            raise InvalidInputError(
                f"`sensor` is None, but this model stores no prototypes to retrieve one by; name one of {self.names}."
            )
        distances = self.distances(raw_pixels)
        retrieved = self._within(raw_pixels) if self.reaches else distances
        matches = []
        for index, row, by in zip(indices, distances, retrieved, strict=True):
            chosen = int(by.argmin()) if index is None else index
            distance = row[chosen].item()
            none = index is None and self.reaches and not nearest and by[chosen] > 1.0
            matches.append(
                SensorMatch(None if none else self.names[chosen], distance if distance < float("inf") else None)
            )
        return matches

    def _within(self, raw_pixels: Tensor) -> Tensor:
        """Distances to the prototypes over how far each sensor's own touches lie, (B, K); infinite where unknown."""
        reaches = torch.tensor([self.reaches.get(name, 0.0) for name in self.names], device=self.prototypes.device)
        looks = self.prototypes.float().unflatten(1, (3, self.prototype_size, -1))
        distances = torch.stack([layout_distances(raw_pixels.to(looks), look) for look in looks], dim=1)
        return (distances / reaches.clamp_min(1e-6)).masked_fill(~self.known | (reaches == 0.0), float("inf"))

    def distances(self, raw_pixels: Tensor) -> Tensor:
        """Mean absolute difference of each image (B, 3, S, S) to each prototype, (B, K); infinite where unknown."""
        flat = raw_pixels.flatten(1).to(self.prototypes)
        gap = torch.stack([(flat - prototype).abs().mean(dim=1) for prototype in self.prototypes], dim=1)
        return gap.masked_fill(~self.known, float("inf"))

    def unfamiliar(self, distances: Sequence[float | None]) -> list[int]:
        """Which rows of distances, as of `SensorMatch`, are beyond `reach`: hardly touches that the sensor took.

        Colours are all that it goes by: a photograph that has those of a touch passes for one.
        """
        return [row for row, distance in enumerate(distances) if distance is not None and distance > self.reach]

    def forward(self, indices: Tensor) -> Tensor:
        """Tokens (B, L, width) of sensors given by index, int64 (B,)."""
        return self.tokens[indices]

    def encode(self, encoder: Callable[..., Tensor], pixels: Tensor, indices: Tensor) -> Tensor:
        """What an encoder makes of pixel values and the tokens of their sensors, (B, ...); index -1 has none."""
        named = (indices >= 0) & bool(len(self))  # where the indices are, which may have values where pixels have none
        indices = indices.to(self.tokens.device, torch.long)
        if not bool(named.any()):
            return encoder(pixels)
        if bool(named.all()):
            return encoder(pixels, self(indices))
        rows = named.to(pixels.device)
        parts = encoder(pixels[rows], self(indices[rows])), encoder(pixels[~rows])
        order = torch.cat([rows.nonzero()[:, 0], (~rows).nonzero()[:, 0]]).argsort()
        return torch.cat(parts)[order]
