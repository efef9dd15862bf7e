"""The checks and error types every part uses.

Every message names the argument, says what came, and says what to do. Users' mistakes raise `InvalidInputError` (a
`ValueError`) or `InvalidTypeError` (a `TypeError`) before any network runs.
"""

import io
import math
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from numbers import Integral, Real
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # so the command line may say what is wrong before torch is imported, which takes seconds
    import torch


class InvalidInputError(ValueError):
    """A value that cannot be used."""


class InvalidTypeError(TypeError):
    """A value of a kind that cannot be used."""


class NonFiniteError(ArithmeticError):
    """A computation left the range of floating-point numbers; the message says at which step and in which sample."""


class UnfamiliarInputWarning(UserWarning):
    """An input is unlike those that the model knows, or a touch of nothing, so what is made of it is a guess."""


class ExchangedInputsWarning(UserWarning):
    """Two inputs that look as if each was meant to be the other."""


class DroppedFramesWarning(UserWarning):
    """Frames of a recording are missing, so what was taken of it may not be the best of it."""


class NotConvergedError(ArithmeticError):
    """A computation did not reach its tolerance within what it was allowed; the message says how far it came."""


REFUSALS = (InvalidInputError, InvalidTypeError, NonFiniteError, NotConvergedError)
"""What a person is told in one line, and no programmer has to look for."""

USAGE_ERROR, INTERRUPTED = 2, 130
"""Exit codes of commands that a user's mistake ended, and an interrupt."""


def run_commands(app: Any, name: str, *words: Any, reworded: Callable[[str], str] = str, **options: Any) -> Any:
    """Runs a typer application; a mistake of the user is one line on standard error and exit code 2, a warning a line.

    Args:
        app: The application.
        name: What the line begins with.
        words: The command line, in place of the one that the process was started with.
        reworded: What the line says of an error of ours.
        options: Of the application's call.

    Returns:
        The exit code, 0 or `None` if all went well.
    """
    import typer

    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="surrogateescape")  # names of files in another encoding are printed as they are
    usage: Any = typer.BadParameter.__bases__  # typer's base class of all usage errors has no public name
    try:
        with warnings_as_lines(name):
            code = app(*words, standalone_mode=False, **options)
        if code == INTERRUPTED:
            print(f"{name}: stopped; what is written is whole.", file=sys.stderr)
        return code
    except usage as error:
        message = error.format_message()  # empty where the help has been shown instead
    except REFUSALS as error:
        message = reworded(str(error))
    if message:
        print(f"{name}: {' '.join(message.split())}", file=sys.stderr)
    sys.exit(USAGE_ERROR)


@contextmanager
def warnings_as_lines(name: str) -> Iterator[None]:
    """Makes each warning of ours a line on standard error that begins with a name, and leaves out those of libraries.

    These are for their programmers: what they say of how this package calls them is raised in a module of ours, and
    shown. Touches that are unlike those of their sensor are the commands' to tell, which know their files.
    """

    def show(message: Warning | str, *place: Any) -> None:
        print(f"{name}: {' '.join(str(message).split())}", file=sys.stderr)

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", module=r"(?!unitouch_gen\b)")
        warnings.simplefilter("always", ExchangedInputsWarning)
        warnings.simplefilter("ignore", UnfamiliarInputWarning)
        warnings.showwarning = show  # type: ignore[assignment]
        yield


def describe(value: Any) -> str:
    """A short, safe description of what a user passed."""
    if isinstance(value, Real | str) or value is None:
        try:
            text = str(value) if isinstance(value, Real) else repr(value)
        except ValueError:  # Python writes no integers of thousands of digits
            return "a number of thousands of digits"
        return shortened(text, 80)
    if isinstance(value, type):
        return f"the class {value.__name__}"
    if hasattr(value, "is_quantized"):  # a tensor
        return f"a {_kind(value)}tensor" + ("" if value.is_nested else f" of {_shape_and_dtype(value)}")
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return f"an array of {_shape_and_dtype(value)}"
    if isinstance(value, list | tuple):
        return f"a {type(value).__name__} of {len(value)}"
    return f"a {type(value).__name__}"


def shortened(text: str, most: int = 400) -> str:
    """A text, or both ends of a long one."""
    return text if len(text) <= most else f"{text[: most // 2 - 3]}...{text[-(most // 2) :]}"


def _shape_and_dtype(value: Any) -> str:
    return f"shape {tuple(value.shape)} and dtype {str(value.dtype).removeprefix('torch.')}"


def _kind(tensor: Any) -> str:
    """What sets a tensor apart from those whose values all lie in memory, one by one: "sparse_coo "; or nothing."""
    layout = str(tensor.layout).removeprefix("torch.")
    kinds = {"nested ": tensor.is_nested, "meta ": tensor.is_meta, "quantised ": tensor.is_quantized}
    return next((kind for kind, found in kinds.items() if found), "" if layout == "strided" else f"{layout} ")


def first_line(error: BaseException) -> str:
    """The first line of what an error says, or its kind where it says nothing."""
    return str(error).strip().partition("\n")[0] or type(error).__name__


MOST_NAMES = 10
"""In a message."""


def first_of(names: Sequence[str], between: str = "; ") -> str:
    """The first ten of many, and how many more there are."""
    more = [f"and {len(names) - MOST_NAMES} more"] if len(names) > MOST_NAMES else []
    return between.join([*names[:MOST_NAMES], *more])


def needed(module: str, extra: str = "train") -> Any:
    """A module of an extra.

    Raises:
        InvalidInputError: If it is not installed.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise InvalidInputError(
            f"This needs the package `{module}`, which is not installed; run: pip install 'unitouch_gen[{extra}]'"
        ) from error


def check_integer(name: str, value: Any, low: int, high: int | None = None, *, hint: str = "") -> int:
    """`value` as an int within [low, high].

    Raises:
        InvalidTypeError: If it is no integer (booleans are not).
        InvalidInputError: If it is out of range.
    """
    whole = isinstance(value, Integral) and not isinstance(value, bool)
    number = int(value) if whole else value
    if whole and low <= number and (high is None or number <= high):
        return number
    error = InvalidInputError if whole else InvalidTypeError
    raise error(f"`{name}` is {describe(number)}; it has to be an integer{_span(low, high)}.{_tail(hint)}")


def check_number(name: str, value: Any, low: float = -math.inf, high: float = math.inf, *, hint: str = "") -> float:
    """`value` as a finite float within [low, high].

    Raises:
        InvalidTypeError: If it is no real number.
        InvalidInputError: If it is NaN, infinite or out of range.
    """
    if isinstance(value, bool) or not isinstance(value, Real):
        raise InvalidTypeError(f"`{name}` is {describe(value)}; it has to be a number{_span(low, high)}.{_tail(hint)}")
    try:
        number = float(value)
    except OverflowError:  # of integers and fractions
        number = math.inf
    if not math.isfinite(number) or not low <= number <= high:
        raise InvalidInputError(
            f"`{name}` is {describe(value)}; it has to be a finite number{_span(low, high)}.{_tail(hint)}"
        )
    return number


def check_flag(name: str, value: Any) -> bool:
    """`value`, if it is a boolean.

    Raises:
        InvalidTypeError: Otherwise; "no" would count as true.
    """
    if not isinstance(value, bool):
        raise InvalidTypeError(f"`{name}` is {describe(value)}; it has to be True or False.")
    return value


def check_kind(name: str, value: Any, *kinds: type, hint: str = "") -> Any:
    """`value`, if it is an instance of one of some classes.

    Raises:
        InvalidTypeError: Otherwise.
    """
    if not isinstance(value, kinds):
        known = " or ".join(kind.__name__ for kind in kinds)
        raise InvalidTypeError(f"`{name}` is {describe(value)}; it has to be a {known}.{_tail(hint)}")
    return value


def check_texts(name: str, value: Any) -> list[str]:
    """A string, or each of a list of them, as a list of strings that can be written in UTF-8.

    Raises:
        InvalidTypeError: If it is something else.
        InvalidInputError: If there is none, or one holds half of a pair of surrogates, as what was decoded in error.
    """
    texts = [value] if isinstance(value, str) else value
    if not isinstance(texts, list | tuple) or not all(isinstance(text, str) for text in texts):
        raise InvalidTypeError(f"`{name}` is {describe(value)}; it has to be a string or a list of strings.")
    if not texts:
        raise InvalidInputError(f"`{name}` is an empty {type(texts).__name__}; pass at least one string.")
    for text in texts:
        try:
            text.encode()
        except UnicodeEncodeError as error:
            raise InvalidInputError(
                f"`{name}` is {describe(text)}, whose character {error.start} is none by itself; decode it as UTF-8."
            ) from error
    return list(texts)


def check_names(name: str, values: Any) -> list[str]:
    """Several strings, or none, as a list.

    Raises:
        InvalidTypeError: If they are no list of strings, as a single one is not.
    """
    if not isinstance(values, list | tuple) or not all(isinstance(value, str) for value in values):
        raise InvalidTypeError(f"`{name}` is {describe(values)}; it has to be a list of strings.")
    return list(values)


def check_choice(name: str, value: Any, choices: Iterable[str], *, hint: str = "") -> str:
    """`value`, if it is one of `choices`.

    Raises:
        InvalidInputError: Otherwise; the message lists the choices, and the one that was likely meant.
    """
    choices = list(choices)
    if isinstance(value, str) and value in choices:
        return value
    raise InvalidInputError(
        f"`{name}` is {describe(value)}; it has to be one of {', '.join(map(repr, choices))}."
        f"{_tail(did_you_mean(value, choices))}{_tail(hint)}"
    )


def check_choices(name: str, values: Any, choices: Iterable[str]) -> list[str]:
    """Several names, each of which is one of `choices`.

    Raises:
        InvalidTypeError: If they are no list, as a single name is not.
        InvalidInputError: If one is something else; see `check_choice`.
    """
    if isinstance(values, str) or hasattr(values, "dtype") or not isinstance(values, Iterable):  # tensors may not end
        raise InvalidTypeError(f"`{name}` is {describe(values)}; it has to be a list of names.")
    choices = list(choices)
    return [check_choice(name, value, choices) for value in values]


def check_arguments(function: str, given: Iterable[str], known: Iterable[str]) -> None:
    """Refuses keyword arguments that a function would ignore.

    Raises:
        InvalidInputError: If one is not known; the message lists those there are, and the one that was likely meant.
    """
    known = sorted(known)
    if unknown := sorted(set(given) - set(known)):
        hint = did_you_mean(unknown[0], known)
        raise InvalidInputError(f"`{function}` got {unknown}; it takes {', '.join(known)}.{_tail(hint)}")


TYPING_MISTAKE = 0.75
"""Least similarity (difflib's ratio) of a typing mistake to what was meant: that of "huen" to "heun", two letters of
four exchanged. Names of different things may come near it: "gelslim" and "gelsight", two sensors, are at 0.67."""


def did_you_mean(value: Any, choices: Iterable[str]) -> str:
    """ "Did you mean ...?" with the choice that `value` is likely a misspelling of; empty if there is none."""
    from difflib import get_close_matches

    if not isinstance(value, str):
        return ""
    spelled = {choice.casefold(): choice for choice in choices}
    nearest = get_close_matches(value.casefold(), spelled, n=1, cutoff=TYPING_MISTAKE)
    return f"Did you mean {spelled[nearest[0]]!r}?" if nearest else ""


def check_finite(name: str, tensor: "torch.Tensor") -> "torch.Tensor":
    """`tensor`, if all of it is finite.

    Raises:
        InvalidInputError: Otherwise, with the number of offending values.
    """
    finite = tensor.isfinite()
    if not bool(finite.all()):
        bad = int((~finite).sum())
        raise InvalidInputError(
            f"`{name}` holds {bad} of {tensor.numel()} values that are NaN or infinite; pass finite values only."
        )
    return tensor


FLOATS = ("float32", "float16", "bfloat16", "float64")
INTEGERS = tuple(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64))
"""dtypes that torch computes with, by its names for them; of others it can do little more than store them."""


REALS = (*FLOATS, *INTEGERS, "bool")


def check_dense(name: str, tensor: "torch.Tensor", dtypes: Sequence[str] = REALS, hint: str = "") -> None:
    """Checks that all values of a tensor lie in memory, one by one, as numbers of some dtypes.

    Raises:
        InvalidTypeError: Otherwise, as of sparse, nested and quantised ones, and those on the meta device.
    """
    if _kind(tensor) or str(tensor.dtype).removeprefix("torch.") not in dtypes:
        wanted = {FLOATS: "floating-point numbers", INTEGERS: "integers", REALS: "real numbers"}[tuple(dtypes)]
        raise InvalidTypeError(f"`{name}` is {describe(tensor)}; it has to be dense and hold {wanted}.{_tail(hint)}")


def check_tensor(
    name: str, value: Any, *shape: int | str, integers: bool = False, finite: bool = True, hint: str = ""
) -> "torch.Tensor":
    """`value`, if it is a dense tensor of finite floating-point numbers of some shape.

    Args:
        name: Of the argument, for the messages.
        value: What came.
        shape: Sizes, of which a letter stands for any of at least 1, everywhere the same one: "B", 3, "S", "S".
        integers: Whether it has to hold integers instead.
        finite: Whether to look at the values.
        hint: End of the messages.

    Raises:
        InvalidTypeError: If it is something else, or holds other numbers.
        InvalidInputError: If its shape does not fit, or a value is NaN or infinite.
    """
    import torch

    form = f"a tensor ({', '.join(map(str, shape))}{',' * (len(shape) == 1)})"
    if not isinstance(value, torch.Tensor):
        raise InvalidTypeError(f"`{name}` is {describe(value)}; it has to be {form}.{_tail(hint)}")
    check_dense(name, value, INTEGERS if integers else FLOATS, hint)
    pairs = zip(shape, value.shape, strict=False)
    sizes: dict[Any, int] = {wanted: max(size, 1) for wanted, size in pairs if isinstance(wanted, str)}
    fits = tuple(value.shape) == tuple(sizes.get(wanted, wanted) for wanted in shape)
    if not fits:
        raise InvalidInputError(f"`{name}` is {describe(value)}; it has to be {form}.{_tail(hint)}")
    return check_finite(name, value) if finite else value


def check_dtype(name: str, value: Any) -> "torch.dtype":
    """`value`, or what it is the name of, if weights may have it.

    Raises:
        InvalidTypeError: If it is no dtype of floating-point numbers that torch computes with.
        InvalidInputError: If it is the name of none.
    """
    import torch

    known = {word: getattr(torch, word) for word in FLOATS}
    if isinstance(value, str):
        return known[check_choice(name, value.removeprefix("torch."), known)]
    if not isinstance(value, torch.dtype) or value not in known.values():
        what = value if isinstance(value, torch.dtype) else describe(value)
        raise InvalidTypeError(
            f"`{name}` is {what}; weights are floating-point numbers: pass torch.float32 or torch.bfloat16."
        )
    return value


def check_device(name: str, value: Any) -> "torch.device":
    """`value` as a device that is there.

    Raises:
        InvalidInputError: If it names none, or torch finds none of its kind.
    """
    import torch

    try:
        device = torch.device(value)
    except (RuntimeError, TypeError, ValueError) as error:
        raise InvalidInputError(f'`{name}` is {describe(value)}; pass "cpu", "cuda" or "meta".') from error
    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as error:  # by the kind, and by its number
        raise InvalidInputError(f"`{name}` is {str(device)!r}, and torch finds none here; leave it out.") from error
    return device


def _span(low: float, high: float | None) -> str:
    ends = [end if isinstance(end, int) else f"{end:g}" for end in (low, math.inf if high is None else high)]
    bounded_below, bounded_above = low > -math.inf, high is not None and high < math.inf
    if bounded_below and bounded_above:
        return f" from {ends[0]} to {ends[1]}"
    if bounded_below:
        return f" of at least {ends[0]}"
    return f" of at most {ends[1]}" if bounded_above else ""


def _tail(hint: str) -> str:
    return f" {hint}" if hint else ""
