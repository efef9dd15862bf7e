"""The grid on which a gel is solved: its layout, what refining and spectral slopes do, and what it refuses."""

import math

import pytest
import torch
import torch.nn.functional as F

from unitouch_gen.world import SENSORS, World
from unitouch_gen.world.gel import GelGrid, contact_share
from unitouch_gen.world.optics import slopes, spectral_slopes, touch_images

SENSOR = SENSORS["gelsight"]
ROUGH = torch.rand(2, 128, 128, generator=torch.Generator().manual_seed(0))


def touch(height: torch.Tensor, size: int = 64, **options) -> torch.Tensor:
    rows = torch.ones(len(height))
    return touch_images(height, rows, 0.5 * rows, 0.0 * rows, SENSOR, size, **options)


@pytest.mark.parametrize("size", [16, 33, 50, 64, 66, 128])
@pytest.mark.parametrize("margin", [1.0, 1.125, 1.5, 1.75])
@pytest.mark.parametrize("refinement", [1, 2, 3])
def test_the_view_lies_in_the_middle_of_the_gel_at_its_own_scale(size: int, margin: float, refinement: int) -> None:
    pixels, extent, seen = GelGrid(margin, refinement).layout(SENSOR.field_of_view, size)
    assert seen.start == pixels - seen.stop  # as much on either side
    assert seen.stop - seen.start == refinement * size
    assert extent / pixels == pytest.approx(SENSOR.field_of_view / (refinement * size))
    assert abs(pixels - margin * refinement * size) <= 1.0


@pytest.mark.parametrize("size", [32, 33, 66])
def test_a_surface_like_its_mirror_image_is_touched_alike_on_both_sides(size: int) -> None:
    axis = (torch.arange(128) + 0.5) / 4.0 - 16.0
    ball = ((900.0 - axis[:, None] ** 2 - axis[None, :] ** 2).sqrt() - 30.0)[None]
    dots = touch(ball, size, markers=True)
    bare = touch(ball, size)
    shade = dots / bare  # the lights are not alike on both sides, but what the markers take is
    torch.testing.assert_close(shade, shade.flip(-1), rtol=0, atol=2e-3)


def test_a_refined_gel_shows_the_mean_of_a_larger_image() -> None:
    larger = touch(ROUGH, 128)
    assert torch.equal(touch(ROUGH, 64, grid=GelGrid(refinement=2)), F.avg_pool2d(larger, 2))


def test_the_default_grid_changes_nothing() -> None:
    assert torch.equal(touch(ROUGH), touch(ROUGH, grid=GelGrid(1.5, 1, "central")))


def test_spectral_slopes_of_a_wave_are_its_derivative() -> None:
    size, extent = 32, 8.0
    k = 2 * math.pi * 5 / extent
    x = extent / size * torch.arange(size, dtype=torch.float64)
    wave = torch.sin(k * x).expand(1, size, size)
    along_x, along_y = spectral_slopes(wave, extent)
    torch.testing.assert_close(along_x, (k * torch.cos(k * x)).expand(1, size, size), rtol=0, atol=1e-5)
    torch.testing.assert_close(along_y, torch.zeros_like(along_y), rtol=0, atol=1e-5)
    central, _ = slopes(wave, extent / size)
    assert (central - along_x).abs().max() > 0.1 * k  # which miss a third of a wave of six pixels


@pytest.mark.parametrize("size", [31, 32])
def test_spectral_slopes_turn_with_the_field(size: int) -> None:
    field = torch.rand(1, size, size, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    along_x, along_y = spectral_slopes(field, 4.0)
    turned_x, turned_y = spectral_slopes(field.transpose(1, 2), 4.0)
    torch.testing.assert_close(turned_x, along_y.transpose(1, 2))
    torch.testing.assert_close(turned_y, along_x.transpose(1, 2))


def test_a_world_renders_on_the_grid_it_is_given() -> None:
    names = [0, 7], [1, 1], [0, 0]
    plain = World(resolution=256).render(*names, modalities=("touch",)).touch["gelsight"]
    fine = World(resolution=256, gel=GelGrid(refinement=2)).render(*names, modalities=("touch",)).touch["gelsight"]
    assert fine.shape == plain.shape
    assert not torch.equal(fine, plain)


def test_a_ball_touches_a_disc() -> None:
    axis = (torch.arange(128) + 0.5) / 4.0 - 16.0
    ball = ((900.0 - axis[:, None] ** 2 - axis[None, :] ** 2).sqrt() - 30.0)[None]
    share = contact_share(ball, torch.tensor([0.5]), torch.zeros(1), SENSOR, 64, GelGrid(refinement=4))
    rim = 30.0**2 - 29.5**2  # squared radius of a cap of 0.5 mm
    assert share.item() == pytest.approx(math.pi * rim / SENSOR.field_of_view**2, rel=0.01)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"margin": 0.9}, "margin"),
        ({"margin": math.nan}, "margin"),
        ({"margin": math.inf}, "margin"),
        ({"refinement": 0}, "refinement"),
        ({"refinement": 1.5}, "refinement"),
        ({"slopes": "steep"}, "slopes"),
    ],
)
def test_a_bad_grid_is_refused_by_name(options: dict, named: str) -> None:
    with pytest.raises(ValueError, match=f"`{named}`"):
        GelGrid(**options)


def test_how_many_heights_are_bad_is_said() -> None:
    height = ROUGH.clone()
    height[0, :2, :3], height[1, 5, 5] = math.nan, -math.inf
    with pytest.raises(ValueError, match="`height` holds 7 of 32768 values"):
        touch(height)
