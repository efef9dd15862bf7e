"""Gels against closed forms."""

import math
from dataclasses import replace

import pytest
import torch

from tests.helpers.plain_sensor import PLAIN
from unitouch_gen.world import Sensor
from unitouch_gen.world.gel import gel_displacement, gel_indentation, gel_square, in_view, resample_centre
from unitouch_gen.world.grids import PATCH_MM, pixel_axis

EXTENT, THICKNESS, CORRELATION, RELAXATION = 24.0, 2.0, 0.9, 0.05
GEL = replace(
    PLAIN, field_of_view=EXTENT, thickness=THICKNESS, correlation=CORRELATION, relaxation=RELAXATION, blur=0.0
)


def displaced(load: torch.Tensor, dwell: float, gel: Sensor = GEL) -> torch.Tensor:
    """Displacement by a saturated load over the whole square (the inverse of p = T (1 - e^{-d/T}))."""
    indentation = -THICKNESS * torch.log1p(-load / THICKNESS)
    return gel_displacement(indentation, torch.tensor([dwell]).double(), gel, load.shape[-1])


@pytest.mark.parametrize("mode", [(0, 0), (0, 1), (2, 5)])
@pytest.mark.parametrize(("dwell", "blur"), [(0.0, 0.0), (0.03, 0.0), (0.03, 0.5), (1e6, 0.0)])
def test_a_cosine_indentation_is_one_decaying_mode(mode: tuple[int, int], dwell: float, blur: float) -> None:
    index = torch.arange(32, dtype=torch.float64)
    wave = torch.cos(2 * math.pi * (mode[0] * index[:, None] + mode[1] * index[None, :]) / 32)[None]
    k2 = (2 * math.pi / EXTENT) ** 2 * (mode[0] ** 2 + mode[1] ** 2)

    def settled(rate: float) -> float:
        return -math.expm1(-rate * dwell / RELAXATION) / rate

    blurred = settled(1 + CORRELATION**2 * k2) * math.exp(-0.5 * blur**2 * k2)  # as a Gaussian does
    u = displaced(0.6 + 0.4 * wave, dwell, replace(GEL, blur=blur))
    torch.testing.assert_close(u, 0.6 * settled(1.0) + 0.4 * blurred * wave, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("correlation", [0.3, 1.0])
def test_a_gel_that_follows_is_drawn_along_exponentially_beside_a_ridge(correlation: float) -> None:
    """u - c^2 u'' = 0 beside a ridge of one depth, and the ridge's own depth where it touches."""
    x = pixel_axis(192, EXTENT).double()
    load = 0.5 * (x.abs() < 2.0).double().expand(1, 192, -1)
    gels = (replace(GEL, correlation=correlation, contact_steps=steps) for steps in (200, 20))
    u, few = (displaced(load, math.inf, gel) for gel in gels)
    edge = x[x.abs() < 2.0].max()
    beside = 0.5 * torch.exp(-(x.abs() - edge).clamp_min(0.0) / correlation)
    torch.testing.assert_close(u[0, 0], beside, rtol=0.0, atol=0.03)
    torch.testing.assert_close(few, u, rtol=0.0, atol=0.02)


def test_a_ball_touches_a_disc_at_any_height() -> None:
    axis = pixel_axis(512)
    ball = ((900.0 - axis[:, None] ** 2 - axis[None, :] ** 2).sqrt() - 23.0)[None]
    indentation = in_view(gel_indentation(ball, torch.tensor([0.5]), PLAIN, 256), 256)
    assert indentation.max() == pytest.approx(0.5)
    assert indentation.min() == 0.0
    rim = 30.0**2 - 29.5**2  # squared radius of a cap of 0.5 mm
    assert (indentation > 0.0).float().mean().item() == pytest.approx(math.pi * rim / PLAIN.field_of_view**2, rel=0.01)


@pytest.mark.parametrize("size", [16, 33, 66, 128])
def test_the_view_lies_in_the_middle_of_the_gel_at_its_own_scale(size: int) -> None:
    pixels, extent = gel_square(PLAIN, size)
    assert extent / pixels == pytest.approx(16.0 / size)
    assert abs(pixels - 1.5 * size) <= 1.0
    axis = pixel_axis(pixels, extent).expand(1, pixels, -1)
    torch.testing.assert_close(in_view(axis, size)[0, 0], pixel_axis(size, 16.0))


@pytest.mark.parametrize("pixels", [24, 25, 64, 90])  # 2.7, 2.6, 1 and 0.7 pixels of the plane to one
def test_resampling_reproduces_a_plane(pixels: int) -> None:
    def plane(axis: torch.Tensor) -> torch.Tensor:
        return 3.0 * axis[None, None, :] - 2.0 * axis[None, :, None]

    small = resample_centre(plane(pixel_axis(128)), 16.0, pixels)
    torch.testing.assert_close(small, plane(pixel_axis(pixels, 16.0)), rtol=0, atol=1e-4)


@pytest.mark.parametrize("resolution", [192, 448])  # 1.5 and 3.5 to a pixel of the target
def test_a_wave_beyond_the_targets_nyquist_limit_does_not_fold_back(resolution: int) -> None:
    cycles = 1.4 * 0.5 * 128  # over the whole patch; the target has 96 pixels on three quarters of it
    wave = torch.cos(2 * math.pi * cycles * (torch.arange(resolution) + 0.5) / resolution)
    wave = wave.expand(1, resolution, resolution)
    assert resample_centre(wave, 0.75 * PATCH_MM, 96).std() < 0.2 * wave.std()
