"""Pictures through air: the flat surface, whose shading has a closed form, and what light, body and grid do to it."""

import math

import pytest
import torch

from unitouch_gen.world.fields import PATCH_MM
from unitouch_gen.world.optics import pictures

WHITE = torch.ones(3)


def picture(height=None, albedo=0.4, body=None, light=(0.0, 0.0, 1.0), gloss=0.0, white=WHITE, size=16) -> torch.Tensor:
    height = torch.zeros(1, 32, 32) if height is None else height
    body = torch.ones_like(height) if body is None else body
    toward = torch.tensor([light]) / math.dist(light, (0, 0, 0))
    colour = torch.full((1, 3, *height.shape[-2:]), albedo)
    return pictures(height, colour, body, toward, torch.tensor([gloss]), size, white)


@pytest.mark.parametrize("elevation", [0.4, 0.9, 1.5])
def test_a_flat_matt_surface_has_lamberts_brightness(elevation: float) -> None:
    image = picture(light=(math.cos(elevation), 0.0, math.sin(elevation)))
    expected = (0.4 * (0.38 + 0.72 * math.sin(elevation))) ** (1 / 1.8)
    torch.testing.assert_close(image, torch.full_like(image, expected))


def test_a_slope_toward_the_lamp_is_brighter() -> None:
    ramp = (torch.arange(32) * PATCH_MM / 32)[None, None, :].expand(1, 32, 32)
    toward, away = picture(-0.5 * ramp, light=(1.0, 0.0, 1.0)), picture(0.5 * ramp, light=(1.0, 0.0, 1.0))
    assert toward[..., 4:-4].min() > away[..., 4:-4].max()


def test_turning_the_scene_turns_the_picture() -> None:
    height = torch.rand(1, 32, 32, generator=torch.Generator().manual_seed(0))
    image = picture(height, light=(0.6, 0.2, 0.7), gloss=0.5)
    turned = picture(height.transpose(1, 2), light=(0.2, 0.6, 0.7), gloss=0.5)
    torch.testing.assert_close(turned, image.transpose(2, 3), rtol=0, atol=1e-5)


def test_gloss_adds_light_that_is_white() -> None:
    gain = (picture(gloss=0.5) ** 1.8 - picture(gloss=0.0) ** 1.8)[0]
    torch.testing.assert_close(gain, torch.full_like(gain, 0.35 * 0.5), rtol=1e-4, atol=1e-4)


def test_what_lies_behind_shows_where_there_is_no_body() -> None:
    image = picture(body=torch.zeros(1, 32, 32), albedo=0.9)
    assert torch.equal(image, picture(body=torch.zeros(1, 32, 32), albedo=0.1))


def test_the_white_balance_scales_linear_light() -> None:
    white = torch.tensor([1.0, 0.5, 0.25])
    ratio = (picture(white=white) / picture())[0].mean(dim=(1, 2)) ** 1.8
    torch.testing.assert_close(ratio, white, rtol=1e-4, atol=1e-4)


def test_a_cliff_and_a_spike_stay_finite_and_in_range() -> None:
    height = torch.zeros(2, 32, 32)
    height[0, :, 16:], height[1, 16, 16] = 1e4, -1e4
    image = pictures(
        height, torch.ones(2, 3, 32, 32), torch.ones(2, 32, 32), torch.eye(3)[[0, 2]], torch.ones(2), 16, 2.0 * WHITE
    )
    assert torch.isfinite(image).all()
    assert image.min() >= 0.0
    assert image.max() <= 1.0
