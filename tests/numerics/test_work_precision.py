"""Error against run time: what is measured and kept, the orders that are fitted to it, and the front."""

import csv
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.numerics import work_precision
from unitouch_gen.numerics.problems import make_problem
from unitouch_gen.numerics.reference import Reference
from unitouch_gen.numerics.targets import BASELINES, Configuration, ProblemTarget
from unitouch_gen.numerics.work_precision import (
    VERSION,
    Result,
    ResultFolder,
    configurations,
    fitted_orders,
    measure,
    pareto_front,
)
from unitouch_gen.schedulers import SOLVERS

# numpy 2 on diffusers' DEIS.
pytestmark = pytest.mark.filterwarnings("ignore:__array_wrap__ must accept context:DeprecationWarning")


@pytest.fixture(scope="module")
def gaussian() -> ProblemTarget:
    return ProblemTarget(make_problem("gaussian"), seeds=3)


def results_of(target: ProblemTarget, *points: Configuration) -> list[Result]:
    return [measure(target, point, target.reference(point.guidance_scale), 1) for point in points]


def result(steps: int | None = 10, error: float | None = 0.01, **values) -> Result:
    known = {"solver": "heun", "samples": 8, "seconds": 0.1, "evaluations": 10.0}
    return Result(**{**known, "steps": steps, "error": error, **values})


# What is measured -----------------------------------------------------------------------------------------------------


def test_every_combination_is_there_once():
    found = configurations(["unipc", "adaptive", "unipc"], [5, 10], [0.1], ["float32", "bfloat16"], [1.0, 3.0])
    assert len(found) == len({point.key for point in found}) == 2 * 2 * (2 + 1)
    assert {point.tolerance for point in found if point.solver == "adaptive"} == {0.1}
    assert {point.steps for point in found if point.solver == "unipc"} == {5, 10}


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"solver": "unipc", "steps": 0}, "`steps` is 0"),
        ({"solver": "unipc", "steps": -3}, "`steps` is -3"),
        ({"solver": "adaptive", "tolerance": 0.0}, "`tolerances` is 0"),
        ({"solver": "adaptive", "tolerance": 2.0}, "`tolerances` is 2"),
        ({"solver": "adaptive", "tolerance": math.nan}, "`tolerances` is nan"),
        ({"solver": "unipc", "steps": 5, "guidance_scale": math.inf}, "`guidance` is inf"),
        ({"solver": "unipc", "steps": 5, "dtype": "int8"}, "`dtypes` is 'int8'.*'bfloat16'"),
    ],
)
def test_values_out_of_range_are_refused(values, words):
    with pytest.raises(InvalidInputError, match=words):
        Configuration(**values)


def test_steps_are_whole():
    with pytest.raises(InvalidTypeError, match=r"`steps` is 2\.5"):
        Configuration("unipc", 2.5)


@pytest.mark.parametrize(
    ("point", "words"),
    [
        (Configuration("unipcc", 5), "Did you mean 'unipc'"),
        (Configuration("default", 5), "`solvers` is 'default'"),
        (Configuration("unipc", 1001), "`steps` is 1001.*to 1000"),
        (Configuration("unipc", 5, guidance_scale=3.0), "`guidance` is 3, but 'gaussian' has no unconditional branch"),
        (Configuration("unipc", 5, options={"solver_ordr": 1}), "Did you mean 'solver_order'"),
        (Configuration("adaptive", tolerance=0.1, options={"solver_order": 1}), "`option` is for schedulers"),
    ],
)
def test_what_a_problem_cannot_be_run_with_is_refused_before_anything_runs(gaussian, tmp_path, point, words):
    with pytest.raises(InvalidInputError, match=words):
        next(ResultFolder(tmp_path, gaussian).sweep([Configuration("ddim", 2), point]))
    assert not list(tmp_path.iterdir())


def test_errors_are_those_against_the_closed_form(gaussian):
    (found,) = results_of(gaussian, Configuration("unipc", 12))
    latents, _ = gaussian.run(Configuration("unipc", 12))
    exact = gaussian.problem.solution(gaussian.noise)
    errors = [((a - b).norm() / b.norm()).item() for a, b in zip(latents.double(), exact, strict=True)]
    assert (found.error_low, found.error, found.error_high) == pytest.approx(np.quantile(errors, [0.25, 0.5, 0.75]))


@pytest.mark.parametrize(("solver", "evaluations"), [("ddim", 7), ("heun", 13), ("diffusers:ddim", 7), ("unipc", 7)])
def test_evaluations_are_counted(gaussian, solver, evaluations):
    (found,) = results_of(gaussian, Configuration(solver, 7))
    assert (found.evaluations, found.samples, found.failures) == (evaluations, 3, 0)
    assert 0 < found.seconds <= found.seconds_median


def test_evaluations_of_batches_are_their_mean():
    whole, parted = (ProblemTarget(make_problem("mixture"), 4, size) for size in (None, 2))
    (together,) = results_of(whole, Configuration("unipc", 6))
    (apart,) = results_of(parted, Configuration("unipc", 6))
    assert together.evaluations == apart.evaluations == 6
    assert apart.error == pytest.approx(together.error, rel=1e-4)


def test_a_tolerance_takes_more_evaluations_for_less_error(gaussian):
    loose, tight = results_of(gaussian, *(Configuration("adaptive", tolerance=value) for value in (0.1, 0.001)))
    assert tight.evaluations > loose.evaluations and tight.error < loose.error < 0.1


def test_a_low_dtype_leaves_its_rounding():
    target = ProblemTarget(make_problem("mixture"), 2)
    exact, rough = results_of(target, *(Configuration("unipc", 60, dtype=name) for name in ("float32", "bfloat16")))
    assert rough.series == "unipc, bfloat16"
    assert 3 * exact.error < rough.error < 2**-8


def test_options_change_the_scheduler_and_not_the_reference():
    target = ProblemTarget(make_problem("mixture"), 2)
    first, second = results_of(target, *(Configuration("dpm++2m", 40, options={"solver_order": n}) for n in (1, 2)))
    (plain,) = results_of(target, Configuration("dpm++2m", 40))
    assert second.error == pytest.approx(plain.error, rel=1e-3) and first.error > 3 * second.error


def test_each_guidance_scale_has_its_own_reference(tmp_path):
    target = ProblemTarget(make_problem("mixture-3"), 2)
    points = [Configuration("unipc", 30, guidance_scale=scale) for scale in (3.0, 1.0, 7.5)]
    folder = ResultFolder(tmp_path, target, rtol=1e-6)
    found = list(folder.sweep(points, repeats=1))
    assert [item.guidance_scale for item in found] == [1.0, 3.0, 7.5] == list(folder.references)
    assert all(item.error < 0.01 for item in found)


def test_what_cannot_be_run_is_a_failed_row(gaussian):
    """Leading spacing with an offset has no 1000 steps."""
    failed, fine = results_of(gaussian, Configuration("diffusers:ddim", 1000), Configuration("ddim", 3))
    assert failed.failures == 3 and failed.error is None and failed.seconds is None
    assert failed.reason.startswith("InvalidInputError: `num_inference_steps` is 1000")
    assert not fine.failures


def test_samples_that_break_are_a_failed_row():
    """Guidance 1e39 leaves the range of float32."""
    target = ProblemTarget(make_problem("mixture-3"), 2)
    reference = Reference(target.noise, torch.zeros(2), {}, {})
    found = measure(target, Configuration("euler", 5, guidance_scale=1e39), reference, 1)
    assert (found.failures, found.reason, found.error) == (2, "non_finite", None)
    assert found.evaluations == 5 and found.seconds > 0


@pytest.mark.parametrize("name", BASELINES)
def test_baselines_come_near_the_solution(name):
    (found,) = results_of(ProblemTarget(make_problem("mixture"), 2), Configuration(name, 40))
    assert not found.failures and found.error < 0.1


# What rows say --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", [1.0, 2.0, 3.3])
def test_an_order_is_found_above_what_covers_it(order):
    """Not from steps that are too long, nor from where the error levels off."""
    steps = (2, 5, 10, 20, 40, 80, 160, 320, 640, 999)
    floor = 0.5 * 300.0**-order
    rows = [result(number, max(0.5 * number**-order, floor) + (3.0 if number == 2 else 0.0)) for number in steps]
    (found,) = fitted_orders(rows, {1.0: 0.0}, lambda solver: SOLVERS[solver].order)
    assert found.fitted == pytest.approx(order, abs=0.01) and found.nominal == 2


def test_an_order_is_not_fitted_to_the_references_own_error():
    rows = [result(number, number**-2.0) for number in (5, 10, 20, 40, 80)]
    assert fitted_orders(rows, {1.0: 1e-9}, lambda _: 2)[0].points == 5
    assert fitted_orders(rows, {1.0: 1e-4}, lambda _: 2)[0].points == 3
    assert fitted_orders(rows, {1.0: 2e-3}, lambda _: 2)[0].fitted is None


def test_orders_are_of_a_series_and_a_guidance_scale():
    rows = [result(n, n**-order, solver=name) for name, order in (("ddim", 1.0), ("heun", 2.0)) for n in (20, 40, 80)]
    rows += [replace(item, guidance_scale=3.0) for item in rows]
    found = fitted_orders([*rows, result(None, 0.1, solver="adaptive", tolerance=0.1)], {}, lambda _: None)
    assert [(order.series, round(order.fitted, 6)) for order in found] == 2 * [("ddim", 1.0), ("heun", 2.0)]


costs = st.lists(st.tuples(st.integers(1, 9), st.integers(1, 9), st.booleans()), max_size=12)


@given(costs)
def test_the_front_is_what_no_other_beats(points):
    rows = [result(error=error, seconds=cost, failures=failed) for cost, error, failed in points]
    good = [item for item in rows if not item.failures]
    best = {
        (item.seconds, item.error)
        for item in good
        if not any(
            other.seconds <= item.seconds
            and other.error <= item.error
            and (other.seconds, other.error) != (item.seconds, item.error)
            for other in good
        )
    }
    front = pareto_front(rows, "seconds")
    assert {(item.seconds, item.error) for item in front} == best and len(front) == len(best)


# Kept in a folder -----------------------------------------------------------------------------------------------------

POINTS = [Configuration("euler", 3), Configuration("adaptive", tolerance=0.3), Configuration("diffusers:ddim", 1000)]


@pytest.fixture
def folder(gaussian, tmp_path) -> ResultFolder:
    made = ResultFolder(tmp_path / "new" / "folder", gaussian)
    list(made.sweep(POINTS, repeats=1))
    return made


def test_rows_are_found_again(gaussian, folder):
    again = ResultFolder(folder.folder, gaussian)
    assert again.results == folder.results and again.references == folder.references
    assert [item.steps for item in again.sweep([*POINTS, Configuration("euler", 4)])] == [4]


def test_every_row_is_in_the_file_as_soon_as_it_is_measured(gaussian, tmp_path):
    for number, _ in enumerate(ResultFolder(tmp_path, gaussian).sweep(POINTS, repeats=1), 1):
        assert len(json.loads((tmp_path / "results.json").read_text())["rows"]) == number


def test_the_csv_has_a_line_for_each_row(folder):
    with folder.save_csv().open(newline="") as file:
        lines = list(csv.DictReader(file))
    assert [line["solver"] for line in lines] == ["euler", "adaptive", "diffusers:ddim"]
    first = next(iter(folder.results.values()))
    assert math.isclose(float(lines[0]["error"]), first.error)
    assert lines[2]["error"] == "" and "num_inference_steps" in lines[2]["reason"]


def test_json_holds_no_values_that_json_has_not(folder):
    folder.save()

    def refuse(word: str) -> None:
        pytest.fail(f"{word} is no JSON")

    json.loads((folder.folder / "results.json").read_text(), parse_constant=refuse)


def test_another_target_is_refused(folder):
    with pytest.raises(InvalidInputError, match="holds results of 'gaussian' with other inputs"):
        ResultFolder(folder.folder, ProblemTarget(make_problem("gaussian"), 4))


def test_another_reference_is_refused(gaussian, folder):
    with pytest.raises(InvalidInputError, match="with other inputs, weights or settings"):
        ResultFolder(folder.folder, gaussian, rtol=1e-3)


def test_another_machine_is_refused(gaussian, folder, monkeypatch):
    monkeypatch.setattr(work_precision, "machine", lambda device: "a faster one")
    with pytest.raises(InvalidInputError, match="from another machine"):
        ResultFolder(folder.folder, gaussian)


@pytest.mark.parametrize("text", ["", "{", "[]", f'{{"version": {VERSION}}}', '{"version": 1, "rows": []}'])
def test_a_damaged_file_is_refused_and_kept(gaussian, tmp_path, text):
    (tmp_path / "results.json").write_text(text)
    with pytest.raises(InvalidInputError, match=r"`output` holds .*name another folder"):
        ResultFolder(tmp_path, gaussian)
    assert (tmp_path / "results.json").read_text() == text


def counted(target: ProblemTarget, monkeypatch) -> list[float]:
    """Guidance scales that references are solved at."""
    solved, solve = [], target.reference

    def reference(scale: float, *settings) -> Reference:
        solved.append(scale)
        return solve(scale, *settings)

    monkeypatch.setattr(target, "reference", reference)
    return solved


def test_a_reference_that_took_solvers_is_found_again(tmp_path, monkeypatch):
    target = ProblemTarget(make_problem("mixture-3"), 2)
    solved = counted(target, monkeypatch)
    first = ResultFolder(tmp_path, target, rtol=1e-3).reference(3.0)
    again = ResultFolder(tmp_path, target, rtol=1e-3).reference(3.0)
    assert solved == [3.0] and torch.equal(again.latents, first.latents)
    assert (again.evaluations, again.seconds) == (first.evaluations, first.seconds)
    ResultFolder(tmp_path, target, rtol=1e-3).reference(1.0)
    assert solved == [3.0, 1.0]


def cut_short(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:100])


@pytest.mark.parametrize("damage", [cut_short, Path.unlink, lambda file: file.write_bytes(b"")])
def test_a_damaged_reference_is_solved_anew(tmp_path, monkeypatch, damage):
    target = ProblemTarget(make_problem("mixture-3"), 2)
    solved = counted(target, monkeypatch)
    first = ResultFolder(tmp_path, target, rtol=1e-3).reference(3.0)
    (file,) = (tmp_path / "references").iterdir()
    damage(file)
    for _ in range(2):
        again = ResultFolder(tmp_path, target, rtol=1e-3).reference(3.0)
    assert solved == [3.0, 3.0] and torch.equal(again.latents, first.latents)


def test_noise_and_identity_do_not_depend_on_what_is_run(gaussian):
    before = gaussian.noise.clone()
    results_of(gaussian, Configuration("unipc", 5))
    assert torch.equal(gaussian.noise, before)
    assert gaussian.identity == ProblemTarget(make_problem("gaussian"), seeds=3).identity
    assert gaussian.identity != ProblemTarget(make_problem("gaussian"), seeds=4).identity
