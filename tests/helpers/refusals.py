"""What a refusal has to be: an error of the package's own class, in one line that names the argument and what came."""

import re
from collections.abc import Callable
from typing import Any

import pytest

from unitouch_gen.errors import InvalidInputError, InvalidTypeError


def what_came(value: Any) -> str:
    """How a message has to show a value: numbers and texts as they are, as far as they are short; others by no rule."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        return str(value)[:37]
    return value.strip()[:37] if isinstance(value, str) and value.isprintable() else ""


def check_refusal(
    call: Callable[[], Any], name: str | None, *patterns: str, kind: type[Exception] | None = None, given: Any = None
) -> str:
    """Holds a call to a refusal, and returns its message.

    Args:
        call: What has to be refused.
        name: The argument that the message has to name, alone or among others; `None` if it names a file alone.
        patterns: Regular expressions that the message has to match: a reason, or a way out.
        kind: The error's class; either of the package's two if left out.
        given: The argument's value, which the message has to show if it is a number or a text.
    """
    with pytest.raises((InvalidInputError, InvalidTypeError)) as caught:
        call()
    message = str(caught.value)
    assert kind in (None, type(caught.value)), message
    assert "\n" not in message
    if name is not None:
        named = rf"`([\w.]+[,:] )?{re.escape(name)}(\[[^`]*\])?(, \w+)?`"
        assert re.search(named, message), f"`{name}` is not named: {message}"
    assert what_came(given) in message, f"{given!r} is not shown: {message}"
    for pattern in patterns:
        assert re.search(pattern, message), f"{pattern!r} is not said: {message}"
    return message
