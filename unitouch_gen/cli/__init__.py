"""`unitouch-gen ...`: a thin layer over the pipelines. Each command imports what it needs when it runs.

A mistake of the user prints one line on standard error and exits with 2.
"""

import sys
from typing import Any, NoReturn

import typer

from unitouch_gen.cli.convert import app as convert
from unitouch_gen.cli.fit import fit
from unitouch_gen.cli.options import as_options
from unitouch_gen.cli.pictures import stylize, touch_to_image, x_to_touch
from unitouch_gen.cli.stability import stability
from unitouch_gen.cli.work_precision import work_precision
from unitouch_gen.errors import InvalidInputError, InvalidTypeError, NonFiniteError, NotConvergedError

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Generative pipelines between touch and image.",
)
app.command("touch-to-image")(touch_to_image)
app.command("stylize")(stylize)
app.command("x-to-touch")(x_to_touch)
app.command("stability")(stability)
app.command("work-precision")(work_precision)
app.command("fit")(fit)
app.add_typer(convert, name="convert")

USAGE_ERROR = 2
WRONG_USAGE: Any = typer.BadParameter.__bases__  # typer's base class of all usage errors has no public name


def main() -> None:
    """Entry point: turns users' mistakes into one line and exit code 2."""
    try:
        code = app(standalone_mode=False)
    except WRONG_USAGE as error:  # type: ignore[misc]
        complain(error.format_message())
    except (InvalidInputError, InvalidTypeError, NonFiniteError, NotConvergedError) as error:
        complain(as_options(str(error)))
    else:
        sys.exit(code)


def complain(message: str) -> NoReturn:
    """One line on standard error, and exit code 2; no line where the help has been shown instead."""
    if message:
        print(f"unitouch-gen: {' '.join(message.split())}", file=sys.stderr)
    sys.exit(USAGE_ERROR)
