"""What a sensor's lights and background come to, against closed forms."""

import math
from dataclasses import replace

import torch

from tests.helpers.plain_sensor import PLAIN
from unitouch_gen.world.sensors import gel_background, shade_gel

ONE_LIGHT = replace(PLAIN, azimuths=(180.0,), elevation=30.0, colours=((1.0, 0.5, 0.0),), gain=1.0, falloff=0.0)
"""From the left."""


def change(sensor, slope: float) -> torch.Tensor:
    """What a gel of one slope along x everywhere changes in the picture of an untouched one, (3, 8, 8)."""
    tilted = torch.full((1, 8, 8), slope)
    return (shade_gel(tilted, 0.0 * tilted, sensor) - gel_background(sensor, 8))[0]


def test_a_facet_is_lit_by_the_cosine_to_the_light() -> None:
    for degrees in (-40.0, 0.0, 25.0, 60.0):
        lit = math.sin(math.radians(30.0 + degrees)) if degrees > -30.0 else 0.0  # it has turned away at -30
        expected = (lit - math.sin(math.radians(30.0))) * torch.tensor([1.0, 0.5, 0.0])
        found = change(ONE_LIGHT, math.tan(math.radians(degrees)))
        torch.testing.assert_close(found, expected[:, None, None].expand(3, 8, 8), rtol=0.0, atol=1e-6)


def test_lights_may_stand_at_heights_of_their_own() -> None:
    blue = (0.0, 0.2, 0.9)
    both = replace(ONE_LIGHT, azimuths=(180.0, 70.0), colours=(*ONE_LIGHT.colours, blue), elevation=(30.0, 55.0))
    other = replace(ONE_LIGHT, azimuths=(70.0,), colours=(blue,), elevation=55.0)
    torch.testing.assert_close(change(both, 0.4), change(ONE_LIGHT, 0.4) + change(other, 0.4), rtol=0.0, atol=1e-6)


def test_a_light_is_as_much_stronger_at_the_rim_as_its_gradient_says() -> None:
    axis = (torch.arange(8) + 0.5) / 4.0 - 1.0
    factor = 1.0 + 0.3 * axis[None, :] - 0.2 * axis[:, None]
    leaning = replace(ONE_LIGHT, gradients=((0.3, -0.2),))
    torch.testing.assert_close(change(leaning, 0.4), change(ONE_LIGHT, 0.4) * factor, rtol=0.0, atol=1e-6)


def test_a_tint_is_added_for_each_millimetre() -> None:
    level, depth = torch.zeros(1, 8, 8), torch.full((1, 8, 8), 1.5)
    tinted = replace(ONE_LIGHT, tint=(-0.1, 0.0, 0.02))
    found = (shade_gel(level, level, tinted, depth) - gel_background(tinted, 8))[0, :, 3, 4]
    torch.testing.assert_close(found, torch.tensor([-0.15, 0.0, 0.03]), rtol=0.0, atol=1e-6)


def test_a_backdrop_is_the_background_at_its_own_grid() -> None:
    grid = torch.rand(3, 8, 8, generator=torch.Generator().manual_seed(0))
    sensor = replace(ONE_LIGHT, backdrop=tuple(tuple(map(tuple, plane)) for plane in grid.tolist()))
    torch.testing.assert_close(gel_background(sensor, 8), grid)
    assert gel_background(sensor, 64).shape == (3, 64, 64)
