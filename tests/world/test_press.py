"""Height maps pressed against sensors: closed forms, units, several contacts, and maps that are refused."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from tests.helpers.plain_sensor import PLAIN
from unitouch_gen.examples import example
from unitouch_gen.world import SENSORS, press, untouched_gel

SHARP = replace(PLAIN, correlation=1e-3, blur=0.0, thickness=1e4, noise=0.0)  # its gel is displaced as the map says
AXIS = (np.arange(400) + 0.5) / 400 - 0.5


def ball(radius: float, mm: float) -> np.ndarray:
    """A sphere's top, mm, over a map that is `mm` wide."""
    away2 = (mm * AXIS[:, None]) ** 2 + (mm * AXIS[None, :]) ** 2
    return np.sqrt(np.maximum(radius**2 - away2, 0.0))


@pytest.mark.parametrize(("radius", "depth"), [(4.0, 0.5), (6.0, 1.2), (20.0, 0.3)])
def test_a_sphere_leaves_a_disc_of_known_radius(radius: float, depth: float) -> None:
    made = press(ball(radius, 20.0), mm=20.0, sensor=SHARP, depth=depth, seed=None)
    area = (made.depth > 1e-3).float().mean().item() * made.field_of_view**2
    assert math.sqrt(area / math.pi) == pytest.approx(math.sqrt(2 * radius * depth - depth**2), rel=0.02)
    assert made.depth.max().item() == pytest.approx(depth, rel=0.02)


def test_twice_the_width_is_twice_the_size_and_fine_maps_are_averaged() -> None:
    small, large = (press(ball(5.0, 10.0) * k, 10.0 * k, SHARP, 0.5 * k, seed=None).depth[0] for k in (1, 2))
    assert (large > 1e-3).float().sum() / (small > 1e-3).float().sum() == pytest.approx(4.0, rel=0.03)
    fine = np.kron(ball(5.0, 10.0), np.ones((4, 4)))
    again = press(fine, 10.0, SHARP, 0.5, seed=None).depth[0]
    torch.testing.assert_close(again, small, rtol=0, atol=0.02)
    stripes = 0.05 * ((np.arange(2048) % 2) * np.ones((2048, 1)))  # finer than a pixel of the gel: their mean is felt
    assert press(stripes, 20.0, SHARP, 0.5, seed=None).depth.std() < 1e-3


def test_pressing_a_plane_leaves_the_gel_untouched() -> None:
    plane = 0.002 * 16.0 * AXIS[None, :] * np.ones((400, 1))
    made = press(plane, mm=16.0, sensor=PLAIN, seed=None)
    inside = (slice(None), slice(16, -16), slice(16, -16))
    torch.testing.assert_close(made.touch[0][inside], untouched_gel(PLAIN, 128)[inside], rtol=0, atol=2 / 255)


def test_integers_are_a_share_of_their_range_and_floats_are_mm(tmp_path: Path) -> None:
    share = ball(6.0, 16.0) / 6.0
    expected = press(1.5 * share, 16.0, SHARP, 0.8, seed=None).depth
    Image.fromarray((share * 65535).round().astype(np.uint16)).save(tmp_path / "deep.png")
    Image.fromarray((share * 255).round().astype(np.uint8)).save(tmp_path / "eight.png")
    Image.fromarray((share * 255).round().astype(np.uint8)).convert("RGB").save(tmp_path / "grey.png")
    Image.fromarray((1.5 * share).astype(np.float32)).save(tmp_path / "float.tif")
    np.save(tmp_path / "float.npy", 1.5 * share)
    for name, relief, error in (
        ("deep.png", 1.5, 1e-3),
        ("eight.png", 1.5, 8e-3),
        ("grey.png", 1.5, 8e-3),
        ("float.tif", 1.0, 1e-4),
        ("float.npy", 1.0, 1e-4),
    ):
        made = press(tmp_path / name, 16.0, SHARP, 0.8, relief_mm=relief, seed=None).depth
        torch.testing.assert_close(made, expected, rtol=0, atol=error)
    image = Image.open(tmp_path / "deep.png")
    for given in (image, np.asarray(image), np.asarray(image)[..., None], torch.from_numpy(np.array(image))):
        made = press(given, 16.0, SHARP, 0.8, relief_mm=1.5, seed=None).depth
        torch.testing.assert_close(made, expected, atol=1e-3, rtol=0)


def test_several_contacts_are_those_of_one_at_a_time() -> None:
    maps = np.stack([ball(4.0, 20.0), ball(8.0, 20.0)])
    both = press(maps, 20.0, "gelsight", [0.5, 1.0], at=[(0.0, 0.0), (3.0, -2.0)], seed=None)
    for row, (depth, place) in enumerate(((0.5, (0.0, 0.0)), (1.0, (3.0, -2.0)))):
        one = press(maps[row], 20.0, "gelsight", depth, at=[place], seed=None)
        torch.testing.assert_close(both.touch[row], one.touch[0], rtol=0, atol=1e-5)
    moved = press(maps[0], 20.0, SHARP, 0.5, at=[(3.0, -2.0)], seed=None).depth[0]
    axis = 16.0 * (torch.arange(128) + 0.5) / 128 - 8.0
    x = (moved * axis).sum() / moved.sum()
    y = (moved * axis[:, None]).sum() / moved.sum()
    assert (x.item(), y.item()) == (pytest.approx(-3.0, abs=0.05), pytest.approx(2.0, abs=0.05))


@pytest.mark.parametrize("sensor", SENSORS)
def test_every_sensor_sees_the_coin_with_the_noise_of_its_camera(sensor: str) -> None:
    quiet, one, same, other = (press(example("coin", "height"), 24.0, sensor, seed=seed) for seed in (None, 0, 0, 1))
    assert one.touch.shape == (1, 3, 128, 128)
    assert one.touch.min() >= 0.0
    assert one.touch.max() <= 1.0
    assert torch.equal(one.touch, same.touch)
    assert not torch.equal(one.touch, other.touch)
    assert (one.touch - quiet.touch).std().item() == pytest.approx(SENSORS[sensor].noise, rel=0.1)
    assert torch.equal(one.depth, quiet.depth)
    assert 0.4 < one.depth.max() < 1.5
    assert (quiet.touch[0] - untouched_gel(SENSORS[sensor], 128)).abs().max() > 0.1
