"""The process of a command: its words, streams, threads and interrupts, and one line for a user's mistake."""

import logging
import os
import re
import signal
import sys
import threading
import warnings
from collections.abc import Sequence
from typing import Any

from unitouch_gen.errors import (
    InvalidInputError,
    InvalidTypeError,
    NonFiniteError,
    NotConvergedError,
    UnfamiliarInputWarning,
)
from unitouch_gen.streams import open_standard_streams


def run_commands(app: Any, name: str, words: Sequence[str] | None = None, **options: Any) -> Any:
    """Runs a typer application under a name; `words` replace the command line of the process.

    A user's mistake ends in one line on standard error and exit code 2. A warning of the package is one line.
    """
    import typer

    if words is None:
        words = sys.argv[1:]
    words = [expand_home(word) for word in words]

    def say(message: Any, *_: Any) -> None:  # `warnings.showwarning` also passes category, file and line
        one_line = " ".join(str(message).split())
        print(f"{name}: {one_line}", file=sys.stderr)

    open_standard_streams()
    logging.getLogger().addHandler(logging.NullHandler())  # otherwise Python prints what libraries log
    usage: Any = typer.BadParameter.__bases__  # the base class of typer's usage errors has no public name
    try:
        check_working_folder()
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", module=r"(?!unitouch_gen\b)")
            warnings.simplefilter("always", UnfamiliarInputWarning)
            warnings.showwarning = say  # type: ignore[assignment]
            code = app(words, standalone_mode=False, **options)
        if code == 130:  # exit code of an interrupt
            say("stopped; what is written is whole.")
        return code
    except (*usage, OSError, InvalidInputError, InvalidTypeError, NonFiniteError, NotConvergedError) as error:
        message = error.format_message() if isinstance(error, usage) else str(error)
        if message:  # empty if the help was shown
            say(message)
    sys.exit(2)


def wait_passively() -> None:
    """Lets threads that wait for each other leave the processors to other processes, unless the user said otherwise.

    It has no effect once torch is imported.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


def interrupt_on_termination() -> None:
    """Makes SIGTERM and SIGHUP interrupt the process as Ctrl-C does, so that temporary folders are removed.

    It has no effect outside of the main thread.
    """
    if threading.current_thread() is not threading.main_thread():
        return
    for name in ("SIGTERM", "SIGHUP"):  # sent by `docker stop`, systemd and Slurm, and by a terminal that closes
        number = getattr(signal, name, None)  # Windows has no SIGHUP
        if number is not None and signal.getsignal(number) == signal.SIG_DFL:  # `nohup` ignores it
            signal.signal(number, signal.default_int_handler)


def check_working_folder() -> None:
    """Raises if the working folder was deleted, since importing torch would then end the process."""
    try:
        os.getcwd()
    except FileNotFoundError as error:
        raise InvalidInputError("The working folder has been deleted; change to one that exists.") from error


def expand_home(word: str) -> str:
    """A word of a command line with `~` expanded, which shells do not do in `--output=~/pictures`."""
    option, value = re.fullmatch(r"(--[\w-]+=)?(.*)", word, flags=re.DOTALL).groups(default="")  # type: ignore[union-attr]
    return option + (os.path.expanduser(value) if re.match(r"~[/\\]", value) else value)
