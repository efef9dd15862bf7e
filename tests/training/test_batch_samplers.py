"""In-batch sampling (Eq. 4 of the paper) and shuffled epochs, both functions of the step alone."""

import numpy as np
import pytest
from scipy.stats import chisquare

from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.training.sampler import InBatchSampler, ShuffledSampler

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


# Eq. 4 ----------------------------------------------------------------------------------------------------------------


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


def test_sigma_zero_is_uniform_over_the_union() -> None:
    sampler = InBatchSampler(SIZES, 24, 0.0, seed=2)
    total = sum(sources(sampler(step)) for step in range(500))
    assert chisquare(total, total.sum() * np.array(SIZES) / sum(SIZES)).pvalue > 0.01


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


@pytest.mark.parametrize("sigma", [-0.1, 1.1, float("nan")])
def test_a_share_outside_of_zero_to_one_is_refused_by_name(sigma: float) -> None:
    with pytest.raises(InvalidInputError, match="`sigma`"):
        InBatchSampler(SIZES, 16, sigma)


def test_an_empty_data_set_is_refused_by_its_place() -> None:
    with pytest.raises(InvalidInputError, match=r"`sizes\[1\]` is 0"):
        InBatchSampler([10, 0], 4)


def test_a_batch_of_none_is_refused_by_name() -> None:
    with pytest.raises(InvalidInputError, match="`batch_size` is 0"):
        InBatchSampler(SIZES, 0)


def test_a_batch_size_that_is_no_integer_is_refused_by_name() -> None:
    with pytest.raises(InvalidTypeError, match="`batch_size`"):
        InBatchSampler(SIZES, 16.0)  # type: ignore[arg-type]


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


def test_a_batch_larger_than_the_data_is_all_of_the_data() -> None:
    assert sorted(ShuffledSampler(5, 64)(3)) == list(range(5))


@pytest.mark.parametrize(("size", "batch_size"), [(0, 8), (8, 0)])
def test_epochs_of_nothing_are_refused(size: int, batch_size: int) -> None:
    with pytest.raises(InvalidInputError, match="it has to be an integer of at least 1"):
        ShuffledSampler(size, batch_size)
