"""The examples that commands show in their help."""

import re
import shlex
from collections.abc import Iterator
from typing import Any

import pytest
import typer

from unitouch_gen.cli import commands


def found(command: Any = None, name: str = "unitouch-gen") -> Iterator[tuple[str, Any]]:
    """Every command, by the words that call it."""
    command = command or typer.main.get_command(commands)
    for word, inner in getattr(command, "commands", {}).items():
        yield from found(inner, f"{name} {word}")
    if not hasattr(command, "commands"):
        yield name, command


COMMANDS = dict(found())


@pytest.mark.parametrize("name", COMMANDS)
def test_each_command_shows_one_that_it_takes(name):
    command = COMMANDS[name]
    (example,) = re.findall(r"Example: (.+)", command.help)
    assert example.startswith(name)
    command.make_context(name, shlex.split(example.removeprefix(name)))
