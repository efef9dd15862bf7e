"""Pictures through air: the flat surface, whose shading has a closed form, and what light, body and grid do to it."""

import math

import pytest
import torch

from unitouch_gen.world.fields import PATCH_MM
from unitouch_gen.world.optics import GAMMA, pictures

WHITE = torch.ones(3)


def picture(height=None, albedo=0.4, body=None, light=(0.0, 0.0, 1.0), gloss=0.0, white=WHITE, size=16) -> torch.Tensor:
    height = torch.zeros(1, 32, 32) if height is None else height
    body = torch.ones_like(height) if body is None else body
    toward = torch.tensor([light]) / math.dist(light, (0, 0, 0))
    colour = albedo if isinstance(albedo, torch.Tensor) else torch.full((1, 3, *height.shape[-2:]), albedo)
    return pictures(height, colour, body, toward, torch.tensor([gloss]), size, white)


def lit_from(elevation: float, **kwargs) -> torch.Tensor:
    """Linear light of a flat surface under a lamp at an elevation in radians."""
    image = picture(light=(math.cos(elevation), 0.0, math.sin(elevation)), **kwargs)
    torch.testing.assert_close(image, image[:, :, :1, :1].expand_as(image))  # flat: the same all over
    return image[0, :, 0, 0] ** GAMMA


@pytest.mark.parametrize("albedo", [0.1, 0.4])
@pytest.mark.parametrize("elevation", [0.2, 0.9, 1.2])
def test_a_flat_matt_surface_brightens_as_lamberts_cosine(elevation: float, albedo: float) -> None:
    low, high, between = (lit_from(angle, albedo=albedo) for angle in (0.0, math.pi / 2, elevation))
    ratio = (between - low) / (high - low)  # what the sky adds cancels
    torch.testing.assert_close(ratio, torch.full((3,), math.sin(elevation)), rtol=1e-4, atol=1e-4)


def test_a_matt_surface_sends_back_its_albedos_share() -> None:
    ratio = lit_from(0.7, albedo=0.6) / lit_from(0.7, albedo=0.2)
    torch.testing.assert_close(ratio, torch.full((3,), 3.0), rtol=1e-4, atol=0)


def test_a_slope_toward_the_lamp_is_brighter() -> None:
    ramp = (torch.arange(32) * PATCH_MM / 32)[None, None, :].expand(1, 32, 32)
    toward, away = picture(-0.5 * ramp, light=(1.0, 0.0, 1.0)), picture(0.5 * ramp, light=(1.0, 0.0, 1.0))
    assert toward[..., 4:-4].min() > away[..., 4:-4].max()


def test_turning_the_scene_turns_the_picture() -> None:
    height = torch.rand(1, 32, 32, generator=torch.Generator().manual_seed(0))
    image = picture(height, light=(0.6, 0.2, 0.7), gloss=0.5)
    turned = picture(height.transpose(1, 2), light=(0.2, 0.6, 0.7), gloss=0.5)
    torch.testing.assert_close(turned, image.transpose(2, 3), rtol=0, atol=1e-5)


def test_gloss_adds_white_light_in_proportion() -> None:
    red = torch.tensor([0.5, 0.2, 0.1])[:, None, None].expand(1, 3, 32, 32)
    gains = []
    for gloss in (0.4, 0.8):
        plain, glossy = (picture(albedo=red, gloss=weight) ** GAMMA for weight in (0.0, gloss))
        gains.append(glossy - plain)
    assert gains[0].min() > 0.0
    torch.testing.assert_close(gains[0], gains[0][:, :1].expand_as(gains[0]))  # the same on every channel
    torch.testing.assert_close(gains[1], 2 * gains[0])


def test_what_lies_behind_shows_where_there_is_no_body() -> None:
    image = picture(body=torch.zeros(1, 32, 32), albedo=0.9)
    assert torch.equal(image, picture(body=torch.zeros(1, 32, 32), albedo=0.1))


def test_the_white_balance_scales_linear_light() -> None:
    white = torch.tensor([1.0, 0.5, 0.25])
    ratio = (picture(white=white) / picture())[0].mean(dim=(1, 2)) ** GAMMA
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
