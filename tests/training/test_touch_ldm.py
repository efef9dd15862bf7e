"""What the touch network is shown in training: one token, of one norm, sometimes perturbed, sometimes none."""

from pathlib import Path

import numpy as np
import pytest
import torch
from diffusers import DDPMScheduler
from diffusers.models.unets.unet_2d_condition import UNet2DConditionOutput
from torch import Tensor, nn

from unitouch_gen.models import UniTouchProcessor
from unitouch_gen.training.data import DataConfig, columns_of
from unitouch_gen.training.touch_ldm import (
    TouchDiffusionObjective,
    TouchDiffusionSettings,
    class_labels,
    places_of,
    untouched_gels,
)
from unitouch_gen.world import SENSORS, untouched_gel

COUNT, WIDTH, NORM = 800, 64, 14.0
AUDIO = {"clip_seconds": 0.2, "clips": 1, "mel_bins": 16, "frames": 24}


class Shown(nn.Module):
    """A network that predicts nothing, and keeps what it is shown."""

    def forward(self, sample: Tensor, steps: Tensor, encoder_hidden_states: Tensor, class_labels: Tensor):
        self.sample, self.hidden, self.labels = sample, encoder_hidden_states, class_labels
        return UNet2DConditionOutput(sample=torch.zeros_like(sample[:, :2]))


@pytest.fixture
def embeds() -> Tensor:
    return 3.0 * torch.randn(COUNT, WIDTH, generator=torch.Generator().manual_seed(1))


def show(embeds: Tensor, **changes: float) -> Shown:
    torch.manual_seed(0)
    plain = {"condition_dropout": 0.0, "noisy_share": 0.0, "condition_noise": 0.0, "snr_gamma": 5.0}
    settings = TouchDiffusionSettings(**plain | changes)
    objective = TouchDiffusionObjective(Shown(), DDPMScheduler(), NORM, settings)
    objective({"image_embeds": embeds, "latents": torch.randn(COUNT, 2, 2, 2), "sensor": torch.arange(COUNT) % 3})
    return objective.trained


def test_the_condition_is_one_token_of_the_joint_spaces_norm(embeds: Tensor) -> None:
    hidden = show(embeds).hidden
    assert hidden.shape == (COUNT, 1, WIDTH)
    torch.testing.assert_close(hidden[:, 0], NORM * embeds / embeds.norm(dim=1, keepdim=True))


def test_without_a_condition_the_token_is_zeros(embeds: Tensor) -> None:
    dropped = (show(embeds, condition_dropout=0.25).hidden == 0).flatten(1)
    assert (dropped.any(dim=1) == dropped.all(dim=1)).all()
    assert dropped.all(dim=1).float().mean().item() == pytest.approx(0.25, abs=0.06)


def test_the_sensor_is_named_with_and_without_a_condition(embeds: Tensor) -> None:
    assert torch.equal(show(embeds, condition_dropout=0.5).labels, torch.arange(COUNT) % 3)


def test_some_conditions_are_perturbed_and_keep_their_norm(embeds: Tensor) -> None:
    hidden = show(embeds, noisy_share=0.5, condition_noise=1.0).hidden[:, 0]
    torch.testing.assert_close(hidden.norm(dim=1), torch.full((COUNT,), NORM))
    cosine = torch.cosine_similarity(hidden, embeds, dim=1)
    assert (cosine > 1 - 1e-5).float().mean().item() == pytest.approx(0.5, abs=0.07)
    # A perturbation as long as the embedding and at right angles to it leaves a cosine of 1 / sqrt(2).
    assert 0.5 < cosine.min().item() < 0.72


def test_the_background_of_each_sample_lies_behind_its_noise() -> None:
    settings = TouchDiffusionSettings(condition_dropout=0.5, noisy_share=0.0, condition_noise=0.0, snr_gamma=5.0)
    backgrounds, rows = torch.randn(4, 2, 2, 2), torch.tensor([3, 0, 3])
    objective = TouchDiffusionObjective(Shown(), DDPMScheduler(), NORM, settings, backgrounds)
    batch = {"image_embeds": torch.randn(3, WIDTH), "latents": torch.zeros(3, 2, 2, 2), "sensor": rows}
    objective({**batch, "background": rows})
    assert torch.equal(objective.trained.sample[:, 2:], backgrounds[rows])


def test_every_contact_knows_what_both_of_its_sensors_see_untouched(cache: Path, processor: UniTouchProcessor) -> None:
    config = DataConfig(drawn={"sensors": [None, "digit"], "objects": 1, "contacts_per_object": 2}, audio=AUDIO)
    splits = columns_of(config.sources(), cache, config, processor, ("image", "touch"))
    gels = np.concatenate([untouched_gels(split)[:] for split in splits])
    digit = (untouched_gel(SENSORS["digit"], processor.image_size) * 255).round().byte().numpy()
    for split, places in zip(splits, places_of(splits), strict=True):
        assert np.array_equal(gels[places], split.untouched[:][:, 0])
        assert np.array_equal(gels[places + 1], split.untouched[:][:, 1])
    assert (gels[places_of(splits)[1]] == digit).all() and not (gels[places_of(splits)[0]] == digit).all()
    assert set(class_labels(splits, ["digit"]).tolist()) == {0, 1} and class_labels(splits, ["digit"])[0] == 1
