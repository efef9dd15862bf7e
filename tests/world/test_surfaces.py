"""Bodies are the solids they are named after; pictures of surfaces whose shading is known."""

import math

import pytest
import torch
from torch import Tensor

from unitouch_gen.world.bodies import NOTHING, body
from unitouch_gen.world.draws import SHAPES, draw
from unitouch_gen.world.grids import PATCH_MM, pixel_axis
from unitouch_gen.world.surfaces import GAMMA, Surfaces, pictures, surfaces

AXIS = pixel_axis(257)
X = AXIS[None, :].expand(257, -1)
Y = AXIS[:, None].expand(-1, 257)


def solid(name: str, size: float, numbers: tuple[float, float, float]) -> Tensor:
    return body(name, X[None], Y[None], torch.full((1, 1, 1), size), torch.tensor(numbers)[None, :, None, None])[0]


@pytest.mark.parametrize("name", [name for name in SHAPES if name != "flat"])
def test_heights_are_finite_and_the_top_is_near_zero(name: str) -> None:
    for size in (0.5, 3.0, 12.0):
        for numbers in ((0.0, 0.0, 0.0), (0.3, 0.7, 0.5), (0.99, 0.99, 0.99)):
            height = solid(name, size, numbers)
            assert torch.isfinite(height).all()
            assert height.min() >= NOTHING - 5.0
            assert -0.5 < height.max() < 1.6
            assert height.clamp_min(-2.0).std() > 1e-3  # none is a plane


def test_a_ball_is_a_sphere_a_rod_a_cylinder_and_a_ring_a_torus() -> None:
    tube = 0.15 * 6.0
    for name, size, numbers, away, radius, inside in (
        ("ball", 5.0, (0.5, 0.5, 0.5), torch.hypot(X, Y), 5.0, torch.hypot(X, Y) < 4.9),
        ("rod", 2.0, (0.25, 0.5, 0.0), Y.abs(), 2.0, (X.abs() < 6.0) & (Y.abs() < 1.9)),  # 2 (1 + 8 / 4) to a side
        ("ring", 6.0, (0.5, 0.0, 0.0), torch.hypot(X, Y) - 6.0, tube, (torch.hypot(X, Y) - 6.0).abs() < 0.95 * tube),
    ):
        height = solid(name, size, numbers)
        expected = (radius**2 - away**2).clamp_min(0.0).sqrt() - radius
        torch.testing.assert_close(height[inside], expected[inside], rtol=0, atol=1e-5)
        assert (height[torch.hypot(X, Y) > 8.6] == NOTHING).all()


def test_a_body_is_nothing_beside_itself_and_a_surface_without_colours_the_same() -> None:
    grid = torch.cartesian_prod(torch.arange(17), torch.arange(12))
    drawn = draw(0, grid[:, 0], grid[:, 1], torch.arange(len(grid)) % 3)
    built = surfaces(0, drawn, 128)
    bare = surfaces(0, drawn, 128, coloured=False)
    assert torch.equal(bare.height, built.height)
    assert torch.equal(bare.body, built.body)
    assert bare.albedo is None
    assert torch.isfinite(built.height).all()
    assert built.albedo.min() >= 0.0
    assert built.albedo.max() <= 1.0
    reach = drawn.shape_offset.abs().amax(dim=1) + drawn.shape_radius
    whole = (drawn.shape == list(SHAPES).index("ball")) & (reach < 16.0) & (drawn.shape_radius < 8.0)
    area = torch.pi * drawn.shape_radius[whole] ** 2 / PATCH_MM**2
    torch.testing.assert_close(built.body[whole].mean(dim=(-2, -1)), area, rtol=0.05, atol=0.003)


def picture(height=None, albedo=0.4, behind=False, light=(0.0, 0.0, 1.0), gloss=0.0, white=(1.0, 1.0, 1.0)) -> Tensor:
    """Of a surface (32, 32), level if left out, (3, 16, 16)."""
    height = torch.zeros(32, 32) if height is None else height
    seen = Surfaces(
        height[None],
        torch.tensor(albedo).expand(3)[None, :, None, None].expand(1, 3, 32, 32),
        torch.full((1, 32, 32), float(not behind)),
    )
    toward = torch.tensor([light]) / math.dist(light, (0, 0, 0))
    return pictures(seen, toward, torch.tensor([gloss]), torch.tensor([white]), torch.tensor([PATCH_MM]), 16)[0]


def lit_from(elevation: float, **options) -> Tensor:
    """Linear light (3,) of a flat surface under a lamp at an elevation in radians."""
    image = picture(light=(math.cos(elevation), 0.0, math.sin(elevation)), **options)
    torch.testing.assert_close(image, image[:, :1, :1].expand_as(image))  # flat: the same all over
    return image[:, 0, 0] ** GAMMA


@pytest.mark.parametrize("albedo", [0.1, 0.4])
@pytest.mark.parametrize("elevation", [0.2, 0.9])
def test_a_flat_matt_surface_brightens_as_lamberts_cosine(elevation: float, albedo: float) -> None:
    low, high, between = (lit_from(angle, albedo=albedo) for angle in (0.0, math.pi / 2, elevation))
    ratio = (between - low) / (high - low)  # what the sky adds cancels
    torch.testing.assert_close(ratio, torch.full((3,), math.sin(elevation)), rtol=1e-4, atol=1e-4)
    share = lit_from(elevation, albedo=2 * albedo) / between
    torch.testing.assert_close(share, torch.full((3,), 2.0), rtol=1e-4, atol=0)


def test_slopes_toward_the_lamp_are_brighter_and_turning_the_scene_turns_the_picture() -> None:
    toward, away = (picture(slope * pixel_axis(32).expand(32, -1), light=(1.0, 0.0, 1.0)) for slope in (-0.5, 0.5))
    assert toward[..., 4:-4].min() > away[..., 4:-4].max()
    height = torch.rand(32, 32, generator=torch.Generator().manual_seed(0))
    image = picture(height, light=(0.6, 0.2, 0.7), gloss=0.5)
    turned = picture(height.T, light=(0.2, 0.6, 0.7), gloss=0.5)
    torch.testing.assert_close(turned, image.transpose(1, 2), rtol=0, atol=1e-5)


def test_gloss_adds_white_light_in_proportion_and_the_white_balance_scales_it() -> None:
    plain, some, twice = (picture(albedo=(0.5, 0.2, 0.1), gloss=gloss) ** GAMMA for gloss in (0.0, 0.4, 0.8))
    assert (some - plain).min() > 0.0
    torch.testing.assert_close(some - plain, (some - plain)[:1].expand(3, 16, 16))  # the same on every channel
    torch.testing.assert_close(twice - plain, 2 * (some - plain))
    ratio = (picture(white=(1.0, 0.5, 0.25)) / picture()).mean(dim=(1, 2)) ** GAMMA
    torch.testing.assert_close(ratio, torch.tensor([1.0, 0.5, 0.25]), rtol=1e-4, atol=1e-4)
    assert torch.equal(picture(behind=True, albedo=0.9), picture(behind=True, albedo=0.1))
