"""Calibrated sensors: where their numbers are from, and that they show contacts as sensors do."""

import json
from dataclasses import fields

import pytest
import torch

from unitouch_gen.world import SENSORS, Sensor
from unitouch_gen.world.sensors import KINDS, NUMBERS, gel_background, shade_gel, touch_images
from unitouch_gen.world.surfaces import PATCH_MM, pixel_axis

ENTRIES = json.loads(NUMBERS.read_text())


@pytest.mark.parametrize("name", SENSORS)
def test_each_value_is_said_to_be_known_or_guessed_once(name: str) -> None:
    entry = ENTRIES[name]
    assert entry["source"] and len(entry["source"]) == len(entry["licence"])
    said = [field for kind in KINDS for field in entry[kind]]
    assert len(said) == len(set(said)) and "thickness" in entry["guessed"]
    assert {field.name for field in fields(Sensor) if field.default is field.default_factory} - {"name"} <= set(said)


@pytest.mark.parametrize("sensor", SENSORS.values(), ids=list(SENSORS))
def test_numbers_are_those_of_something_that_could_be_built(sensor: Sensor) -> None:
    lights = len(sensor.azimuths)
    assert lights == len(sensor.elevation) == len(sensor.gradients) == len(sensor.colours)
    colours = torch.tensor(sensor.colours)
    assert colours.min() >= 0.0 and colours.max() == pytest.approx(1.0, abs=1e-3) and 0.05 < sensor.gain < 2.0
    assert min(sensor.elevation) >= 0.0 and max(sensor.elevation) < 85.0
    assert torch.tensor(sensor.gradients).abs().max() <= 0.5  # no light is negative in a corner
    backdrop = torch.tensor(sensor.backdrop)
    assert backdrop.min() > -0.05 and backdrop.max() < 1.1
    assert 8.0 < sensor.field_of_view < 25.0 and 0.1 < sensor.correlation < 1.0 and 0.0 <= sensor.blur <= 0.3


@pytest.mark.parametrize("sensor", SENSORS.values(), ids=list(SENSORS))
def test_the_side_of_a_ball_that_faces_a_light_has_its_colour(sensor: Sensor) -> None:
    """Each channel is brightest where facets turn to within 60 degrees of its lights' mean, and darkest opposite."""
    azimuths, colours = torch.deg2rad(torch.tensor(sensor.azimuths)), torch.tensor(sensor.colours)
    turned = torch.deg2rad(torch.arange(0.0, 360.0, 10.0))
    fields_ = (-0.4 * part[:, None, None].expand(-1, 8, 8) for part in (turned.cos(), turned.sin()))
    change = (shade_gel(*fields_, sensor) - gel_background(sensor, 8)).mean(dim=(2, 3))  # (36, 3)
    for channel in range(3):
        mean = torch.atan2((colours[:, channel] * azimuths.sin()).sum(), (colours[:, channel] * azimuths.cos()).sum())
        brightest, darkest = change[:, channel].argmax(), change[:, channel].argmin()
        assert torch.cos(turned[brightest] - mean) > 0.5 and torch.cos(turned[darkest] - mean) < -0.5
        assert change[brightest, channel] > 0.02 and change[darkest, channel] < -0.02


@pytest.mark.parametrize("sensor", SENSORS.values(), ids=list(SENSORS))
def test_a_small_ball_changes_the_middle_and_leaves_the_corners(sensor: Sensor) -> None:
    axis = pixel_axis(128, PATCH_MM)
    off = axis[None, :] ** 2 + axis[:, None] ** 2
    ball = torch.where(off < 4.0, (4.0 - off).clamp_min(0.0).sqrt(), torch.tensor(-4.0))[None]
    one = torch.ones(1)
    image = touch_images(ball, 0.8 * one, one, 0.0 * one, sensor, 64)[0]
    change = (image - gel_background(sensor, 64).clamp(0.0, 1.0)).abs()
    assert change[:, 24:40, 24:40].max() > 0.1 > 5 * change[:, :6, :6].max()
