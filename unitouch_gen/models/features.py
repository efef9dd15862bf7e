"""Features of many samples by the joint space, computed in batches."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor
from tqdm.auto import tqdm

from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.models.joint import UniTouchModel
from unitouch_gen.models.processing import UniTouchProcessor


def float_pixels(images: Any) -> Tensor:
    """Images (N, 3, S, S) in [0, 1], from uint8 or from floats in [0, 1]."""
    values = torch.from_numpy(np.array(images))
    return values if values.is_floating_point() else values.float() / 255


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


@torch.no_grad()
def text_embeddings(model: UniTouchModel, processor: UniTouchProcessor, texts: Sequence[str]) -> Tensor:
    """Unit embeddings of texts, (N, D)."""
    inputs = {name: values.to(model.device) for name, values in processor.text(list(texts)).items()}
    return F.normalize(model.get_text_features(**inputs).float(), dim=-1)


def in_batches(count: int, encode: Callable[[slice], Any], size: int = 128) -> Tensor:
    """Applies `encode` to slices of `count` samples, and joins its rows as floats on the CPU."""
    rows = list[Tensor]()
    for start in tqdm(range(0, count, size), mininterval=5.0, leave=False, disable=None):
        batch = encode(slice(start, start + size))
        rows.append(torch.as_tensor(batch).float().cpu())
    return torch.cat(rows)
