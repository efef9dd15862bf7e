"""`unitouch-gen distill` on a saved pipeline of random networks."""

import pytest

from unitouch_gen.pipelines import TouchToImagePipeline
from unitouch_gen.training import distill as distilling


@pytest.fixture
def run(command):
    """Runs `unitouch-gen distill ...`."""
    return lambda *args: command("distill", *args)


def test_a_student_is_written_and_draws(run, command, models, tmp_path, monkeypatch):
    monkeypatch.setattr(distilling, "FITTED_ON", 1)
    code, out, err = run(
        "--pipeline", "touch-to-image", "--model", models["touch-to-image"], "--output", tmp_path / "student",
        "--steps", "1,2", "--guidance", "1,4", "--contacts", "2", "--batch-size", "2", "--updates", "1",
    )  # fmt: skip
    assert code == 0, err
    assert "2 steps of two rows begin with an error of" in out and "against the teacher over guidance 1 to 4" in out
    pipe = TouchToImagePipeline.from_pretrained(tmp_path / "student")
    assert pipe.scheduler.known == ["1, 2 steps at guidance 1 to 4"]
    code, out, err = command(
        "work-precision", "--pipeline", "touch-to-image", "--model", tmp_path / "student", "-o", tmp_path / "chart"
    )
    assert code == 2 and "no flow of its own" in err
    code, _, err = run("--pipeline", "touch-to-image", "--output", tmp_path / "student")
    assert code == 2 and "exists; name another" in err


@pytest.mark.parametrize(("arguments", "named"), [
    (["--pipeline", "stylization"], "pipeline"),
    (["--pipeline", "x-to-touch", "--steps", "3,4"], "has to divide the largest"),
    (["--pipeline", "x-to-touch", "--steps", "0"], "steps"),
    (["--pipeline", "x-to-touch", "--guidance", "9,1"], "the first has to be below the second"),
    (["--pipeline", "x-to-touch", "--guidance", "3"], "guidance"),
    (["--pipeline", "x-to-touch", "--contacts", "8"], "a batch takes 32"),
    (["--pipeline", "x-to-touch", "--contacts", "10000000"], "contacts"),
    (["--pipeline", "x-to-touch", "--updates", "0"], "updates"),
    (["--pipeline", "x-to-touch", "--updates", "1" + "0" * 400], "updates"),
    (["--pipeline", "x-to-touch", "--learning-rate", "1e9"], "learning_rate"),
    (["--pipeline", "x-to-touch", "--seed", "-1"], "seed"),
    (["--pipeline", "x-to-touch", "--family", "."], "`--family` alone"),
    (["--pipeline", "x-to-touch", "--resume"], "nothing to go on from"),
    (["--pipeline", "x-to-touch", "--model", "nowhere"], "nowhere"),
])  # fmt: skip
def test_what_cannot_be_is_one_line_and_exits_with_2(run, tmp_path, arguments, named):
    code, _, err = run(*arguments, "--output", tmp_path / "student")
    assert code == 2 and named in err and len(err.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())
