"""Noise and cells in closed form, whatever the grid; pictures of surfaces whose shading is known."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from scipy.stats import kstest

from unitouch_gen.world.draws import draw
from unitouch_gen.world.surfaces import (
    BASE_RESOLUTION,
    GAMMA,
    PATCH_MM,
    Fields,
    hash_unit,
    pictures,
    pixel_axis,
    surfaces,
    wavenumbers,
    white_spectrum,
    zero_pad_spectrum,
)


def fields(resolution: int = BASE_RESOLUTION, count: int = 4, angle: float = 0.4, seed: int = 0) -> Fields:
    names = torch.zeros(count, dtype=torch.int64), torch.arange(count), torch.zeros(count, dtype=torch.int64)
    axis = pixel_axis(resolution)
    one = torch.ones(count, 1, 1)
    return Fields(
        x=axis[None, None, :].expand(count, resolution, -1),
        y=axis[None, :, None].expand(count, -1, resolution),
        angle=angle * one,
        scale=one,
        amplitude=one,
        spectrum=white_spectrum(seed, *names),
        cell_seed=torch.arange(1.0, count + 1)[:, None, None],
    )


def band_limited(size: int) -> np.ndarray:
    """A random real field without its Nyquist row and column."""
    spectrum = np.fft.rfft2(np.random.default_rng(0).standard_normal((size, size)))
    spectrum[size // 2] = 0.0
    spectrum[:, size // 2] = 0.0
    return np.fft.irfft2(spectrum, (size, size))


def padded(field: np.ndarray, resolution: int) -> np.ndarray:
    spectrum = zero_pad_spectrum(torch.fft.rfft2(torch.from_numpy(field)[None]), resolution)
    return torch.fft.irfft2(spectrum, s=(resolution, resolution))[0].numpy()


def test_pixels_are_centred_on_zero_and_evenly_spaced() -> None:
    axis = pixel_axis(10, 5.0)
    torch.testing.assert_close(axis, torch.linspace(-2.25, 2.25, 10))


def test_wavenumbers_are_numpys_frequencies() -> None:
    ky, kx = wavenumbers(16, 8.0)
    np.testing.assert_allclose(ky[:, 0], 2 * np.pi * np.fft.fftfreq(16, 0.5), rtol=1e-6)
    np.testing.assert_allclose(kx[0], 2 * np.pi * np.fft.rfftfreq(16, 0.5), rtol=1e-6)


@pytest.mark.parametrize("factor", [3, 5])
def test_a_finer_grid_agrees_at_shared_pixel_centres(factor: int) -> None:
    field = band_limited(16)
    shared = slice(factor // 2, None, factor)
    np.testing.assert_allclose(padded(field, 16 * factor)[shared, shared], field, atol=1e-12)


@pytest.mark.parametrize("resolution", [20, 25, 32])
def test_a_finer_grid_is_the_trigonometric_interpolant(resolution: int) -> None:
    field = band_limited(16)
    coefficients = np.fft.fft2(field) / 16**2
    modes = np.fft.fftfreq(16, 1 / 16)
    centres = (np.arange(resolution) + 0.5) / resolution - 0.5 / 16  # shares of the side from the first coarse centre
    basis = np.exp(2j * np.pi * np.outer(centres, modes))  # (fine points, modes)
    expected = (basis @ coefficients @ basis.T).real
    np.testing.assert_allclose(padded(field, resolution), expected, atol=1e-12)


def test_the_same_grid_changes_nothing() -> None:
    spectrum = torch.fft.rfft2(torch.rand(2, 16, 16))
    assert zero_pad_spectrum(spectrum, 16) is spectrum


@pytest.mark.parametrize("factor", [2, 4])
def test_finer_noise_averaged_down_stays_in_place(factor: int) -> None:
    coarse = fields().noise(3.0)
    fine = torch.nn.functional.avg_pool2d(fields(factor * BASE_RESOLUTION).noise(3.0)[:, None], factor)[:, 0]
    torch.testing.assert_close(fine, coarse, rtol=0, atol=0.1)  # a shift by a quarter of a pixel: 0.7
    for dim in (-1, -2):  # a shift either way correlates equally less
        before, after = ((fine.roll(step, dim) * coarse).mean() for step in (-1, 1))
        torch.testing.assert_close(before, after, rtol=0, atol=1e-4)


@pytest.mark.parametrize(
    "settings", [(1.7, 0.5, 1.0, 0), (9.0, 0.3, 3.0, 0), (0.95, 0.3, 24.0, 0), (3.2, 0.25, 1.0, 1)]
)
@pytest.mark.parametrize("resolution", [128, 256])
def test_noise_has_no_mean_and_unit_variance(settings: tuple, resolution: int) -> None:
    noise = fields(resolution).noise(*settings)
    torch.testing.assert_close(noise.mean(dim=(1, 2)), torch.zeros(4), rtol=0, atol=1e-4)
    torch.testing.assert_close(noise.square().mean(dim=(1, 2)), torch.ones(4), rtol=0, atol=0.02)


@pytest.mark.parametrize("wavelength", [1.5, 4.0, 10.0])
def test_noise_has_its_power_around_its_wavelength(wavelength: float) -> None:
    power = torch.fft.rfft2(fields().noise(wavelength, width=0.2)).abs().square().mean(dim=0)
    ky, kx = wavenumbers(BASE_RESOLUTION)
    k = torch.hypot(kx.expand_as(power), ky.expand_as(power))
    # A Gaussian of 0.2 in log k, weighted by the number of modes (~ k), centres at exp(2 * 0.2^2) above.
    centre = (torch.log(k.clamp_min(1e-3)) * power).sum() / power.sum()
    assert math.exp(centre) == pytest.approx(2 * math.pi / wavelength, rel=0.25)


def test_noise_is_stretched_along_the_grain() -> None:
    noise = fields(angle=0.0).noise(3.0, stretch=6.0)
    along = (noise.roll(1, -1) - noise).square().mean()
    across = (noise.roll(1, -2) - noise).square().mean()
    assert along < 0.2 * across


def test_a_shift_gives_another_realisation_of_the_same_noise() -> None:
    made = fields()
    first, second = made.noise(2.0), made.noise(2.0, shift=1)
    correlation = (first * second).mean(dim=(1, 2))
    assert correlation.abs().max() < 0.2
    torch.testing.assert_close(second.square().mean(dim=(1, 2)), first.square().mean(dim=(1, 2)), rtol=1e-2, atol=0)


def test_every_contact_has_white_noise_of_its_own() -> None:
    names = torch.tensor([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]).unbind(1)
    noise = torch.fft.irfft2(torch.cat([white_spectrum(0, *names), white_spectrum(1, *names)])).flatten(1)
    torch.testing.assert_close(torch.corrcoef(noise), torch.eye(8), rtol=0, atol=0.04)  # 5 / sqrt(16384)


def test_a_scale_of_two_is_twice_the_wavelength() -> None:
    small, large = fields(), fields()
    large.scale = 2.0 * large.scale
    torch.testing.assert_close(large.noise(2.0), small.noise(4.0), rtol=1e-4, atol=1e-4)


def test_hashes_fill_the_unit_interval_evenly() -> None:
    i, j = torch.meshgrid(torch.arange(-40.0, 40.0), torch.arange(-40.0, 40.0), indexing="ij")
    values = hash_unit(i, j, torch.tensor(7.0)).flatten().numpy()
    assert (values >= 0.0).all()
    assert (values < 1.0).all()
    assert kstest(values, "uniform").statistic < 0.05


def test_hashes_differ_by_seed_and_repeat() -> None:
    i, j = torch.arange(20.0), torch.arange(20.0, 40.0)
    assert torch.equal(hash_unit(i, j, torch.tensor(3.0)), hash_unit(i, j, torch.tensor(3.0)))
    assert not torch.equal(hash_unit(i, j, torch.tensor(3.0)), hash_unit(i, j, torch.tensor(4.0)))


@pytest.mark.parametrize("jitter", [0.0, 0.5, 1.0])
def test_cell_distances_are_those_of_a_k_d_tree(jitter: float) -> None:
    size, made = 2.1, fields(256, count=1)
    i, j = torch.meshgrid(torch.arange(-12.0, 12.0), torch.arange(-12.0, 12.0), indexing="xy")
    a, b = hash_unit(i, j, made.cell_seed[0]), hash_unit(j, i, made.cell_seed[0] + 17)
    seeds = torch.stack([i + 0.5 + jitter * (a - 0.5), j + 0.5 + jitter * (b - 0.5)], dim=-1).reshape(-1, 2)
    points = torch.stack([made.x, made.y], dim=-1).reshape(-1, 2) / size
    expected, nearest = cKDTree(seeds.numpy()).query(points.numpy(), k=2)
    first, second, label = made.cells(size, jitter)
    np.testing.assert_allclose(first.flatten().numpy(), expected[:, 0], atol=1e-5)
    excess = second.flatten().numpy() - expected[:, 1]
    assert excess.min() > -1e-5
    assert (excess > 1e-5).mean() <= (1e-3 if jitter == 1.0 else 0.0)  # seeds beyond the 3 x 3 squares searched
    if jitter:
        agree = np.isclose(label.flatten().numpy(), a.flatten().numpy()[nearest[:, 0]], atol=1e-6)
        assert agree.mean() > 0.999  # ties between two seeds may fall either way


def test_cells_at_full_jitter_stay_within_reach() -> None:
    first, second, _ = fields(64).cells(2.1)
    assert torch.isfinite(first).all()
    assert torch.isfinite(second).all()
    assert first.max() < math.sqrt(2.0) + 0.1
    assert first.min() < 0.15 * PATCH_MM


def test_an_uncoloured_surface_has_the_same_shape() -> None:
    names = (torch.arange(16), torch.zeros(16, dtype=torch.int64), torch.arange(16))
    bare, coloured = (surfaces(0, draw(0, *names), 128, coloured=wanted) for wanted in (False, True))
    assert torch.equal(bare.height, coloured.height)
    assert torch.equal(bare.body, coloured.body)
    assert bare.albedo is None


def test_a_finer_surface_is_the_same_surface() -> None:
    draws = draw(0, torch.arange(16), torch.full((16,), 10), torch.arange(16))
    draws.shape[:], draws.scale[:] = 0, 1.0  # cliffs fall between pixels, and so do finer grains
    coarse, fine = (surfaces(0, draws, resolution, coloured=False).height for resolution in (128, 384))
    apart = fine[:, 1::3, 1::3] - coarse  # at pixel centres that they share
    # Only noise at the base grid's Nyquist limit, which a finer grid leaves out, tells them apart.
    assert (apart.flatten(1).std(dim=1) < 0.025 * coarse.flatten(1).std(dim=1)).all()


# Pictures -------------------------------------------------------------------------------------------------------------

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


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_heights_that_are_not_finite_are_refused(value: float) -> None:
    height = torch.zeros(1, 32, 32)
    height[0, 5, 7] = value
    with pytest.raises(ValueError, match="`height` holds 1 of 1024 values"):
        picture(height)


def test_a_cliff_and_a_spike_stay_finite_and_in_range() -> None:
    height = torch.zeros(2, 32, 32)
    height[0, :, 16:], height[1, 16, 16] = 1e14, -1e14
    image = pictures(
        height, torch.ones(2, 3, 32, 32), torch.ones(2, 32, 32), torch.eye(3)[[0, 2]], torch.ones(2), 16, 2.0 * WHITE
    )
    assert torch.isfinite(image).all()
    assert image.min() >= 0.0
    assert image.max() <= 1.0
