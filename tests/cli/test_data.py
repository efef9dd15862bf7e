"""`unitouch-gen data check`: what it prints and ends with."""

from pathlib import Path

import numpy as np
import pytest

from tests.helpers.data_sets import BLUE, RED, shade, write_image


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for number, material in enumerate(("wood", "wood", "glass")):
        write_image(tmp_path / "mine" / "train" / material / f"{number}.png", RED if number else BLUE)
    return tmp_path / "mine"


def test_a_data_set_is_told(command, folder):
    for name in (".DS_Store", "train/wood/._0.png", "Thumbs.db"):
        (folder / name).write_bytes(b"left by a system")
    code, out, _ = command("data", "check", folder, "--sensor", "digit")
    rows = [[cell.strip() for cell in line.strip("│").split("│")] for line in out.splitlines() if "│" in line]
    assert code == 0
    assert ["material", "wood", "2"] in rows
    assert ["sensor", "digit", "3"] in rows
    assert "1 of 3 touches are there more than once" in out
    assert "belong to no touch: Thumbs.db\n" in out


def test_all_that_is_wrong_is_told_and_ends_it_with_1(command, tmp_path):
    rows = ["touch,picture,sound,object,split"]
    for number in range(8):
        write_image(tmp_path / f"{number}.png", shade(number % 7))
        write_image(tmp_path / f"picture{number}.png", shade(20 + number))
        np.save(tmp_path / f"{number}.npy", np.zeros(number))
        split = "train" if number < 5 else "test"
        rows.append(f"{number}.png,picture{number}.png,{number}.npy,o{number // 2},{split}")
    (tmp_path / "labels.csv").write_text("\n".join(rows))
    (tmp_path / "3.png").write_bytes(b"\x89PNG")
    (tmp_path / "picture4.png").write_text("gone")
    (tmp_path / "5.npy").write_text("gone")
    code, out, _ = command("data", "check", tmp_path)
    lines = out.splitlines()[-3:]
    assert code == 1
    assert lines[0] == "1 of 4 objects are in more than one of its own splits"
    assert lines[1].startswith("3 of 8 records cannot be read: 3.png: ")
    assert all(name in lines[1] for name in ("; 4.png: ", "picture4.png", "; 5.png: "))
    assert lines[2] == "1 of 8 touches are there more than once: 0.png = 7.png"
