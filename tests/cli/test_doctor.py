"""`unitouch-gen doctor`: what it says of this machine, run on a tiny random pipeline."""

import json
import sys
from importlib.metadata import version

import pytest

import unitouch_gen
import unitouch_gen.cli

doctor = sys.modules["unitouch_gen.cli.doctor"]  # the package has the function under that name


def test_what_is_installed_and_what_a_picture_takes(command, models):
    code, out, err = command("doctor", "--model", models["x-to-touch"], "--device", "cpu", "--json")
    found = json.loads(out)
    assert (code, err, found["version"]) == (0, "", unitouch_gen.__version__)
    torch = next(one for one in found["packages"] if one["name"] == "torch")
    assert (torch["installed"], torch["extra"], torch["fits"]) == (version("torch"), "", True)
    assert {one["extra"] for one in found["packages"]}.isdisjoint({"test", "lint", "docs"})
    assert found["machine"]["device"] == "cpu"
    (cost,) = found["pipelines"]
    assert (cost["pipeline"], cost["steps"], cost["failed"]) == ("x-to-touch", 2, "")
    assert cost["seconds"] > 0 and cost["weights"] > 0


@pytest.mark.slow
def test_every_built_in_pipeline_takes_its_time(command):
    code, out, err = command("doctor", "--device", "cpu", "--json")
    found = json.loads(out)["pipelines"]
    assert (code, err) == (0, "") and all(one["seconds"] > 0 for one in found)
    assert {"touch-to-image", "stylization", "x-to-touch"} <= {one["pipeline"] for one in found}


def test_weights_are_counted_in_their_dtype(command, models):
    words = ("doctor", "--model", models["touch-to-image"], "--device", "cpu", "--json")
    costs = [json.loads(command(*words, "--dtype", dtype)[1])["pipelines"][0] for dtype in ("float32", "bfloat16")]
    assert costs[0]["weights"] == 2 * costs[1]["weights"]


def test_what_is_missing_is_a_line_and_exit_code_1(command, monkeypatch):
    lines = ["no-such-package>=2", "torch>=2", "another-one>=1; extra == 'app'", "a-third; extra == 'test'"]
    monkeypatch.setattr(doctor, "requires", lambda name: lines)
    code, out, err = command("doctor")
    assert code == 1
    assert err == "unitouch-gen: no-such-package is missing; run: pip install 'no-such-package>=2'\n"
    assert "another-one" in out and "a-third" not in out


def test_what_is_too_old_is_told(command, monkeypatch):
    monkeypatch.setattr(doctor, "requires", lambda name: ["torch>=1000"])
    code, _, err = command("doctor", "--no-time", "--device", "cpu")
    assert code == 1 and err == f"unitouch-gen: torch is {version('torch')}; run: pip install 'torch>=1000'\n"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--dtype", "float8"), "'float8'"),
        (("--device", "abacus"), "`--device` is 'abacus'"),
        (("--device", "meta"), "`--device` is 'meta'"),
        (("--device", "cuda:99"), "`--device` is 'cuda:99', and torch finds none here"),
        (("--model", "gone"), "`--model` is 'gone'"),
    ],
)
def test_mistakes(command, refused, words, said):
    refused(command("doctor", *words), said)
