"""Which touches are unlike those that a touch encoder was trained on, by a distance that `touch` fits at its end."""

from collections.abc import Iterable, Sequence

import numpy as np
import torch
from torch import Tensor

from unitouch_gen.models import UniTouchModel
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.models.out_of_distribution import Gaussians, RelativeDistance, touch_statistics
from unitouch_gen.training.data import Rendered
from unitouch_gen.world import ATTRIBUTES

ABSTAINED = 0.046  # share of the touches of training that are beyond the threshold


def spread(values: np.ndarray, count: int = 500) -> np.ndarray:
    """At most `count` rows, spread over all."""
    return values[np.unique(np.linspace(0, len(values) - 1, count).astype(int))]


def fit_gaussians(features: Tensor, labels: Tensor, shrinkage: float = 0.1) -> Gaussians:
    """Gaussians of one covariance around the mean of each class, of features (N, F) with int64 labels (N,).

    `shrinkage` is the share of the covariance, of features in units of their deviation, that is the unit matrix.
    """
    values = features.double()
    names, rows = labels.unique(return_inverse=True)
    means = torch.stack([values[rows == row].mean(dim=0) for row in range(len(names))])
    deviation = values.std(dim=0).clamp_min(1e-6)
    residuals = (values - means[rows]) / deviation
    covariance = residuals.T @ residuals / len(residuals)
    scale, axes = torch.linalg.eigh((1.0 - shrinkage) * covariance + shrinkage * torch.eye(len(covariance)).double())
    return Gaussians(means.float(), (axes * scale.rsqrt() / deviation[:, None]).float())


@torch.no_grad()
def fit_distance(model: UniTouchModel, splits: Sequence[Rendered]) -> None:
    """Gives a model the distance of touches, by class where materials are known, and its threshold."""
    stem, weight = model.touch_model.stem, model.touch_model.projection.weight

    def statistics(images: Iterable[np.ndarray]) -> Tensor:
        pixels = torch.from_numpy(np.concatenate([spread(part) for part in images]))
        parts = (normalise_pixels(part.float() / 255) for part in pixels.split(256))
        return torch.cat([touch_statistics(stem(part.to(weight)), part) for part in parts]).cpu()

    cover = ATTRIBUTES.index("cover")  # what touches nothing is not known by its touch
    pressed = [spread(np.ones(len(one)) if one.attributes is None else one.attributes[:, 0, cover]) for one in splits]
    rows = torch.from_numpy(np.concatenate(pressed)) > 0.0
    materials = torch.from_numpy(np.concatenate([spread(split.material) for split in splits]))[rows]
    touches, pictures = statistics(split.touch for split in splits)[rows], statistics(split.image for split in splits)
    distance = RelativeDistance(fit_gaussians(touches, materials), fit_gaussians(pictures, torch.zeros(len(pictures))))
    model.out_of_distribution["touch"] = distance
    model.config.ood_thresholds = {"touch": {"foreign": distance(touches).quantile(1.0 - ABSTAINED).item()}}
