"""`unitouch-gen stability`: what it lists, runs, prints and writes, and its exit codes."""

import json
import math
import sys

import pytest
import torch

from unitouch_gen.numerics import stability_suite
from unitouch_gen.numerics.stability import Case, Ended
from unitouch_gen.pipelines.tiny import tiny
from unitouch_gen.sampling import ReturnCode

ONE = [ReturnCode.SUCCESS]
FINE = Case("fine", lambda: Ended(torch.ones(1, 2), 0.25, ONE), 0.5, "a closed form")
FAR = Case("far off", lambda: Ended(torch.ones(1, 2), 0.75, ONE), 0.5, "a closed form")
SILENT = Case("silent", lambda: Ended(torch.full((1, 2), math.nan), math.nan, ONE))


@pytest.fixture
def run(command):
    """Runs `unitouch-gen stability ...`."""
    return lambda *args: command("stability", *args)


@pytest.fixture
def other(monkeypatch):
    """Puts other cases in the place of the suite."""
    return lambda **groups: monkeypatch.setattr(stability_suite, "suite", lambda load: groups)


def test_the_suite_has_all_that_is_stiff_and_extreme(run):
    code, out, _ = run("--list")
    assert code == 0
    for words in ("guidance 1000", "1000 steps", "zero terminal SNR", "float16", "bfloat16", "1e+30", "NaN", "Inf",
                  "batch of 64", "(37, 101)", "conditioning-1e12", "an interrupt", "second order"):  # fmt: skip
        assert words in out, words
    assert out.count("\n") > 60


def test_help_names_every_group(run):
    groups = sys.modules["unitouch_gen.cli.stability"].GROUPS  # the package has the function under that name
    assert list(stability_suite.suite(tiny)) == list(groups)
    code, out, _ = run("--help")
    words = " ".join(out.replace("│", " ").split())
    assert code == 0 and [group for group in groups if group not in words] == []


def test_cases_that_end_as_expected_exit_with_0(run, tmp_path):
    file = tmp_path / "outcomes.json"
    names = ("near-delta, unipc", "guidance_scale=0", "stiffness 1e30")
    code, out, _ = run(*(word for name in names for word in ("--only", name)), "--json", file)
    assert code == 0
    assert "3 cases: 3 as expected, 0 not, 0 silently not finite" in out
    record = json.loads(file.read_text())
    assert [row["group"] for row in record["cases"]] == ["stiff", "calls", "gels"]
    assert record["cases"][0]["value"] < 1e-5
    assert (record["wrong"], record["silent"]) == ([], [])
    assert [path.name for path in tmp_path.iterdir()] == ["outcomes.json"]


def test_a_group_is_run_alone(run):
    code, out, _ = run("--group", "sounds")
    assert code == 0
    assert "sounds" in out and "gels" not in out


def test_a_case_that_is_not_as_expected_exits_with_1(run, other, tmp_path):
    other(one=[FINE, FAR], two=[SILENT])
    file = tmp_path / "outcomes.json"
    code, out, _ = run("--json", file)
    assert code == 1
    assert "3 cases: 1 as expected, 2 not, 1 silently not finite" in out
    assert "one, far off: expected success, error <= 0.5 (a closed form); seen: success" in out
    record = json.loads(file.read_text())
    assert (record["wrong"], record["silent"]) == (["far off", "silent"], ["silent"])
    assert [row["ok"] for row in record["cases"]] == [True, False, False]
    assert [row["value"] for row in record["cases"]] == [0.25, 0.75, None]


@pytest.mark.parametrize("name", ["touch-to-image", "stylize", "x-to-touch"])
def test_a_saved_pipeline_is_called_alone(run, models, name):
    code, out, _ = run("--model", models[name], "--group", "calls")
    assert code == 0
    assert "19 cases: 19 as expected, 0 not, 0 silently not finite" in out
    assert run("--model", models[name], "--group", "gels")[0] == 2


def test_a_saved_pipeline_of_another_kind_is_refused(run, tmp_path):
    (tmp_path / "model_index.json").write_text('{"_class_name": "StableDiffusionPipeline"}')
    code, _, err = run("--model", tmp_path)
    assert code == 2 and "holds a StableDiffusionPipeline; name a saved TouchToImagePipeline" in err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--group", "stif"), "`group` is 'stif'; it has to be one of 'stiff'. Did you mean 'stiff'?"),
        (("--only", "no such case"), "`only` is 'no such case'"),
        (("--json", "/proc/folder/file.json"), "`--json` cannot be written to '/proc/folder/file.json'"),
        (("--only",), "requires an argument"),
    ],
)
def test_what_cannot_be_run_exits_with_2(run, other, arguments, words):
    other(stiff=[FINE])
    code, out, err = run(*arguments)
    assert (code, out) == (2, "")
    assert words in err and err.count("\n") == 1
