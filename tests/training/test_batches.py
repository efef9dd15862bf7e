"""How batches are put together: columns, the indices of each step (Eq. 4 of the paper), and what is done to pixels."""

import itertools
from collections.abc import Callable

import numpy as np
import pytest
import torch
from scipy.stats import chisquare
from torch import Tensor

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.training.audio import roll_in_time
from unitouch_gen.training.batches import (
    ArrayDataset,
    InBatchSampler,
    ShuffledSampler,
    add_noise,
    blur_some,
    in_deviations,
    jitter_colours,
    permute_channels,
    shift_pixels,
    turn_and_flip,
)


def test_a_batch_is_a_copy_of_its_rows_of_every_column() -> None:
    rng = np.random.default_rng(0)
    parts = [rng.standard_normal((n, 2, 3)).astype(np.float32) for n in (4, 1, 6)]
    dataset = ArrayDataset(stacked=parts, array=np.arange(11), tensor=torch.arange(11) / 10)
    indices = [7, 0, 10, 4, 7]
    for _ in range(2):
        batch = dataset[indices]
        np.testing.assert_array_equal(batch["stacked"], np.concatenate(parts)[indices])
        assert batch["array"].tolist() == indices and torch.equal(batch["tensor"], torch.tensor(indices) / 10)
        for values in batch.values():
            values.zero_()
    assert len(dataset) == 11
    with pytest.raises(IndexError):
        dataset[[11]]


# Indices of a step: Eq. 4 ---------------------------------------------------------------------------------------------

SIZES = (300, 100, 200)


def sources(batch: list[int], sizes: tuple[int, ...] = SIZES) -> np.ndarray:
    """Number of samples from each data set."""
    edges = np.cumsum(sizes)
    return np.bincount(np.searchsorted(edges, batch, side="right"), minlength=len(sizes))


def test_a_data_set_is_chosen_by_size_and_the_rest_is_uniform_over_the_others() -> None:
    sampler = InBatchSampler(SIZES, 20, 0.75, seed=3)
    counts = np.stack([sources(sampler(step)) for step in range(1500)])
    assert (counts.max(axis=1) == 15).all() and (counts.sum(axis=1) == 20).all()  # the rest is never of the chosen one
    chosen = counts.argmax(axis=1)
    assert chisquare(np.bincount(chosen), len(counts) * np.array(SIZES) / sum(SIZES)).pvalue > 0.01
    others = np.where(np.eye(3, dtype=bool)[chosen], 0, SIZES)
    expected = (5 * others / others.sum(axis=1, keepdims=True)).sum(axis=0)
    np.testing.assert_allclose(np.where(np.eye(3, dtype=bool)[chosen], 0, counts).sum(axis=0), expected, rtol=0.05)


@pytest.mark.parametrize(
    ("size", "sigma", "share"),
    [(48, 0.75, 36), (32, 0.5, 16), (10, 0.34, 3), (10, 0.36, 4), (7, 0.99, 7), (16, 1.0, 16), (24, 0.0, 0)],
)
def test_exactly_the_share_comes_from_one_data_set(size: int, sigma: float, share: int) -> None:
    sizes = (400, 400, 400)
    sampler = InBatchSampler(sizes, size, sigma)
    for step in range(50):
        batch = sampler(step)
        found = sources(batch, sizes)
        assert found.sum() == len(set(batch)) == size and share in found


def test_without_sigma_batches_are_uniform_over_the_union() -> None:
    sampler = InBatchSampler(SIZES, 24, None, seed=2)
    total = sum(sources(sampler(step)) for step in range(500))
    assert chisquare(total, total.sum() * np.array(SIZES) / sum(SIZES)).pvalue > 0.01


def test_samples_of_a_data_set_are_equally_likely() -> None:
    sampler, hits = InBatchSampler((10, 20), 8, 0.75, seed=5), np.zeros(30)
    for step in range(2000):
        hits[sampler(step)] += 1
    for block in (hits[:10], hits[10:]):
        np.testing.assert_allclose(block, block.mean(), rtol=0.15)  # four standard deviations


def test_a_small_data_set_is_repeated_where_it_has_to_be() -> None:
    sampler = InBatchSampler((4, 400), 16, 0.75)
    batches = [batch for batch in map(sampler, range(400)) if sources(batch, (4, 400))[0] == 12]
    assert batches and all(max(batch) < 404 for batch in batches)


def test_an_epoch_repeats_nothing_and_what_it_leaves_out_another_visits() -> None:
    sampler = ShuffledSampler(103, 10)
    epochs = [[index for place in range(10) for index in sampler(10 * epoch + place)] for epoch in range(5)]
    assert all(len(set(epoch)) == len(epoch) == 100 for epoch in epochs) and epochs[0] != epochs[1]
    assert {index for epoch in epochs for index in epoch} == {*range(103)}


@pytest.mark.parametrize(
    "make", [lambda seed: InBatchSampler(SIZES, 16, 0.75, seed), lambda seed: ShuffledSampler(50, 8, seed)]
)
def test_a_batch_follows_from_the_number_of_its_step(make: Callable) -> None:
    sampler = make(7)
    later = [sampler(step) for step in (9, 3, 9)]
    assert later[0] == later[2] == make(7)(9)
    assert sampler(0) != sampler(1) and sampler(0) != make(8)(0)


def test_batches_that_cannot_be_filled_are_refused() -> None:
    with pytest.raises(InvalidInputError, match=r"`sampler\.sigma` is 0\.75, with no other data set"):
        InBatchSampler([100], 16, 0.75)
    with pytest.raises(InvalidInputError, match="`batch_size` is 64, but there are 5 samples"):
        ShuffledSampler(5, 64)


# Augmentations --------------------------------------------------------------------------------------------------------

EVERY: dict[str, Callable[[Tensor, float], Tensor]] = {
    "shift": lambda images, size: shift_pixels(images, round(3 * size)),
    "jitter": lambda images, size: jitter_colours(images, 0.3 * size, 0.2 * size),
    "turn": turn_and_flip,
    "permute": permute_channels,
    "blur": blur_some,
    "noise": lambda images, size: add_noise(images, 0.2 * size),
}


@pytest.fixture
def images() -> Tensor:
    torch.manual_seed(0)
    return torch.rand(64, 3, 12, 12)


@pytest.mark.parametrize("name", EVERY)
def test_pixels_are_drawn_for_each_sample_by_the_seed_and_keep_their_range(name: str, images: Tensor) -> None:
    before = images.clone()
    torch.manual_seed(5)
    out = EVERY[name](images, 0.7)
    torch.manual_seed(5)
    assert torch.equal(EVERY[name](images, 0.7), out) and torch.equal(images, before)
    assert out.shape == images.shape and out.min() >= 0.0 and out.max() <= 1.0
    assert len(EVERY[name](images[:1].expand(64, -1, -1, -1).clone(), 0.7).unique(dim=0)) > 1
    assert torch.equal(EVERY[name](images, 0.0), images)


def test_a_shift_moves_the_content_within_reach_and_repeats_the_border(images: Tensor) -> None:
    place, found = torch.arange(12), set()
    for image, moved in zip(images, shift_pixels(images, 2), strict=True):
        for down, right in itertools.product(range(-2, 3), repeat=2):
            expected = image[:, (place - down).clamp(0, 11)][:, :, (place - right).clamp(0, 11)]
            found |= {(down, right)} if torch.equal(moved, expected) else set()
    assert len(found) > 15  # of 25, with 64 draws


def test_jitter_is_one_line_for_each_channel() -> None:
    torch.manual_seed(0)
    images = 0.3 + 0.3 * torch.rand(32, 3, 8, 8)  # in the middle, where nothing is clamped
    x, y = images.flatten(2), jitter_colours(images, gain=0.1, offset=0.05).flatten(2)
    gain = ((x - x.mean(2, True)) * (y - y.mean(2, True))).sum(2) / (x - x.mean(2, True)).square().sum(2)
    offset = y.mean(2) - gain * x.mean(2)
    torch.testing.assert_close(gain[..., None] * x + offset[..., None], y)
    assert (gain - 1).abs().max() <= 0.1 + 1e-5 and offset.abs().max() <= 0.05 + 1e-5


def test_turning_reaches_all_eight_symmetries_of_the_square(images: Tensor) -> None:
    found = set()
    for image, turned in zip(images, turn_and_flip(images, 1.0), strict=True):
        candidates = [image.rot90(turns, dims=(1, 2)) for turns in range(4)]
        candidates += [candidate.flip(2) for candidate in candidates]
        (which,) = [number for number, candidate in enumerate(candidates) if torch.equal(turned, candidate)]
        found.add(which)
    assert found == set(range(8))


def test_permuting_exchanges_whole_channels_in_all_six_orders(images: Tensor) -> None:
    orders = set()
    for image, permuted in zip(images, permute_channels(images, 1.0), strict=True):
        (order,) = [o for o in itertools.permutations(range(3)) if torch.equal(image[list(o)], permuted)]
        orders.add(order)
    assert len(orders) == 6


def test_blurring_is_by_the_binomial_kernel_and_keeps_a_constant(images: Tensor) -> None:
    point, expected = torch.zeros(2, 1, 3, 7, 7)
    point[:, 1, 3, 3] = 1.0
    expected[:, 1, 2:5, 2:5] = torch.tensor([[1.0, 2.0, 1.0], [2.0, 4.0, 2.0], [1.0, 2.0, 1.0]]) / 16
    torch.testing.assert_close(blur_some(point, 1.0), expected)
    torch.testing.assert_close(blur_some(torch.full((4, 3, 8, 8), 0.3), 1.0), torch.full((4, 3, 8, 8), 0.3))


def test_noise_has_mean_zero_and_at_most_the_deviation() -> None:
    torch.manual_seed(0)
    grey = torch.full((64, 3, 32, 32), 0.5)
    noise = add_noise(grey, 0.05) - grey
    deviation = noise.flatten(1).std(dim=1)
    assert noise.mean().abs() < 1e-3
    assert deviation.max() < 0.05 * 1.06 and deviation.std() > 0.005  # a level for each image


def test_a_delayed_spectrum_starts_with_its_first_frame_repeated() -> None:
    torch.manual_seed(0)
    spectrum, seen = torch.rand(32, 1, 5, 9), set()
    for clip, delayed in zip(spectrum, roll_in_time(spectrum, 2), strict=True):
        candidates = {d: torch.cat([clip[..., :1].expand(-1, -1, d), clip[..., : 9 - d]], dim=-1) for d in range(3)}
        (delay,) = [d for d, candidate in candidates.items() if torch.equal(delayed, candidate)]
        seen.add(delay)
    assert seen == {0, 1, 2}


def test_measures_are_in_units_of_their_deviation_with_a_bound() -> None:
    values = np.random.default_rng(0).normal(3.0, 2.0, (1000, 4))
    values[0, 0], values[:, 3] = 1e3, 7.0
    found = in_deviations(values)
    np.testing.assert_allclose(found[:, 1], (values[:, 1] - values[:, 1].mean()) / values[:, 1].std(), rtol=1e-5)
    assert found[0, 0] == 5.0 and (found[:, 3] == 0.0).all()
