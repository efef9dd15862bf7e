"""`unitouch-gen data check`: what is in a data set, and what is wrong with it."""

from pathlib import Path
from typing import Annotated

from typer import Argument, Exit, Option, Typer, echo

from unitouch_gen.cli.options import Materials, by_comma, is_quiet, print_table

app = Typer(no_args_is_help=True)


@app.callback()
def group() -> None:
    """Data sets to train on."""


@app.command()
def check(
    path: Annotated[Path, Argument(help="Folder of a data set.", metavar="DIR")],
    kind: Annotated[str, Option(help="Its layout, such as touch_and_go; or auto, to see which it is.")] = "auto",
    sensor: Annotated[str | None, Option(help="Name of the sensor of all touches.")] = None,
    materials: Materials = None,
) -> None:
    """Reads every file of a data set, says what it is and what is wrong with it; exits with 1 if files are broken.

    Example: unitouch-gen data check touches/
    """
    from unitouch_gen.training.data import check as checking
    from unitouch_gen.training.data import open_dataset

    data = open_dataset(path, kind, sensor=sensor, materials=by_comma(materials))
    broken, lines = checking.check(data, is_quiet(False))
    splits, rows = checking.contents(data)
    print_table([data.name, data.kind, "records", *splits], rows)
    echo("\n".join(lines or ["Nothing is wrong with it"]))
    raise Exit(1 if broken else 0)
