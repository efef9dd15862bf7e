"""Sensors: shading in closed form, calibrated ones as published, drawn ones as promised, gels that nothing touches."""

import json
import math
from dataclasses import replace

import pytest
import torch

from tests.helpers.chances import has_chance
from tests.helpers.plain_sensor import MARKED, PLAIN, touch_images
from unitouch_gen.world import SENSORS, Sensor, draw_sensor, untouched_gel
from unitouch_gen.world.gel import gel_background, shade_gel
from unitouch_gen.world.grids import pixel_axis
from unitouch_gen.world.sensors import NUMBERS

ONE_LIGHT = replace(PLAIN, azimuths=(180.0,), elevation=(30.0,), colours=((1.0, 0.5, 0.0),), gain=1.0, falloff=0.0)
"""From the left."""

MANY = [draw_sensor(0, number) for number in range(100)]
SOME = [pytest.param(sensor, id=sensor.name) for sensor in (PLAIN, MARKED, *SENSORS.values(), *MANY[:6])]


def change(sensor: Sensor, slope: float, depth: float = 0.0) -> torch.Tensor:
    """What a gel of one slope along x everywhere changes in the picture of an untouched one, (3, 8, 8)."""
    level = torch.zeros(1, 8, 8)
    return (shade_gel(level + slope, level, sensor, level + depth) - gel_background(sensor, 8))[0]


def test_a_facet_is_lit_by_the_cosine_to_the_light() -> None:
    for degrees in (-40.0, 0.0, 25.0, 60.0):
        lit = math.sin(math.radians(30.0 + degrees)) if degrees > -30.0 else 0.0  # it has turned away at -30
        expected = (lit - math.sin(math.radians(30.0))) * torch.tensor([1.0, 0.5, 0.0])
        found = change(ONE_LIGHT, math.tan(math.radians(degrees)))
        torch.testing.assert_close(found, expected[:, None, None].expand(3, 8, 8), rtol=0.0, atol=1e-6)


def test_lights_add_up_lean_and_are_tinted_by_depth() -> None:
    blue = (0.0, 0.2, 0.9)
    other = replace(ONE_LIGHT, azimuths=(70.0,), colours=(blue,), elevation=(55.0,))
    both = replace(ONE_LIGHT, azimuths=(180.0, 70.0), colours=(*ONE_LIGHT.colours, blue), elevation=(30.0, 55.0))
    torch.testing.assert_close(change(both, 0.4), change(ONE_LIGHT, 0.4) + change(other, 0.4), rtol=0.0, atol=1e-6)
    axis = pixel_axis(8, 2.0)
    leaning = replace(ONE_LIGHT, gradients=((0.3, -0.2),))
    factor = 1.0 + 0.3 * axis[None, :] - 0.2 * axis[:, None]
    torch.testing.assert_close(change(leaning, 0.4), change(ONE_LIGHT, 0.4) * factor, rtol=0.0, atol=1e-6)
    tinted = change(replace(ONE_LIGHT, tint=(-0.1, 0.0, 0.02)), 0.0, depth=1.5)[:, 3, 4]
    torch.testing.assert_close(tinted, torch.tensor([-0.15, 0.0, 0.03]), rtol=0.0, atol=1e-6)


def touch(height: torch.Tensor, depth: float, sensor: Sensor, dwell: float = 0.5, size: int = 64) -> torch.Tensor:
    full = torch.ones(len(height))
    return touch_images(height, depth * full, dwell * full, sensor, size)


@pytest.mark.parametrize("sensor", SOME)
def test_a_gel_is_untouched_before_contact_before_time_and_where_nothing_is_near(sensor: Sensor) -> None:
    untouched = untouched_gel(sensor, 64)
    rough = torch.rand(1, 128, 128, generator=torch.Generator().manual_seed(3))
    for image in (touch(rough, -3.0, sensor), touch(rough, 1.0, sensor, dwell=0.0)):
        torch.testing.assert_close(image[0], untouched, rtol=0.0, atol=1e-6)
    if not sensor.marker_pitch:
        expected = gel_background(sensor, 64).clamp(0.0, 1.0) ** sensor.gamma
        torch.testing.assert_close(untouched, expected, rtol=0.0, atol=1e-6)


def test_a_flat_full_contact_shows_no_slopes_and_a_dome_is_touched_in_its_middle_first() -> None:
    flat = torch.zeros(1, 128, 128)
    untouched = untouched_gel(PLAIN, 64)
    torch.testing.assert_close(touch(flat, 1.0, PLAIN)[0], untouched, rtol=0, atol=1e-5)
    change = (touch(flat, 0.3, replace(PLAIN, dome=1.0))[0] - untouched).abs().sum(dim=0)
    assert change[20:44, 20:44].mean() > 5 * change[:8].mean()


def test_markers_only_darken_and_move_alike_on_both_sides_of_a_ball() -> None:
    axis = pixel_axis(128)
    ball = (30.0**2 - axis[None, :] ** 2 - axis[:, None] ** 2).sqrt()[None]
    bare, dots = (touch(ball, 1.0, sensor, size=66) for sensor in (PLAIN, MARKED))
    assert (dots <= bare + 1e-6).all()
    assert (dots < bare - 0.05).any()
    shade = dots / bare  # the lights are not alike on both sides, but what the markers take is
    torch.testing.assert_close(shade, shade.flip(-1), rtol=0, atol=2e-3)


@pytest.mark.parametrize("sensor", SOME)
def test_touch_images_of_extreme_surfaces_are_finite_and_in_range(sensor: Sensor) -> None:
    height = torch.zeros(3, 128, 128)
    height[0, 64, 64] = -1e4
    height[1, :, 64:] = 1e14
    for depth, dwell in ((1e-6, 1e6), (1.0, 1e-6), (1e30, 1e6)):
        image = touch(height, depth, sensor, dwell)
        assert torch.isfinite(image).all()
        assert image.min() >= 0.0
        assert image.max() <= 1.0


def test_every_value_of_a_calibrated_sensor_has_one_provenance_and_every_source_a_licence() -> None:
    for name, entry in json.loads(NUMBERS.read_text()).items():
        parts = [part for part in entry.values() if isinstance(part, dict)]
        assert entry.keys() <= {"source", "licence", "published", "measured", "fitted", "guessed", "settings"}
        assert sum(map(len, parts)) == len(set().union(*parts))
        assert len(entry["source"]) == len(entry["licence"]) > 0
        assert len(SENSORS[name].azimuths) == len(SENSORS[name].elevation) == len(SENSORS[name].colours)


def test_drawn_sensors_are_what_they_are_said_to_be_and_differ() -> None:
    assert draw_sensor(3, 7) == draw_sensor(3, 7) != draw_sensor(3, 8) != draw_sensor(4, 8)
    for sensor in MANY:
        assert 2 <= len(sensor.azimuths) == len(sensor.colours) == len(sensor.gradients) <= 6
        assert all(10.0 <= elevation <= 60.0 for elevation in sensor.elevation)
        assert 0.8 <= sensor.thickness <= 4.0
        assert 10.0 <= sensor.field_of_view <= 20.0
        assert all(0.0 <= value <= 1.0 for colour in sensor.colours for value in colour)
    assert has_chance(sum(sensor.marker_pitch > 0 for sensor in MANY), len(MANY), 0.25)
    assert all(abs(draw_sensor(0, number, near=14.0).field_of_view - 14.0) <= 14.0 / 8 for number in range(50))
    backgrounds = torch.stack([gel_background(sensor, 16) for sensor in MANY])
    assert backgrounds.std(dim=0).mean() > 0.13  # of five named ones it is 0.133
    assert backgrounds.flatten(2).std(dim=-1).mean() > 0.05
