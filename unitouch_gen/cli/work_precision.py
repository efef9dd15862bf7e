"""`unitouch-gen work-precision`."""

import json
import os
import re
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from unitouch_gen.cli.options import AsJson, Model, is_quiet, print_table

if TYPE_CHECKING:
    from unitouch_gen.numerics.results import Results
    from unitouch_gen.numerics.subjects import Configuration, Subject
    from unitouch_gen.numerics.work_precision import Order, Row

Value = TypeVar("Value")

STEPS = (5, 8, 12, 20, 32, 50)
TOLERANCES = (0.1, 0.03, 0.01, 0.003, 0.001)
MODALITIES = {"touch-to-image": ("touch",), "stylization": ("image", "touch"), "x-to-touch": ("image",)}
"""Of a contact, what each pipeline is given."""

Listed = list[str] | None


def work_precision(
    output: Annotated[Path, typer.Option("--output", "-o", help="A folder; one that holds a part is gone on with.")],
    problem: Annotated[str | None, typer.Option(help="An exact problem, such as mixture-7.5.")] = None,
    pipeline: Annotated[str | None, typer.Option(help="touch-to-image, stylization or x-to-touch.")] = None,
    model: Model = None,
    solvers: Annotated[
        Listed, typer.Option(help="Names by comma, with `adaptive`, `own` and `diffusers:ddim`; many when left out.")
    ] = None,
    steps: Annotated[Listed, typer.Option(help="Numbers of steps by comma.")] = None,
    tolerances: Annotated[Listed, typer.Option(help="Of `adaptive`, by comma.")] = None,
    dtypes: Annotated[Listed, typer.Option(help="Of the network, by comma: float32, bfloat16, float16.")] = None,
    guidance: Annotated[Listed, typer.Option(help="Scales by comma; the default one when left out.")] = None,
    option: Annotated[
        Listed,
        typer.Option(help="A variant to measure as well, such as eta=0.5; against the reference without. Repeatable."),
    ] = None,
    seeds: Annotated[
        int | None, typer.Option(help="Noises to start from: 8 for a problem, 2 a condition else.")
    ] = None,
    conditions: Annotated[int, typer.Option(help="Contacts of the world that a pipeline is given.")] = 4,
    batch_size: Annotated[int | None, typer.Option(help="Samples in work at once; all when left out.")] = None,
    repeats: Annotated[int, typer.Option(help="Runs of each point that are timed.")] = 3,
    reference_tolerance: Annotated[
        float | None, typer.Option(help="Of the reference's steps; fine enough when left out.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Charts the error of solvers against their run time."""
    from unitouch_gen.errors import InvalidInputError, check_integer
    from unitouch_gen.numerics.chart import draw_chart, save_chart
    from unitouch_gen.numerics.results import Results
    from unitouch_gen.numerics.work_precision import configurations, fitted_orders

    if (problem is None) == (pipeline is None):
        raise InvalidInputError("Pass `--problem` or `--pipeline`, one of them, to say what is measured.")
    if problem is not None and model is not None:
        raise InvalidInputError(f"`--model` is {model!r}, but an exact problem has none; leave it out.")
    check_integer("repeats", repeats, 1)
    check_writable(output)
    wanted: dict[str, Any] = {
        "steps": values("steps", steps, int, STEPS),
        "tolerances": values("tolerances", tolerances, float, TOLERANCES),
        "dtypes": values("dtypes", dtypes, str, ("float32",)),
        "options": [{}, *map(variant, option or ())],
    }
    names = values("solvers", solvers, str, default_solvers(pipeline))
    scales = values("guidance", guidance, float, (1.0,))
    points = configurations(names, guidance_scales=scales, **wanted)  # what is out of range is refused here

    quiet = is_quiet(as_json)
    subject: Any
    if problem is not None:
        subject = problem_subject(problem, seeds, batch_size)
        note = ""
    else:
        assert pipeline is not None
        subject = pipeline_subject(pipeline, model, seeds, conditions, batch_size, quiet)
        note = f"Conditions and decoding: {subject.seconds_beside():.2g} s more a sample, whatever the solver.  "
    if guidance is None:
        points = configurations(names, guidance_scales=[subject.guidance_scale], **wanted)
    if subject.default is not None and "own" in names and subject.default.guidance_scale in scales_of(points):
        points += [subject.default] if subject.default not in points else []

    device = str(getattr(getattr(subject, "pipe", None), "device", "cpu"))
    results = Results(output, subject, rtol=reference_tolerance, device=device)
    run(subject, points, results, repeats, reference_tolerance, quiet)

    rows = list(results.rows.values())
    orders = fitted_orders(rows, results.own_errors, subject.nominal_order)
    results.save(orders)
    title = f"{subject.name}: error against run time"
    note += f"{subject.samples} samples, {subject.batch_size} at once.  {results.machine}"
    figure = draw_chart(rows, title, own_errors=results.own_errors, orders=orders, note=note)
    files = [results.file, results.save_csv(), *save_chart(figure, output)]
    if as_json:
        typer.echo(json.dumps({"files": [str(file) for file in files], **summary(rows, orders, results)}))
        return
    print_summary(rows, orders, results)
    typer.echo(f"Chart and results are in {output.resolve()}")


# What is asked for ----------------------------------------------------------------------------------------------------


def default_solvers(pipeline: str | None) -> tuple[str, ...]:
    from unitouch_gen.numerics.subjects import OWN, SOLVERS
    from unitouch_gen.schedulers.adaptive import ADAPTIVE

    return (*SOLVERS, ADAPTIVE, *([] if pipeline is None else [OWN]), "diffusers:ddim")


def values(name: str, given: Listed, kind: Callable[[str], Value], otherwise: Sequence[Value]) -> list[Value]:
    """The values of an option that takes several, by comma or repeated.

    Raises:
        InvalidInputError: If there are none, or one of them is not of this kind.
    """
    from unitouch_gen.errors import InvalidInputError

    if given is None:
        return list(otherwise)
    words = [word.strip() for item in given for word in item.split(",") if word.strip()]
    if not words:
        raise InvalidInputError(f"`{name}` is empty; pass at least one, or leave it out.")
    found = []
    for word in words:
        try:
            found.append(kind(word))
        except ValueError as error:
            what = {int: "whole numbers", float: "numbers"}.get(kind, "names")  # type: ignore[call-overload]
            raise InvalidInputError(f"`{name}` holds {word!r}; pass {what}, separated by commas.") from error
    return found


def variant(item: str) -> dict[str, Any]:
    """ "eta=0.5,noise_level=0" as a dictionary; values are JSON, or else text.

    Raises:
        InvalidInputError: If it is not of that form.
    """
    from unitouch_gen.errors import InvalidInputError

    found = {}
    for setting in re.split(r",(?=\s*\w+=)", item):
        name, sign, value = setting.partition("=")
        if not sign or not name.strip().isidentifier():
            raise InvalidInputError(f"`option` is {item!r}; write names and values, such as eta=0.5.")
        try:
            found[name.strip()] = json.loads(value)
        except ValueError:
            found[name.strip()] = value.strip()
    return found


def check_writable(folder: Path) -> None:
    """Refuses a folder that results cannot go to, before anything is measured; it is made with the first of them.

    Raises:
        InvalidInputError: Naming what is in the way.
    """
    from unitouch_gen.errors import InvalidInputError

    there = next(path for path in (folder.absolute(), *folder.absolute().parents) if os.path.lexists(path))
    if not there.is_dir():
        raise InvalidInputError(f"`output` is {str(folder)!r}, but {str(there)!r} is no folder; name another one.")
    if not os.access(there, os.W_OK | os.X_OK):
        raise InvalidInputError(f"`output` is in {str(there)!r}, which cannot be written to; name another folder.")


def problem_subject(name: str, seeds: int | None, batch_size: int | None) -> "Subject":
    from unitouch_gen.errors import check_choice
    from unitouch_gen.numerics.problems import PROBLEMS, make_problem
    from unitouch_gen.numerics.subjects import ProblemSubject

    return ProblemSubject(
        make_problem(check_choice("problem", name, PROBLEMS)), 8 if seeds is None else seeds, batch_size
    )


def pipeline_subject(
    name: str, model: str | None, seeds: int | None, conditions: int, batch_size: int | None, quiet: bool
) -> "Subject":
    from unitouch_gen.cli.loading import load_pipeline
    from unitouch_gen.errors import check_choice, check_integer
    from unitouch_gen.numerics.pipeline_subject import PipelineSubject, world_inputs

    modalities = MODALITIES[check_choice("pipeline", name, MODALITIES)]
    seeds = check_integer("seeds", 2 if seeds is None else seeds, 1)
    if batch_size is not None:
        check_integer("batch_size", batch_size, 1)
    inputs = world_inputs(modalities, conditions)
    pipe = load_pipeline(name, model, quiet, modalities)
    pipe.set_progress_bar_config(disable=True)
    return PipelineSubject(pipe, inputs, name=name, seeds=seeds, batch_size=batch_size)


def scales_of(points: Sequence["Configuration"]) -> set[float]:
    return {point.guidance_scale for point in points}


# Measuring ------------------------------------------------------------------------------------------------------------


def run(
    subject: "Subject",
    points: Sequence["Configuration"],
    results: "Results",
    repeats: int,
    rtol: float | None,
    quiet: bool,
) -> None:
    """Measures what the results lack, with bars that show the time left."""
    from tqdm.auto import tqdm

    from unitouch_gen.numerics.work_precision import sweep

    left = {point.key: point for point in points if point.key not in results.rows}
    with (
        tqdm(total=100, desc="reference", unit="%", leave=False, disable=quiet) as reference_bar,
        tqdm(total=sum(point.expected_evaluations for point in left.values()), unit="evaluation", disable=quiet) as bar,
    ):

        def show(solver: str, share: float) -> None:
            percent = int(100 * share)
            if reference_bar.desc != f"reference, {solver}" or percent < reference_bar.n:
                reference_bar.reset()
                reference_bar.set_description_str(f"reference, {solver}", refresh=False)
            reference_bar.update(percent - reference_bar.n)

        rows = sweep(
            subject,
            points,
            known=results.rows,
            repeats=repeats,
            folder=results.folder / "references",
            rtol=rtol,
            on_reference=results.note,
            progress=None if quiet else show,
        )
        for row in rows:
            results.add(row)
            bar.set_description_str(f"{row.series}, {row.amount}", refresh=False)
            bar.update(left[row.key].expected_evaluations)


# What came out --------------------------------------------------------------------------------------------------------


def summary(rows: Sequence["Row"], orders: Sequence["Order"], results: "Results") -> dict[str, Any]:
    """As plain values, for JSON."""
    from unitouch_gen.numerics.work_precision import pareto_front

    groups = by_scale(rows)
    return {
        "references": {str(scale): figures for scale, figures in results.references.items()},
        "orders": [asdict(order) for order in orders],
        "fronts": {
            str(scale): {
                cost: [row.key for row in pareto_front(group, cost)]  # type: ignore[arg-type]
                for cost in ("seconds", "evaluations")
            }
            for scale, group in groups.items()
        },
        "rows": [asdict(row) for row in rows],
    }


def print_summary(rows: Sequence["Row"], orders: Sequence["Order"], results: "Results") -> None:
    """Tables of what each error costs, and of each series with its order."""
    from unitouch_gen.numerics.chart import answers, failure_lines

    for scale, group in by_scale(rows).items():
        own = results.own_errors.get(scale, 0.0)
        typer.echo(f"Guidance {scale:g}; the reference's own error is {own:.1e}")
        print_table(
            ["error of at most", "seconds a sample", "evaluations", "solver"],
            [
                [f"{target:g}", f"{row.seconds:.2g}", f"{row.evaluations:.4g}", f"{row.series}, {row.amount}"]
                for target, row in answers(group)
            ],
        )
        of_scale = {order.series: order for order in orders if order.guidance_scale == scale}
        print_table(
            [
                "solver",
                "order",
                "nominal",
                "points",
                "least error",
                "evaluations",
                "seconds",
                "estimate/error",
                "failed",
            ],
            [series_cells(name, series, of_scale.get(name)) for name, series in by_series(group).items()],
        )
    for line in failure_lines(rows):
        typer.echo(line)


def by_scale(rows: Sequence["Row"]) -> dict[float, list["Row"]]:
    return {
        scale: [row for row in rows if row.guidance_scale == scale]
        for scale in sorted({row.guidance_scale for row in rows})
    }


def by_series(rows: Sequence["Row"]) -> dict[str, list["Row"]]:
    found: dict[str, list[Row]] = {}
    for row in rows:
        found.setdefault(row.series, []).append(row)
    return found


def series_cells(name: str, rows: Sequence["Row"], order: "Order | None") -> list[str]:
    """One line of the second table."""
    good = [row for row in rows if row.error is not None and not row.failed]
    best = min(good, key=lambda row: row.error or 0.0, default=None)
    ratios = sorted(row.estimate_ratio for row in good if row.estimate_ratio is not None)
    return [
        name,
        "-" if order is None or order.fitted is None else f"{order.fitted:.2f}",
        "-" if order is None or order.nominal is None else str(order.nominal),
        "-" if order is None else str(order.points),
        *(["-"] * 3 if best is None else [f"{best.error:.1e}", f"{best.evaluations:.4g}", f"{best.seconds:.2g}"]),
        f"{ratios[0]:.2g} to {ratios[-1]:.2g}" if ratios else "-",
        str(sum(row.failed for row in rows)) if len(good) < len(rows) else "",
    ]
