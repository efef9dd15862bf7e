"""`unitouch-gen data ...`: data sets to train on."""

from pathlib import Path
from typing import Annotated

import typer

from unitouch_gen.cli.options import Overwrite, check_new, is_quiet, print_table
from unitouch_gen.errors import InvalidInputError

app = typer.Typer(no_args_is_help=True, help="Data sets to train on.")

Pattern = Annotated[
    list[str] | None,
    typer.Option(help="File names over the columns of a table, such as touch={clip}_peak.jpg; may be repeated."),
]
BGR = Annotated[bool, typer.Option("--bgr", metavar="", help="Touches are stored with blue in the place of red.")]


def patterns_of(given: list[str] | None) -> dict[str, str]:
    """`--pattern` as `open_dataset` takes it."""
    if not all("=" in one for one in given or ()):
        raise InvalidInputError(f"`--pattern` is {given}; write each as touch={{clip}}_peak.jpg.")
    return dict(one.split("=", 1) for one in given or ())


@app.callback()
def group() -> None:
    """Data sets to train on."""


@app.command("check")
def check(
    path: Annotated[Path, typer.Argument(help="Folder of a data set.", metavar="DIR")],
    kind: Annotated[str, typer.Option(help="Its layout, such as touch_and_go; or auto, to see which it is.")] = "auto",
    output: Annotated[Path | None, typer.Option("--output", "-o", help="A picture to draw some of it on.")] = None,
    sensor: Annotated[str | None, typer.Option(help="Name of the sensor of all touches.")] = None,
    materials: Annotated[str | None, typer.Option(help="Names of its materials by comma, by their numbers.")] = None,
    pattern: Pattern = None,
    bgr: BGR = False,
    overwrite: Overwrite = False,
) -> None:
    """Reads every file of a data set, says what it is and what is wrong with it; exits with 1 if files are broken.

    Example: unitouch-gen data check touches/ -o sheet.png
    """
    from unitouch_gen.files import check_writable, replacing
    from unitouch_gen.training.data import check as checking
    from unitouch_gen.training.data import open_dataset

    if output is not None:
        if output.suffix.lower() not in (".png", ".jpg"):
            raise InvalidInputError(f"`--output` is {str(output)!r}; name a .png or .jpg.")
        if not overwrite:
            check_new([output])
        check_writable("--output", output)
    names = None if materials is None else [name.strip() for name in materials.split(",")]
    data = open_dataset(path, kind, sensor=sensor, materials=names, bgr=bgr, patterns=patterns_of(pattern))
    broken, lines = checking.check(data, is_quiet(False))
    splits, rows = checking.contents(data)
    print_table([data.name, data.kind, "records", *splits], rows)
    typer.echo("\n".join(lines or ["Nothing is wrong with it"]))
    whole = [row for row in range(len(data)) if row not in broken]
    if output is not None and whole:
        with replacing("--output", output) as file:
            checking.contact_sheet(data, whole).save(file)
        typer.echo(f"Some of it is drawn on {output.resolve()}")
    raise typer.Exit(1 if broken else 0)
