"""Error types, and the checks of arguments. A message names the argument, what came, and what to do."""

import io
import math
import sys
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from importlib import import_module
from numbers import Integral, Real
from typing import TYPE_CHECKING, Any

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
    """A touch is unlike those that the model knows, so what is made of it is a guess."""


USAGE_ERROR, INTERRUPTED = 2, 130  # exit codes


def run_commands(app: Any, name: str, *words: Any, **options: Any) -> Any:
    """Runs a typer application; a user's mistake is one line on standard error and exit code 2, a warning one line.

    Args:
        app: The application.
        name: What the line begins with.
        words: The command line, in place of the one that the process was started with.
        options: Of the application's call.
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
    except (InvalidInputError, InvalidTypeError, NonFiniteError, NotConvergedError) as error:
        message = str(error)
    if message:
        print(f"{name}: {' '.join(message.split())}", file=sys.stderr)
    sys.exit(USAGE_ERROR)


@contextmanager
def warnings_as_lines(name: str) -> Iterator[None]:
    """Makes each warning of ours a line on standard error, and leaves out those of libraries."""

    def show(message: Warning | str, *place: Any) -> None:
        print(f"{name}: {' '.join(str(message).split())}", file=sys.stderr)

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", module=r"(?!unitouch_gen\b)")
        warnings.simplefilter("always", UnfamiliarInputWarning)
        warnings.showwarning = show  # type: ignore[assignment]
        yield


def describe(value: Any) -> str:
    """A short, safe description of what a user passed."""
    if isinstance(value, Real | str) or value is None:
        try:
            text = str(value) if isinstance(value, Real) else repr(value)
        except ValueError:  # Python writes no integers of thousands of digits
            return "a number of thousands of digits"
        return text if len(text) <= 80 else f"{text[:37]}...{text[-40:]}"
    if isinstance(value, type):
        return f"the class {value.__name__}"
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        kind = "a tensor" if hasattr(value, "layout") else "an array"
        return f"{kind} of shape {tuple(value.shape)} and dtype {str(value.dtype).removeprefix('torch.')}"
    if isinstance(value, list | tuple):
        return f"a {type(value).__name__} of {len(value)}"
    return f"a {type(value).__name__}"


def first_line(error: BaseException) -> str:
    """The first line of what an error says, or its kind where it says nothing."""
    return str(error).strip().partition("\n")[0] or type(error).__name__


def needed(module: str, extra: str = "train") -> Any:
    """Imports a module of an extra.

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
    if whole and low <= value and (high is None or value <= high):
        return int(value)
    span = f" of at least {low}" if high is None else f" from {low} to {high}"
    error = InvalidInputError if whole else InvalidTypeError
    raise error(f"`{name}` is {describe(value)}; it has to be an integer{span}. {hint}".strip())


def check_number(name: str, value: Any, low: float = -math.inf, high: float = math.inf, *, hint: str = "") -> float:
    """`value` as a finite float within [low, high].

    Raises:
        InvalidTypeError: If it is no real number.
        InvalidInputError: If it is NaN, infinite or out of range.
    """
    span = " of at least {low:g}" if high == math.inf else " from {low:g} to {high:g}"
    span = "" if low == -math.inf else span.format(low=low, high=high)
    if isinstance(value, bool) or not isinstance(value, Real):
        raise InvalidTypeError(f"`{name}` is {describe(value)}; it has to be a number{span}. {hint}".strip())
    try:
        number = float(value)
    except OverflowError:  # of integers and fractions
        number = math.inf
    if not math.isfinite(number) or not low <= number <= high:
        raise InvalidInputError(f"`{name}` is {describe(value)}; it has to be a finite number{span}. {hint}".strip())
    return number


def check_flag(name: str, value: Any) -> bool:
    """`value`, if it is a boolean; "no" would count as true.

    Raises:
        InvalidTypeError: Otherwise.
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
        raise InvalidTypeError(f"`{name}` is {describe(value)}; it has to be a {known}. {hint}".strip())
    return value


def check_texts(name: str, value: Any) -> list[str]:
    """A string, or each of a list of them, as a list.

    Raises:
        InvalidTypeError: If it is something else.
        InvalidInputError: If there is none, or one cannot be written in UTF-8.
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
                f"`{name}` is {describe(text)}, which is no Unicode; decode it as UTF-8."
            ) from error
    return list(texts)


def check_choice(name: str, value: Any, choices: Iterable[str], *, hint: str = "") -> str:
    """`value`, if it is one of `choices`.

    Raises:
        InvalidInputError: Otherwise; the message lists the choices, and the one that was likely meant.
    """
    choices = list(choices)
    if isinstance(value, str) and value in choices:
        return value
    raise InvalidInputError(
        f"`{name}` is {describe(value)}; it has to be one of {', '.join(map(repr, choices))}. "
        f"{did_you_mean(value, choices)} {hint}".strip()
    )


def did_you_mean(value: Any, choices: Iterable[str]) -> str:
    """ "Did you mean ...?" with the choice that `value` is likely a misspelling of; empty if there is none."""
    if not isinstance(value, str):
        return ""
    spelled = {choice.casefold(): choice for choice in choices}
    # "huen" and "heun" have a ratio of 0.75; "gelslim" and "gelsight", two sensors, of 0.67.
    nearest = get_close_matches(value.casefold(), spelled, n=1, cutoff=0.75)
    return f"Did you mean {spelled[nearest[0]]!r}?" if nearest else ""


FLOATS = ("float32", "float16", "bfloat16", "float64")
INTEGERS = tuple(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64))


def check_finite(name: str, tensor: "torch.Tensor") -> "torch.Tensor":
    """`tensor`, if all of it is finite.

    Raises:
        InvalidInputError: Otherwise, with the number of offending values.
    """
    if bad := int((~tensor.isfinite()).sum()):
        raise InvalidInputError(
            f"`{name}` holds {bad} of {tensor.numel()} values that are NaN or infinite; pass finite values only."
        )
    return tensor


def check_tensor(
    name: str, value: Any, *shape: int | str, integers: bool = False, finite: bool = True, hint: str = ""
) -> "torch.Tensor":
    """`value`, if it is a dense tensor of finite floating-point numbers of some shape.

    Args:
        shape: Sizes; a letter stands for any of at least 1, everywhere the same one: "B", 3, "S", "S".
        integers: Whether it has to hold integers instead.
        finite: Whether to look at the values.

    Raises:
        InvalidTypeError: If it is something else, or holds other numbers.
        InvalidInputError: If its shape does not fit, or a value is NaN or infinite.
    """
    import torch

    form = f"a tensor ({', '.join(map(str, shape))}{',' * (len(shape) == 1)})"
    if not isinstance(value, torch.Tensor):
        raise InvalidTypeError(f"`{name}` is {describe(value)}; it has to be {form}. {hint}".strip())
    check_dense(name, value, INTEGERS if integers else FLOATS)
    sizes: dict[Any, int] = {}
    for wanted, size in zip(shape, value.shape, strict=False):
        if isinstance(wanted, str):
            sizes.setdefault(wanted, max(size, 1))
    if tuple(value.shape) != tuple(sizes.get(wanted, wanted) for wanted in shape):
        raise InvalidInputError(f"`{name}` is {describe(value)}; it has to be {form}. {hint}".strip())
    return check_finite(name, value) if finite else value


def check_dense(name: str, tensor: "torch.Tensor", dtypes: Sequence[str]) -> None:
    """Raises `InvalidTypeError` if a tensor is sparse, nested, quantised, on the meta device, or of other dtypes."""
    dense = str(tensor.layout) == "torch.strided" and not (tensor.is_nested or tensor.is_meta or tensor.is_quantized)
    if not dense or str(tensor.dtype).removeprefix("torch.") not in dtypes:
        what = f"a {tensor.layout} tensor" if not dense else describe(tensor)
        raise InvalidTypeError(f"`{name}` is {what}; it has to be dense, with one of the dtypes {', '.join(dtypes)}.")


def check_dtype(name: str, value: Any) -> "torch.dtype":
    """A dtype for weights, or its name, as a dtype.

    Raises:
        InvalidInputError, InvalidTypeError: If it is none of float32, float16, bfloat16 and float64.
    """
    import torch

    if isinstance(value, str):
        return getattr(torch, check_choice(name, value.removeprefix("torch."), FLOATS))
    if not isinstance(value, torch.dtype) or str(value).removeprefix("torch.") not in FLOATS:
        what = value if isinstance(value, torch.dtype) else describe(value)
        raise InvalidTypeError(f"`{name}` is {what}; pass torch.float32 or torch.bfloat16, for example.")
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
        raise InvalidInputError(f'`{name}` is {describe(value)}; pass "cpu" or "cuda".') from error
    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as error:  # by the kind, and by its number
        raise InvalidInputError(f"`{name}` is {str(device)!r}, and torch finds none here; leave it out.") from error
    return device
