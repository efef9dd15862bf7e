"""Networks fitted to pairs: they learn what a touch says of a picture, and each half is trained by its own loss."""

from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from unitouch_gen.training import paired
from unitouch_gen.training.paired import METHODS, SIDE, fitted

PIXELS = 32


def pairs(count: int = 64) -> tuple[np.ndarray, np.ndarray]:
    """Touches with a bright half, at the left or at the right, and pictures that are bright or dark by it."""
    left = np.arange(count) % 2 == 0
    touch = np.zeros((count, 3, PIXELS, PIXELS), np.uint8)
    touch[left, :, :, : PIXELS // 2] = 255
    touch[~left, :, :, PIXELS // 2 :] = 255
    return touch, np.broadcast_to(np.where(left, 220, 30).astype(np.uint8)[:, None, None, None], touch.shape).copy()


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(paired, "SIDE", 16)


@pytest.mark.parametrize("method", METHODS)
def test_a_method_learns_what_touches_say(method: str, small: None, tmp_path: Path) -> None:
    touch, image = pairs()
    network = fitted(method, [touch], [image], 25, tmp_path, "pairs")
    made = network.draw(torch.from_numpy(touch[:2]).float() / 255)
    assert made.shape == (2, 3, PIXELS, PIXELS) and made.min() >= 0.0 and made.max() <= 1.0
    assert made[0].mean() - made[1].mean() > 0.4  # 0.86 and 0.12 in truth


def test_one_that_was_trained_is_found_again(small: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    touch, image = pairs(16)
    shown = torch.rand(2, 3, PIXELS, PIXELS)
    first = fitted("pix2pix", [touch], [image], 2, tmp_path, "pairs").draw(shown)
    other = fitted("pix2pix", [touch], [image], 2, tmp_path, "pairs", seed=1).draw(shown)
    assert len(list(tmp_path.iterdir())) == 2 and not torch.equal(other, first)
    monkeypatch.setattr(paired, "Trainer", None)
    assert torch.equal(fitted("pix2pix", [touch], [image], 2, tmp_path, "pairs").draw(shown), first)


def test_one_that_was_stopped_goes_on(small: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    touch, image = pairs(16)
    whole = fitted("pix2pix", [touch], [image], 4, tmp_path / "whole", "pairs").state_dict()
    step = paired.Trainer.train_step

    def stopped(trainer: paired.Trainer, batch: paired.Batch) -> dict[str, float]:
        trainer.stopped = trainer.step == 1
        return step(trainer, batch)

    monkeypatch.setattr(paired.Trainer, "train_step", stopped)
    with pytest.raises(SystemExit):
        fitted("pix2pix", [touch], [image], 4, tmp_path / "parts", "pairs")
    monkeypatch.setattr(paired.Trainer, "train_step", step)
    again = fitted("pix2pix", [touch], [image], 4, tmp_path / "parts", "pairs").state_dict()
    for name, value in whole.items():
        torch.testing.assert_close(again[name], value, msg=name)


@pytest.mark.parametrize("method", METHODS)
def test_each_half_has_the_gradients_of_its_own_loss(method: str) -> None:
    """Of two losses one after the other, as Isola et al. (2017) take them."""
    torch.manual_seed(0)
    objective = METHODS[method]()
    touch, image = (torch.from_numpy(part[:2]) for part in pairs())
    objective({"touch": touch, "image": image})["loss"].backward()
    gradients = {name: value.grad.clone() for name, value in objective.named_parameters()}
    objective.zero_grad()

    shown, true = (2 * F.interpolate(part.float() / 255, (SIDE, SIDE), mode="area") - 1 for part in (touch, image))
    made = objective.generator(shown)
    said = [objective.discriminator(torch.cat([shown, part], dim=1)) for part in (true, made.detach())]
    told = [objective.criterion(part, torch.full_like(part, number)) for part, number in zip(said, (1.0, 0.0))]
    half = dict(objective.discriminator.named_parameters())
    of_discriminator = torch.autograd.grad(0.5 * sum(told), list(half.values()))
    fooled = objective.discriminator(torch.cat([shown, made], dim=1))
    loss = objective.criterion(fooled, torch.ones_like(fooled)) + objective.weight * F.l1_loss(made, true)
    of_generator = torch.autograd.grad(loss, list(objective.generator.parameters()))
    for (name, _), value in zip(half.items(), of_discriminator, strict=True):
        torch.testing.assert_close(gradients[f"discriminator.{name}"], value)
    for (name, _), value in zip(objective.generator.named_parameters(), of_generator, strict=True):
        torch.testing.assert_close(gradients[f"generator.{name}"], value)
