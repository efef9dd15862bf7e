"""Surfaces from files: how they are read, and which cannot be used."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from tests.benchmarks.surfaces import RELIEF, load_surface, pairs_in, patches, relief_of
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.world.surfaces import BASE_RESOLUTION as SIDE


def write(folder: Path, albedo: tuple[int, int], height: tuple[int, int]) -> tuple[Path, Path]:
    """A pair of pictures of given widths and heights, as it is found."""
    draw = np.random.default_rng(0)
    Image.fromarray(draw.integers(0, 256, (albedo[1], albedo[0], 3), np.uint8)).save(folder / "bark_albedo.png")
    Image.fromarray(draw.integers(0, 256, (height[1], height[0]), np.uint8)).save(folder / "bark_height.png")
    return pairs_in(folder)["bark"]


def test_a_surface_is_read_as_colours_and_relief(tmp_path: Path) -> None:
    albedo, relief = load_surface(*write(tmp_path, (150, 140), (150, 140)))
    assert albedo.shape == (3, 140, 150) and albedo.min() >= 0.0 and albedo.max() <= 1.0
    assert relief.shape == (140, 150) and (relief.min(), relief.max()) == (0.0, RELIEF)
    assert patches(albedo, 2).shape == (4, 3, SIDE, SIDE)


@pytest.mark.parametrize(
    ("albedo", "height", "words"),
    [
        ((200, 100), (200, 200), ("bark_albedo.png' of 200 x 100 pixels", f"at least {SIDE}")),
        ((200, 200), (64, 200), ("bark_height.png' of 64 x 200 pixels", f"at least {SIDE}")),
        ((256, 200), (128, 128), ("bark_albedo.png' of 256 x 200", "bark_height.png' of 128 x 128", "one size")),
    ],
)
def test_sizes_that_cannot_be_used_are_named(tmp_path: Path, albedo, height, words) -> None:
    with pytest.raises(InvalidInputError) as caught:
        write(tmp_path, albedo, height)
    assert [word for word in words if word not in str(caught.value)] == [], caught.value


def test_a_folder_without_a_pair_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="holds no pair such as"):
        pairs_in(tmp_path)


def test_half_a_percent_of_a_relief_is_cut_at_either_end() -> None:
    relief = relief_of(torch.linspace(3.0, 5.0, 10_001).view(73, 137))
    assert (relief == 0.0).float().mean() == pytest.approx(0.005, abs=2e-4)
    assert (relief == RELIEF).float().mean() == pytest.approx(0.005, abs=2e-4)


def test_maps_as_large_as_scans_come_have_a_relief() -> None:
    relief = relief_of(torch.linspace(0.0, 1.0, 4100).expand(4100, -1))
    assert relief.shape == (4100, 4100) and relief.max() == RELIEF
