"""`unitouch-gen work-precision`, run in this process on an exact problem and on a tiny random pipeline."""

import csv
import json
from pathlib import Path

import pytest

from unitouch_gen.cli.work_precision import variant
from unitouch_gen.errors import InvalidInputError

FILES = ["chart.png", "chart.svg", "results.csv", "results.json"]
FEW = ("--solvers", "euler,unipc", "--steps", "4,8", "--seeds", "2", "--repeats", "1")


@pytest.fixture(scope="session")
def model(tmp_path_factory, make_x_to_touch) -> str:
    """Folder of a saved x-to-touch pipeline."""
    folder = tmp_path_factory.mktemp("model")
    make_x_to_touch(default_num_inference_steps=3, default_guidance_scale=1.0).save_pretrained(folder)
    return str(folder)


@pytest.fixture
def run(command, tmp_path, monkeypatch):
    """Runs the command in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return lambda *args: command("work-precision", *args)


def test_a_problem_is_charted(run):
    code, out, err = run("--problem", "gaussian", *FEW, "-o", "out")
    assert (code, err) == (0, "")
    assert sorted(path.name for path in Path("out").iterdir()) == FILES
    assert "reference in closed form" in Path("out/chart.svg").read_text()
    assert "unipc" in out and "error of at most" in out and "Chart and results are in" in out
    with open("out/results.csv", newline="") as file:
        assert [(row["solver"], row["steps"]) for row in csv.DictReader(file)] == [
            (solver, steps) for solver in ("euler", "unipc") for steps in ("4", "8")
        ]


def test_json_has_rows_fronts_and_orders(run):
    code, out, _ = run("--problem", "gaussian", *FEW, "-o", "out", "--json")
    found = json.loads(out)
    assert code == 0 and len(found["rows"]) == 4
    assert {order["solver"]: order["nominal"] for order in found["orders"]} == {"euler": 1, "unipc": 3}
    rows = {row["key"]: row for row in found["rows"]}
    front = [rows[key] for key in found["fronts"]["1.0"]["evaluations"]]
    assert front[-1]["error"] == min(row["error"] for row in found["rows"])
    assert [Path(file).name for file in found["files"]] == ["results.json", "results.csv", "chart.png", "chart.svg"]


def test_what_is_there_is_not_measured_again(run):
    run("--problem", "gaussian", *FEW, "-o", "out")
    before = json.loads(Path("out/results.json").read_text())["rows"]
    run("--problem", "gaussian", *FEW, "--solvers", "heun", "-o", "out")
    after = json.loads(Path("out/results.json").read_text())["rows"]
    assert after[:4] == before and {row["solver"] for row in after[4:]} == {"heun"}


def test_a_folder_of_something_else_is_refused_and_kept(run):
    run("--problem", "gaussian", *FEW, "-o", "out")
    before = Path("out/results.json").read_text()
    code, _, err = run("--problem", "mixture", *FEW, "-o", "out")
    assert code == 2 and "holds results of 'gaussian'" in err and err.count("\n") == 1
    assert Path("out/results.json").read_text() == before


def test_guidance_scales_dtypes_and_variants_are_measured(run):
    more = ("--dtypes", "float32,bfloat16", "--guidance", "1,3", "--option", "solver_order=1")
    args = ("--solvers", "unipc", "--steps", "4", "--seeds", "2", "--repeats", "1", "--reference-tolerance", "1e-5")
    code, out, err = run("--problem", "mixture-3", *args, *more, "-o", "out", "--json")
    assert (code, err) == (0, "")
    assert {(row["guidance_scale"], row["series"]) for row in json.loads(out)["rows"]} == {
        (scale, f"unipc{dtype}{option}")
        for scale in (1.0, 3.0)
        for dtype in ("", ", bfloat16")
        for option in ("", ", solver_order=1")
    }
    assert len(list(Path("out/references").iterdir())) == 2


def test_failed_points_are_told(run):
    code, out, _ = run("--problem", "pure-noise", *FEW, "-o", "out")
    assert code == 0 and "✕ unipc, 4 steps, 8 steps: InvalidInputError: `solver` is 'unipc'" in " ".join(out.split())


def test_a_pipeline_is_charted_with_its_default(run, model):
    settings = ("--solvers", "default,ddim", "--steps", "2", "--conditions", "1", "--seeds", "1", "--repeats", "1")
    args = ("--pipeline", "x-to-touch", "--model", model, *settings, "--reference-tolerance", "0.1", "--json")
    code, out, _ = run(*args, "-o", "out")
    assert code == 0
    rows = json.loads(out)["rows"]
    assert [(row["solver"], row["steps"], row["default"]) for row in rows] == [
        ("default", 2, False), ("ddim", 2, False), ("default", 3, True),
    ]  # fmt: skip
    assert all(row["error"] > 0 and row["seconds"] > 0 for row in rows)


def test_variants_are_names_and_values():
    assert variant("eta=0.5") == {"eta": 0.5}
    assert variant("a=1,b=true, c=one, two,d=[1, 2]") == {"a": 1, "b": True, "c": "one, two", "d": [1, 2]}
    for wrong in ("", "eta", "=1", "a b=1"):
        with pytest.raises(InvalidInputError, match="`option` is"):
            variant(wrong)


MISTAKES = {
    "nothing to measure": ((), "Pass `--problem` or `--pipeline`"),
    "both": (("--problem", "gaussian", "--pipeline", "x-to-touch"), "Pass `--problem` or `--pipeline`"),
    "unknown problem": (("--problem", "mixtur-7.5"), "Did you mean 'mixture-7.5'"),
    "unknown pipeline": (("--pipeline", "x-to-tuch"), "Did you mean 'x-to-touch'"),
    "problem with a model": (("--problem", "gaussian", "--model", "m"), "`--model` is 'm'"),
    "no such model": (("--pipeline", "x-to-touch", "--model", "none"), "`--model` is 'none'"),
    "unknown solver": (("--problem", "gaussian", "--solvers", "euler,unipcc"), "Did you mean 'unipc'"),
    "default of a problem": (("--problem", "gaussian", "--solvers", "default"), "`solvers` is 'default'"),
    "tolerances of no solver": (
        ("--problem", "gaussian", "--solvers", "euler", "--tolerances", "nan"),
        "`tolerances` is 'nan', which none of the `solvers` takes",
    ),
    "tolerances that are none": (("--problem", "gaussian", "--tolerances", "nan"), "`tolerances` is nan"),
    "steps of no solver": (("--problem", "gaussian", "--solvers", "adaptive", "--steps", "5"), "`steps` is '5', which"),
    "no solvers": (("--problem", "gaussian", "--solvers", ""), "`solvers` is empty"),
    "no steps": (("--problem", "gaussian", "--steps", ","), "`steps` is empty"),
    "no tolerances": (("--problem", "gaussian", "--tolerances", ""), "`tolerances` is empty"),
    "steps are words": (("--problem", "gaussian", "--steps", "few"), "`steps` holds 'few'; pass whole numbers"),
    "half a step": (("--problem", "gaussian", "--steps", "2.5"), "`steps` holds '2.5'"),
    "no step": (("--problem", "gaussian", "--steps", "0"), "`steps` is 0"),
    "too many steps": (("--problem", "gaussian", "--steps", "1001"), "`steps` is 1001"),
    "tolerance 0": (("--problem", "gaussian", "--tolerances", "0"), "`tolerances` is 0"),
    "tolerance nan": (("--problem", "gaussian", "--tolerances", "nan"), "`tolerances` is nan"),
    "unknown dtype": (("--problem", "gaussian", "--dtypes", "float8"), "`dtypes` is 'float8'"),
    "guidance below 0": (("--problem", "mixture-3", "--guidance", "-1"), "`guidance` is -1"),
    "guidance without a branch": (("--problem", "gaussian", "--guidance", "3"), "has no unconditional branch"),
    "unknown option": (
        ("--problem", "gaussian", "--solvers", "unipc", "--option", "solver_ordr=1"),
        "Did you mean 'solver_order'",
    ),
    "option of no value": (("--problem", "gaussian", "--option", "eta"), "`option` is 'eta'"),
    "no seeds": (("--problem", "gaussian", "--seeds", "0"), "`seeds` is 0"),
    "no conditions": (("--pipeline", "x-to-touch", "--conditions", "0"), "`conditions` is 0"),
    "no batch": (("--problem", "gaussian", "--batch-size", "0"), "`batch_size` is 0"),
    "no repeats": (("--problem", "gaussian", "--repeats", "0"), "`repeats` is 0"),
    "reference too loose": (("--problem", "mixture", "--reference-tolerance", "1"), "`rtol` is 1"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_one_line_and_leaves_nothing(run, name):
    args, words = MISTAKES[name]
    code, out, err = run(*args, "-o", "out")
    assert (code, out) == (2, "")
    assert err.count("\n") == 1 and words in err
    assert not Path("out").exists()


def test_an_output_that_cannot_be_a_folder_is_refused(run):
    Path("file").write_text("kept")
    for output in ("file", "file/below"):
        code, _, err = run("--problem", "gaussian", "-o", output)
        assert code == 2 and err.count("\n") == 1 and "file is a file" in err
    assert Path("file").read_text() == "kept"
