"""`unitouch-gen stability`: what it lists, runs and prints, and its exit codes."""

import pytest

from unitouch_gen.numerics import stability
from unitouch_gen.numerics.stability import Case


def breaks() -> float:
    raise ArithmeticError("no result")


FINE = Case("fine", lambda: 0.25, 0.5, "a closed form")
FAR = Case("far off", lambda: 0.75, 0.5, "a closed form")
UNKNOWN = Case("unknown", lambda: float("nan"), 0.5, "a closed form")
RAISING = Case("raising", breaks)


@pytest.fixture
def run(command):
    """Runs `unitouch-gen stability ...`."""
    return lambda *args: command("stability", *args)


@pytest.fixture
def table(monkeypatch):
    """Replaces the table of cases."""
    return lambda *rows: monkeypatch.setattr(stability, "cases", lambda load, kinds: list(rows))


def test_the_list_has_the_cases_with_their_demands(run, table):
    table(FINE, RAISING)
    code, out, _ = run("--list")
    assert code == 0
    assert all(words in out for words in ("fine", "raising", "a closed form"))


def test_a_case_within_its_bound(run, table):
    table(FINE, FAR)
    code, out, _ = run("--only", "fine")
    assert code == 0 and "far off" not in out
    assert all(words in out for words in ("fine", "0.5", "0.25", "1 of 1 cases hold."))


@pytest.mark.parametrize("case", [FAR, UNKNOWN, RAISING], ids=lambda case: case.name)
def test_a_case_that_fails_exits_with_1_after_the_others(run, table, case):
    table(case, FINE)
    code, out, _ = run()
    assert code == 1 and "FAILED" in out and "1 of 2 cases hold." in out


@pytest.mark.parametrize("name", ["touch-to-image", "stylize", "x-to-touch"])
def test_a_saved_pipeline_takes_the_place_of_the_built_in_ones(run, models, name):
    kind = {"stylize": "stylization"}.get(name, name)
    assert run("--model", models[name], "--only", f"{kind}: guidance_scale 1e6")[0] == 0
    others = {"touch-to-image", "stylization", "x-to-touch"} - {kind}
    _, out, _ = run("--model", models[name], "--list")
    assert f"{kind}: " in out and not any(f"{other}: " in out for other in others)


def test_a_saved_pipeline_of_another_kind_exits_with_2(run, tmp_path):
    (tmp_path / "model_index.json").write_text('{"_class_name": "StableDiffusionPipeline"}')
    code, _, err = run("--model", tmp_path)
    assert code == 2 and "holds a StableDiffusionPipeline; name a saved TouchToImagePipeline" in err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--only", "fin"), "Unknown case 'fin'; --list shows them. Did you mean 'fine'?"),
        (("--only",), "requires an argument"),
        (("--group", "stiff"), "No such option"),
    ],
)
def test_bad_input_exits_with_2_and_one_line(run, table, arguments, words):
    table(FINE)
    code, out, err = run(*arguments)
    assert (code, out) == (2, "")
    assert words in err and err.count("\n") == 1
