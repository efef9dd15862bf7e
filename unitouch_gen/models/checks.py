"""What the encoders refuse before they run."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from unitouch_gen.errors import InvalidInputError, InvalidTypeError, describe


def check_input(name: str, values: Tensor, shape: tuple[int, ...], ndim: int = 4) -> None:
    """Values (B, *shape), of clips (B, clips, *shape)."""
    if values.ndim != ndim or tuple(values.shape[-3:]) != shape:
        leading = ("B", "clips")[: ndim - 3]
        expected = ", ".join([*leading, *map(str, shape)])
        raise InvalidInputError(
            f"`{name}` is {describe(values)}; this model takes ({expected}). Use UniTouchProcessor."
        )


def check_sensor_ids(sensor_ids: Any, count: int, names: Sequence[str]) -> None:
    """Integers (count,) that are indices into the names."""
    hint = f"pass the index of each image's sensor, integers ({count},) from 0 to {len(names) - 1}, or None."
    if not names:
        raise InvalidInputError(f"`sensor_ids` is {describe(sensor_ids)}; this model has no sensor tokens; pass None.")
    if not isinstance(sensor_ids, Tensor) or sensor_ids.dtype == torch.bool or sensor_ids.is_floating_point():
        raise InvalidTypeError(f"`sensor_ids` is {describe(sensor_ids)}; {hint}")
    if tuple(sensor_ids.shape) != (count,):
        raise InvalidInputError(f"`sensor_ids` is {describe(sensor_ids)}; {hint}")
    if count and not 0 <= int(sensor_ids.min()) <= int(sensor_ids.max()) < len(names):
        raise InvalidInputError(f"`sensor_ids` is {sensor_ids.tolist()}; {hint}")
