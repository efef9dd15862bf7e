"""Noise and cells in closed form, whatever the grid."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from unitouch_gen.world.draws import draw
from unitouch_gen.world.grids import wavenumbers
from unitouch_gen.world.materials import MATERIALS
from unitouch_gen.world.reliefs import BASE_RESOLUTION, Fields, hash_unit, relief, zero_pad_spectrum


def unit_fields(resolution: int = BASE_RESOLUTION, angle: float = 0.4, scale: float = 1.0) -> Fields:
    rows = torch.arange(4)
    drawn = draw(0, 0 * rows, rows, 0 * rows)
    drawn.angle[:], drawn.scale[:] = angle, scale
    return Fields(0, drawn, rows, resolution)


@pytest.mark.parametrize("resolution", [16, 25, 48])
def test_a_finer_grid_is_the_trigonometric_interpolant(resolution: int) -> None:
    spectrum = np.fft.rfft2(np.random.default_rng(0).standard_normal((16, 16)))
    spectrum[8], spectrum[:, 8] = 0.0, 0.0  # of a field without its Nyquist row and column
    field = np.fft.irfft2(spectrum, (16, 16))
    coefficients = np.fft.fft2(field) / 16**2
    modes = np.fft.fftfreq(16, 1 / 16)
    centres = (np.arange(resolution) + 0.5) / resolution - 0.5 / 16  # shares of the side from the first coarse centre
    basis = np.exp(2j * np.pi * np.outer(centres, modes))  # (fine points, modes)
    padded = zero_pad_spectrum(torch.fft.rfft2(torch.from_numpy(field)[None]), resolution)
    found = torch.fft.irfft2(padded, s=(resolution, resolution))[0].numpy()
    np.testing.assert_allclose(found, (basis @ coefficients @ basis.T).real, atol=1e-12)


@pytest.mark.parametrize(
    "settings", [(1.7, 0.5, 1.0, 0), (9.0, 0.3, 3.0, 0), (0.95, 0.3, 24.0, 0), (3.2, 0.25, 1.0, 1)]
)
@pytest.mark.parametrize("resolution", [128, 256])
def test_noise_has_no_mean_and_unit_variance(settings: tuple, resolution: int) -> None:
    noise = unit_fields(resolution).noise(*settings)
    torch.testing.assert_close(noise.mean(dim=(1, 2)), torch.zeros(4), rtol=0, atol=1e-4)
    torch.testing.assert_close(noise.square().mean(dim=(1, 2)), torch.ones(4), rtol=0, atol=0.02)


@pytest.mark.parametrize("wavelength", [1.5, 10.0])
def test_noise_has_its_power_around_its_wavelength(wavelength: float) -> None:
    power = torch.fft.rfft2(unit_fields().noise(wavelength, width=0.2)).abs().square().mean(dim=0)
    ky, kx = wavenumbers(BASE_RESOLUTION)
    k = torch.hypot(kx.expand_as(power), ky.expand_as(power))
    # A Gaussian of 0.2 in log k, weighted by the number of modes (~ k), centres at exp(2 * 0.2^2) above.
    centre = (torch.log(k.clamp_min(1e-3)) * power).sum() / power.sum()
    assert math.exp(centre) == pytest.approx(2 * math.pi / wavelength, rel=0.25)


def test_noise_is_stretched_along_the_grain_shifted_and_scaled() -> None:
    noise = unit_fields(angle=0.0).noise(3.0, stretch=6.0)
    along, across = ((noise.roll(1, axis) - noise).square().mean() for axis in (-1, -2))
    assert along < 0.2 * across
    made = unit_fields()
    assert (made.noise(2.0) * made.noise(2.0, shift=1)).mean(dim=(1, 2)).abs().max() < 0.2  # another realisation
    torch.testing.assert_close(unit_fields(scale=2.0).noise(2.0), made.noise(4.0), rtol=1e-4, atol=1e-4)


def test_cell_distances_are_those_of_a_k_d_tree() -> None:
    size = 2.1
    made = unit_fields(256)
    i, j = torch.meshgrid(torch.arange(-60.0, 60.0), torch.arange(-60.0, 60.0), indexing="xy")
    a = hash_unit(i, j, made.cell_seed[0])
    b = hash_unit(j, i, made.cell_seed[0] + 17)
    seeds = torch.stack([i + a, j + b], dim=-1).reshape(-1, 2)
    points = torch.stack([made.x[0], made.y[0]], dim=-1).reshape(-1, 2) / size
    expected, nearest = cKDTree(seeds.numpy()).query(points.numpy(), k=2)
    first, second, label = (part[0].flatten().numpy() for part in made.cells(size))
    np.testing.assert_allclose(first, expected[:, 0], atol=1e-5)
    excess = second - expected[:, 1]
    assert excess.min() > -1e-5
    assert (excess > 1e-5).mean() <= 1e-3  # seeds beyond the 3 x 3 squares searched
    assert np.isclose(label, a.flatten().numpy()[nearest[:, 0]], atol=1e-6).mean() > 0.999  # ties fall either way


def test_roughness_is_that_of_the_reliefs() -> None:
    rows = torch.arange(32)
    for index, material in enumerate(MATERIALS):
        drawn = draw(0, torch.full((32,), index), rows, torch.zeros(32, dtype=torch.int64))
        height, _ = relief(material.name, Fields(0, drawn, rows, 128))
        deviation = (height.flatten(1).std(dim=1) / drawn.amplitude).median()
        assert material.roughness == pytest.approx(deviation.item(), rel=0.2)
