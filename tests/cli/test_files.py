"""The files of the command line: names that never clash, and pictures that are never half written."""

from pathlib import Path

import pytest
from PIL import Image

from unitouch_gen.cli.files import save_picture, unique
from unitouch_gen.errors import InvalidInputError


@pytest.mark.parametrize(
    ("names", "stems"),
    [
        (["a.png", "b.png"], ["a", "b"]),
        (["a.png", "x/a.png", "a.jpg"], ["a", "a-2", "a-3"]),
        (["a.png", "x/a.png", "a-2.png"], ["a", "a-2", "a-2-2"]),
        (["a-2.png", "a.png", "x/a.png"], ["a-2", "a", "a-3"]),
        (["A.png", "a.png"], ["A", "a-2"]),
    ],
)
def test_no_two_pictures_have_one_name(names, stems):
    assert unique([Path(name).stem for name in names]) == stems


def test_a_picture_that_cannot_be_saved_leaves_nothing_half_written(tmp_path):
    """A format that Pillow starts to write and then gives up."""
    picture = Image.new("RGB", (70_000, 1))
    with pytest.raises(InvalidInputError, match="`--output` cannot be written"):
        save_picture(picture, tmp_path / "picture.jpg")
    assert list(tmp_path.iterdir()) == []


def test_a_picture_that_cannot_be_saved_leaves_the_one_before_it(tmp_path):
    Image.new("RGB", (8, 8)).save(tmp_path / "picture.jpg")
    before = (tmp_path / "picture.jpg").read_bytes()
    with pytest.raises(InvalidInputError):
        save_picture(Image.new("RGB", (70_000, 1)), tmp_path / "picture.jpg")
    assert (tmp_path / "picture.jpg").read_bytes() == before
