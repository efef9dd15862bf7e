"""Attributes of contacts whose measures are known."""

import math

import pytest
import torch
from scipy.ndimage import gaussian_filter

from unitouch_gen.world.attributes import ATTRIBUTES, CELLS, contact_attributes, contact_maps, gaussian_blur
from unitouch_gen.world.grids import pixel_axis

VIEW, SIZE = 16.0, 128
AXIS = pixel_axis(SIZE, VIEW)
X = AXIS[None, :].expand(SIZE, -1)
Y = AXIS[:, None].expand(-1, SIZE)


def measured(indentation: torch.Tensor, compliance: float = 0.0) -> dict[str, float]:
    values = contact_attributes(indentation[None], VIEW, torch.tensor([compliance]))[0]
    return dict(zip(ATTRIBUTES, values.tolist(), strict=True))


def test_attributes_of_a_ball() -> None:
    radius = 6.0
    depth = 0.5
    x = 2.0
    y = -1.0
    ball = (radius**2 - (X - x) ** 2 - (Y - y) ** 2).clamp_min(0.0).sqrt() - radius
    found = measured((ball + depth).clamp_min(0.0), 0.3)
    rim = math.sqrt(2 * radius * depth - depth**2)
    assert found["cover"] == pytest.approx(math.pi * rim**2 / VIEW**2, rel=0.02)
    assert found["depth"] == pytest.approx(math.log(depth + 0.02), abs=0.01)
    volume = math.pi * depth**2 * (radius - depth / 3)
    assert found["load"] == pytest.approx(math.log(volume / VIEW**2 + 0.003), abs=0.02)
    assert (found["place x"], found["place y"]) == pytest.approx((2 * x / VIEW, 2 * y / VIEW), abs=0.01)
    assert found["extent"] == pytest.approx(rim / math.sqrt(2) * 2 / VIEW, rel=0.02)  # of a disc
    assert math.hypot(found["grain x"], found["grain y"]) < 0.02  # a ball has none
    assert found["compliance"] == pytest.approx(0.3)


@pytest.mark.parametrize("angle", [0.0, 0.4, 2.5])
def test_attributes_of_waves(angle: float) -> None:
    period, height = 2.0, 0.1
    wave = height * torch.cos(2 * math.pi / period * (math.cos(angle) * X + math.sin(angle) * Y)) + 2 * height
    found = measured(wave)
    slope = 2 * math.pi / period * height / math.sqrt(2)
    assert found["cover"] == 1.0
    assert found["slope"] == pytest.approx(math.log(slope + 0.01), abs=0.03)
    assert found["steepness"] == pytest.approx(0.5 * math.log(slope**2 + 1e-3), abs=0.03)
    assert (found["grain x"], found["grain y"]) == pytest.approx((math.cos(2 * angle), math.sin(2 * angle)), abs=0.03)
    shorter = measured(height * torch.cos(4 * math.pi / period * X) + 2 * height)
    assert shorter["fine relief"] > found["fine relief"]
    assert shorter["coarse relief"] < found["coarse relief"]


def test_attributes_where_nothing_is_touched() -> None:
    found = measured(torch.zeros(SIZE, SIZE))
    assert all(map(math.isfinite, found.values()))
    assert found["cover"] == found["place x"] == found["place y"] == found["extent"] == 0.0


def test_contact_maps_of_a_slope_and_of_waves() -> None:
    deep, slope_x, slope_y, _ = contact_maps((2.0 + 0.1 * X - 0.05 * Y)[None], VIEW)[0]
    middle = (torch.arange(CELLS) + 0.5) * VIEW / CELLS - VIEW / 2
    expected = torch.log(2.0 + 0.1 * middle[None, :] - 0.05 * middle[:, None] + 0.02)
    torch.testing.assert_close(deep, expected, rtol=0, atol=1e-4)
    torch.testing.assert_close(slope_x, torch.full_like(slope_x, 0.1), rtol=0, atol=1e-4)
    torch.testing.assert_close(slope_y, torch.full_like(slope_y, -0.05), rtol=0, atol=1e-4)
    wave = 0.1 * torch.sin(math.pi * X) + 1.0  # a period in each cell
    _, mean, _, steep = contact_maps(wave[None], VIEW)[0, :, 1:-1, 1:-1]
    assert mean.abs().max() < 0.02
    assert steep.exp().mean() == pytest.approx((0.1 * math.pi) ** 2 / 2, rel=0.06)


def test_gaussian_blur_is_scipys() -> None:
    field = torch.rand(1, 40, 40, generator=torch.Generator().manual_seed(0))
    expected = gaussian_filter(field[0].double().numpy(), 3.0, mode="nearest", truncate=8 / 3)
    torch.testing.assert_close(gaussian_blur(field, 3.0)[0], torch.from_numpy(expected).float(), rtol=0, atol=1e-5)
