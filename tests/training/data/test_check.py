"""What the check of a data set finds, and the sheet that it draws."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.helpers.data_sets import GREY, RED, write_image
from unitouch_gen.training.data import open_dataset
from unitouch_gen.training.data.check import IN_A_ROW, TILE, check, contact_sheet

REST = (70, 110, 130)
"""A gel at rest, bluish."""


def write_touch(file: Path, depth: int, place: int = 0, bgr: bool = False) -> None:
    """A gel with a brighter patch in it, and the noise of a camera."""
    rng, row, column = np.random.default_rng(place), 16 * (place % 4), 16 * (place // 4 % 4)
    pixels = np.broadcast_to(np.array(REST, float), (64, 64, 3)) + rng.normal(0, 1.5, (64, 64, 3))
    pixels[row : row + 16, column : column + 16] += depth
    file.parent.mkdir(parents=True, exist_ok=True)
    stored = pixels.clip(0, 255).astype(np.uint8)
    Image.fromarray(stored[..., ::-1] if bgr else stored).save(file)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Sixteen touches; one of no contact, one with channels exchanged, one twice."""
    rows = ["touch,material,object,split"]
    for number in range(16):
        write_touch(tmp_path / f"{number}.png", 0 if number == 5 else 40, number, bgr=number == 9)
        rows.append(
            f"{number}.png,{'wood' if number % 2 else 'glass'},o{number // 4},{'train' if number < 10 else 'test'}"
        )
    (tmp_path / "15.png").write_bytes((tmp_path / "0.png").read_bytes())
    (tmp_path / "labels.csv").write_text("\n".join(rows))
    return tmp_path


def test_odd_touches_are_found_by_the_median_of_all(folder: Path) -> None:
    report = check(open_dataset(folder), quiet=True)
    assert report.flagged == {"untouched": ["5.png"], "exchanged": ["9.png"], "no touch": []} and report.broken == {}
    assert "1 of 16 touches look untouched: 5.png" in report.lines
    assert "1 of 16 touches may have red and blue exchanged: 9.png" in report.lines
    assert "1 of 16 touches are there more than once: 0.png = 15.png" in report.lines


def test_odd_touches_are_found_by_their_own_backgrounds(tmp_path: Path) -> None:
    for number in range(4):  # too few for a median
        write_touch(tmp_path / f"{number}.png", 0 if number == 2 else 40, number)
    write_touch(tmp_path / "background.png", 0, 99)
    assert check(open_dataset(tmp_path), quiet=True).flagged == {
        "untouched": ["2.png"],
        "exchanged": [],
        "no touch": [],
    }


def test_what_splits_share_is_found(folder: Path) -> None:
    lines = check(open_dataset(folder), quiet=True).lines
    assert "1 of 4 objects are in more than one of its own splits" in lines  # o2 has 8 to 11
    assert "1 touches are in more than one of its own splits" in lines  # 0.png and 15.png


def test_files_that_cannot_be_read_are_named_with_the_reason(folder: Path) -> None:
    (folder / "3.png").write_bytes((folder / "3.png").read_bytes()[:60])
    (folder / "4.png").write_text("gone")
    report = check(open_dataset(folder), quiet=True)
    assert list(report.broken) == ["3.png", "4.png"] and "no known image format" in report.broken["4.png"]
    assert any(line.startswith("2 of 16 records cannot be read: 3.png: ") for line in report.lines)


@pytest.mark.parametrize(("colour", "told"), [((60, 80, 160), True), ((160, 80, 60), False), (GREY, False)])
def test_pictures_that_are_blue_on_the_whole_are_told(colour: tuple, told: bool, tmp_path: Path) -> None:
    for number in range(3):
        write_touch(tmp_path / f"touch/{number}.png", 40, number)
        write_image(tmp_path / f"picture/{number}.png", colour)
    lines = check(open_dataset(tmp_path), quiet=True).lines
    assert any("Pictures are bluer" in line for line in lines) == told


def test_the_sheet_shows_every_kind_of_touch_with_its_picture(tmp_path: Path) -> None:
    for number in range(3):
        write_touch(tmp_path / f"touch/{number}.png", 40, number)
        write_image(tmp_path / f"picture/{number}.png", RED)
    sheet = contact_sheet(check(open_dataset(tmp_path), quiet=True))
    assert sheet.size == (IN_A_ROW * (TILE + 4) + 4, 2 * TILE + 36)
    pixels = np.asarray(sheet)
    touch, picture = pixels[17 + TILE * 7 // 8, 4 + TILE * 7 // 8], pixels[17 + TILE + TILE // 2, 4 + TILE // 2]
    assert np.abs(touch.astype(int) - REST).max() < 12 and tuple(picture) == RED
    assert (pixels[:, 3 * (TILE + 4) + 4 :] == 255).all()  # there are only three


def test_the_sheet_shows_what_is_odd_and_leaves_out_what_is_broken(folder: Path) -> None:
    (folder / "3.png").write_text("gone")
    report = check(open_dataset(folder), quiet=True)
    sheet = contact_sheet(report)
    assert sheet.size[1] == 4 * (TILE + 32) + 4  # fifteen touches in two rows, one row untouched, one exchanged
