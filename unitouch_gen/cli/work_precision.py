"""`unitouch-gen work-precision`."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from unitouch_gen.cli.options import AsJson, Model, is_quiet, print_table
from unitouch_gen.errors import InvalidInputError

MODALITIES = {"touch-to-image": ("touch",), "stylization": ("image", "touch"), "x-to-touch": ("image",)}
"""What each pipeline is given of a contact."""


def work_precision(
    output: Annotated[Path, typer.Option("--output", "-o", help="A folder for the chart and the results.")],
    problem: Annotated[str | None, typer.Option(help="An exact problem, such as mixture-7.5.")] = None,
    pipeline: Annotated[str | None, typer.Option(help="touch-to-image, stylization or x-to-touch.")] = None,
    model: Model = None,
    solvers: Annotated[str | None, typer.Option(help="Names by comma; all if left out.")] = None,
    steps: Annotated[str, typer.Option(help="Numbers of steps by comma.")] = "5,8,12,20,32,50",
    tolerances: Annotated[str, typer.Option(help="Tolerances of adaptive, by comma.")] = "0.1,0.03,0.01,0.003,0.001",
    guidance: Annotated[float | None, typer.Option(help="Guidance scale; the target's own if left out.")] = None,
    seeds: Annotated[int, typer.Option(help="Noises to start from, for each contact.")] = 4,
    conditions: Annotated[int, typer.Option(help="Contacts of the world that a pipeline is given.")] = 4,
    repeats: Annotated[int, typer.Option(help="Runs of each point that are timed.")] = 3,
    as_json: AsJson = False,
) -> None:
    """Charts the error of solvers against their run time.

    Example: unitouch-gen work-precision --problem mixture-7.5 -o outputs/mixture
    """
    from tqdm import tqdm

    from unitouch_gen.cli.loading import load_pipeline
    from unitouch_gen.errors import check_choice, check_integer, check_number
    from unitouch_gen.files import check_writable
    from unitouch_gen.numerics import work_precision as wp
    from unitouch_gen.numerics.problems import PROBLEMS

    if (problem is None) == (pipeline is None):
        raise InvalidInputError("Pass `--problem` or `--pipeline`, one of them, to say what is measured.")
    if problem is not None and (model is not None or guidance is not None):
        raise InvalidInputError(
            "`--model` and `--guidance` are of pipelines, and an exact problem came; leave them out."
        )
    check_writable("output", output / "results.json")
    known = [name for name in wp.NAMES if pipeline is not None or name != "default"]
    names = known if solvers is None else solvers.split(",")
    counts, errors = numbers_of("--steps", steps, int), numbers_of("--tolerances", tolerances, float)
    points: list[dict[str, Any]] = []
    for name in dict.fromkeys(check_choice("solvers", name.strip(), known) for name in names):
        if name == "adaptive":
            points += [
                {"solver": name, "tolerance": check_number("tolerances", each, 1e-5, 1.0)} for each in errors or ()
            ]
        else:
            points += [{"solver": name, "steps": check_integer("steps", count, 1, 1000)} for count in counts or ()]
    for option, count in {"seeds": seeds, "repeats": repeats, "conditions": conditions}.items():
        check_integer(option, count, 1, 17 if option == "conditions" else 1000)

    quiet = is_quiet(as_json)
    if problem is not None:
        target = wp.problem_target(PROBLEMS[check_choice("problem", problem, PROBLEMS)], seeds)
    else:
        modalities = MODALITIES[check_choice("pipeline", pipeline, MODALITIES)]
        scale = None if guidance is None else check_number("guidance", guidance, 0.0)
        pipe = load_pipeline(str(pipeline), model, quiet)
        pipe.set_progress_bar_config(disable=True)
        inputs = wp.world_inputs(modalities, conditions)
        target = wp.pipeline_target(pipe, inputs, name=str(pipeline), seeds=seeds, guidance_scale=scale)
        if any(point["solver"] == "default" for point in points):
            points.append({"solver": "default", "steps": target.default_steps})
    wp.measure(target, "ddim", 2, repeats=1)  # a warm-up
    rows = [wp.measure(target, **point, repeats=repeats) for point in tqdm(points, disable=quiet)]
    files = wp.save(output, target, rows)
    if as_json:
        typer.echo(json.dumps({"files": [str(file) for file in files], "rows": rows}))
        return
    typer.echo(
        f"{target.name}, guidance {target.guidance.scale:g}; the reference's own error is {target.own_error:.1e}"
    )
    best = [[wp.amount(row), row["solver"], f"{row['error']:.1e}", str(row["evaluations"]), f"{row['seconds']:.2g}"]
            for row in wp.pareto_front(rows, "evaluations")]  # fmt: skip
    print_table(["cheapest", "solver", "error", "evaluations", "seconds a sample"], best)
    for row in rows:
        if row["failures"]:
            typer.echo(f"\N{MULTIPLICATION X} {row['solver']}, {wp.amount(row)}: {row['reason']}")
    typer.echo(f"Chart and results are in {output.resolve()}")


def numbers_of(option: str, words: str, kind: type[int] | type[float]) -> list[float]:
    """ "20,50,100" as numbers."""
    try:
        return [kind(word) for word in words.split(",")]
    except ValueError as error:
        what = "whole numbers" if kind is int else "numbers"
        raise InvalidInputError(f"`{option}` is {words!r}; write {what} with commas between them.") from error
