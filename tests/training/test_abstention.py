"""Fitting what a joint space does not know: what is written, and that nothing else changes."""

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from scipy.spatial.distance import mahalanobis

from unitouch_gen.models import MODALITIES, UniTouchModel, UniTouchProcessor
from unitouch_gen.training.abstention import abstention, fit_gaussians
from unitouch_gen.training.data import Rendered
from unitouch_gen.training.stages import save_modalities

SETTINGS = ("data.drawn={sensors: [digit], objects: 4, contacts_per_object: 1, held_out: 2}",)


@pytest.fixture
def space(model: UniTouchModel, processor: UniTouchProcessor, split: Rendered, tmp_path: Path) -> Path:
    model.sensor_bank.set_prototype("digit", torch.from_numpy(split.touch[:].copy()).float().mean(dim=0) / 255)
    save_modalities(model.half(), MODALITIES, processor, tmp_path / "space")
    return tmp_path / "space"


def test_a_distance_that_knows_touches_from_pictures_is_written_and_weights_stay(
    space: Path, cache: Path, processor: UniTouchProcessor, split: Rendered
) -> None:
    before = load_file(space / "model.safetensors")
    abstention(joint=space, overrides=list(SETTINGS), cache=cache)
    after = load_file(space / "model.safetensors")
    assert {key for key in after if not key.startswith("out_of_distribution.")} == set(before)
    assert all(torch.equal(after[key], tensor) for key, tensor in before.items())
    new = {key: tensor for key, tensor in after.items() if key not in before}
    assert new and all(tensor.dtype == torch.float16 for tensor in new.values())
    again = UniTouchModel.from_pretrained(space)
    assert list(again.config.ood_thresholds) == ["touch"]
    assert set(again.config.sensor_reaches) == {"digit"} and 0.0 < again.config.sensor_reaches["digit"] < 0.3
    for column, low, high in (("touch", 0.0, 0.15), ("image", 0.5, 1.0)):
        reasons = again.unknown_touches(processor.touch(torch.from_numpy(getattr(split, column)[:].copy()) / 255))
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
