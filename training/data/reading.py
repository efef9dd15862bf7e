"""What the layouts of data sets have in common: folders of images, lists and tables."""

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from PIL import Image

from unitouch_gen.errors import InvalidInputError, did_you_mean, first_of
from unitouch_gen.files import natural
from unitouch_gen.training.data.frames import Frame

IMAGES = frozenset(Image.registered_extensions()) - {".pdf", ".mpg", ".mpeg", ".h5", ".hdf"}
"""Suffixes of files that Pillow reads as images."""


def images_in(folder: Path) -> list[Path]:
    """The images in a folder, in natural order; none where there is no folder."""
    return [file for file in found(folder, "*") if file.suffix.lower() in IMAGES]


def images_below(folder: Path) -> list[Path]:
    """The images in a folder and in those below it."""
    return [file for file in found(folder, "**/*") if file.suffix.lower() in IMAGES]


def found(folder: Path, *patterns: str) -> list[Path]:
    """What patterns find in a folder, in natural order, without hidden files."""
    paths = {path for pattern in patterns for path in folder.glob(pattern) if not path.name.startswith(".")}
    return sorted(paths, key=natural)


def beside(*parts: str | Path) -> Path | None:
    """A file, if it is there."""
    file = Path(*parts)
    return file if file.is_file() else None


def frame_at(*parts: str | Path) -> Frame | None:
    """An image file, if it is there."""
    file = beside(*parts)
    return None if file is None else Frame(str(file))


def read_text(file: Path) -> str:
    """A text in UTF-8."""
    try:
        return file.read_text(encoding="utf-8-sig")
    except (UnicodeDecodeError, OSError) as error:
        why = "it is not in UTF-8; save it as UTF-8" if isinstance(error, UnicodeDecodeError) else error.strerror
        raise InvalidInputError(f"{str(file)!r} cannot be read as a text: {why}.") from error


def read_table(file: Path, header: Sequence[str] | None = None) -> list[dict[str, str]]:
    """The rows of a table with columns parted by commas, semicolons or tabs, by the names in its first line, if any."""
    text = read_text(file)
    delimiter = max(",;\t", key=text.partition("\n")[0].count)
    lines = [line for line in csv.reader(io.StringIO(text), delimiter=delimiter) if any(map(str.strip, line))]
    names = list(header) if header else [name.strip().lower() for name in lines.pop(0)] if lines else []
    odd = [str(number) for number, line in enumerate(lines, start=1) if len(line) != len(names)]
    if not lines or len(set(names)) < len(names) or odd:
        wrong = f"other columns in row {first_of(odd, ', ')}; quote texts that hold commas" if odd else "no rows"
        raise InvalidInputError(
            f"{str(file)!r} has the columns {names}, and {wrong if odd or not lines else 'two of one name'}."
        )
    return [dict(zip(names, map(str.strip, line), strict=True)) for line in lines]


def column_of(file: Path, names: Iterable[str], known: Sequence[str]) -> str:
    """The one of `known` that is a column of a table."""
    names = list(names)
    for name in known:
        if name in names:
            return name
    hint = next(filter(None, (did_you_mean(name, known) for name in names)), "")
    raise InvalidInputError(
        f"{str(file)!r} has the columns {names}, and none of {', '.join(map(repr, known))}. {hint}".rstrip()
    )


def integer(text: Any, what: str) -> int:
    """A whole number; `what` it is, for the message."""
    try:
        return int(text)
    except (TypeError, ValueError) as error:
        raise InvalidInputError(f"{what} is {text!r}; it has to be a whole number.") from error
