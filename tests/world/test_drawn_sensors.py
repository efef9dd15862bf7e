"""Sensors drawn anew: the same each time, within what they promise, and as different as real ones."""

from dataclasses import replace

import pytest
import torch

from tests.helpers.plain_sensor import PLAIN
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.world import SENSORS, World, untouched_gel
from unitouch_gen.world.drawn_sensors import draw_sensor
from unitouch_gen.world.sensors import gel_background, touch_images
from unitouch_gen.world.surfaces import pixel_axis

MANY = [draw_sensor(0, number) for number in range(200)]


def test_a_number_names_a_sensor() -> None:
    assert draw_sensor(3, 7) == draw_sensor(3, 7)
    assert draw_sensor(3, 7) != draw_sensor(3, 8)
    assert draw_sensor(3, 7) != draw_sensor(4, 7)


@pytest.mark.parametrize(("names", "refused"), [((-1, 0), "seed"), ((0, -1), "number")])
def test_a_number_below_zero_is_refused(names, refused) -> None:
    with pytest.raises(InvalidInputError, match=f"`{refused}` is -1"):
        draw_sensor(*names)


@pytest.mark.parametrize("near", [0.0, -5.0, float("nan"), 1e9])
def test_a_view_beyond_any_sensor_is_refused(near) -> None:
    with pytest.raises(InvalidInputError, match="`near` is"):
        draw_sensor(0, 0, near=near)


def test_they_are_what_they_are_said_to_be() -> None:
    for sensor in MANY:
        assert 2 <= len(sensor.azimuths) == len(sensor.colours) <= 6
        assert all(10.0 <= elevation <= 60.0 for elevation in sensor.elevation)
        assert 0.8 <= sensor.thickness <= 4.0
        assert 10.0 <= sensor.field_of_view <= 20.0
        assert all(0.0 <= value <= 1.0 for colour in sensor.colours for value in colour)
    assert 0.15 < sum(sensor.marker_pitch > 0 for sensor in MANY) / len(MANY) < 0.35


def test_their_backgrounds_differ_within_and_between() -> None:
    backgrounds = torch.stack([gel_background(sensor, 16) for sensor in MANY])
    assert backgrounds.std(dim=0).mean() > 0.13  # of the five named ones it is 0.133
    assert backgrounds.flatten(2).std(dim=-1).mean() > 0.05


def test_an_untouched_gel_shows_its_backdrop() -> None:
    sensor = replace(MANY[0], marker_pitch=0.0, gamma=1.0)
    image = touch_images(torch.zeros(1, 64, 64), torch.tensor([-1.0]), torch.ones(1), torch.zeros(1), sensor, 12)
    torch.testing.assert_close(image[0], torch.tensor(sensor.backdrop), rtol=0, atol=1e-6)


def test_a_gamma_is_a_power_of_every_value() -> None:
    plain, axis = replace(MANY[0], gamma=1.0), pixel_axis(64)
    ball = -(axis[None, :, None] ** 2 + axis[None, None, :] ** 2) / 20.0
    call = (ball, torch.ones(1), torch.ones(1), torch.zeros(1))
    torch.testing.assert_close(
        touch_images(*call, replace(plain, gamma=1.3), 32), touch_images(*call, plain, 32) ** 1.3
    )


def test_a_dome_is_touched_in_its_middle_first() -> None:
    call = (torch.zeros(1, 64, 64), torch.tensor([0.3]), torch.ones(1), torch.zeros(1))
    bulging = replace(PLAIN, dome=1.0)
    change = (touch_images(*call, bulging, 32) - gel_background(bulging, 32)).abs().sum(dim=1)[0]
    assert change[10:22, 10:22].mean() > 5 * change[:4].mean()


def test_scenes_take_sensors_as_they_are_beside_names() -> None:
    made = World(0).render(
        [1, 2], [0, 0], [0, 0], modalities=("touch", "attributes"), sensors=("digit", MANY[0], MANY[1])
    )
    assert set(made.touch) == set(made.attributes) == {"digit", "drawn_0", "drawn_1"}
    for images in made.touch.values():
        assert torch.isfinite(images).all()
        assert images.min() >= 0.0
        assert images.max() <= 1.0
    alone = World(0).render([1, 2], [0, 0], [0, 0], modalities=("touch",), sensors=("digit",))
    assert torch.equal(alone.touch["digit"], made.touch["digit"])


def test_two_sensors_of_one_name_are_refused() -> None:
    with pytest.raises(InvalidInputError, match="two sensors of one name"):
        World(0).render([1], [0], [0], sensors=(MANY[0], replace(MANY[0], gain=0.1)))


@pytest.mark.parametrize("sensor", [*SENSORS.values(), *MANY[:8]], ids=lambda sensor: sensor.name)
def test_an_untouched_gel_is_one_that_a_surface_does_not_reach(sensor) -> None:
    zero = torch.zeros(1)
    away = touch_images(torch.zeros(1, 128, 128), zero - 1.0, zero + 0.3, zero, sensor, 32)[0]
    torch.testing.assert_close(untouched_gel(sensor, 32), away, atol=1e-6, rtol=0.0)
