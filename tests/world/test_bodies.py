"""Bodies are the solids they are named after."""

import pytest
import torch
from torch import Tensor

from unitouch_gen.world.bodies import BODIES, NOTHING
from unitouch_gen.world.surfaces import pixel_axis


def body(name: str, size: float, numbers: tuple[float, float, float] = (0.5, 0.5, 0.5)) -> Tensor:
    axis = pixel_axis(257)
    x, y = axis[None, None, :].expand(1, 257, 257), axis[None, :, None].expand(1, 257, 257)
    return BODIES[name](x, y, torch.full((1, 1, 1), size), torch.tensor(numbers)[None, :, None, None])[0]


AXIS = pixel_axis(257)
X, Y = AXIS[None, :].expand(257, -1), AXIS[:, None].expand(-1, 257)


@pytest.mark.parametrize("name", BODIES)
@pytest.mark.parametrize("numbers", [(0.0, 0.0, 0.0), (0.3, 0.7, 0.5), (0.99, 0.99, 0.99)])
@pytest.mark.parametrize("size", [0.5, 3.0, 12.0])
def test_heights_are_finite_and_the_top_is_near_zero(name, numbers, size) -> None:
    height = body(name, size, numbers)
    assert torch.isfinite(height).all()
    assert height.min() >= NOTHING - 5.0
    assert -0.5 < height.max() < 1.6
    assert height.clamp_min(-2.0).std() > 1e-3  # none is a plane


def test_a_ball_is_a_sphere() -> None:
    height, away = body("ball", 5.0), X**2 + Y**2
    torch.testing.assert_close(height[away < 24.0], (25.0 - away[away < 24.0]).sqrt() - 5.0, rtol=0, atol=1e-5)
    assert (height[away > 25.1] == NOTHING).all()


def test_a_rod_is_a_cylinder_with_round_ends() -> None:
    height = body("rod", 2.0, (0.25, 0.5, 0.0))  # 2 (1 + 8 / 4) = 6 mm to either side
    inside = (X.abs() < 6.0) & (Y.abs() < 1.9)
    torch.testing.assert_close(height[inside], (4.0 - Y[inside] ** 2).sqrt() - 2.0, rtol=0, atol=1e-5)
    assert (height[X.abs() > 8.1] == NOTHING).all()


def test_a_ring_is_a_torus() -> None:
    height, tube = body("ring", 6.0, (0.5, 0.0, 0.0)), 0.15 * 6.0
    away = torch.hypot(X, Y) - 6.0
    inside = away.abs() < 0.95 * tube
    torch.testing.assert_close(height[inside], (tube**2 - away[inside] ** 2).sqrt() - tube, rtol=0, atol=1e-5)
