"""What there is to see of held-out data while an encoder trains: retrieval."""

from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.training.data import Rendered


def pixels_of(splits: Sequence[Rendered], modality: str, device: torch.device | None = None) -> Tensor:
    """Pixel values (N, 3, S, S) of all samples of some splits."""
    pixels = torch.from_numpy(np.concatenate([getattr(split, modality) for split in splits]))
    return normalise_pixels(pixels.to(device).float() / 255)


def retrieval(query: Tensor, key: Tensor) -> dict[str, float]:
    """Shares of N queries (N, D) whose own key (N, D) is the nearest, and among the five nearest, beside chance."""
    query, key = (F.normalize(rows.float().cpu(), dim=-1) for rows in (query, key))
    count = len(query)
    found = (query @ key.T).argsort(dim=1, descending=True, stable=True) == torch.arange(count)[:, None]
    figures = {}
    for k in (1, 5):
        figures[f"retrieval_top{k}"] = found[:, :k].any(dim=1).float().mean().item()
        figures[f"chance_top{k}"] = min(k / count, 1.0)
    return figures
