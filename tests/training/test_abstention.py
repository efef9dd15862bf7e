"""What a touch encoder does not know: the distance that is fitted, and where it is kept."""

from dataclasses import replace

import numpy as np
import torch
from scipy.spatial.distance import mahalanobis

from unitouch_gen.models import UniTouchModel
from unitouch_gen.training.touch import fit_distance, fit_gaussians, set_prototypes


def test_a_distance_that_knows_touches_from_pictures_is_kept_with_the_touch_encoder(model, processor, split, tmp_path):
    splits = [split, replace(split, sensor="gelsight", touch=split.second)]
    set_prototypes(model, splits, reaches=True)
    fit_distance(model, splits)
    model.save_pretrained(tmp_path / "touch")
    again = UniTouchModel.from_pretrained(tmp_path / "touch")
    assert [*again.config.ood_thresholds] == ["touch"]
    reaches = again.config.sensor_reaches
    assert set(reaches) == {"gelsight", "digit"} and 0.0 < reaches["digit"] < 0.3
    for column, low, high in (("touch", 0.0, 0.15), ("image", 0.5, 1.0)):
        reasons = again.encode_touches(processor.touch(torch.from_numpy(getattr(split, column)[:].copy()) / 255))[1]
        assert low <= sum(map(bool, reasons)) / len(reasons) <= high


def test_the_distance_is_mahalanobis_to_the_nearest_class() -> None:
    mixing = np.random.default_rng(0).normal(size=(6, 6)) * [1.0, 3.0, 0.1, 1.0, 10.0, 1.0]
    drawn = np.random.default_rng(1).normal(size=(620, 6)) @ mixing
    drawn[300:600] += mixing.sum(axis=0) * 4.0
    features, labels, others = drawn[:600], np.repeat([0, 1], 300), drawn[600:]
    means = [features[labels == label].mean(axis=0) for label in (0, 1)]
    residuals = features - np.stack(means)[labels]
    inverse = np.linalg.inv(residuals.T @ residuals / 600)
    gaussians = fit_gaussians(torch.from_numpy(features), torch.from_numpy(labels), shrinkage=0.0)
    expected = [min(mahalanobis(row, mean, inverse) for mean in means) ** 2 for row in others]
    np.testing.assert_allclose(gaussians(torch.from_numpy(others)), expected, rtol=1e-3)
    halved = gaussians.half()(torch.from_numpy(others))
    np.testing.assert_allclose(halved, expected, rtol=0.05, atol=0.1)
