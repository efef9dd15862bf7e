"""A sensor in a file of its own: what `unitouch-gen adapt` learns, for `UniTouchModel.load_sensor`."""

import copy
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from unitouch_gen.errors import InvalidInputError, check_finite, first_line
from unitouch_gen.files import check_file, write_file
from unitouch_gen.models.sensors import SensorBank

KIND = "unitouch sensor 1"  # in the metadata of such a file

DOWN, UP = ".lora_A.weight", ".lora_B.weight"
"""Ends of the names of low-rank updates, as peft has them."""


@dataclass(frozen=True, eq=False)
class AddedSensor:
    """A sensor that a touch encoder was not trained with.

    Attributes:
        name: To call it by.
        base: `print_of` the touch encoder that it was made for.
        tokens: (L, width); L is 0 for an encoder without sensor tokens.
        prototype: Mean raw image, in [0, 1], (3, S, S).
        lora: Low-rank updates of linear layers (Hu et al., 2022) for touches of this sensor alone, by the layer's name
            and `DOWN` (r, in) or `UP` (out, r); the scale is in them.
        figures: What was measured of it.
        reach: How far its touches lie from the prototype; see `SensorBank`.
    """

    name: str
    base: Tensor
    tokens: Tensor
    prototype: Tensor
    lora: Mapping[str, Tensor] = field(default_factory=dict)
    figures: Mapping[str, Any] = field(default_factory=dict)
    reach: float | None = None

    def save(self, file: Path) -> None:
        """Writes it in half precision; raises an `InvalidInputError` if the file cannot be written."""
        parts = {"tokens": self.tokens, "prototype": self.prototype, **self.lora}
        tensors = {key: value.detach().cpu().half().contiguous() for key, value in parts.items()}
        metadata = {"kind": KIND, "name": self.name, "figures": json.dumps(dict(self.figures))}
        metadata |= {} if self.reach is None else {"reach": repr(self.reach)}
        write_file("output", file, save({**tensors, "base": self.base}, metadata))

    @classmethod
    def read(cls, file: Path) -> Self:
        """Reads what `save` wrote; raises an `InvalidInputError` if it is no such file, or not finite."""
        check_file("file", file, "a sensor")
        try:
            with safe_open(file, framework="pt") as stored:
                known = stored.metadata() or {}
                if known.get("kind") != KIND:
                    raise ValueError("it holds no sensor")
                tensors = {key: check_finite(key, stored.get_tensor(key).float()) for key in stored.keys()}  # noqa: SIM118
            base, tokens, prototype = (tensors.pop(name) for name in ("base", "tokens", "prototype"))
            figures = json.loads(known["figures"])
            reach = float(known["reach"]) if "reach" in known else None
        except (OSError, ValueError, KeyError, SafetensorError) as error:
            raise InvalidInputError(
                f"`file` is {str(file)!r}, which cannot be read ({first_line(error)}); pass what `adapt` wrote."
            ) from error
        return cls(known["name"], base, tokens, prototype, tensors, figures, reach)

    def extend(self, bank: SensorBank, encoder: nn.Module) -> SensorBank:
        """A bank with this sensor behind the others; raises an `InvalidInputError` if it is for another touch encoder,
        or its name is taken."""
        found, brought = print_of(encoder), f"`file` brings the sensor {self.name!r}"
        if found.shape != self.base.shape or bool(((found - self.base).abs() > 0.015).any()):
            raise InvalidInputError(f"{brought} of another touch encoder than this model's; adapt it to this one.")
        if self.name in bank.names:
            raise InvalidInputError(f"{brought}, a name that this model knows already; take another.")
        try:
            return bank.extended(self.name, self.tokens, self.prototype, self.encoder(encoder), self.reach)
        except (KeyError, AttributeError, RuntimeError) as error:  # updates of which half is missing, or of other sizes
            raise InvalidInputError(f"{brought}, which does not fit ({first_line(error)}); adapt it anew.") from error

    @torch.no_grad()
    def encoder(self, base: nn.Module) -> nn.Module | None:
        """A copy of the touch encoder with the updates in its weights, W + B A; `None` if there are none."""
        if not self.lora:
            return None
        encoder = copy.deepcopy(base)
        for key in self.lora:
            if key.endswith(DOWN):
                weight = encoder.get_parameter(f"{key.removesuffix(DOWN)}.weight")
                weight.add_((self.lora[key.replace(DOWN, UP)] @ self.lora[key]).to(weight))
        return encoder


def print_of(encoder: nn.Module) -> Tensor:
    """A fingerprint of an encoder's weights, (tensors, 2): logarithmic norm, and a random projection over it.

    It is of the first 4096 values of each tensor, and of the order of 1. Weights that change by a hundredth of
    themselves change it by more than 0.015; rounding to any precision does not.
    """
    found = []
    for number, tensor in enumerate(encoder.state_dict().values()):
        values = tensor.detach().flatten()[:4096].double().cpu()
        direction = torch.randn(len(values), generator=torch.Generator().manual_seed(number), dtype=torch.float64)
        norm = values.norm().clamp_min(1e-3)
        found.append(torch.stack([norm.log(), values @ direction / norm]))
    return torch.stack(found).float()
