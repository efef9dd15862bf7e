"""`unitouch-gen work-precision`."""

import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from unitouch_gen.cli.options import AsJson, Model, is_quiet, print_table

if TYPE_CHECKING:
    from unitouch_gen.numerics.targets import Configuration
    from unitouch_gen.numerics.work_precision import Order, Result, ResultFolder

Value = TypeVar("Value")

STEPS = (5, 8, 12, 20, 32, 50)
TOLERANCES = (0.1, 0.03, 0.01, 0.003, 0.001)
MODALITIES = {"touch-to-image": ("touch",), "stylization": ("image", "touch"), "x-to-touch": ("image",)}
"""What each pipeline is given of a contact."""

Listed = list[str] | None


def work_precision(
    output: Annotated[Path, typer.Option("--output", "-o", help="A folder; one that holds a part is gone on with.")],
    problem: Annotated[str | None, typer.Option(help="An exact problem, such as mixture-7.5.")] = None,
    pipeline: Annotated[str | None, typer.Option(help="touch-to-image, stylization or x-to-touch.")] = None,
    model: Model = None,
    solvers: Annotated[
        Listed,
        typer.Option(help="Names by comma, with `adaptive`, `default` and `diffusers:ddim`; many if left out."),
    ] = None,
    steps: Annotated[Listed, typer.Option(help="Numbers of steps by comma.")] = None,
    tolerances: Annotated[Listed, typer.Option(help="Tolerances of `adaptive`, by comma.")] = None,
    dtypes: Annotated[Listed, typer.Option(help="Dtypes of the network by comma: float32, bfloat16, float16.")] = None,
    guidance: Annotated[Listed, typer.Option(help="Guidance scales by comma; the default one if left out.")] = None,
    option: Annotated[
        Listed,
        typer.Option(
            help="A variant to measure as well, such as eta=0.5; against the reference without; may be repeated."
        ),
    ] = None,
    seeds: Annotated[
        int | None, typer.Option(help="Noises to start from; 8 for a problem and 2 a condition if left out.")
    ] = None,
    conditions: Annotated[int, typer.Option(help="Contacts of the world that a pipeline is given.")] = 4,
    batch_size: Annotated[int | None, typer.Option(help="Samples in work at once; all if left out.")] = None,
    repeats: Annotated[int, typer.Option(help="Runs of each point that are timed.")] = 3,
    reference_tolerance: Annotated[
        float | None, typer.Option(help="Tolerance of the reference; fine enough if left out.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Charts the error of solvers against their run time.

    Example: unitouch-gen work-precision --problem mixture-7.5 -o outputs/mixture
    """
    from unitouch_gen.errors import InvalidInputError, check_choice, check_integer
    from unitouch_gen.files import check_writable
    from unitouch_gen.numerics.chart import draw_chart, save_chart
    from unitouch_gen.numerics.problems import PROBLEMS
    from unitouch_gen.numerics.targets import DEFAULT, MOST_SEEDS, PipelineTarget, ProblemTarget, Target, world_inputs
    from unitouch_gen.numerics.work_precision import (
        COSTS,
        MOST_REPEATS,
        ResultFolder,
        configurations,
        fitted_orders,
        grouped,
        pareto_front,
    )
    from unitouch_gen.schedulers.adaptive import ADAPTIVE

    if (problem is None) == (pipeline is None):
        raise InvalidInputError("Pass `--problem` or `--pipeline`, one of them, to say what is measured.")
    if problem is not None and model is not None:
        raise InvalidInputError(f"`--model` is {model!r}, but an exact problem has none; leave it out.")
    check_integer("repeats", repeats, 1, MOST_REPEATS)
    check_writable("output", output / "results.json")
    known = Target.solvers if pipeline is None else (*Target.solvers, DEFAULT)
    wanted: dict[str, Any] = {
        "solvers": values("solvers", solvers, str, (*known, "diffusers:ddim")),
        "steps": values("steps", steps, int, STEPS),
        "tolerances": values("tolerances", tolerances, float, TOLERANCES),
        "dtypes": values("dtypes", dtypes, str, ("float32",)),
        "guidance_scales": values("guidance", guidance, float, (1.0,)),
        "options": [{}, *map(variant, option or ())],
    }
    for name, given, used in (
        ("tolerances", tolerances, ADAPTIVE in wanted["solvers"]),
        ("steps", steps, set(wanted["solvers"]) != {ADAPTIVE}),
    ):
        if given is not None and not used:
            raise InvalidInputError(
                f"`{name}` is {','.join(given)!r}, which none of the `solvers` takes ({', '.join(wanted['solvers'])}); "
                "leave it out."
            )
    points = configurations(**wanted)  # what is out of range is refused here

    quiet, note = is_quiet(as_json), ""
    target: Target
    if pipeline is None:
        problem = check_choice("problem", problem, PROBLEMS)
        target = ProblemTarget(PROBLEMS[problem], 8 if seeds is None else seeds, batch_size)
    else:
        from unitouch_gen.cli.loading import load_pipeline

        modalities = MODALITIES[check_choice("pipeline", pipeline, MODALITIES)]
        seeds = check_integer("seeds", 2 if seeds is None else seeds, 1, MOST_SEEDS)
        if batch_size is not None:
            check_integer("batch_size", batch_size, 1)
        inputs = world_inputs(modalities, conditions)
        pipe = load_pipeline(pipeline, model, quiet, modalities)
        pipe.set_progress_bar_config(disable=True)
        target = PipelineTarget(pipe, inputs, name=pipeline, seeds=seeds, batch_size=batch_size)
        note = f"Conditions and decoding: {target.seconds_beside():.2g} s more a sample, whatever the solver.  "
    if guidance is None:
        points = configurations(**{**wanted, "guidance_scales": [target.guidance_scale]})
    star = target.default if DEFAULT in wanted["solvers"] else None
    if star is not None and star not in points and target.guidance_scale in {point.guidance_scale for point in points}:
        points.append(star)

    folder = ResultFolder(output, target, reference_tolerance)
    run(folder, points, repeats, quiet)
    results = list(folder.results.values())
    orders = fitted_orders(results, folder.own_errors, target.nominal_order)
    title = f"{target.name}: error against run time"
    note += f"{target.samples} samples, {target.batch_size} at once.  {folder.machine}"
    figure = draw_chart(results, title, own_errors=folder.own_errors, orders=orders, note=note)
    files = [folder.save(orders), folder.save_csv(), *save_chart(figure, output)]
    if not as_json:
        print_summary(folder, orders)
        typer.echo(f"Chart and results are in {output.resolve()}")
        return
    fronts = {
        str(scale): {cost: [result.key for result in pareto_front(group, cost)] for cost in COSTS}
        for scale, group in grouped(results, "guidance_scale").items()
    }
    written = json.loads(files[0].read_text(encoding="utf-8"))
    summary = {name: written[name] for name in ("references", "orders", "rows")}
    typer.echo(json.dumps({"files": [str(file) for file in files], "fronts": fronts, **summary}))


def values(name: str, given: Listed, kind: Callable[[str], Value], otherwise: Sequence[Value]) -> list[Value]:
    """The values of an option that takes several, by comma or repeated; others where it is left out."""
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
            what = "whole numbers" if kind is int else "numbers"
            raise InvalidInputError(f"`{name}` holds {word!r}; pass {what}, separated by commas.") from error
    return found


def variant(item: str) -> dict[str, Any]:
    """ "eta=0.5,noise_level=0" as a dictionary; values are JSON, or else text."""
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


def run(folder: "ResultFolder", points: Sequence["Configuration"], repeats: int, quiet: bool) -> None:
    """Measures what the folder lacks, with bars that show the time left."""
    from tqdm.auto import tqdm

    total = sum(point.expected_evaluations for point in points if point.key not in folder.results)
    with (
        tqdm(total=100, desc="reference", unit="%", leave=False, disable=quiet) as reference_bar,
        tqdm(total=total, unit="evaluation", disable=quiet) as bar,
    ):

        def show(solver: str, share: float) -> None:
            reference_bar.set_description_str(f"reference, {solver}", refresh=False)
            reference_bar.update(int(100 * share) - reference_bar.n)

        for result in folder.sweep(points, repeats, None if quiet else show):
            bar.set_description_str(f"{result.series}, {result.amount}", refresh=False)
            bar.update(result.expected_evaluations)


def print_summary(folder: "ResultFolder", orders: Sequence["Order"]) -> None:
    """Tables of what each error costs, and of each series with its order."""
    from unitouch_gen.numerics.chart import answers, failure_lines
    from unitouch_gen.numerics.work_precision import grouped

    results = list(folder.results.values())
    for scale, group in sorted(grouped(results, "guidance_scale").items()):
        own = folder.own_errors.get(scale, 0.0)
        typer.echo(f"Guidance {scale:g}; the reference's own error is {own:.1e}")
        print_table(
            ["error of at most", "seconds a sample", "evaluations", "solver"],
            [
                [f"{error:g}", f"{best.seconds:.2g}", f"{best.evaluations:.4g}", f"{best.series}, {best.amount}"]
                for error, best in answers(group)
            ],
        )
        named = {order.series: order for order in orders if order.guidance_scale == scale}
        columns = [
            "solver",
            "order",
            "nominal",
            "points",
            "least error",
            "evaluations",
            "seconds",
            "failed",
        ]
        print_table(columns, [series_cells(*item, named.get(item[0])) for item in grouped(group, "series").items()])
    for line in failure_lines(results):
        typer.echo(line)


def series_cells(name: str, results: Sequence["Result"], order: "Order | None") -> list[str]:
    """One line of the second table."""
    good = [result for result in results if result.error is not None and not result.failures]
    best = min(good, key=lambda result: result.error or 0.0, default=None)
    fitted = (None, None, None) if order is None else (order.fitted, order.nominal, order.points)
    least = (None, None, None) if best is None else (best.error, best.evaluations, best.seconds)
    cells = zip((*fitted, *least), (".2f", "", "", ".1e", ".4g", ".2g"), strict=True)
    return [
        name,
        *("-" if value is None else format(value, digits) for value, digits in cells),
        str(sum(result.failures > 0 for result in results)) if len(good) < len(results) else "",
    ]
