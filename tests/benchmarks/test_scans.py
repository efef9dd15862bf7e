"""What scanned surfaces are measured by, where the answer is known."""

from pathlib import Path

import pytest
import torch

from tests.benchmarks import scans
from unitouch_gen import weights
from unitouch_gen.evaluation.controls import others
from unitouch_gen.world.scans import scanned_surfaces


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def wave(down: int, across: int, size: int = 128) -> torch.Tensor:
    """A grey sine (1, 3, S, S) of so many periods from top to bottom and from left to right."""
    y, x = torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij")
    phase = 2.0 * torch.pi * (down * y + across * x) / size
    return (0.5 + 0.2 * torch.sin(phase)).expand(1, 3, -1, -1)


@pytest.mark.parametrize(("down", "across"), [(0, 6), (2, 10), (10, 22), (-6, 14), (30, 42), (50, 62)])
def test_a_sine_lights_the_cell_of_its_frequency(down: int, across: int) -> None:
    # A Hann window spreads a frequency to its two neighbours, which are in the same cell.
    spectrum = scans.log_spectrum(wave(down, across)).view(32, 16)
    row, column = divmod(int(spectrum.argmax()), 16)
    assert (row, column) == (down // 4 % 32, across // 4)
    away = torch.ones(32, 16, dtype=torch.bool)
    away[torch.arange(row - 2, row + 3) % 32, max(column - 2, 0) : column + 3] = False
    assert float(spectrum.max() - spectrum[away].max()) > 5.0


def test_a_spectrum_grows_by_the_square_of_contrast_and_ignores_brightness() -> None:
    images = torch.rand(2, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    once = scans.log_spectrum(images / 4)
    twice = scans.log_spectrum(images / 2 + 0.1)
    torch.testing.assert_close(twice - once, torch.full_like(once, 4.0).log(), rtol=1e-3, atol=1e-3)


def test_white_noise_has_a_flat_spectrum() -> None:
    """But for what the mean over 33 pixels takes away, below some four periods."""
    mean = scans.log_spectrum(0.1 * random(400, 3, 64, 64)).mean(dim=0).view(16, 8)
    above = mean[4:13]
    assert float(above.max() - above.min()) < 0.2


def test_a_round_holds_one_flat_contact_of_each_held_out_surface() -> None:
    source = scans.scanned_contacts(1000, 1)
    _, objects, contacts = source.contacts("test")
    draws = source.world().draw(*source.contacts("test"))
    assert not draws.shape.any()  # all are flat
    heldout = [one for one in scanned_surfaces() if one.split == "test" and one.heights != "none"]
    names = [scanned_surfaces()[number].name for number in draws.surface.tolist()]
    assert set(names) == {one.name for one in heldout}
    rounds = scans.rounds_of(source)
    groups = {one.name: one.group for one in heldout}
    assert rounds.shape == (scans.ROUNDS, len(set(groups.values())))
    assert rounds.shape[1] >= scans.AMONG
    assert {groups[names[row]] for row in rounds[0].tolist()} == set(groups.values())
    for surface in rounds.T:
        assert len({names[row] for row in surface.tolist()}) == 1
        assert len(objects[surface].unique()) == 1
        assert contacts[surface].tolist() == list(range(scans.ROUNDS))


def test_controls_of_what_is_found_are_what_they_should_be() -> None:
    gallery = random(3, 43, 60)
    alike = torch.ones(2, 43, 60)
    row = scans.found_row(gallery[:2], gallery, alike, first=5)
    assert row["value"] == 1.0
    assert row["chance"] == 5 / 40
    assert row["class_mean"] == pytest.approx(5 / 40)  # all are equally near
    assert row["shuffled"] < 0.3
    assert row["ceiling"] < 0.3
    assert scans.found_row(gallery[:, others(43)], gallery, gallery)["class_mean"] == 1.0


def test_read_linearly_finds_a_linear_relation() -> None:
    mixing = random(12, 20, seed=1)
    source = random(300, 12, seed=2)
    known = source[:257]
    asked = source[257:]
    read, stored = scans.read_linearly((known, 3.0 + known @ mixing), asked, 3.0 + asked @ mixing)
    assert scans.found_among(read[None], stored[None]) == 1.0


@pytest.mark.slow
def test_the_built_in_joint_space_is_beside_its_controls(tmp_path: Path) -> None:
    words = ["--joint", str(weights.JOINT), "--seeds", "1", "--train-objects", "2"]
    figures = scans.measure(scans.arguments(words), tmp_path)
    row = figures["rows"]["touch to its touch by a DIGIT, among 40"]
    assert row["value"] > row["shuffled"]
    assert figures["of"]["recorded"] == {"takes": 20, "kinds": 4, "materials": 4}
