"""What the touch network is shown in training: one token, of one norm, sometimes perturbed, sometimes none."""

import pytest
import torch
from diffusers import DDPMScheduler
from diffusers.models.unets.unet_2d_condition import UNet2DConditionOutput
from torch import Tensor, nn

from unitouch_gen.training.touch_ldm import TouchDiffusionObjective, TouchDiffusionSettings

COUNT, WIDTH, NORM = 800, 64, 14.0


class Shown(nn.Module):
    """A network that predicts nothing, and keeps what it is shown."""

    def forward(self, sample: Tensor, steps: Tensor, encoder_hidden_states: Tensor, class_labels: Tensor):
        self.hidden, self.labels = encoder_hidden_states, class_labels
        return UNet2DConditionOutput(sample=torch.zeros_like(sample))


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
