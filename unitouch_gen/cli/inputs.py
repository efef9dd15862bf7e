"""What a command is given to work on: files, folders, patterns, examples, and standard input."""

import atexit
import glob
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from unitouch_gen.errors import InvalidInputError

STDIN = "-"

EXAMPLE = "example:"
"""What stands before the name of an input that comes with the package."""


def files_of(name: str, given: Sequence[str], modality: str) -> list[Path]:
    """The files that words of a command line stand for, in their order.

    A word is the path of a file, of a folder, which stands for the files of the modality in it, a pattern such as
    "touches/**/*.png", "example:brick", or "-", standard input.

    Args:
        name: Of the argument, for the messages.
        given: The words.
        modality: "touch", "image" or "audio".
    """
    return [file for word in given for file in _files(name, word, modality)]


def _files(name: str, word: str, modality: str) -> list[Path]:
    from unitouch_gen.examples import example
    from unitouch_gen.files import check_file, check_no_address, natural

    if word == STDIN:
        return [_standard_input(name)]
    if word.startswith(EXAMPLE):
        return [example(word.removeprefix(EXAMPLE), modality)]
    check_no_address(name, word)
    if os.path.isdir(word):
        from unitouch_gen.files import SOUNDS
        from unitouch_gen.models.videos import VIDEOS
        from unitouch_gen.training.data.reading import IMAGES

        suffixes = {"audio": SOUNDS, "image": IMAGES, "touch": IMAGES | VIDEOS}[modality]
        files = [file for file in Path(word).iterdir() if file.suffix.lower() in suffixes and file.is_file()]
        if not files:
            what = "sounds" if modality == "audio" else "images"
            raise InvalidInputError(f"`{name}` names the folder {word!r}, which holds no {what}; name another.")
        return sorted(files, key=natural)
    if not os.path.lexists(word) and re.search(r"[*?[]", word):
        files = [Path(file) for file in glob.glob(word, recursive=True) if os.path.isfile(file)]
        if not files:
            raise InvalidInputError(f"`{name}` is the pattern {word!r}, which no file matches; look at the folder.")
        return sorted(files, key=natural)
    check_file(name, word, "a sound file" if modality == "audio" else "an image file")  # before anything is imported
    return [Path(word)]


def _standard_input(name: str) -> Path:
    """A file of what comes in on standard input, which goes when the process ends."""
    if sys.stdin.isatty():
        raise InvalidInputError(f"`{name}` is '-', standard input, which is a terminal; lead a file into it.")
    folder = tempfile.TemporaryDirectory(prefix="unitouch-")
    atexit.register(folder.cleanup)
    file = Path(folder.name) / "stdin"
    with file.open("wb") as sink:
        shutil.copyfileobj(sys.stdin.buffer, sink)
    if not file.stat().st_size:
        raise InvalidInputError(f"`{name}` is '-', standard input, which is empty or was read already; name a file.")
    return file


def texts_of(given: Sequence[str]) -> list[str]:
    """Descriptions; "-" stands for the lines of standard input."""
    lines = []
    for word in given:
        if word == STDIN:
            content = _standard_input("--text").read_text(encoding="utf-8", errors="surrogateescape")
            lines += [line for line in content.splitlines() if line.strip()]
        else:
            lines.append(word)
    return lines


def stem_of(value: Path | str) -> str:
    """A name for what is made of an input: that of its file, or the words of a description."""
    if isinstance(value, Path):
        return value.stem
    return re.sub(r"\W+", "-", value.lower())[:LONGEST].strip("-") or "text"


LONGEST = 60
"""Characters of a description that the name of a file has."""
