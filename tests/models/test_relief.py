"""The relief behind a touch against heights that are known: shaded by lamps drawn at random, and the world's own."""

import pytest
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor

from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.models.relief import relief
from unitouch_gen.world import MATERIAL_NAMES, World, draw_sensor


def bumps(seed: int, height: int = 128, width: int = 128, count: int = 40) -> tuple[Tensor, Tensor]:
    """Gaussian bumps, (H, W), and their slopes along x and y, (2, H, W)."""
    rng = torch.Generator().manual_seed(seed)
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    at = torch.rand(count, 2, generator=rng) * torch.tensor([width, height])
    wide = (2.5 + 2.5 * torch.rand(count, 1, 1, generator=rng)) * min(height, width) / 128
    dx = x - at[:, :1, None]
    dy = y - at[:, 1:, None]
    each = torch.exp(-(dx**2 + dy**2) / (2 * wide**2))
    return each.sum(0), torch.stack([(-dx / wide**2 * each).sum(0), (-dy / wide**2 * each).sum(0)])


def shaded(slopes: Tensor, seed: int, channels: int = 3) -> Tensor:
    """A picture (1, C, H, W) of slopes under lamps of random colours, with a glow across it."""
    rng = torch.Generator().manual_seed(1000 + seed)
    mixture = torch.randn(channels, 2, generator=rng)
    glow = torch.linspace(-1.0, 1.0, slopes.shape[-1]).expand(slopes.shape[-2:])
    base = torch.randn(channels, 1, 1, generator=rng) + torch.randn(channels, 1, 1, generator=rng) * glow
    return (base + 0.3 * torch.einsum("ck,khw->chw", mixture, slopes))[None]


def alike(a: Tensor, b: Tensor) -> float:
    """Correlation away from the rim."""
    both = torch.stack([a[8:-8, 8:-8].flatten(), b[8:-8, 8:-8].flatten()])
    return torch.corrcoef(both)[0, 1].item()


@pytest.mark.parametrize("size", [(128, 128), (64, 64), (96, 160)])
def test_slopes_and_heights_come_back_whatever_the_lamps_are(size: tuple[int, int]) -> None:
    for seed in range(4):
        heights, slopes = bumps(seed, *size)
        found = relief(shaded(slopes, seed))[0]
        assert alike(found[0], slopes[0]) > 0.95
        assert alike(found[1], slopes[1]) > 0.95
        assert alike(found[2], heights) > 0.8  # what is wider than the window is left out
        assert all(0.4 < deviation < 2.5 for deviation in found.flatten(1).std(dim=1))


def test_two_channels_are_enough_and_one_gives_its_own_direction() -> None:
    heights, slopes = bumps(0)
    assert alike(relief(shaded(slopes, 3, channels=2))[0, 2], heights) > 0.7
    grey = relief(0.5 + 0.3 * slopes[None, :1])[0]
    assert alike(grey[0], slopes[0]) > 0.9


def test_an_even_touch_has_no_relief_and_noise_hardly_any() -> None:
    assert relief(torch.full((1, 3, 64, 64), 0.7)).abs().max() < 1e-3
    torch.manual_seed(0)
    assert relief(0.05 * torch.randn(2, 3, 128, 128)).std() < 0.2


def test_a_broken_pixel_spoils_no_other_touch() -> None:
    pixels = torch.randn(2, 3, 32, 32)
    alone = relief(pixels[1:])
    for pixels[0, 0, 5, 5] in (float("nan"), float("inf"), -1e30):
        torch.testing.assert_close(relief(pixels)[1:], alone)


def test_heights_under_sensors_never_seen_are_those_of_the_gel() -> None:
    """The world's own depths, less what is wide in them."""
    world = World(seed=3)
    count = len(MATERIAL_NAMES)
    found = []
    for number in range(4):
        names = (list(range(count)), [number] * count, [0] * count)
        wanted = ("touch", "depth")
        scene = world.render(*names, modalities=wanted, sensors=[draw_sensor(3, number)])
        (touch,), (depth,) = scene.touch.values(), scene.depth.values()
        detail = depth - torch.from_numpy(gaussian_filter(depth.numpy(), (0, 8, 8)))
        there = detail.flatten(1).std(dim=1) > 0.003
        read = relief(normalise_pixels(touch))[:, 2]
        found += [alike(a, b) for a, b in zip(read[there], detail[there], strict=True)]
    signed = torch.tensor(found)
    assert len(signed) > 40
    assert signed.abs().median() > 0.75
    assert (signed[signed.abs() > 0.5] > 0).float().mean() > 0.8  # joints, pores and holes read as rises
