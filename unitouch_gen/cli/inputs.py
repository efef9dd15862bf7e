"""Inputs of commands: files, folders, patterns, examples, and standard input."""

import atexit
import glob
import os
import re
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from unitouch_gen.errors import InvalidInputError

IMAGES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".gif", ".tif", ".tiff", ".webp"})
SOUNDS = frozenset({".wav", ".flac", ".ogg", ".mp3"})


def suffixes_of(modality: str) -> frozenset[str]:
    """Suffixes of the files in a folder that are taken for "touch", "image" or "audio"."""
    from unitouch_gen.models.videos import VIDEOS

    return {"audio": SOUNDS, "image": IMAGES, "touch": IMAGES | VIDEOS}[modality]


def files_of(name: str, words: Sequence[str], modality: str) -> list[Path]:
    """The files that words of a command line stand for, in their order.

    A word is the path of a file, of a folder, which stands for the files of the modality in it, a pattern such as
    "touches/**/*.png", "example:brick", or "-", standard input.

    Args:
        name: The argument, for the messages.
        words: As they were typed.
        modality: "touch", "image" or "audio".
    """
    return [file for word in words for file in _files(name, word, modality)]


def _files(name: str, word: str, modality: str) -> list[Path]:
    from unitouch_gen.examples import example
    from unitouch_gen.files import check_file, natural

    if word == "-":
        return [_standard_input(name)]
    if word.startswith("example:"):
        return [example(word.removeprefix("example:"), modality)]
    if os.path.isdir(word):
        suffixes = suffixes_of(modality)
        files = [file for file in Path(word).iterdir() if file.suffix.lower() in suffixes and file.is_file()]
    elif not os.path.lexists(word) and re.search(r"[*?[]", word):
        files = [Path(file) for file in glob.glob(word, recursive=True) if os.path.isfile(file)]
    else:
        check_file(name, word, "a sound file" if modality == "audio" else "an image file")  # before torch is imported
        return [Path(word)]
    if not files:
        what = "sounds" if modality == "audio" else "images"
        raise InvalidInputError(f"`{name}` is {word!r}, where there are no {what}; name another folder or pattern.")
    return sorted(files, key=natural)


def _standard_input(name: str) -> Path:
    """A file of what comes in on standard input, which goes when the process ends."""
    content = sys.stdin.buffer.read()
    if not content:
        raise InvalidInputError(f"`{name}` is '-', standard input, which is empty or was read already; name a file.")
    folder = tempfile.TemporaryDirectory(prefix="unitouch-")
    atexit.register(folder.cleanup)
    file = Path(folder.name) / "stdin"
    file.write_bytes(content)
    return file


def check_readable(processor: Any, inputs: Mapping[str, Any]) -> None:
    """Reads the inputs of a picture, so that one that cannot be used does not end the work of hours."""
    read = {"touch": processor.touch, "image": processor.images, "audio": processor.sounds, "text": processor.text}
    for modality in read.keys() & inputs.keys():
        read[modality](inputs[modality])


def stem_of(value: Path | str) -> str:
    """A name for what is made of an input: that of its file, or the first words of a description."""
    if isinstance(value, Path):
        return value.stem
    return re.sub(r"\W+", "-", value.lower())[:60].strip("-") or "text"
