"""`unitouch-gen fit` on a saved pipeline, and on a family, of random networks."""

import json
from pathlib import Path

import pytest

from tests.helpers.small_family import write_small_family
from unitouch_gen import weights
from unitouch_gen.pipelines import XToTouchPipeline
from unitouch_gen.pipelines.tiny import tiny


@pytest.fixture
def run(command):
    """Runs `unitouch-gen fit ...`."""
    return lambda *args: command("fit", *args)


@pytest.fixture
def saved(tmp_path, make_x_to_touch) -> Path:
    make_x_to_touch(default_num_inference_steps=3).save_pretrained(tmp_path / "pipe")
    return tmp_path / "pipe"


def test_the_folder_brings_fits_from_then_on(run, saved):
    code, out, err = run("--pipeline", "x-to-touch", "--model", str(saved), "--steps", "3", "--contacts", "2",
                   "--no-calibrate")  # fmt: skip
    assert code == 0, err
    assert "3 steps leave an error of" in out
    pipe = XToTouchPipeline.from_pretrained(saved)
    assert pipe.scheduler.known == ["3 steps at guidance 2"]
    assert json.loads((saved / "model_index.json").read_text())["scheduler"][1] == "FittedScheduler"


@pytest.mark.slow
def test_a_family_brings_fits_from_then_on(run, tmp_path):
    write_small_family(tmp_path)
    defaults = tmp_path / weights.X_TO_TOUCH.name / "defaults.json"
    before = json.loads(defaults.read_text())
    code, _, err = run("--pipeline", "x-to-touch", "--family", tmp_path, "--steps", "3", "--guidance", "2",
                       "--contacts", "2", "--no-calibrate")  # fmt: skip
    assert code == 0, err
    assert tiny("x-to-touch", family=tmp_path).scheduler.find(3, 2.0) is not None
    assert json.loads(defaults.read_text()) == {"calibration": {}, **before}


@pytest.mark.parametrize(("arguments", "named"), [
    (["--pipeline", "x-to-touch"], "--model"),
    (["--pipeline", "touch", "--model", "."], "pipeline"),
    (["--pipeline", "x-to-touch", "--model", ".", "--steps", "0"], "`steps` is 0"),
    (["--pipeline", "x-to-touch", "--model", ".", "--steps", "6,99999"], "`steps` is 99999; it has to be an integer"),
    (["--pipeline", "x-to-touch", "--model", ".", "--otherwise", "unipcc"], "unipc"),
    (["--pipeline", "x-to-touch", "--model", ".", "--contacts", "8501"], "from 1 to 8500"),
    (["--pipeline", "x-to-touch", "--model", "nowhere"], "nowhere"),
    (["--pipeline", "x-to-touch", "--model", "some/repository"], "no folder"),
])  # fmt: skip
def test_what_cannot_be_is_one_line_and_exits_with_2(run, arguments, named):
    code, _, err = run(*arguments)
    assert code == 2 and named in err and len(err.strip().splitlines()) == 1
