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
    Stacked,
    add_noise,
    blur_some,
    jitter_colours,
    permute_channels,
    shift_pixels,
    turn_and_flip,
)

# Columns --------------------------------------------------------------------------------------------------------------


@pytest.fixture
def parts() -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [rng.standard_normal((n, 2, 3)).astype(np.float32) for n in (4, 1, 6)]


def test_stacked_arrays_read_as_their_concatenation(parts: list[np.ndarray]) -> None:
    whole, stacked = np.concatenate(parts), Stacked(parts)
    assert len(stacked) == 11
    for index in (np.arange(11), np.array([10, 0, 4, 4, 5, 3])):
        np.testing.assert_array_equal(stacked[index], whole[index])


def test_stacked_arrays_refuse_an_index_beyond_their_end(parts: list[np.ndarray]) -> None:
    with pytest.raises(IndexError):
        Stacked(parts)[np.array([11])]


def test_a_batch_is_its_samples_stacked(parts: list[np.ndarray]) -> None:
    dataset = ArrayDataset(stacked=parts, array=np.arange(11), tensor=torch.linspace(0, 1, 11))
    indices = [7, 0, 10, 7]
    batch = dataset[indices]
    for key, values in batch.items():
        assert torch.equal(values, torch.cat([dataset[[index]][key] for index in indices]))


def test_columns_are_indexed_together(parts: list[np.ndarray]) -> None:
    batch = ArrayDataset(x=parts, number=np.arange(11))[[9, 2]]
    assert batch["number"].tolist() == [9, 2]
    np.testing.assert_array_equal(batch["x"], np.concatenate(parts)[[9, 2]])


def test_a_batch_is_a_copy(parts: list[np.ndarray]) -> None:
    dataset = ArrayDataset(x=parts, number=np.arange(11))
    batch = dataset[[0, 1]]
    batch["x"].zero_(), batch["number"].zero_()
    again = dataset[[0, 1]]
    assert again["number"].tolist() == [0, 1] and again["x"].abs().sum() > 0


def test_columns_of_different_lengths_are_refused() -> None:
    with pytest.raises(ValueError, match=r"`columns` have lengths \{'a': 3, 'b': 4\}"):
        ArrayDataset(a=np.zeros(3), b=torch.zeros(4))


# Indices of a step: Eq. 4 ---------------------------------------------------------------------------------------------

SIZES = (300, 100, 200)


def sources(batch: list[int], sizes: tuple[int, ...] = SIZES) -> np.ndarray:
    """Number of samples from each data set."""
    edges = np.cumsum(sizes)
    return np.bincount(np.searchsorted(edges, batch, side="right"), minlength=len(sizes))


@pytest.fixture(scope="module")
def counts() -> np.ndarray:
    """Samples from each data set in 1,500 batches of 20 with sigma = 0.75, (1500, 3)."""
    sampler = InBatchSampler(SIZES, 20, 0.75, seed=3)
    return np.stack([sources(sampler(step)) for step in range(1500)])


@pytest.mark.parametrize(
    ("size", "sigma", "share"),
    [(48, 0.75, 36), (32, 0.5, 16), (10, 0.34, 3), (10, 0.36, 4), (7, 0.99, 7), (128, 0.75, 96)],
)
def test_exactly_the_share_comes_from_one_data_set(size: int, sigma: float, share: int) -> None:
    sizes = (400, 400, 400)
    sampler = InBatchSampler(sizes, size, sigma)
    for step in range(50):
        found = sources(sampler(step), sizes)
        assert found.sum() == size
        assert share in found  # the rest is spread over the others, so it does not land on the chosen one


def test_the_rest_never_comes_from_the_chosen_data_set(counts: np.ndarray) -> None:
    assert (counts.max(axis=1) == 15).all()
    assert (counts.sum(axis=1) == 20).all()


def test_a_data_set_is_chosen_with_probability_by_size(counts: np.ndarray) -> None:
    chosen = np.bincount(counts.argmax(axis=1), minlength=3)
    assert chisquare(chosen, len(counts) * np.array(SIZES) / sum(SIZES)).pvalue > 0.01


def test_the_rest_is_uniform_over_the_other_data_sets(counts: np.ndarray) -> None:
    chosen = np.eye(3, dtype=bool)[counts.argmax(axis=1)]
    others = np.where(chosen, 0, SIZES)
    expected = (5 * others / others.sum(axis=1, keepdims=True)).sum(axis=0)
    np.testing.assert_allclose(np.where(chosen, 0, counts).sum(axis=0), expected, rtol=0.05)


def test_samples_of_a_data_set_are_equally_likely() -> None:
    sizes = (10, 20)
    sampler, hits = InBatchSampler(sizes, 8, 0.75, seed=5), np.zeros(30)
    for step in range(2000):
        hits[sampler(step)] += 1
    for block in (hits[:10], hits[10:]):
        np.testing.assert_allclose(block, block.mean(), rtol=0.15)  # four standard deviations


def test_sigma_one_takes_the_whole_batch_from_one_data_set() -> None:
    sampler = InBatchSampler(SIZES, 16, 1.0)
    assert all(sources(sampler(step)).max() == 16 for step in range(100))


def test_sigma_one_needs_only_one_data_set() -> None:
    assert sorted(InBatchSampler([16], 16, 1.0)(0)) == list(range(16))


def test_without_sigma_batches_are_uniform_over_the_union() -> None:
    sampler = InBatchSampler(SIZES, 24, None, seed=2)
    total = sum(sources(sampler(step)) for step in range(500))
    assert chisquare(total, total.sum() * np.array(SIZES) / sum(SIZES)).pvalue > 0.01


def test_sigma_zero_takes_nothing_from_the_data_set_that_was_chosen() -> None:
    sampler = InBatchSampler(SIZES, 24, 0.0, seed=2)
    assert all(sources(sampler(step)).min() == 0 for step in range(100))


def test_a_step_has_the_same_batch_whenever_it_is_asked_for() -> None:
    sampler = InBatchSampler(SIZES, 16, 0.75, seed=4)
    later = [sampler(step) for step in (9, 3, 9)]
    assert later[0] == later[2] == InBatchSampler(SIZES, 16, 0.75, seed=4)(9)


def test_steps_and_seeds_have_batches_of_their_own() -> None:
    sampler = InBatchSampler(SIZES, 16, 0.75, seed=4)
    assert sampler(0) != sampler(1)
    assert sampler(0) != InBatchSampler(SIZES, 16, 0.75, seed=5)(0)


def test_nothing_is_repeated_within_a_batch_that_the_data_can_fill() -> None:
    sampler = InBatchSampler((20, 16, 18), 16, 0.75)
    for step in range(300):
        batch = sampler(step)
        assert len(set(batch)) == len(batch)


def test_a_small_data_set_is_repeated_where_it_has_to_be() -> None:
    sampler = InBatchSampler((4, 400), 16, 0.75)
    batches = [batch for batch in map(sampler, range(400)) if sources(batch, (4, 400))[0] == 12]
    assert batches and all(max(batch) < 404 for batch in batches)


def test_a_share_needs_another_data_set_for_the_rest() -> None:
    with pytest.raises(InvalidInputError, match=r"`sigma` is 0\.75 with 1 data set"):
        InBatchSampler([100], 16, 0.75)


# Epochs ---------------------------------------------------------------------------------------------------------------


def test_an_epoch_repeats_nothing() -> None:
    sampler = ShuffledSampler(103, 10)
    for epoch in range(3):
        seen = [index for place in range(10) for index in sampler(10 * epoch + place)]
        assert len(seen) == len(set(seen)) == 100
        assert set(seen) <= set(range(103))


def test_an_epoch_of_whole_batches_visits_everything() -> None:
    sampler = ShuffledSampler(60, 20)
    assert sorted(sampler(3) + sampler(4) + sampler(5)) == list(range(60))


def test_what_one_epoch_leaves_out_another_visits() -> None:
    sampler = ShuffledSampler(13, 10)
    assert {index for epoch in range(20) for index in sampler(epoch)} == set(range(13))


def test_epochs_are_shuffled_differently() -> None:
    sampler = ShuffledSampler(60, 60)
    assert sampler(0) != sampler(1)


def test_a_shuffled_step_does_not_depend_on_what_was_asked_before() -> None:
    sampler = ShuffledSampler(50, 8, seed=7)
    for step in range(20):
        sampler(step)
    assert sampler(11) == ShuffledSampler(50, 8, seed=7)(11)


def test_a_batch_larger_than_the_data_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="`batch_size` is 64, but there are 5 samples"):
        ShuffledSampler(5, 64)


# Augmentations --------------------------------------------------------------------------------------------------------

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
