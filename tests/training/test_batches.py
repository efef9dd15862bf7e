"""How batches are put together: columns, the indices of each step (Eq. 4 of the paper), and what is done to pixels."""

import itertools
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
import torch
from scipy.stats import chisquare
from torch import Tensor

from unitouch_gen.training import batches
from unitouch_gen.training.batches import (
    ArrayDataset,
    SamplerSettings,
    in_batch_indices,
    shuffled_indices,
    two_part_indices,
)
from unitouch_gen.training.binding import roll_in_time


def test_a_batch_is_a_copy_of_its_rows_of_every_column() -> None:
    rng = np.random.default_rng(0)
    parts = [rng.standard_normal((n, 2, 3)).astype(np.float32) for n in (4, 1, 6)]
    dataset = ArrayDataset(stacked=parts, array=np.arange(11), tensor=torch.arange(11) / 10)
    indices = [7, 0, 10, 4, 7]
    for _ in range(2):
        batch = dataset[indices]
        np.testing.assert_array_equal(batch["stacked"], np.concatenate(parts)[indices])
        assert batch["array"].tolist() == indices
        assert torch.equal(batch["tensor"], torch.tensor(indices) / 10)
        for values in batch.values():
            values.zero_()
    assert len(dataset) == len(ArrayDataset(array=np.arange(11))) == 11


SIZES = np.array([300, 100, 200])
SIGMA = SamplerSettings(sigma=0.75)


def sources(batch: list[int], sizes: np.ndarray = SIZES) -> np.ndarray:
    """Number of samples from each data set."""
    return np.bincount(np.searchsorted(np.cumsum(sizes), batch, side="right"), minlength=len(sizes))


def test_a_data_set_is_chosen_by_size_and_the_rest_is_uniform_over_the_others() -> None:
    counts = np.stack([sources(in_batch_indices(step, SIZES, 20, SIGMA, seed=3)) for step in range(1500)])
    assert (counts.max(axis=1) == 15).all()  # the rest is never of the chosen one
    assert (counts.sum(axis=1) == 20).all()
    chosen = np.eye(3, dtype=bool)[counts.argmax(axis=1)]
    assert chisquare(chosen.sum(axis=0), len(counts) * SIZES / SIZES.sum()).pvalue > 0.01
    others = np.where(chosen, 0, SIZES)
    expected = (5 * others / others.sum(axis=1, keepdims=True)).sum(axis=0)
    np.testing.assert_allclose(np.where(chosen, 0, counts).sum(axis=0), expected, rtol=0.05)
    uniform = sum(sources(in_batch_indices(step, SIZES, 24, SamplerSettings(), seed=2)) for step in range(500))
    assert chisquare(uniform, uniform.sum() * SIZES / SIZES.sum()).pvalue > 0.01


def test_a_batch_has_its_share_of_either_part_and_each_sample_of_a_part_as_often() -> None:
    in_first = np.arange(50) % 5 == 0
    batches = [two_part_indices(step, in_first, 0.6, 10, seed=1) for step in range(1000)]
    assert all(in_first[batch].sum() == 6 and len({*batch}) == 10 for batch in batches)
    counts = np.bincount(np.concatenate(batches), minlength=50)
    assert chisquare(counts[in_first]).pvalue > 0.01
    assert chisquare(counts[~in_first]).pvalue > 0.01


@pytest.mark.parametrize("in_first", [np.ones(50, dtype=bool), np.zeros(50, dtype=bool)])
def test_a_batch_of_one_part_is_whole(in_first: np.ndarray) -> None:
    assert len({*two_part_indices(0, in_first, 0.6, 10)}) == 10


def test_an_epoch_repeats_nothing_and_what_it_leaves_out_another_visits() -> None:
    batches = [[shuffled_indices(10 * epoch + place, 103, 10) for place in range(10)] for epoch in range(5)]
    epochs = [[*itertools.chain(*epoch)] for epoch in batches]
    assert all(len({*epoch}) == len(epoch) == 100 for epoch in epochs)
    assert epochs[0] != epochs[1]
    assert {index for epoch in epochs for index in epoch} == {*range(103)}


@pytest.mark.parametrize(
    "indices_of",
    [
        partial(in_batch_indices, sizes=SIZES, batch_size=16, settings=SIGMA),
        partial(shuffled_indices, size=50, batch_size=8),
    ],
)
def test_a_batch_follows_from_the_number_of_its_step_and_the_seed(indices_of: Callable) -> None:
    assert indices_of(9, seed=7) == indices_of(9, seed=7)
    assert indices_of(0, seed=7) != indices_of(1, seed=7)
    assert indices_of(0, seed=7) != indices_of(0, seed=8)


TIME = torch.arange(12)
PERMUTED = [*itertools.permutations(range(3))]


def moved(image: Tensor) -> list[Tensor]:
    """All shifts of an image (3, 12, 12) by up to two pixels, with its border repeated."""
    place = [(TIME - offset).clamp(0, 11) for offset in range(-2, 3)]
    return [image[:, down][:, :, right] for down, right in itertools.product(place, repeat=2)]


def blurred(image: Tensor) -> list[Tensor]:
    """An image, and what the 3 x 3 binomial kernel makes of it."""
    padded = torch.nn.functional.pad(image[None], (1, 1, 1, 1), mode="replicate")[0]
    across = (padded[..., :-2] + 2 * padded[..., 1:-1] + padded[..., 2:]) / 4
    return [image, (across[:, :-2] + 2 * across[:, 1:-1] + across[:, 2:]) / 4]


@pytest.mark.parametrize(
    ("augment", "candidates"),
    [
        (lambda images: batches.shift_pixels(images, 2), moved),
        (lambda images: batches.permute_channels(images, 1.0), lambda image: [image[[*p]] for p in PERMUTED]),
        (lambda images: batches.blur_some(images, 0.5), blurred),
        (lambda images: roll_in_time(images, 2), lambda clip: [clip[..., (TIME - d).clamp(0)] for d in range(3)]),
    ],
)
def test_each_image_becomes_one_of_those_that_it_can_become(augment: Callable, candidates: Callable) -> None:
    torch.manual_seed(0)
    images = torch.rand(256, 3, 12, 12)
    found = set()
    before = images.clone()
    for image, out in zip(before, augment(images), strict=True):
        (which,) = [number for number, one in enumerate(candidates(image)) if torch.allclose(one, out, atol=1e-6)]
        found.add(which)
    assert found == {*range(len(candidates(images[0])))}
    assert torch.equal(images, before)


def test_jitter_is_one_line_for_each_channel_and_noise_has_a_level_for_each_image() -> None:
    torch.manual_seed(0)
    images = 0.3 + 0.3 * torch.rand(32, 3, 8, 8)  # in the middle, where nothing is clamped
    x = images.flatten(2)
    y = batches.jitter_colours(images, gain=0.1, offset=0.05).flatten(2)
    gain = ((x - x.mean(2, True)) * (y - y.mean(2, True))).sum(2) / (x - x.mean(2, True)).square().sum(2)
    offset = y.mean(2) - gain * x.mean(2)
    torch.testing.assert_close(gain[..., None] * x + offset[..., None], y)
    assert 0.05 < (gain - 1).abs().max() <= 0.1 + 1e-5
    assert offset.abs().max() <= 0.05 + 1e-5
    noise = batches.add_noise(torch.full((64, 3, 32, 32), 0.5), 0.05) - 0.5
    deviation = noise.flatten(1).std(dim=1)
    assert noise.mean().abs() < 1e-3
    assert deviation.max() < 0.05 * 1.06
    assert deviation.std() > 0.005
    for bright in (batches.jitter_colours(images + 0.6, 0.3, 0.2), batches.add_noise(images + 0.6, 0.2)):
        assert bright.max() == 1.0


def test_groups_are_of_an_example_and_others_of_its_nearest() -> None:
    near = np.eye(10)[np.arange(600) // 60]  # ten kinds of sixty alike
    settings = SamplerSettings(sigma=0.5, group=4)
    rows = np.array(in_batch_indices(3, [600, 600], 16, settings, seed=1, near=np.concatenate([near, near])))
    assert len(set(rows[:8].tolist())) == 8
    for group in rows[:8].reshape(2, 4):
        assert len(set((group % 600 // 60).tolist())) == 1
