"""`unitouch-gen stability` and `work-precision`: what they run and print, and their exit codes."""

import json
import re
import shutil

import pytest
from diffusers import DDIMScheduler

from unitouch_gen.numerics import stability
from unitouch_gen.numerics.stability import Case

FINE = Case("fine", lambda: 0.25, 0.5, "a closed form")
FAR = Case("far off", lambda: 0.75, 0.5, "a closed form")
UNKNOWN = Case("unknown", lambda: float("nan"), 0.5, "a closed form")
RAISING = Case("raising", lambda: 1 / 0)


@pytest.fixture
def table(monkeypatch):
    """Replaces the table of cases."""
    return lambda *rows: monkeypatch.setattr(stability, "cases", lambda load, kinds: list(rows))


def test_stability_runs_cases_by_name(command, table):
    table(FINE, FAR, RAISING)
    code, out, _ = command("stability", "--only", "fine")
    assert code == 0
    assert "far off" not in out
    assert all(words in out for words in ("fine", "a closed form", "0.5", "0.25", "1 of 1 cases hold."))


def test_a_case_that_fails_exits_with_1_after_the_others(command, table):
    for case in (FAR, UNKNOWN, RAISING):
        table(case, FINE)
        code, out, _ = command("stability")
        assert code == 1, case.name
        assert "FAILED" in out, case.name
        assert "1 of 2 cases hold." in out, case.name


@pytest.mark.parametrize("name", ["touch-to-image", "stylize", "x-to-touch"])
def test_a_saved_pipeline_takes_the_place_of_the_built_in_ones(command, models, name):
    kind = {"stylize": "stylization"}.get(name, name)
    assert command("stability", "--model", models[name], "--only", f"{kind}: guidance_scale 1e6")[0] == 0
    other = "stylization" if kind == "touch-to-image" else "touch-to-image"
    assert command("stability", "--model", models[name], "--only", f"{other}: guidance_scale 1e6")[0] == 2


@pytest.mark.parametrize("target", ["problem", "pipeline"])
def test_a_chart_of_error_and_time(here, command, models, target):
    words = ["--problem", "mixture-7.5"]
    if target == "pipeline":
        words = ["--pipeline", "x-to-touch", "--model", "model", "--guidance-scale", 2]
        folder = shutil.copytree(models["x-to-touch"], here / "model")
        # Of few levels: a network of random weights changes with every one of them.
        DDIMScheduler(num_train_timesteps=20, beta_start=0.02, beta_end=0.2).save_pretrained(folder / "scheduler")
    points = ["--solvers", "euler,tolerance", "--steps", "4,8", "--tolerances", "0.1", "--seeds", 1]
    code, out, err = command("work-precision", *words, *points, "-o", "chart")
    assert code == 0, err
    assert "Chart and results are in" in out, err
    rows = json.loads((here / "chart/results.json").read_text())["rows"]
    assert [(row["solver"], row["steps"], row["tolerance"]) for row in rows] == [
        ("euler", 4, None),
        ("euler", 8, None),
        ("tolerance", None, 0.1),
    ]
    assert rows[1]["error"] < rows[0]["error"]
    assert re.search(r"euler .*4 steps, .*s.*\n", out)
    assert "for an error of" in out
