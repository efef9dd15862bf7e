"""`unitouch-gen stability`."""

import warnings
from typing import TYPE_CHECKING, Annotated, Any

import typer

from unitouch_gen.cli.loading import CLASSES, kind_of, load_pipeline
from unitouch_gen.cli.options import Model, is_quiet, print_table

if TYPE_CHECKING:
    import torch


def stability(
    model: Model = None,
    only: Annotated[str | None, typer.Option(help="Name of the one case to run.")] = None,
    list_cases: Annotated[bool, typer.Option("--list", metavar="", help="List the cases, and run none.")] = False,
) -> None:
    """Runs solvers and pipelines on stiff and extreme input; exits with 1 if a case fails.

    Example: unitouch-gen stability
    """
    import diffusers.utils.logging
    from tqdm import tqdm

    from unitouch_gen.errors import InvalidInputError, did_you_mean
    from unitouch_gen.numerics.stability import cases

    def load(kind: str, dtype: "torch.dtype") -> Any:
        return load_pipeline(kind, model, True, dtype=str(dtype).removeprefix("torch."))

    table = cases(load, [*CLASSES] if model is None else [kind_of(model)])
    if only is not None and only not in (names := [case.name for case in table]):
        raise InvalidInputError(f"Unknown case {only!r}; --list shows them. {did_you_mean(only, names)}".rstrip())
    table = [case for case in table if only in (None, case.name)]
    if list_cases:
        print_table(["case", "reason of the bound"], [[case.name, case.reason] for case in table])
        return
    diffusers.utils.logging.set_verbosity_error()
    rows, failed = [], 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # libraries warn of extreme input
        for case in tqdm(table, disable=is_quiet(False), leave=False):
            try:
                value, bound = case.run()
            except Exception as error:  # the other cases still run
                ok, figures = False, ["-", f"{type(error).__name__}: {error}"]
            else:
                ok, figures = value <= bound, [f"{bound:.2g}", f"{value:.2g}"]
            failed += not ok
            rows.append([case.name, *figures, "ok" if ok else "FAILED"])
    print_table(["case", "bound", "result", ""], rows)
    typer.echo(f"{len(rows) - failed} of {len(rows)} cases hold.")
    if failed:
        raise typer.Exit(1)
