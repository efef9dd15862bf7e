"""`unitouch-gen data check`: what is in a data set, and what is wrong with it."""

from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Exit, Option, Typer, echo

from unitouch_gen.cli.options import is_quiet, print_table
from unitouch_gen.errors import InvalidInputError

app = Typer(no_args_is_help=True, help="Data sets to train on.")

Materials = Annotated[str | None, Option(help="Names of its materials by comma, in the order of their numbers.")]
Pattern = Annotated[
    list[str] | None, Option(help="File names over the columns of a table, such as touch={clip}_peak.jpg; repeatable.")
]
BGR = Annotated[bool, Option("--bgr", metavar="", help="Touches are stored with blue in the place of red.")]


def layout_of(materials: str | None, pattern: list[str] | None) -> dict[str, Any]:
    """`--materials` and `--pattern` as `open_dataset` takes them."""
    if not all("=" in one for one in pattern or ()):
        raise InvalidInputError(f"`--pattern` is {pattern}; write each as touch={{clip}}_peak.jpg.")
    names = None if materials is None else [name.strip() for name in materials.split(",")]
    return {"materials": names, "patterns": dict(one.split("=", 1) for one in pattern or ())}


@app.callback()
def group() -> None:
    """Data sets to train on."""


@app.command()
def check(
    path: Annotated[Path, Argument(help="Folder of a data set.", metavar="DIR")],
    kind: Annotated[str, Option(help="Its layout, such as touch_and_go; or auto, to see which it is.")] = "auto",
    sensor: Annotated[str | None, Option(help="Name of the sensor of all touches.")] = None,
    materials: Materials = None, pattern: Pattern = None, bgr: BGR = False,
) -> None:  # fmt: skip
    """Reads every file of a data set, says what it is and what is wrong with it; exits with 1 if files are broken.

    Example: unitouch-gen data check touches/
    """
    from unitouch_gen.training.data import check as checking
    from unitouch_gen.training.data import open_dataset

    data = open_dataset(path, kind, sensor=sensor, bgr=bgr, **layout_of(materials, pattern))
    broken, lines = checking.check(data, is_quiet(False))
    splits, rows = checking.contents(data)
    print_table([data.name, data.kind, "records", *splits], rows)
    echo("\n".join(lines or ["Nothing is wrong with it"]))
    raise Exit(1 if broken else 0)
