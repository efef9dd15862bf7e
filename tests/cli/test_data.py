"""`unitouch-gen data check`: what it prints and ends with."""

from pathlib import Path

import pytest

from tests.helpers.data_sets import BLUE, RED, write_image


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for number, material in enumerate(("wood", "wood", "glass")):
        write_image(tmp_path / "mine" / "train" / material / f"{number}.png", RED if number else BLUE)
    return tmp_path / "mine"


def test_a_data_set_is_told(command, folder):
    code, out, _ = command("data", "check", folder, "--sensor", "digit")
    rows = [[cell.strip() for cell in line.strip("│").split("│")] for line in out.splitlines() if "│" in line]
    assert code == 0 and ["material", "wood", "2", "2"] in rows and ["sensor", "digit", "3", "3"] in rows
    assert "1 of 3 touches are there more than once" in out


def test_broken_files_are_listed_and_end_it_with_1(command, folder):
    (folder / "train/wood/1.png").write_bytes(b"\x89PNG")
    code, out, _ = command("data", "check", folder)
    assert code == 1 and "1 of 3 records cannot be read: train/wood/1.png: " in out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nowhere"], "`path` is 'nowhere', which is not there"),
        (["{folder}", "--kind", "touch_and_go"], "Data set 'mine' (touch_and_go; all) has no records"),
        (["{folder}", "--kind", "mine"], "`kind` is 'mine'"),
        (["{folder}", "--pattern", "touch"], "`--pattern` is ['touch']; write each as touch={clip}_peak.jpg"),
        (["{folder}", "--materials", "wood"], "`materials` names 1 of 2"),
    ],
)
def test_a_mistake_is_one_line(command, refused, folder, words, message):
    refused(command("data", "check", *(word.format(folder=folder) for word in words)), message)
