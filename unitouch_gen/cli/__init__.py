"""`unitouch-gen`: commands, a thin layer over the pipelines. Each command imports its dependencies when it runs."""

import sys
from typing import Annotated

import typer

from unitouch_gen import __version__
from unitouch_gen.cli.answers import ask, classify
from unitouch_gen.cli.app import app
from unitouch_gen.cli.batch import batch
from unitouch_gen.cli.convert import app as convert
from unitouch_gen.cli.convert import distill
from unitouch_gen.cli.data import app as data
from unitouch_gen.cli.doctor import doctor
from unitouch_gen.cli.evaluate import evaluate
from unitouch_gen.cli.numerics import stability, work_precision
from unitouch_gen.cli.pictures import stylize, touch_to_image, x_to_touch
from unitouch_gen.cli.press import press
from unitouch_gen.commands import interrupt_on_termination, run_commands, wait_passively

commands = typer.Typer(no_args_is_help=True, pretty_exceptions_enable=False)


def print_version(requested: bool) -> None:
    """Prints the version and exits, for --version."""
    if requested:
        typer.echo(f"unitouch_gen {__version__}")
        raise typer.Exit


@commands.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", metavar="", callback=print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Generative pipelines between touch and image."""


drawing = (touch_to_image, stylize, x_to_touch, press, batch, app)
for function in (*drawing, ask, classify, distill, evaluate, work_precision, stability, doctor):
    commands.command()(function)
commands.add_typer(convert, name="convert")
commands.add_typer(data, name="data")


def main() -> None:
    """Entry point. A user's mistake ends in one line and exit code 2."""
    wait_passively()
    interrupt_on_termination()
    sys.exit(run_commands(commands, "unitouch-gen"))
