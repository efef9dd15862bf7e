"""`unitouch-gen adapt` on a folder of touches."""

import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from unitouch_gen import weights
from unitouch_gen.cli import main
from unitouch_gen.models import UniTouchModel

pytestmark = pytest.mark.skipif(
    not (weights.JOINT / "model.safetensors").exists(), reason="built-in weights are not there"
)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for kind in ("touch", "picture"):
        (tmp_path / "mine" / kind).mkdir(parents=True)
        for number in range(10):
            pixels = np.random.default_rng(number).integers(0, 256, (70, 64, 3), dtype=np.uint8)
            Image.fromarray(pixels).save(tmp_path / "mine" / kind / f"{number}.png")
    return tmp_path / "mine"


def run(monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    monkeypatch.setattr("sys.argv", ["unitouch-gen", "adapt", *words])
    with pytest.raises(SystemExit) as ended:
        main()
    return int(ended.value.code or 0)


def test_a_folder_becomes_a_sensor(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "out" / "mine.safetensors"
    assert run(monkeypatch, str(folder), "--sensor", "mine", "--steps", "2", "--rank", "2", "-o", str(file)) == 0
    out = capsys.readouterr().out
    assert "of 2 touches that were held out" in out and "its own picture is nearest to it" in out
    assert "These are too few to tell: each of them is 50 % of the figures" in out
    assert UniTouchModel.from_pretrained(weights.JOINT).load_sensor(file) == "mine"
    assert [path.name for path in file.parent.iterdir()] == [file.name]
    assert run(monkeypatch, str(folder), "--sensor", "mine", "-o", str(file)) == 2  # it is there
    assert "pass `--overwrite`" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nowhere", "--sensor", "mine"], "nowhere"),
        (["{folder}", "--sensor", "digit"], "`sensor` is 'digit', which this model knows already"),
        (["{folder}", "--sensor", "mine", "-o", "{folder}/a.png"], "name a .safetensors file"),
        (["{folder}", "--sensor", "mine", "--steps", "0"], "`--steps` is 0"),
        (["{folder}", "--sensor", "mine", "--rank", "1" + "0" * 30], "`--rank` is 1"),
        (["{folder}", "--sensor", "mine", "--seed", "1" + "0" * 30], "`--seed` is 1"),
        (["{folder}", "--sensor", "mine", "--pattern", "touch"], "`--pattern` is ['touch']"),
        (["{folder}", "--sensor", "mine", "--model", "{folder}"], "holds no config.json"),
    ],
)
def test_a_mistake_is_one_line_and_leaves_nothing(
    folder: Path,
    words: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    assert run(monkeypatch, *(word.format(folder=folder) for word in words)) == 2
    error = [line for line in capsys.readouterr().err.splitlines() if "unitouch-gen" in line]
    assert len(error) == 1 and message in error[0]
    assert list((tmp_path / "here").iterdir()) == []


@pytest.mark.parametrize(
    ("kept", "name", "message"),
    [(7, "mine", "`touches` are 7; 8 is the least"), (10, "digit", "`sensor` is 'digit', which this model knows")],
)
def test_what_can_be_refused_is_refused_before_an_image_is_read(
    folder: Path,
    kept: int,
    name: str,
    message: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for number in range(10):
        (folder / "touch" / f"{number}.png").write_text("no image")
        if number >= kept:
            (folder / "touch" / f"{number}.png").unlink()
    assert run(monkeypatch, str(folder), "--sensor", name) == 2
    assert message in capsys.readouterr().err


def test_what_is_odd_about_a_folder_is_told(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "picture" / "3.png").unlink()
    for touch in sorted((folder / "touch").iterdir())[:4]:
        Image.new("RGB", (64, 64), "lime").save(touch)
    monkeypatch.chdir(folder.parent)
    assert run(monkeypatch, str(folder), "--sensor", "mine", "--steps", "1", "--rank", "0") == 0
    lines = [line.split(";")[0] for line in capsys.readouterr().err.splitlines()]
    assert lines[0] == "unitouch-gen: 9 of 10 touches have a picture, so no pictures are used"
    unfamiliar = r"unitouch-gen: \d+ of 10 touches look like those of no sensor that the model knows, as photos would"
    assert len(lines) == 2 and re.fullmatch(unfamiliar, lines[1])
