"""Error types, and the checks of arguments, each of which returns the checked value.

A value of a wrong kind is an `InvalidTypeError`, any other that cannot be used an `InvalidInputError`; the message
names the argument, what came, and what to do.
"""

import logging
import math
import os
import re
import sys
import warnings
from collections.abc import Collection, Iterable, Sequence
from difflib import get_close_matches
from importlib import import_module
from numbers import Integral, Real
from typing import TYPE_CHECKING, Any

from unitouch_gen.streams import open_standard_streams

if TYPE_CHECKING:  # so the command line can say what is wrong before torch is imported, which takes seconds
    import torch


class InvalidInputError(ValueError):
    """A value that cannot be used."""


class InvalidTypeError(TypeError):
    """A value of a kind that cannot be used."""


class NonFiniteError(ArithmeticError):
    """A computation left the range of floating-point numbers; the message says at which step and in which sample."""


class NotConvergedError(ArithmeticError):
    """A computation did not reach its tolerance within what it was allowed."""


class UnfamiliarInputWarning(UserWarning):
    """A touch is unlike those that the model knows, or a recording may show none, so what is made of it is a guess."""


def run_commands(app: Any, name: str, words: Sequence[str] | None = None, **options: Any) -> Any:
    """Runs a typer application under a name; `words` are a command line in place of the process's own.

    A user's mistake is one line on standard error and exit code 2, a warning of ours one line.
    """
    import typer

    words = [expand_home(word) for word in (sys.argv[1:] if words is None else words)]

    def say(message: Any, *place: Any) -> None:
        print(f"{name}: {' '.join(str(message).split())}", file=sys.stderr)

    open_standard_streams()
    logging.getLogger().addHandler(logging.NullHandler())  # or Python prints what libraries log, such as matplotlib
    usage: Any = typer.BadParameter.__bases__  # typer's base class of all usage errors has no public name
    try:
        check_working_folder()
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", module=r"(?!unitouch_gen\b)")
            warnings.simplefilter("always", UnfamiliarInputWarning)
            warnings.showwarning = say  # type: ignore[assignment]
            code = app(words, standalone_mode=False, **options)
        if code == 130:  # interrupted
            say("stopped; what is written is whole.")
        return code
    except (*usage, OSError, InvalidInputError, InvalidTypeError, NonFiniteError, NotConvergedError) as error:
        message = error.format_message() if isinstance(error, usage) else str(error)
        if message:  # empty where the help has been shown instead
            say(message)
    sys.exit(2)


def check_working_folder() -> None:
    """Raises if the folder that the process is in was deleted, where torch ends the process as it is imported."""
    try:
        os.getcwd()
    except FileNotFoundError as error:
        raise InvalidInputError("The working folder has been deleted; change to one that is there.") from error


def expand_home(word: str) -> str:
    """A word of a command line with the home folder for `~`, which shells leave as it is in `--output=~/pictures`."""
    option, value = re.fullmatch(r"(--[\w-]+=)?(.*)", word, flags=re.DOTALL).groups(default="")  # type: ignore[union-attr]
    return option + (os.path.expanduser(value) if re.match(r"~[/\\]", value) else value)


def describe(value: Any) -> str:
    """A short, safe description of what a user passed."""
    if value is None or isinstance(value, Real | str | type):
        text = str(value) if isinstance(value, Real) else repr(value)
        return text if len(text) <= 80 else f"{text[:37]}...{text[-40:]}"
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        kind = "a tensor" if hasattr(value, "layout") else "an array"
        return f"{kind} of shape {tuple(value.shape)} and dtype {str(value.dtype).removeprefix('torch.')}"
    return f"a {type(value).__name__}" + (f" of {len(value)}" if isinstance(value, list | tuple) else "")


def first_line(error: BaseException) -> str:
    """The first line of what an error says, or its kind where it says nothing."""
    return str(error).strip().partition("\n")[0] or type(error).__name__


def needed(module: str, extra: str = "train") -> Any:
    """Imports a module of an extra."""
    try:
        return import_module(module)
    except ImportError as error:
        missing = isinstance(error, ModuleNotFoundError) and error.name == module
        why = "is missing" if missing else f"cannot be imported ({first_line(error)})"
        raise InvalidInputError(f'`{module}` {why}: pip install "unitouch_gen[{extra}]"') from error


def did_you_mean(value: Any, choices: Iterable[str]) -> str:
    """ "Did you mean ...?" with the choice that `value` is likely a misspelling of; empty if there is none."""
    spelled = {choice.casefold(): choice for choice in choices}
    # "huen" and "heun" have a ratio of 0.75; "gelslim" and "gelsight", two sensors, of 0.67.
    nearest = get_close_matches(str(value).casefold(), spelled, n=1, cutoff=0.75)
    return f"Did you mean {spelled[nearest[0]]!r}?" if nearest else ""


def check_arguments(of: str, given: Iterable[str], known: Collection[str]) -> None:
    """Raises if a name is no argument of a function that would ignore it; private names of libraries pass."""
    for name in given:
        if name not in known and not name.startswith("_"):
            raise InvalidTypeError(f"`{name}` is no argument of {of}. {did_you_mean(name, known)}".strip())


def check_kind(name: str, value: Any, *kinds: type) -> Any:
    """An instance of one of some classes."""
    if not isinstance(value, kinds):
        known = " or ".join(kind.__name__ for kind in kinds)
        raise InvalidTypeError(f"`{name}` is {describe(value)}; it has to be a {known}.")
    return value


def check_integer(name: str, value: Any, low: int, high: float = math.inf) -> int:
    """An integer from `low` to `high`, as an int; booleans are none."""
    if isinstance(value, bool) or not isinstance(value, Integral):
        raise InvalidTypeError(f"`{name}` is {describe(value)}; it has to be an integer.")
    check_number(name, value, low, high)
    return int(value)


def check_number(name: str, value: Any, low: float = -math.inf, high: float = math.inf) -> float:
    """A finite number from `low` to `high`, as a float; booleans are none."""
    if isinstance(value, bool) or not isinstance(value, Real):
        raise InvalidTypeError(f"`{name}` is {describe(value)}; it has to be a number.")
    try:
        fits = math.isfinite(value) and low <= value <= high  # type: ignore[operator]
    except OverflowError:  # of integers beyond the range of floats
        fits = False
    if not fits:
        raise InvalidInputError(f"`{name}` is {describe(value)}; it has to be a number from {low:g} to {high:g}.")
    return float(value)


def check_texts(name: str, value: Any) -> list[str]:
    """A string, or one or more of them, as a list; each can be written in UTF-8."""
    texts = [value] if isinstance(value, str) else value
    if not isinstance(texts, list | tuple) or not all(isinstance(text, str) for text in texts):
        raise InvalidTypeError(f"`{name}` is {describe(value)}; it has to be a string or a list of strings.")
    if not texts or any("\ud800" <= letter <= "\udfff" for letter in "".join(texts)):  # bytes in another encoding
        raise InvalidInputError(f"`{name}` is {describe(value)}; pass at least one string, in UTF-8.")
    return list(texts)


def check_choice(name: str, value: Any, choices: Iterable[str], *, hint: str = "") -> str:
    """One of `choices`; the message lists them, and the one that was likely meant."""
    choices = list(choices)
    if isinstance(value, str) and value in choices:
        return value
    wanted = f"it has to be one of {', '.join(map(repr, choices))}. {did_you_mean(value, choices)} {hint}"
    raise InvalidInputError(f"`{name}` is {describe(value)}; {wanted}".strip())


def is_lfs_pointer(path: str | os.PathLike) -> bool:
    """Whether a file is a pointer of Git LFS, which stands for a file that was not fetched."""
    start = b"version https://git-lfs.github.com/spec/"
    with open(path, "rb") as stream:
        return stream.read(len(start)) == start


def check_file(name: str, path: str | os.PathLike, what: str) -> None:
    """Raises `InvalidInputError` if `what`, such as "an image file", cannot be opened there or is a Git LFS pointer."""
    subject = f"`{name}` names {str(path)[:400]!r}, which"
    if not os.path.isfile(path):  # unlike Path.is_file, False for a name that is too long
        why = "is a folder" if os.path.isdir(path) else "is no file" if os.path.exists(path) else "does not exist"
        raise InvalidInputError(f"{subject} {why}; pass the path of {what}.")
    try:
        pointer = is_lfs_pointer(path)
    except OSError as error:
        raise InvalidInputError(f"{subject} cannot be opened: {error.strerror}; pass the path of {what}.") from error
    if pointer:
        raise InvalidInputError(f"{subject} is a Git LFS pointer to {what}; run `git lfs pull` in its repository.")


def check_unused(instead: str, **given: Any) -> None:
    """Raises if an argument has no effect together with `instead`."""
    for name, value in given.items():
        if value is not None:
            raise InvalidInputError(f"`{name}` is {describe(value)}, but has no effect with `{instead}`; pass one.")


def check_finite(name: str, tensor: "torch.Tensor") -> "torch.Tensor":
    """A tensor of finite values; the message counts the others."""
    if bad := int((~tensor.isfinite()).sum()):
        raise InvalidInputError(f"`{name}` holds {bad} of {tensor.numel()} values that are NaN or infinite.")
    return tensor


def check_tensor(name: str, value: Any, *shape: int | str, finite: bool = True) -> "torch.Tensor":
    """A dense tensor of floating-point numbers of some shape; a letter in it stands for any size of at least 1."""
    import torch

    form = ", ".join(map(str, shape))
    message = f"`{name}` is {describe(value)}; it has to be a dense floating-point tensor ({form})."
    dense = isinstance(value, torch.Tensor) and value.layout == torch.strided and not value.is_meta
    if not dense or not value.is_floating_point():
        raise InvalidTypeError(message)
    sizes = [max(size, 1) if isinstance(one, str) else one for one, size in zip(shape, value.shape, strict=False)]
    if len(shape) != value.ndim or sizes != list(value.shape):
        raise InvalidInputError(message)
    return check_finite(name, value) if finite else value


def check_dtype(name: str, value: Any) -> "torch.dtype":
    """A dtype for weights, or its name, as a dtype."""
    import torch

    names = ("float32", "float16", "bfloat16", "float64")
    return getattr(torch, check_choice(name, str(value).removeprefix("torch."), names))
