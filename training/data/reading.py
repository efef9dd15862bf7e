"""What the layouts of data sets have in common: folders of images, optional files, and tables."""

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path

from PIL import Image

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.files import natural
from unitouch_gen.training.data.frames import Frame

IMAGES = frozenset(Image.registered_extensions()) - {".pdf", ".mpg", ".mpeg", ".h5", ".hdf"}
"""Suffixes of files that Pillow reads as images."""


def few(names: Sequence[str]) -> str:
    """The first five of many, and how many more there are."""
    return "; ".join([*names[:5], f"and {len(names) - 5} more"] if len(names) > 5 else names)


def found(folder: Path, *patterns: str) -> list[Path]:
    """What patterns find in a folder, in natural order, without hidden files."""
    paths = {path for pattern in patterns for path in folder.glob(pattern) if not path.name.startswith(".")}
    return sorted(paths, key=natural)


def images_in(folder: Path, pattern: str = "*") -> list[Path]:
    """The images in a folder, in natural order; none where there is no folder."""
    return [file for file in found(folder, pattern) if file.suffix.lower() in IMAGES]


def frame_at(file: Path) -> Frame | None:
    """An image file, if it is there."""
    return Frame(str(file)) if file.is_file() else None


def read_text(file: Path) -> str:
    """A text in UTF-8; nothing where there is no file."""
    try:
        return file.read_text(encoding="utf-8-sig") if file.is_file() else ""
    except UnicodeDecodeError as error:
        raise InvalidInputError(f"{str(file)!r} is not in UTF-8; save it as UTF-8.") from error


def read_table(file: Path, header: Sequence[str] | None = None) -> list[dict[str, str]]:
    """The rows of a table with columns parted by commas, semicolons or tabs, by the names in its first line."""
    text = read_text(file)
    delimiter = max(",;\t", key=text.partition("\n")[0].count)
    cells = [row for row in csv.reader(io.StringIO(text), delimiter=delimiter) if any(map(str.strip, row))]
    names = header or [name.strip().lower() for name in (cells.pop(0) if cells else ())]
    odd = [str(number) for number, row in enumerate(cells, start=1) if len(row) != len(names)]
    if not cells or odd or len(set(names)) < len(names):
        wrong = f"other columns in row {few(odd)}; quote texts that hold commas" if odd else "two of one name"
        raise InvalidInputError(f"{str(file)!r} has the columns {names}, and {wrong if cells else 'no rows'}.")
    return [dict(zip(names, map(str.strip, row), strict=True)) for row in cells]


def column_of(file: Path, columns: Iterable[str], known: Sequence[str]) -> str:
    """The first of `known` that is a column of a table."""
    for name in known:
        if name in columns:
            return name
    raise InvalidInputError(f"{str(file)!r} has the columns {list(columns)}, and none of {', '.join(known)}.")
