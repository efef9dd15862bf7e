"""Error types, and checks of arguments.

A value of a wrong type raises `InvalidTypeError`. Any other value that cannot be used raises `InvalidInputError`. The
message names the argument, its value, and what to do. A check that returns something returns the checked value.
"""

import math
import os
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence, Sized
from contextlib import contextmanager
from difflib import get_close_matches
from importlib import import_module
from numbers import Integral, Real
from types import NoneType
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:  # importing torch takes seconds, and the command line checks its arguments before
    import torch
    from pydantic import BaseModel

    Model = TypeVar("Model", bound=BaseModel)


class InvalidInputError(ValueError):
    """A value that cannot be used."""


class InvalidTypeError(TypeError):
    """A value of a type that cannot be used."""


class NonFiniteError(ArithmeticError):
    """A computation left the range of floating-point numbers; the message says at which step and in which sample."""


class NotConvergedError(ArithmeticError):
    """A computation did not reach its tolerance within its evaluations."""


class UnfamiliarInputWarning(UserWarning):
    """A touch is out of distribution, or a recording may show no touch, so the result is a guess."""


def describe(value: Any) -> str:
    """A short, safe description of a user's value."""
    if value is None or isinstance(value, Real | str | type):
        text = str(value) if isinstance(value, Real) else repr(value)
        return text if len(text) <= 80 else f"{text[:37]}...{text[-40:]}"
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        kind = "a tensor" if hasattr(value, "layout") else "an array"
        return f"{kind} of shape {tuple(value.shape)} and dtype {str(value.dtype).removeprefix('torch.')}"
    if isinstance(value, list | tuple):
        return f"a {type(value).__name__} of {len(value)}"
    return f"a {type(value).__name__}"


def first_line(error: BaseException) -> str:
    """The first line of an error's message, or its class if the message is empty."""
    return str(error).strip().partition("\n")[0] or type(error).__name__


@contextmanager
def explain_errors(problem: str, advice: str, *kinds: type[Exception]) -> Iterator[None]:
    """Turns errors of some kinds into an `InvalidInputError`: "problem (first line of the error); advice."

    An `InvalidInputError` stays as it is.
    """
    try:
        yield
    except InvalidInputError:
        raise
    except kinds as error:
        why = getattr(error, "strerror", None) or first_line(error).rstrip(".")
        raise InvalidInputError(f"{problem} ({why}); {advice}.") from error


def import_optional(module: str, extra: str = "train") -> Any:
    """Imports a module of another package; if it is missing, the error names the extra that installs it."""
    try:
        return import_module(module)
    except ImportError as error:
        missing = isinstance(error, ModuleNotFoundError) and error.name == module
        why = "is missing" if missing else f"cannot be imported ({first_line(error)})"
        raise InvalidInputError(f'`{module}` {why}: pip install "unitouch_gen[{extra}]"') from error


def did_you_mean(value: Any, choices: Iterable[str]) -> str:
    """A hint with the choice that `value` is likely a misspelling of; empty if there is none."""
    originals = {choice.casefold(): choice for choice in choices}
    # "huen" and "heun" have a ratio of 0.75; "gelslim" and "gelsight", two sensors, of 0.67.
    nearest = get_close_matches(str(value).casefold(), originals, n=1, cutoff=0.75)
    return f"Did you mean {originals[nearest[0]]!r}?" if nearest else ""


def check_arguments(of: str, names: Iterable[str], known: Collection[str]) -> None:
    """Raises if a name is no argument of a function, which would ignore it. Private names of libraries pass."""
    for name in names:
        if name not in known and not name.startswith("_"):
            raise InvalidTypeError(f"`{name}` is no argument of {of}. {did_you_mean(name, known)}".strip())


def check_kind(name: str, value: Any, *kinds: Any) -> Any:
    """An instance of one of `kinds`."""
    if not isinstance(value, kinds):
        classes = " or ".join("None" if kind is NoneType else kind.__name__ for kind in kinds)
        raise InvalidTypeError(f"`{name}` is {describe(value)}; it has to be a {classes}.")
    return value


def check_integer(name: str, value: Any, low: int, high: float = math.inf) -> int:
    """An integer from `low` to `high`, as an int. Booleans are not integers here."""
    check_number(name, value, low, high, kind=Integral)
    return int(value)


def check_number(name: str, value: Any, low: float = -math.inf, high: float = math.inf, *, kind: Any = Real) -> float:
    """A finite number of a kind from `low` to `high`, as a float. Booleans are not numbers here."""
    if isinstance(value, bool) or not isinstance(value, kind):
        wanted = "an integer" if kind is Integral else "a number"
        raise InvalidTypeError(f"`{name}` is {describe(value)}; it has to be {wanted}.")
    try:
        fits = math.isfinite(value) and low <= value <= high
    except OverflowError:  # raised by integers beyond the range of floats
        fits = False
    if not fits:
        raise InvalidInputError(f"`{name}` is {describe(value)}; it has to be a number from {low:g} to {high:g}.")
    return float(value)


def check_multiple(name: str, value: int, factor: int, of: str = "") -> None:
    """Raises unless an integer is a multiple of a factor; `of` says what the factor is."""
    if value % factor:
        raise InvalidInputError(f"`{name}` is {value}; it has to be a multiple of {of or factor}.")


def plain_integer(value: Any) -> Any:
    """An integer of any library as an int; any other value as it is."""
    return int(value) if isinstance(value, Integral) and not isinstance(value, bool) else value


def check_fields(model: "type[Model]", values: Any, whole: str = "arguments") -> "Model":
    """Values as a pydantic model; raises on the first that is missing, of a wrong kind, or out of bounds.

    `whole` is what the values are together, in messages.
    """
    from pydantic import ValidationError

    try:
        return model.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(map(str, first["loc"])) or whole
        context = first.get("ctx", {})
        if "error" in context:  # raised by a validator of the package
            raise InvalidInputError(f"In `{name}`, {context['error']}") from error
        if first["type"] == "missing":
            raise InvalidInputError(f"`{name}` is missing in the {whole}; set it.") from error
        wanted = first["msg"].replace("Input should", "it has to")
        wanted = wanted.replace("greater than or equal to", "at least").replace("less than or equal to", "at most")
        choices = re.findall(r"'([^']*)'", str(context.get("expected", "")))
        value = first["input"]
        message = f"`{name}` is {describe(value)}; {wanted}. {did_you_mean(value, choices)}".strip()
        wrong_kind = first["type"].endswith("_type")
        raise (InvalidTypeError if wrong_kind else InvalidInputError)(message) from error


def check_texts(name: str, value: Any, *, blank: bool = True, repeated: bool = True) -> list[str]:
    """A string, or a list of at least one string, as a list.

    Raises if a string cannot be encoded in UTF-8. Without `blank`, none may be blank; without `repeated`, each has to
    be different.
    """
    texts = [value] if isinstance(value, str) else value
    if not isinstance(texts, list | tuple) or not all(isinstance(text, str) for text in texts):
        raise InvalidTypeError(f"`{name}` is {describe(value)}; it has to be a string or a list of strings.")
    wanted = ""
    if not texts:
        wanted = "pass at least one string"
    elif any("\ud800" <= letter <= "\udfff" for letter in "".join(texts)):  # from bytes in another encoding
        wanted = "pass texts in UTF-8"
    elif not blank and not all(text.strip() for text in texts):
        wanted = "pass texts that are not blank"
    elif not repeated and len(set(texts)) < len(texts):
        wanted = "pass each of them once"
    if wanted:
        raise InvalidInputError(f"`{name}` is {describe(value)}; {wanted}.")
    return list(texts)


def check_choice(name: str, value: Any, choices: Iterable[str], *, hint: str = "") -> str:
    """One of `choices`; the message lists them and hints at the one that was likely meant."""
    choices = list(choices)
    if isinstance(value, str) and value in choices:
        return value
    wanted = f"it has to be one of {', '.join(map(repr, choices))}. {did_you_mean(value, choices)} {hint}"
    raise InvalidInputError(f"`{name}` is {describe(value)}; {wanted}".strip())


def is_lfs_pointer(path: str | os.PathLike) -> bool:
    """Whether a file is a Git LFS pointer to a file that was not fetched."""
    start = b"version https://git-lfs.github.com/spec/"
    with open(path, "rb") as stream:
        return stream.read(len(start)) == start


def check_file(name: str, path: str | os.PathLike, what: str) -> None:
    """Raises `InvalidInputError` if `what`, such as "an image file", cannot be opened or is a Git LFS pointer."""
    subject = f"`{name}` names {str(path)[:400]!r}, which"
    wanted = f"pass the path of {what}"
    why = ""
    if os.path.isfile(path):  # unlike Path.is_file, False for a name that is too long
        with explain_errors(f"{subject} cannot be opened", wanted, OSError):
            if is_lfs_pointer(path):
                why = "is a Git LFS pointer"
                wanted = "run `git lfs pull` in its repository"
    elif os.path.isdir(path):
        why = "is a folder"
    elif os.path.exists(path):
        why = "is not a regular file"
    else:
        why = "does not exist"
    if why:
        raise InvalidInputError(f"{subject} {why}; {wanted}.")


def check_count(name: str, count: int, inputs: int) -> None:
    """Raises unless there is one for all of the inputs, or one for each."""
    if count not in (1, inputs):
        raise InvalidInputError(f"`{name}` holds {count} for {inputs} inputs; pass one, or one each.")


def one_each(name: str, values: Sequence[Any], inputs: int) -> list[Any]:
    """A list with one of the values for each input; a single value serves all of them."""
    check_count(name, len(values), inputs)
    return [*values] * inputs if len(values) == 1 else [*values]


def check_not_empty(name: str, values: Sized) -> None:
    """Raises if a list is empty."""
    if len(values) == 0:
        raise InvalidInputError(f"`{name}` is an empty list; pass at least one.")


def check_equal(name: str, what: str, value: Any, expected: Any, why: str) -> None:
    """Raises unless a property of an argument, such as its "width", is as expected; `why` says what expects it."""
    if value != expected:
        raise InvalidInputError(f"`{name}` has {what} {describe(value)}; it has to be {describe(expected)}, {why}.")


def check_passed(arguments: Mapping[str, Any], *, only_one: bool = False) -> dict[str, Any]:
    """Those of the arguments that are not `None`; raises if all are, or with `only_one` if more than one is not."""
    passed = {name: value for name, value in arguments.items() if value is not None}
    if not passed or (only_one and len(passed) > 1):
        names = ", ".join(f"`{name}`" for name in arguments)
        wanted = "exactly" if only_one else "at least"
        given = f"{len(passed)} were passed" if passed else "none was passed"
        raise InvalidInputError(f"Pass {wanted} one of {names}; {given}.")
    return passed


def check_unused(where: str, **arguments: Any) -> None:
    """Raises if one of the arguments is not `None`: it has no effect `where`, such as "with `touch_embeds`".

    Pass `value or None` for an argument whose default is False or 0.
    """
    for name, value in arguments.items():
        if value is not None:
            raise InvalidInputError(f"`{name}` is {describe(value)}, but has no effect {where}; leave it out.")


def check_finite(name: str, tensor: "torch.Tensor") -> "torch.Tensor":
    """A tensor of finite values; the message counts the others."""
    not_finite = int((~tensor.isfinite()).sum())
    if not_finite:
        counts = f"{not_finite} of {tensor.numel()} values"
        raise InvalidInputError(f"`{name}` holds {counts} that are NaN or infinite; pass finite ones.")
    return tensor


def check_tensor(name: str, value: Any, *shape: int | str, finite: bool = True) -> "torch.Tensor":
    """A dense tensor of floating-point numbers of a shape, in which a letter stands for any size of at least 1."""
    import torch

    sizes = ", ".join(map(str, shape))
    message = f"`{name}` is {describe(value)}; it has to be a dense floating-point tensor ({sizes})."
    is_dense = isinstance(value, torch.Tensor) and value.layout == torch.strided and not value.is_meta
    if not is_dense or not value.is_floating_point():
        raise InvalidTypeError(message)
    fits = [size >= 1 if isinstance(wanted, str) else size == wanted for wanted, size in zip(shape, value.shape)]
    if len(shape) != value.ndim or not all(fits):
        raise InvalidInputError(message)
    return check_finite(name, value) if finite else value


def check_dtype(name: str, value: Any) -> "torch.dtype":
    """A dtype for weights, from a dtype or its name."""
    import torch

    names = ("float32", "float16", "bfloat16", "float64")
    return getattr(torch, check_choice(name, str(value).removeprefix("torch."), names))
