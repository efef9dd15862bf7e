"""Augmentations: what each leaves alone, and what it may do to a sample."""

import itertools
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from unitouch_gen.training.audio import roll_in_time
from unitouch_gen.training.augment import (
    add_noise,
    blur_some,
    jitter_colours,
    permute_channels,
    shift_pixels,
    turn_and_flip,
)

EVERY: dict[str, Callable[[Tensor], Tensor]] = {
    "shift": lambda images: shift_pixels(images, 3),
    "jitter": lambda images: jitter_colours(images, 0.3, 0.2),
    "turn": lambda images: turn_and_flip(images, 0.5),
    "permute": lambda images: permute_channels(images, 0.5),
    "blur": lambda images: blur_some(images, 0.5),
    "noise": lambda images: add_noise(images, 0.2),
}


@pytest.fixture
def images() -> Tensor:
    torch.manual_seed(0)
    return torch.rand(64, 3, 12, 12)


@pytest.mark.parametrize("name", EVERY)
def test_pixels_keep_shape_and_range(name: str, images: Tensor) -> None:
    out = EVERY[name](images)
    assert out.shape == images.shape and out.dtype == images.dtype
    assert out.min() >= 0.0 and out.max() <= 1.0


@pytest.mark.parametrize("name", EVERY)
def test_the_input_is_left_alone(name: str, images: Tensor) -> None:
    before = images.clone()
    EVERY[name](images)
    assert torch.equal(images, before)


@pytest.mark.parametrize("name", EVERY)
def test_samples_draw_for_themselves(name: str) -> None:
    torch.manual_seed(0)
    same = torch.rand(1, 3, 12, 12).expand(64, -1, -1, -1).clone()
    assert len(EVERY[name](same).unique(dim=0)) > 1


@pytest.mark.parametrize("name", EVERY)
def test_draws_follow_the_seed(name: str, images: Tensor) -> None:
    torch.manual_seed(5)
    first = EVERY[name](images)
    torch.manual_seed(5)
    assert torch.equal(EVERY[name](images), first)


def shifts(image: Tensor, reach: int) -> dict[tuple[int, int], Tensor]:
    """All shifts (down, right) of one image (3, S, S) with its border repeated, by plain indexing."""
    size = image.shape[-1]
    place = torch.arange(size)
    offsets = range(-reach, reach + 1)
    return {
        (down, right): image[:, (place - down).clamp(0, size - 1)][:, :, (place - right).clamp(0, size - 1)]
        for down, right in itertools.product(offsets, offsets)
    }


def test_a_shift_moves_the_content_and_repeats_the_border(images: Tensor) -> None:
    found = set()
    for image, moved in zip(images, shift_pixels(images, 2), strict=True):
        found |= {offset for offset, expected in shifts(image, 2).items() if torch.equal(moved, expected)}
    assert len(found) > 15  # of 25, with 64 draws


def test_every_shift_is_one_of_those_within_reach(images: Tensor) -> None:
    for image, moved in zip(images, shift_pixels(images, 2), strict=True):
        assert any(torch.equal(moved, expected) for expected in shifts(image, 2).values())


def test_a_reach_of_zero_changes_nothing(images: Tensor) -> None:
    assert torch.equal(shift_pixels(images, 0), images)


def test_jitter_is_one_line_for_each_channel() -> None:
    torch.manual_seed(0)
    images = 0.3 + 0.3 * torch.rand(32, 3, 8, 8)  # in the middle, where nothing is clamped
    out = jitter_colours(images, gain=0.1, offset=0.05)
    x, y = images.flatten(2), out.flatten(2)
    gain = ((x - x.mean(2, True)) * (y - y.mean(2, True))).sum(2) / (x - x.mean(2, True)).square().sum(2)
    offset = y.mean(2) - gain * x.mean(2)
    torch.testing.assert_close(gain[..., None] * x + offset[..., None], y)
    assert (gain - 1).abs().max() <= 0.1 + 1e-5 and offset.abs().max() <= 0.05 + 1e-5


def dihedral(image: Tensor) -> list[Tensor]:
    """The eight symmetries of a square."""
    turned = [image.rot90(turns, dims=(1, 2)) for turns in range(4)]
    return turned + [other.flip(2) for other in turned]


def test_turning_with_probability_zero_changes_nothing(images: Tensor) -> None:
    assert torch.equal(turn_and_flip(images, 0.0), images)


def test_turning_gives_a_symmetry_of_the_square(images: Tensor) -> None:
    for image, turned in zip(images, turn_and_flip(images, 1.0), strict=True):
        assert sum(torch.equal(turned, candidate) for candidate in dihedral(image)) == 1


def test_turning_reaches_all_eight_symmetries(images: Tensor) -> None:
    out = turn_and_flip(images, 1.0)
    which = {
        next(i for i, candidate in enumerate(dihedral(image)) if torch.equal(turned, candidate))
        for image, turned in zip(images, out, strict=True)
    }
    assert which == set(range(8))


def test_permuting_with_probability_zero_changes_nothing(images: Tensor) -> None:
    assert torch.equal(permute_channels(images, 0.0), images)


def test_permuting_exchanges_whole_channels(images: Tensor) -> None:
    orders = set()
    for image, permuted in zip(images, permute_channels(images, 1.0), strict=True):
        match = [order for order in itertools.permutations(range(3)) if torch.equal(image[list(order)], permuted)]
        assert len(match) == 1
        orders |= set(match)
    assert len(orders) == 6


def test_blurring_with_probability_zero_changes_nothing(images: Tensor) -> None:
    assert torch.equal(blur_some(images, 0.0), images)


def test_blurring_keeps_a_constant_image() -> None:
    constant = torch.tensor([0.2, 0.5, 0.9])[None, :, None, None].expand(4, 3, 8, 8)
    torch.testing.assert_close(blur_some(constant, 1.0), constant)


def test_blurring_a_point_gives_the_binomial_kernel() -> None:
    point = torch.zeros(1, 3, 7, 7)
    point[:, 1, 3, 3] = 1.0
    expected = torch.zeros(1, 3, 7, 7)
    expected[:, 1, 2:5, 2:5] = torch.tensor([[1.0, 2.0, 1.0], [2.0, 4.0, 2.0], [1.0, 2.0, 1.0]]) / 16
    torch.testing.assert_close(blur_some(point, 1.0), expected)


def test_blurring_leaves_each_image_whole_or_soft(images: Tensor) -> None:
    soft = blur_some(images, 1.0)
    for image, blurred, out in zip(images, soft, blur_some(images, 0.5), strict=True):
        assert torch.equal(out, image) or torch.equal(out, blurred)


def test_noise_of_no_deviation_changes_nothing(images: Tensor) -> None:
    assert torch.equal(add_noise(images, 0.0), images)


def test_noise_has_mean_zero_and_at_most_the_deviation() -> None:
    torch.manual_seed(0)
    grey = torch.full((64, 3, 32, 32), 0.5)
    noise = add_noise(grey, 0.05) - grey
    deviation = noise.flatten(1).std(dim=1)
    assert noise.mean().abs() < 1e-3
    assert deviation.max() < 0.05 * 1.06 and deviation.std() > 0.005  # a level for each image


def test_a_delayed_spectrum_starts_with_its_first_frame_repeated() -> None:
    torch.manual_seed(0)
    spectrum = torch.rand(32, 1, 5, 9)
    seen = set()
    for clip, delayed in zip(spectrum, roll_in_time(spectrum, 2), strict=True):
        candidates = {d: torch.cat([clip[..., :1].expand(-1, -1, d), clip[..., : 9 - d]], dim=-1) for d in range(3)}
        matches = {d for d, candidate in candidates.items() if torch.equal(delayed, candidate)}
        assert len(matches) == 1
        seen |= matches
    assert seen == {0, 1, 2}
