"""What the check of a data set finds."""

from pathlib import Path

import numpy as np

from tests.helpers.data_sets import shade, write_image
from unitouch_gen.training.data import open_dataset
from unitouch_gen.training.data.check import check


def test_all_that_is_wrong_is_told(tmp_path: Path) -> None:
    rows = ["touch,picture,sound,object,split"]
    for number in range(16):
        write_image(tmp_path / f"{number}.png", shade(number % 15))
        write_image(tmp_path / f"picture{number}.png", shade(20 + number))
        np.save(tmp_path / f"{number}.npy", np.zeros(number))
        split = "train" if number < 10 else "test"
        rows.append(f"{number}.png,picture{number}.png,{number}.npy,o{number // 4},{split}")
    (tmp_path / "labels.csv").write_text("\n".join(rows))
    (tmp_path / "3.png").write_bytes((tmp_path / "3.png").read_bytes()[:60])
    (tmp_path / "picture4.png").write_text("gone")
    (tmp_path / "5.npy").write_text("gone")
    broken, lines = check(open_dataset(tmp_path), quiet=True)
    assert list(broken) == [3, 4, 5] and "cannot be read as an image" in broken[4]
    assert lines[0] == "1 of 4 objects are in more than one of its own splits"
    assert lines[1].startswith("3 of 16 records cannot be read: 3.png: ") and "picture4.png" in lines[1]
    assert lines[2:] == ["1 of 16 touches are there more than once: 0.png = 15.png"]
