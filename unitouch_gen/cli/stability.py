"""`unitouch-gen stability`."""

import json
import math
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from unitouch_gen.cli.loading import kind_of, load_pipeline
from unitouch_gen.cli.options import Model, is_quiet, print_table

if TYPE_CHECKING:
    import torch

    from unitouch_gen.numerics.stability import Outcome

NOT_AS_EXPECTED = 1
"""Exit code."""

GROUPS = (
    "stiff", "guidance", "few steps", "steps", "batches", "schedules", "predictions", "calls", "inputs", "many",
    "precision", "broken", "gels", "sounds",
)  # fmt: skip
"""Groups of the suite, which takes torch to make: help has to be there at once."""

WIDEST = 40
"""Characters of what was seen that the table shows; the file and the lines below it have all of them."""


def stability(
    group: Annotated[
        list[str] | None,
        typer.Option(help=f"Run the cases of a group; may be repeated. One of {', '.join(map(repr, GROUPS))}."),
    ] = None,
    only: Annotated[list[str] | None, typer.Option(help="Run the case of a name; may be repeated.")] = None,
    model: Model = None,
    file: Annotated[Path | None, typer.Option("--json", help="A file to write the outcomes to, as JSON.")] = None,
    list_cases: Annotated[bool, typer.Option("--list", metavar="", help="List the cases, and run none.")] = False,
) -> None:
    """Runs solvers, pipelines and the world's physics on stiff and extreme input; exits with 1 if one went wrong.

    Of a saved pipeline only the cases that call it are run.

    Example: unitouch-gen stability
    """
    from tqdm import tqdm

    from unitouch_gen.files import check_writable
    from unitouch_gen.numerics import stability_suite
    from unitouch_gen.numerics.stability import choose, run_case, summary
    from unitouch_gen.pipelines.tiny import tiny

    def load(kind: str, dtype: "torch.dtype") -> Any:
        return load_pipeline(kind, model, True, dtype=str(dtype).removeprefix("torch."))

    suite = stability_suite.suite(tiny) if model is None else stability_suite.pipeline_cases(load, [kind_of(model)])
    chosen = choose(suite, group or (), only or ())
    if list_cases:
        print_table(["group", "case", "expected"], [[name, case.name, case.expected] for name, case in chosen])
        return
    if file is not None:
        check_writable("--json", file)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of libraries, on input that is meant to be odd
        bar = tqdm(chosen, disable=is_quiet(False), leave=False)
        outcomes = [run_case(case, name) for name, case in bar]
    print_outcomes(outcomes)
    if file is not None:
        save(outcomes, file)
    typer.echo(summary(outcomes))
    if not all(outcome.ok for outcome in outcomes):
        raise typer.Exit(NOT_AS_EXPECTED)


def save(outcomes: "Sequence[Outcome]", file: Path) -> None:
    """Writes the outcomes, and then their number and those that are wrong."""
    record = {
        "cases": [{**vars(row), "value": row.value if math.isfinite(row.value) else None} for row in outcomes],
        "wrong": [outcome.name for outcome in outcomes if not outcome.ok],
        "silent": [outcome.name for outcome in outcomes if outcome.silent],
    }
    from unitouch_gen.files import write_file

    write_file("--json", file, json.dumps(record, indent=1, allow_nan=False) + "\n")


def print_outcomes(outcomes: "Sequence[Outcome]") -> None:
    """A table of all, and a line of each that is wrong."""
    rows = [
        [
            row.group,
            row.name,
            row.expected,
            row.seen if len(row.seen) <= WIDEST else f"{row.seen[: WIDEST - 3]}...",
            "-" if row.value != row.value else f"{row.value:.1e}",
            f"{row.seconds:.2f}",
            "ok" if row.ok else "WRONG",
        ]
        for row in outcomes
    ]
    print_table(["group", "case", "expected", "seen", "error", "seconds", "ok"], rows)
    for row in outcomes:
        if not row.ok:
            typer.echo(f"{row.group}, {row.name}: expected {row.expected}; seen: {' '.join(row.seen.split())}")
