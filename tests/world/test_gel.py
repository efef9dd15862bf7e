"""Gels against closed forms, stiff and extreme ones included; touch images, and the grid they are solved on."""

import dataclasses
import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from scipy.integrate import solve_ivp

from tests.helpers.plain_sensor import MARKED, PLAIN
from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.world import SENSORS, Sensor, World
from unitouch_gen.world.draws import draw
from unitouch_gen.world.gel import SOFT_SHARE, GelGrid, contact_indentation, gel_displacement, resample_centre
from unitouch_gen.world.sensors import contact_share, gel_background, shade_gel, touch_images
from unitouch_gen.world.surfaces import PATCH_MM, slopes, spectral_slopes, surfaces, wavenumbers

EXTENT, THICKNESS, CORRELATION, RELAXATION = 24.0, 2.0, 0.9, 0.05
GEL = {"extent": EXTENT, "thickness": THICKNESS, "correlation": CORRELATION, "relaxation": RELAXATION}
STIFFNESSES = (1e-3, 0.1, 1.0, 30.0, 1e3)
UNMARKED = [PLAIN, *SENSORS.values()]


def indentation_of(load: torch.Tensor) -> torch.Tensor:
    """The indentation whose saturated load is `load` (the inverse of p = T (1 - e^{-d/T}))."""
    return -THICKNESS * torch.log1p(-load / THICKNESS)


def cosine(mode: tuple[int, int], size: int = 32) -> torch.Tensor:
    """cos(k . x) over the square, float64 (1, size, size)."""
    index = torch.arange(size, dtype=torch.float64)
    return torch.cos(2 * math.pi * (mode[0] * index[:, None] + mode[1] * index[None, :]) / size)[None]


def spike(size: int = 96) -> torch.Tensor:
    field = torch.zeros(1, size, size)
    field[0, size // 2, size // 2] = 10.0
    return field


def cliff(size: int = 96) -> torch.Tensor:
    field = torch.zeros(1, size, size)
    field[..., size // 2 :] = 10.0
    return field


EXTREMES = {
    "spike": spike(),
    "cliff": cliff(),
    "fully pressed": torch.full((1, 96, 96), 10.0),
    "none": torch.zeros(1, 96, 96),
}


@pytest.mark.parametrize("stiffness", STIFFNESSES)
@pytest.mark.parametrize("dwell", [0.0, 1e-4, 0.05, 1.0, 1e6])
def test_a_uniform_indentation_follows_its_exponential(stiffness: float, dwell: float) -> None:
    depth = torch.tensor([0.01, 0.5, 10.0], dtype=torch.float64)
    u = gel_displacement(
        depth[:, None, None].expand(3, 16, 16), torch.full((3,), dwell, dtype=torch.float64), stiffness=stiffness, **GEL
    )
    expected = [
        THICKNESS * -math.expm1(-d / THICKNESS) * -math.expm1(-stiffness * dwell / RELAXATION) / stiffness
        for d in depth
    ]
    torch.testing.assert_close(
        u, torch.tensor(expected, dtype=torch.float64)[:, None, None].expand_as(u), rtol=1e-6, atol=1e-9
    )


@pytest.mark.parametrize("stiffness", STIFFNESSES)
@pytest.mark.parametrize("mode", [(0, 1), (3, 0), (2, 5)])
def test_a_cosine_indentation_is_one_decaying_mode(stiffness: float, mode: tuple[int, int]) -> None:
    dwell, wave = 0.03, cosine(mode)
    k2 = (2 * math.pi / EXTENT) ** 2 * (mode[0] ** 2 + mode[1] ** 2)
    u = gel_displacement(indentation_of(0.6 + 0.4 * wave), torch.tensor([dwell]).double(), stiffness=stiffness, **GEL)

    def settled(rate: float) -> float:
        return -math.expm1(-rate * dwell / RELAXATION) / rate

    expected = 0.6 * settled(stiffness) + 0.4 * settled(stiffness * (1 + CORRELATION**2 * k2)) * wave
    torch.testing.assert_close(u, expected, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("stiffness", [1e-3, 1.0, 1e3])
def test_the_solution_agrees_with_an_integrated_equation(stiffness: float) -> None:
    size, dwell = 8, 0.07
    load = np.random.default_rng(0).uniform(0.0, 1.9, (size, size))
    k = 2 * np.pi * np.fft.fftfreq(size, EXTENT / size)
    k2 = k[:, None] ** 2 + k[None, :] ** 2

    def rate_of_change(_: float, u: np.ndarray) -> np.ndarray:
        u = u.reshape(size, size)
        laplacian = np.fft.ifft2(-k2 * np.fft.fft2(u)).real
        return ((load - stiffness * (u - CORRELATION**2 * laplacian)) / RELAXATION).ravel()

    solved = solve_ivp(rate_of_change, (0.0, dwell), np.zeros(size * size), method="Radau", rtol=1e-9, atol=1e-12)
    u = gel_displacement(
        indentation_of(torch.from_numpy(load)[None]), torch.tensor([dwell]).double(), stiffness=stiffness, **GEL
    )
    np.testing.assert_allclose(u[0].numpy(), solved.y[:, -1].reshape(size, size), rtol=1e-5, atol=1e-8)


def test_at_contact_nothing_has_moved() -> None:
    u = gel_displacement(cliff(), torch.zeros(1), **GEL)
    assert torch.equal(u, torch.zeros_like(u))


def test_after_long_the_gel_is_in_balance_with_the_load() -> None:
    load = torch.rand(1, 32, 32, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    u = gel_displacement(indentation_of(load), torch.tensor([1e9]).double(), stiffness=3.0, **GEL)[0].numpy()
    k = 2 * np.pi * np.fft.fftfreq(32, EXTENT / 32)
    laplacian = np.fft.ifft2(-(k[:, None] ** 2 + k[None, :] ** 2) * np.fft.fft2(u)).real
    np.testing.assert_allclose(3.0 * (u - CORRELATION**2 * laplacian), load[0].numpy(), atol=1e-5)


def test_camera_blur_damps_a_mode_as_a_gaussian_does() -> None:
    wave, dwell = cosine((0, 4)), torch.tensor([0.1]).double()
    sharp = gel_displacement(indentation_of(0.5 + 0.4 * wave), dwell, **GEL)
    blurred = gel_displacement(indentation_of(0.5 + 0.4 * wave), dwell, blur=0.5, **GEL)
    factor = math.exp(-0.5 * (0.5 * 2 * math.pi * 4 / EXTENT) ** 2)
    torch.testing.assert_close(blurred - blurred.mean(), factor * (sharp - sharp.mean()), rtol=1e-6, atol=1e-9)


def test_float32_and_a_blur_folded_into_the_transform_cost_nothing() -> None:
    press, dwell, blur = torch.rand(1, 96, 96, generator=torch.Generator().manual_seed(1)), torch.tensor([0.1]), 0.3
    exact = gel_displacement(press.double(), dwell.double(), blur=blur, **GEL)
    ky, kx = wavenumbers(96, EXTENT)
    gain = torch.exp(-0.5 * blur**2 * (ky**2 + kx**2))
    sharp = gel_displacement(press, dwell, **GEL)
    for found in (gel_displacement(press, dwell, blur=blur, **GEL), torch.fft.irfft2(torch.fft.rfft2(sharp) * gain)):
        assert (found - exact).norm() < 1e-6 * exact.norm()


def test_moving_the_indenter_moves_the_displacement() -> None:
    pushed = torch.rand(1, 32, 32, generator=torch.Generator().manual_seed(1))
    still = gel_displacement(pushed, torch.tensor([0.1]), **GEL)
    moved = gel_displacement(pushed.roll((5, 9), (1, 2)), torch.tensor([0.1]), **GEL)
    torch.testing.assert_close(moved, still.roll((5, 9), (1, 2)), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", EXTREMES)
@pytest.mark.parametrize("sensor", SENSORS.values(), ids=SENSORS)
def test_displacement_stays_within_the_gel_but_for_a_little_ringing(name: str, sensor) -> None:
    dwell = torch.tensor([0.0, 1e-3, 0.1, 1e9])
    u = gel_displacement(
        EXTREMES[name].expand(4, -1, -1),
        dwell,
        extent=EXTENT,
        thickness=sensor.thickness,
        correlation=sensor.correlation,
        relaxation=sensor.relaxation,
        blur=sensor.blur,
    )
    assert torch.isfinite(u).all()
    assert u.max() <= sensor.thickness * (1 + 1e-5)
    assert u.min() >= -0.01 * sensor.thickness


@pytest.mark.parametrize("name", EXTREMES)
@pytest.mark.parametrize("stiffness", STIFFNESSES)
def test_displacement_is_finite_and_bounded_at_any_stiffness(name: str, stiffness: float) -> None:
    u = gel_displacement(EXTREMES[name].expand(3, -1, -1), torch.tensor([1e-6, 0.1, 1e9]), stiffness=stiffness, **GEL)
    assert torch.isfinite(u).all()
    assert u.abs().max() <= THICKNESS / stiffness * (1 + 1e-5)


@pytest.mark.parametrize("correlation", [0.3, 1.0])
def test_a_gel_that_follows_is_drawn_along_exponentially_beside_a_ridge(correlation: float) -> None:
    """u - c^2 u'' = 0 beside a ridge of one depth, and the ridge's own depth where it touches."""
    x = ((torch.arange(192, dtype=torch.float64) + 0.5) / 192 - 0.5) * EXTENT
    load = 0.5 * (x.abs() < 2.0).double().expand(1, 192, -1)
    settled = {**GEL, "correlation": correlation, "relaxation": 0.0}
    u = gel_displacement(indentation_of(load), torch.ones(1), contact_steps=200, **settled)
    edge = x[x.abs() < 2.0].max()
    beside = 0.5 * torch.exp(-(x.abs() - edge).clamp_min(0.0) / correlation)
    torch.testing.assert_close(u[0, 0], beside, rtol=0.0, atol=0.03)
    few = gel_displacement(indentation_of(load), torch.ones(1), contact_steps=20, **settled)
    torch.testing.assert_close(few, u, rtol=0.0, atol=0.02)


def test_a_longer_dwell_sinks_deeper() -> None:
    u = gel_displacement(cliff().expand(4, -1, -1), torch.tensor([0.01, 0.05, 0.2, 5.0]), **GEL)
    assert (u.mean(dim=(1, 2)).diff() > 0).all()


def test_a_soft_object_takes_up_its_share_of_the_depth() -> None:
    height = torch.rand(2, 16, 16, generator=torch.Generator().manual_seed(2))
    depth = contact_indentation(height, torch.tensor([1.0, 1.0]), torch.tensor([0.0, 0.6])).amax(dim=(1, 2))
    torch.testing.assert_close(depth, torch.tensor([1.0, 1.0 - 0.6 * SOFT_SHARE]))


def test_indentation_is_the_part_of_the_surface_beyond_the_gel() -> None:
    height = torch.tensor([[[0.0, -0.2], [-0.5, -3.0]]])
    torch.testing.assert_close(
        contact_indentation(height, torch.tensor([0.4]), torch.zeros(1)), torch.tensor([[[0.4, 0.2], [0.0, 0.0]]])
    )


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"stiffness": 0.0}, "stiffness"),
        ({"stiffness": math.nan}, "stiffness"),
        ({"thickness": 0.0}, "thickness"),
        ({"contact_steps": -1}, "contact_steps"),
        ({"dwell": torch.tensor([-1.0])}, "dwell"),
        ({"dwell": torch.tensor([math.nan])}, "dwell"),
        ({"indentation": torch.full((1, 8, 8), -1.0)}, "indentation"),
    ],
)
def test_a_gel_that_cannot_be_is_refused_by_name(options: dict, named: str) -> None:
    with pytest.raises(ValueError, match=f"`{named}`"):
        gel_displacement(**{"indentation": spike(8), "dwell": torch.ones(1), **GEL, **options})


# Touch images -----------------------------------------------------------------------------------------------------


def touch(height: torch.Tensor, depth: float, sensor, dwell: float = 0.5, **kwargs) -> torch.Tensor:
    rows = len(height)
    return touch_images(
        height, torch.full((rows,), depth), torch.full((rows,), dwell), torch.zeros(rows), sensor, 64, **kwargs
    )


def share_of(height: torch.Tensor, depth: float, sensor) -> torch.Tensor:
    return contact_share(height, torch.full((len(height),), depth), torch.zeros(len(height)), sensor, 64)


@pytest.mark.parametrize("depth", [0.0, -1.0])
@pytest.mark.parametrize("sensor", UNMARKED, ids=lambda sensor: sensor.name)
def test_without_contact_the_image_is_the_background(sensor, depth: float) -> None:
    height = torch.rand(1, 128, 128, generator=torch.Generator().manual_seed(3))
    assert torch.equal(touch(height, depth, sensor)[0], gel_background(sensor, 64).clamp(0.0, 1.0))
    assert share_of(height, depth, sensor).item() == 0.0


def test_without_contact_markers_show_nothing_of_what_is_above_them() -> None:
    assert torch.equal(touch(spike(128), 0.0, MARKED), touch(cliff(128), 0.0, MARKED))


@pytest.mark.parametrize("sensor", UNMARKED, ids=lambda sensor: sensor.name)
def test_without_dwell_the_image_is_the_background(sensor) -> None:
    image = touch(torch.rand(1, 128, 128, generator=torch.Generator().manual_seed(3)), 1.0, sensor, dwell=0.0)
    assert torch.equal(image[0], gel_background(sensor, 64).clamp(0.0, 1.0))


@pytest.mark.parametrize("sensor", SENSORS.values(), ids=SENSORS)
def test_touch_images_of_extreme_surfaces_are_finite_and_in_range(sensor) -> None:
    surfaces = torch.stack(
        [spike(128)[0], cliff(128)[0], torch.zeros(128, 128), -1e3 * spike(128)[0], 1e13 * cliff(128)[0]]
    )
    for depth in (1e-6, 1.0, 50.0, 1e30):
        for dwell in (1e-6, 1e6):
            image = touch(surfaces, depth, sensor, dwell)
            assert torch.isfinite(image).all()
            assert image.min() >= 0.0
            assert image.max() <= 1.0
        share = share_of(surfaces, depth, sensor)
        assert ((share >= 0.0) & (share <= 1.0)).all()


@pytest.mark.parametrize("depth", [math.nan, math.inf])
def test_a_depth_that_is_not_finite_is_refused(depth: float) -> None:
    with pytest.raises(ValueError, match="`indentation_depth`"):
        touch(cliff(128), depth, PLAIN)


def test_contact_share_grows_with_the_indentation_depth() -> None:
    height = torch.rand(4, 128, 128, generator=torch.Generator().manual_seed(4))
    shares = torch.stack([share_of(height, depth, PLAIN) for depth in (0.0, 0.1, 0.3, 0.6, 1.5)])
    assert (shares.diff(dim=0) >= 0).all()
    assert shares[0].max() == 0.0
    assert shares[-1].min() == 1.0


@pytest.mark.parametrize("sensor", SENSORS.values(), ids=SENSORS)
def test_half_a_view_beside_a_cliff_is_half_in_contact(sensor) -> None:
    assert share_of(cliff(128), 1.0, sensor).item() == pytest.approx(0.5, abs=1 / 64)


def test_a_flat_full_contact_shows_no_slopes() -> None:
    image = touch(torch.zeros(1, 128, 128), 1.0, PLAIN)
    torch.testing.assert_close(image[0], gel_background(PLAIN, 64).clamp(0.0, 1.0), rtol=0, atol=1e-5)
    assert share_of(torch.zeros(1, 128, 128), 1.0, PLAIN).item() == 1.0


def test_printed_markers_only_darken() -> None:
    height = torch.rand(1, 128, 128, generator=torch.Generator().manual_seed(5))
    plain, marked = (touch(height, 1.0, sensor) for sensor in (PLAIN, MARKED))
    assert (marked <= plain + 1e-6).all()
    assert (marked < plain - 0.05).any()


def test_a_facet_turned_to_a_light_gains_that_lights_colour() -> None:
    sensor = dataclasses.replace(PLAIN, azimuths=(0.0,), colours=((1.0, 0.0, 0.0),), falloff=0.0)
    level = torch.zeros(1, 8, 8)
    toward, away = torch.full_like(level, -0.3), torch.full_like(level, 0.3)  # falling toward +x faces a light there
    red = [shade_gel(slope, level, sensor)[0, 0].mean() for slope in (away, level, toward)]
    assert red[0] < red[1] < red[2]


def test_central_differences_of_a_sine_are_its_discrete_derivative() -> None:
    size, pixel = 32, 0.25
    k = 2 * math.pi * 3 / (size * pixel)
    x = pixel * torch.arange(size, dtype=torch.float64)
    along_x, along_y = slopes(torch.sin(k * x)[None, None, :].expand(1, size, size), pixel)
    expected = torch.cos(k * x) * math.sin(k * pixel) / pixel
    torch.testing.assert_close(along_x[0], expected.expand(size, size))
    assert torch.equal(along_y, torch.zeros_like(along_y))


@pytest.mark.parametrize("pixels", [24, 25, 40, 64, 90])  # 2.7, 2.6, 1.6, 1 and 0.7 pixels of the plane to one
def test_resampling_reproduces_a_plane(pixels: int) -> None:
    axis = (torch.arange(128) + 0.5) / 128 - 0.5
    plane = (3.0 * axis[None, :] - 2.0 * axis[:, None])[None]
    small = (torch.arange(pixels) + 0.5) / pixels * 0.5 - 0.25
    torch.testing.assert_close(
        resample_centre(plane, 16.0, pixels)[0], 3.0 * small[None, :] - 2.0 * small[:, None], rtol=0, atol=1e-5
    )


@pytest.mark.parametrize("resolution", [192, 256, 448])  # 1.5, 2 and 3.5 to a pixel of the target
def test_a_wave_beyond_the_targets_nyquist_limit_does_not_fold_back(resolution: int) -> None:
    cycles = 1.4 * 0.5 * 128  # over the whole patch; the target has 96 pixels on three quarters of it
    wave = torch.cos(2 * math.pi * cycles * (torch.arange(resolution) + 0.5) / resolution)
    wave = wave.expand(1, resolution, resolution)
    assert resample_centre(wave, 0.75 * PATCH_MM, 96).std() < 0.2 * wave.std()


# The grid -------------------------------------------------------------------------------------------------------------

SENSOR = PLAIN
ROUGH = torch.rand(2, 128, 128, generator=torch.Generator().manual_seed(0))


def seen_at(height: torch.Tensor, size: int = 64, sensor: Sensor = SENSOR, **options) -> torch.Tensor:
    rows = torch.ones(len(height))
    return touch_images(height, rows, 0.5 * rows, 0.0 * rows, sensor, size, **options)


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
    dots = seen_at(ball, size, sensor=MARKED)
    bare = seen_at(ball, size)
    shade = dots / bare  # the lights are not alike on both sides, but what the markers take is
    torch.testing.assert_close(shade, shade.flip(-1), rtol=0, atol=2e-3)


def test_a_refined_gel_shows_the_mean_of_a_larger_image() -> None:
    larger = seen_at(ROUGH, 128)
    assert torch.equal(seen_at(ROUGH, 64, grid=GelGrid(refinement=2)), F.avg_pool2d(larger, 2))


def test_the_default_grid_changes_nothing() -> None:
    assert torch.equal(seen_at(ROUGH), seen_at(ROUGH, grid=GelGrid(1.5, 1, "central")))


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
    plain = World().render(*names, modalities=("touch",)).touch["gelsight"]
    fine = World(gel=GelGrid(refinement=2)).render(*names, modalities=("touch",)).touch["gelsight"]
    assert fine.shape == plain.shape
    assert not torch.equal(fine, plain)


def test_a_ball_touches_a_disc() -> None:
    axis = (torch.arange(128) + 0.5) / 4.0 - 16.0
    ball = ((900.0 - axis[:, None] ** 2 - axis[None, :] ** 2).sqrt() - 30.0)[None]
    share = contact_share(ball, torch.tensor([0.5]), torch.zeros(1), SENSOR, 64, GelGrid(refinement=4))
    rim = 30.0**2 - 29.5**2  # squared radius of a cap of 0.5 mm
    assert share.item() == pytest.approx(math.pi * rim / SENSOR.field_of_view**2, rel=0.01)


@pytest.mark.parametrize(
    "sensor", [dataclasses.replace(PLAIN, field_of_view=15.0), PLAIN], ids=lambda sensor: sensor.name
)
def test_at_one_depth_a_wider_margin_lets_less_in_over_the_periodic_ends(sensor) -> None:
    index = torch.arange(4)
    drawn = dataclasses.replace(draw(0, index, 10 + 0 * index, index), shape=0 * index, texture=0 * index - 1)
    height = surfaces(0, drawn, 128, coloured=False).height

    def summit(grid: GelGrid) -> torch.Tensor:  # where the gel's square is touched first
        pixels, extent, _ = grid.layout(sensor.field_of_view, 64)
        return resample_centre(height, extent, pixels).amax(dim=(1, 2))

    def image(margin: float) -> torch.Tensor:
        depth = 1.0 - summit(widest) + summit(GelGrid(margin))
        return touch_images(height, depth, 0.2 + 0 * depth, 0 * depth, sensor, 64, grid=GelGrid(margin))

    widest = GelGrid(1.875)
    exact, untouched = image(widest.margin), gel_background(sensor, 64)
    errors = [((image(margin) - exact).norm() / (exact - untouched).norm()).item() for margin in (1.0, 1.25, 1.5, 1.75)]
    assert errors == sorted(errors, reverse=True) and errors[2] < 1e-3


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"margin": 0.9}, "margin"),
        ({"margin": math.nan}, "margin"),
        ({"margin": math.inf}, "margin"),
        ({"refinement": 0}, "refinement"),
        ({"refinement": 1.5}, "refinement"),
        ({"refinement": True}, "refinement"),
        ({"refinement": 10**9}, "refinement"),
        ({"margin": 1e300}, "margin"),
        ({"margin": "wide"}, "margin"),
        ({"margin": 10**400}, "margin"),
        ({"slopes": None}, "slopes"),
        ({"slopes": "steep"}, "slopes"),
    ],
)
def test_a_bad_grid_is_refused_by_name(options: dict, named: str) -> None:
    with pytest.raises((InvalidInputError, InvalidTypeError), match=f"`{named}"):
        GelGrid(**options)


@pytest.mark.parametrize("options", [{"margin": 90.0, "refinement": 90}, {"refinement": 100}])
def test_a_grid_of_more_pixels_than_memory_holds_is_refused(options: dict) -> None:
    with pytest.raises(InvalidInputError, match=r"`margin and refinement: pixels a side` is \d+"):
        GelGrid(**options).layout(16.0, 256)


def test_how_many_heights_are_bad_is_said() -> None:
    height = ROUGH.clone()
    height[0, :2, :3], height[1, 5, 5] = math.nan, -math.inf
    with pytest.raises(ValueError, match="`height` holds 7 of 32768 values"):
        seen_at(height)
