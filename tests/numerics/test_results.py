"""Results in a folder: what has been measured is kept, and does not mix with anything else."""

import csv
import json
import math
from dataclasses import replace

import pytest

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.numerics import results as results_module
from unitouch_gen.numerics.problems import make_problem
from unitouch_gen.numerics.results import Results, machine, write_whole
from unitouch_gen.numerics.subjects import Configuration, ProblemSubject
from unitouch_gen.numerics.work_precision import sweep

POINTS = [Configuration("euler", 3), Configuration("adaptive", tolerance=0.3), Configuration("diffusers:ddim", 1000)]


@pytest.fixture(scope="module")
def subject() -> ProblemSubject:
    return ProblemSubject(make_problem("gaussian"), 2)


@pytest.fixture
def results(subject, tmp_path) -> Results:
    made = Results(tmp_path / "new" / "folder", subject)
    for row in sweep(subject, POINTS, repeats=1, on_reference=made.note):
        made.add(row)
    return made


def test_rows_are_found_again(subject, results):
    again = Results(results.folder, subject)
    assert again.rows == results.rows and again.references == results.references
    assert list(sweep(subject, POINTS, known=again.rows)) == []


def test_every_row_is_in_the_file_as_soon_as_it_is_added(subject, results):
    row = next(iter(results.rows.values()))
    results.add(replace(row, key="another"))
    assert len(json.loads(results.file.read_text())["rows"]) == 4
    assert not list(results.folder.glob("*partial*"))


def test_the_csv_has_a_line_for_each_row(results):
    with results.save_csv().open(newline="") as file:
        lines = list(csv.DictReader(file))
    assert [line["solver"] for line in lines] == ["euler", "adaptive", "diffusers:ddim"]
    first = next(iter(results.rows.values()))
    assert math.isclose(float(lines[0]["error"]), first.error)
    assert lines[2]["error"] == "" and "num_inference_steps" in lines[2]["reason"]


def test_json_holds_no_values_that_json_has_not(results):
    results.save()

    def refuse(word: str) -> None:
        pytest.fail(f"{word} is no JSON")

    json.loads(results.file.read_text(), parse_constant=refuse)


def test_another_subject_is_refused(results):
    with pytest.raises(InvalidInputError, match="holds results of 'gaussian' with other inputs"):
        Results(results.folder, ProblemSubject(make_problem("gaussian"), 3))


def test_another_reference_is_refused(subject, results):
    with pytest.raises(InvalidInputError, match="with other inputs, weights or settings"):
        Results(results.folder, subject, rtol=1e-3)


def test_another_machine_is_refused(subject, results, monkeypatch):
    monkeypatch.setattr(results_module, "machine", lambda device: "a faster one")
    with pytest.raises(InvalidInputError, match="from another machine"):
        Results(results.folder, subject)


@pytest.mark.parametrize("text", ["", "{", "[]", '{"version": 1}', '{"version": 2, "subject": {}, "machine": ""}'])
def test_a_damaged_file_is_refused_and_kept(subject, tmp_path, text):
    (tmp_path / "results.json").write_text(text)
    with pytest.raises(InvalidInputError, match=r"`output` holds .*name another folder"):
        Results(tmp_path, subject)
    assert (tmp_path / "results.json").read_text() == text


def test_what_cannot_be_written_is_one_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InvalidInputError, match="`output` cannot be written"):
        write_whole(tmp_path / "file" / "inside", b"")


def test_the_machine_is_named():
    assert "torch" in machine() and "thread" in machine()
