"""`unitouch-gen data check`: what it prints, draws, and ends with."""

from pathlib import Path

import pytest
from PIL import Image

from tests.helpers.data_sets import BLUE, RED, write_image
from unitouch_gen.cli import main


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for number, material in enumerate(("wood", "wood", "glass")):
        write_image(tmp_path / "mine" / "train" / material / f"{number}.png", RED if number else BLUE)
    return tmp_path / "mine"


def check(monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    monkeypatch.setattr("sys.argv", ["unitouch-gen", "data", "check", *words])
    with pytest.raises(SystemExit) as stopped:
        main()
    return stopped.value.code or 0


def test_a_data_set_is_told_and_drawn(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    sheet = tmp_path / "sheets" / "sheet.png"
    assert check(monkeypatch, str(folder), "--sensor", "digit", "-o", str(sheet)) == 0
    out = capsys.readouterr().out
    rows = [[cell.strip() for cell in line.strip("│").split("│")] for line in out.splitlines() if "│" in line]
    assert ["material", "wood", "2", "2"] in rows and ["sensor", "digit", "3", "3"] in rows
    assert "1 of 3 touches are there more than once" in out and str(sheet) in out
    assert Image.open(sheet).width > 1000


def test_broken_files_are_listed_and_end_it_with_1(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "train/wood/1.png").write_bytes(b"\x89PNG")
    assert check(monkeypatch, str(folder)) == 1
    assert "1 of 3 records cannot be read: train/wood/1.png: " in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nowhere"], "`path` is 'nowhere', which is not there"),
        (["{folder}", "--kind", "touch_and_go"], "Data set 'mine' (touch_and_go; all) has no records"),
        (["{folder}", "--kind", "mine"], "`kind` is 'mine'"),
        (["{folder}", "--pattern", "touch"], "`--pattern` is ['touch']; write each as touch={clip}_peak.jpg"),
        (["{folder}", "--materials", "wood"], "`materials` names 1 of 2"),
        (["{folder}", "-o", "sheet"], "`--output` is 'sheet'; name a .png or .jpg"),
        (["{folder}", "-o", "{folder}/train/wood/0.png"], "0.png'; name another place, or pass `--overwrite`"),
        (["{folder}", "-o", "{folder}/train/wood/0.png/sheet.png"], "`--output` cannot be written"),
    ],
)  # fmt: skip
def test_a_mistake_is_one_line(
    words: list[str],
    message: str,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert check(monkeypatch, *(word.format(folder=folder, clip="{clip}") for word in words)) == 2
    captured = capsys.readouterr()
    assert len(captured.err.splitlines()) == 1 and message in captured.err and captured.out == ""
