"""Error against run time of the world's physics: its yardsticks against closed forms, and what every row has to be."""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch

from unitouch_gen.numerics.physics import REQUESTS, request_rows
from unitouch_gen.numerics.physics_row import (
    PhysicsRow,
    observed_order,
    pareto_front,
    time_calls,
    with_orders,
    with_quartiles,
)
from unitouch_gen.numerics.physics_sound import fitted_error, rate_rows, sound_rows, sound_spectrum
from unitouch_gen.numerics.physics_touch import (
    CLOSED_FORMS,
    MARGINS,
    Setting,
    image_errors,
    margin_rows,
    refined_together,
    solver_rows,
    sweep,
    touch_rows,
    world_contacts,
    world_heights,
)
from unitouch_gen.world import MATERIALS, SENSORS, SHAPE_NAMES
from unitouch_gen.world.gel import GelGrid
from unitouch_gen.world.sensors import shade_gel, touch_images

TACTO = {"touch of tacto": SENSORS["tacto"]}


# Yardsticks ---------------------------------------------------------------------------------------------------------


def test_calls_take_turns_after_a_warm_up() -> None:
    calls: list[str] = []
    seconds = time_calls({"a": lambda: calls.append("a"), "b": lambda: calls.append("b")}, repeats=3)
    assert calls == ["a", "b"] * 4
    assert all(0.0 <= least <= median for least, median in seconds.values())


@pytest.mark.parametrize("order", [0.5, 1.0, 2.0, 4.0])
def test_the_order_of_a_power_of_the_spacing_is_its_exponent(order: float) -> None:
    spacings = [1.0, 0.5, 0.25]
    assert observed_order(spacings, [3.0 * h**order for h in spacings]) == pytest.approx(order)


def test_orders_are_fitted_to_each_problem_and_option_apart() -> None:
    rows = [
        PhysicsRow(problem, option, f"{h}", h, error=h**order)
        for problem, option, order in (("a", "x", 1.0), ("a", "y", 2.0), ("b", "x", 3.0))
        for h in (1.0, 0.5)
    ]
    rows.append(PhysicsRow("a", "margin", "1.5", error=0.1))
    assert [row.order for row in with_orders(rows)] == [
        *(pytest.approx(order) for order in (1.0, 1.0, 2.0, 2.0, 3.0, 3.0)), None,
    ]  # fmt: skip


def test_a_failed_row_has_no_say_in_the_order() -> None:
    rows = [PhysicsRow("a", "x", f"{h}", h, error=h) for h in (1.0, 0.5)]
    rows.append(PhysicsRow("a", "x", "0.25", 0.25, error=7.0, failed=True))
    assert [row.order for row in with_orders(rows)] == [pytest.approx(1.0)] * 3


def test_the_front_holds_what_nothing_beats_in_both_error_and_time() -> None:
    points = np.random.default_rng(0).uniform(0.1, 1.0, (40, 2))
    rows = [PhysicsRow("a", "x", f"{i}", error=error, seconds=seconds) for i, (error, seconds) in enumerate(points)]
    unbeaten = {i for i, point in enumerate(points) if not (points < point).all(axis=1).any()}
    assert {int(row.value) for row in pareto_front(rows)} == unbeaten
    assert pareto_front([PhysicsRow("a", "x", "1", error=0.0, seconds=0.0, failed=True)]) == []


def test_quartiles_are_numpys() -> None:
    errors = np.random.default_rng(0).uniform(size=11)
    row = with_quartiles(PhysicsRow("a", "x", "1"), errors)
    assert (row.error_low, row.error, row.error_high) == pytest.approx(tuple(np.quantile(errors, (0.25, 0.5, 0.75))))
    assert row.samples == 11


def test_a_sample_that_is_not_finite_fails_its_row() -> None:
    row = with_quartiles(PhysicsRow("a", "x", "1"), torch.tensor([0.1, math.nan]))
    assert row.failed
    assert row.reason
    assert math.isnan(row.error)


def test_image_errors_of_a_constant_offset() -> None:
    untouched = torch.full((1, 3, 8, 8), 0.2)
    reference = torch.full((2, 3, 8, 8), 0.6)
    error, psnr = image_errors(reference + torch.tensor([0.04, 0.004])[:, None, None, None], reference, untouched)
    torch.testing.assert_close(error, torch.tensor([0.1, 0.01]), rtol=1e-4, atol=0)
    torch.testing.assert_close(psnr, torch.tensor([-20 * math.log10(0.04), -20 * math.log10(0.004)]), rtol=1e-4, atol=0)


def test_the_error_of_a_sound_does_not_know_its_loudness() -> None:
    x, y = np.random.default_rng(0).standard_normal((2, 3, 50))
    np.testing.assert_allclose(fitted_error(7.0 * x, y), fitted_error(x, y))
    np.testing.assert_allclose(fitted_error(3.0 * y, y), 0.0, atol=1e-12)


def test_the_error_of_a_sound_is_the_sine_of_its_angle_to_the_reference() -> None:
    x, y = np.random.default_rng(1).standard_normal((2, 1, 50))
    x = x * np.sign((x * y).sum())
    cosine = (x * y).sum() / np.sqrt((x * x).sum() * (y * y).sum())
    np.testing.assert_allclose(fitted_error(x, y), math.sqrt(1 - cosine**2))


def test_silence_is_right_about_silence_only() -> None:
    silent, loud = np.zeros((1, 4)), np.ones((1, 4))
    assert fitted_error(silent, silent) == 0.0
    assert fitted_error(silent, loud) == 1.0
    assert fitted_error(loud, silent) == math.inf


def test_spectra_of_one_wave_agree_at_all_rates() -> None:
    def spectrum(rate: int) -> np.ndarray:
        time = torch.arange(round(0.25 * rate), dtype=torch.float64) / rate
        return sound_spectrum(torch.sin(2 * math.pi * 440.0 * time)[None], rate)[:, :500]

    np.testing.assert_allclose(spectrum(8000), spectrum(32_000), atol=1e-4 * np.abs(spectrum(8000)).max())


# Touch --------------------------------------------------------------------------------------------------------------


def test_the_contacts_show_every_material_and_shape() -> None:
    draws = world_contacts()
    assert set(draws.material.tolist()) == set(range(len(MATERIALS)))
    assert set(draws.shape.tolist()) == set(range(len(SHAPE_NAMES)))


def test_a_finer_surface_is_the_same_surface() -> None:
    draws = world_contacts()
    coarse, fine = world_heights(draws, 128), world_heights(draws, 384)[:, 1::3, 1::3]  # shared pixel centres
    # Only noise at the base grid's Nyquist limit, which a finer grid leaves out, tells them apart.
    assert ((fine - coarse).flatten(1).std(dim=1) < 0.02 * coarse.flatten(1).std(dim=1)).all()


@pytest.mark.parametrize("name", CLOSED_FORMS)
def test_a_surface_in_closed_form_is_the_same_at_shared_pixel_centres(name: str) -> None:
    draws = world_contacts(3)
    coarse, fine = CLOSED_FORMS[name](draws, 128), CLOSED_FORMS[name](draws, 384)[:, 1::3, 1::3]
    torch.testing.assert_close(fine, coarse, rtol=0, atol=1e-4)


@pytest.mark.parametrize(("slopes", "at_worst"), [("central", 0.08), ("spectral", 0.05)])
def test_touch_images_of_a_wave_approach_the_closed_form_at_second_order(slopes: str, at_worst: float) -> None:
    sensor, dwell = SENSORS["gelsight"], 0.1
    wave = 2 * math.pi * 8 / 24.0  # eight periods on the gel, 3 mm each

    def settled(rate: float) -> float:
        return -math.expm1(-rate * dwell / sensor.relaxation) / rate

    # A load T (0.4 + 0.2 cos k x) is one constant and one mode, each with its own decay and blur.
    def indentation(x: torch.Tensor) -> torch.Tensor:
        return -sensor.thickness * torch.log1p(-(0.4 + 0.2 * torch.cos(wave * x)))

    height = sensor.thickness * 0.2 * settled(1 + (sensor.correlation * wave) ** 2)
    height *= math.exp(-0.5 * (sensor.blur * wave) ** 2)
    x = ((torch.arange(1024) + 0.5) / 1024 - 0.5) * sensor.field_of_view
    slope = (-height * wave * torch.sin(wave * x)).expand(1, 1024, 1024)
    exact = torch.nn.functional.avg_pool2d(shade_gel(slope, torch.zeros_like(slope), sensor).clamp(0.0, 1.0), 16)

    spacings, errors = [1.0, 0.5, 0.25], []
    for k in (1, 2, 4):
        axis = ((torch.arange(128 * k) + 0.5) / (128 * k) - 0.5) * 32.0
        surface = indentation(axis).expand(1, 128 * k, -1)
        depth = indentation(torch.zeros(1))
        image = touch_images(
            surface, depth, torch.tensor([dwell]), torch.zeros(1), sensor, 64, grid=GelGrid(refinement=k, slopes=slopes)
        )
        errors.append(((image - exact).norm() / (exact - exact.mean(dim=(2, 3), keepdim=True)).norm()).item())
    assert errors[0] < at_worst
    assert observed_order(spacings, errors) == pytest.approx(2.0, abs=0.35)


@pytest.fixture(scope="module")
def rows() -> list[PhysicsRow]:
    return with_orders(touch_rows(2, ("tacto",), (1, 2), repeats=1))


def test_every_row_of_touch_has_an_error_and_a_time(rows: list[PhysicsRow]) -> None:
    for row in rows:
        assert not row.failed, row
        assert 0.0 < row.error_low <= row.error <= row.error_high < 1.0
        assert row.psnr_low <= row.psnr <= row.psnr_high
        assert 0.0 < row.seconds <= row.seconds_median
        assert row.samples == 2


def test_refining_both_grids_lowers_the_error(rows: list[PhysicsRow]) -> None:
    together = [row for row in rows if row.option == "both grids, central slopes"]
    assert {row.problem for row in together} == {"touch of tacto", *(f"{name} under tacto" for name in CLOSED_FORMS)}
    for row in together:
        assert row.order is not None
        assert row.order > 1.0


def test_the_reference_is_nearer_to_its_half_than_to_any_other(rows: list[PhysicsRow]) -> None:
    for problem in {row.problem for row in rows}:
        half = next(row for row in rows if row.problem == problem and row.option == "half the reference")
        assert half.error == min(row.error for row in rows if row.problem == problem)


def test_a_setting_that_cannot_be_rendered_is_a_failed_row() -> None:
    def heights(draws: object, resolution: int) -> torch.Tensor:
        return torch.full((2, resolution, resolution), math.nan) if resolution == 256 else world_heights(draws, 128)

    settings = [Setting("surface", "1x"), Setting("surface", "2x", resolution=256)]
    fine, broken = sweep(TACTO, world_contacts(2), heights, settings, 1, 1)
    assert not fine.failed
    assert broken.failed
    assert "`height`" in broken.reason


def test_settings_refine_surface_and_gel_alike() -> None:
    for setting in refined_together((1, 2, 4)):
        assert setting.resolution == 128 * setting.grid.refinement
        assert setting.spacing == 1 / setting.grid.refinement


def test_at_one_depth_a_wider_margin_lets_less_in_over_the_ends() -> None:
    errors = [row.error for row in margin_rows(4, ("digit",), repeats=1)]
    assert len(errors) == len(MARGINS)
    assert errors == sorted(errors, reverse=True)
    assert errors[MARGINS.index(1.5)] < 1e-3


def test_float32_and_a_folded_blur_cost_the_displacement_nothing() -> None:
    for row in solver_rows(4, repeats=1):
        assert row.error_high < 1e-6


# Sounds and requests ------------------------------------------------------------------------------------------------


def test_a_higher_rate_carries_more_of_a_sound() -> None:
    made = list(rate_rows(world_contacts(), (8000, 16_000, 32_000), 1))
    for band in ("sound, own band", "sound, whole band"):
        errors = [row.error for row in made if row.problem == band]
        assert errors == sorted(errors, reverse=True)
        assert not any(row.failed for row in made)


@pytest.fixture(scope="module")
def sounds() -> list[PhysicsRow]:
    return list(sound_rows(4, (16_000,), repeats=1))


@pytest.mark.parametrize("option", ["modes", "grains"])
def test_more_of_a_sound_is_nearer_to_all_of_it(sounds: list[PhysicsRow], option: str) -> None:
    errors = [row.error_high for row in sounds if row.option == option]
    assert errors[0] > 0.0
    assert all(after <= before + 1e-6 for before, after in pairwise(errors))
    assert errors[-1] < 1e-3


def test_each_request_costs_less_than_everything() -> None:
    made = {row.request: row for row in request_rows(8, repeats=1)}
    assert set(made) == set(REQUESTS)
    everything = made.pop("everything")
    assert (everything.share, everything.saved) == (1.0, 0.0)
    assert all(row.share < 1.0 for row in made.values())
    assert made["caption"].saved > 0.7
