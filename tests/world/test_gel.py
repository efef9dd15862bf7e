"""Gels against closed forms and an integrated equation, stiff and extreme ones included."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from tests.helpers.plain_sensor import PLAIN
from unitouch_gen.world.gel import contact_indentation, gel_displacement, gel_square, in_view, resample_centre
from unitouch_gen.world.grids import PATCH_MM, pixel_axis
from unitouch_gen.world.sensors import gel_indentation

EXTENT, THICKNESS, CORRELATION, RELAXATION = 24.0, 2.0, 0.9, 0.05
GEL = {"extent": EXTENT, "thickness": THICKNESS, "correlation": CORRELATION, "relaxation": RELAXATION}
STIFFNESSES = (1e-3, 1.0, 1e3)


def indentation_of(load: torch.Tensor) -> torch.Tensor:
    """The indentation whose saturated load is `load` (the inverse of p = T (1 - e^{-d/T}))."""
    return -THICKNESS * torch.log1p(-load / THICKNESS)


def cosine(mode: tuple[int, int], size: int = 32) -> torch.Tensor:
    """cos(k . x) over the square, float64 (1, size, size)."""
    index = torch.arange(size, dtype=torch.float64)
    return torch.cos(2 * math.pi * (mode[0] * index[:, None] + mode[1] * index[None, :]) / size)[None]


def random_load(size: int) -> torch.Tensor:
    return 1.9 * torch.rand(1, size, size, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


@pytest.mark.parametrize("stiffness", STIFFNESSES)
@pytest.mark.parametrize("mode", [(0, 0), (0, 1), (2, 5)])
@pytest.mark.parametrize(("dwell", "blur"), [(0.0, 0.0), (0.03, 0.0), (0.03, 0.5), (1e6, 0.0)])
def test_a_cosine_indentation_is_one_decaying_mode(stiffness, mode: tuple[int, int], dwell, blur) -> None:
    wave = cosine(mode)
    k2 = (2 * math.pi / EXTENT) ** 2 * (mode[0] ** 2 + mode[1] ** 2)
    pressed = indentation_of(0.6 + 0.4 * wave)
    u = gel_displacement(pressed, torch.tensor([dwell]).double(), stiffness=stiffness, blur=blur, **GEL)

    def settled(rate: float) -> float:
        return -math.expm1(-rate * dwell / RELAXATION) / rate

    blurred = settled(stiffness * (1 + CORRELATION**2 * k2)) * math.exp(-0.5 * blur**2 * k2)  # as a Gaussian does
    torch.testing.assert_close(u, 0.6 * settled(stiffness) + 0.4 * blurred * wave, rtol=1e-6, atol=1e-9)


def laplacian(u: np.ndarray) -> np.ndarray:
    k = 2 * np.pi * np.fft.fftfreq(len(u), EXTENT / len(u))
    return np.fft.ifft2(-(k[:, None] ** 2 + k[None, :] ** 2) * np.fft.fft2(u)).real


@pytest.mark.parametrize("stiffness", STIFFNESSES)
def test_the_solution_agrees_with_an_integrated_equation(stiffness: float) -> None:
    size, dwell, load = 8, 0.07, random_load(8)

    def rate_of_change(_: float, u: np.ndarray) -> np.ndarray:
        u = u.reshape(size, size)
        return ((load[0].numpy() - stiffness * (u - CORRELATION**2 * laplacian(u))) / RELAXATION).ravel()

    solved = solve_ivp(rate_of_change, (0.0, dwell), np.zeros(size * size), method="Radau", rtol=1e-9, atol=1e-12)
    u = gel_displacement(indentation_of(load), torch.tensor([dwell]).double(), stiffness=stiffness, **GEL)
    np.testing.assert_allclose(u[0].numpy(), solved.y[:, -1].reshape(size, size), rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("dwell", [1e9, math.inf])
def test_after_long_the_gel_is_in_balance_with_the_load(dwell: float) -> None:
    load = random_load(32)
    u = gel_displacement(indentation_of(load), torch.tensor([dwell]).double(), stiffness=3.0, **GEL)[0].numpy()
    np.testing.assert_allclose(3.0 * (u - CORRELATION**2 * laplacian(u)), load[0].numpy(), atol=1e-5)


def test_moving_the_indenter_moves_the_displacement() -> None:
    pressed, time = random_load(32), torch.tensor([0.1]).double()
    still = gel_displacement(pressed, time, contact_steps=5, **GEL)
    moved = gel_displacement(pressed.roll((5, 9), (1, 2)), time, contact_steps=5, **GEL)
    torch.testing.assert_close(moved, still.roll((5, 9), (1, 2)))


@pytest.mark.parametrize("correlation", [0.3, 1.0])
def test_a_gel_that_follows_is_drawn_along_exponentially_beside_a_ridge(correlation: float) -> None:
    """u - c^2 u'' = 0 beside a ridge of one depth, and the ridge's own depth where it touches."""
    x = pixel_axis(192, EXTENT).double()
    load = 0.5 * (x.abs() < 2.0).double().expand(1, 192, -1)
    settled = {**GEL, "correlation": correlation, "relaxation": 0.0}
    u = gel_displacement(indentation_of(load), torch.ones(1), contact_steps=200, **settled)
    edge = x[x.abs() < 2.0].max()
    beside = 0.5 * torch.exp(-(x.abs() - edge).clamp_min(0.0) / correlation)
    torch.testing.assert_close(u[0, 0], beside, rtol=0.0, atol=0.03)
    few = gel_displacement(indentation_of(load), torch.ones(1), contact_steps=20, **settled)
    torch.testing.assert_close(few, u, rtol=0.0, atol=0.02)


def test_indentation_is_the_part_of_the_surface_beyond_the_gel() -> None:
    height = torch.tensor([[[0.0, -0.2], [-0.5, -3.0]]])
    expected = torch.tensor([[[0.4, 0.2], [0.0, 0.0]]])
    torch.testing.assert_close(contact_indentation(height + 7.0, torch.tensor([0.4])), expected)


def test_a_ball_touches_a_disc() -> None:
    axis = pixel_axis(512)
    ball = ((900.0 - axis[:, None] ** 2 - axis[None, :] ** 2).sqrt() - 30.0)[None]
    touched = in_view(gel_indentation(ball, torch.tensor([0.5]), PLAIN, 256), 256) > 0.0
    rim = 30.0**2 - 29.5**2  # squared radius of a cap of 0.5 mm
    assert touched.float().mean().item() == pytest.approx(math.pi * rim / PLAIN.field_of_view**2, rel=0.01)


@pytest.mark.parametrize("size", [16, 33, 66, 128])
def test_the_view_lies_in_the_middle_of_the_gel_at_its_own_scale(size: int) -> None:
    pixels, extent = gel_square(16.0, size)
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
