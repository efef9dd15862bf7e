"""What becomes of files: cut, emptied, replaced by something else, or by what has no end."""

import json
import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

Damage = Callable[[Path], Any]


def replaced(file: Path, make: Damage) -> None:
    file.unlink()
    make(file)


ANY: dict[str, Damage] = {
    "cut": lambda file: file.write_bytes(file.read_bytes()[: file.stat().st_size // 2]),
    "empty": lambda file: file.write_bytes(b""),
    "noise": lambda file: file.write_bytes(bytes(range(256)) * 8),
    "zeros": lambda file: file.write_bytes(bytes(1000)),
    "a page": lambda file: file.write_bytes(b"<html>404</html>"),
    "a folder": lambda file: replaced(file, Path.mkdir),
    "endless": lambda file: replaced(file, lambda file: file.symlink_to("/dev/zero")),
    "a pipe": lambda file: replaced(file, os.mkfifo),
    "a loop": lambda file: replaced(file, lambda file: file.symlink_to(file)),
}
"""Of files that are needed, of any kind."""

WEIGHTS: dict[str, Damage] = {
    **ANY,
    "missing": Path.unlink,
    "cut to its length": lambda file: file.write_bytes(file.read_bytes()[:8]),
    "a header of exabytes": lambda file: file.write_bytes(struct.pack("<Q", 2**62) + b"{}"),
}

SETTINGS: dict[str, Damage] = {
    **ANY,
    "a list": lambda file: file.write_text("[1]"),
    "deep": lambda file: file.write_text("[" * 100_000),
    "an integer of thousands of digits": lambda file: file.write_text(f'{{"a": {"9" * 5000}}}'),
    "no UTF-8": lambda file: file.write_bytes(b'{"a": "\xff"}'),
}


def claim(**changes: Any) -> Damage:
    """Other settings in a JSON file, `section__key` in one of its sections."""

    def change(file: Path) -> None:
        settings = json.loads(file.read_text())
        for name, value in changes.items():
            *sections, key = name.split("__")
            inner = settings
            for section in sections:
                inner = inner[section]
            inner[key] = value
        file.write_text(json.dumps(settings))

    return change
