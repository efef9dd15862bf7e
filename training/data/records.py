"""Records, each a touch with all that is known of it, and what layouts of data sets read them with."""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from PIL import Image

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.files import natural
from unitouch_gen.training.data.frames import Frame

IMAGES = frozenset(Image.registered_extensions()) - {".pdf", ".mpg", ".mpeg", ".h5", ".hdf"}
"""Suffixes of files that Pillow reads as images."""


@dataclass(frozen=True, slots=True)
class Record:
    """One touch with all that is known of it.

    Attributes:
        id: Unique in its data set.
        touch, picture, background: Frames; the background is the gel before the contact.
        sensor: What took the touch.
        object, recording: What records of several splits may not share.
        labels: Numbers of classes by the label's name; layouts yield their names, which `open_dataset` numbers.
        caption: In words.
        sound: A sound file, or a .npy file of samples.
        split: "train", "val" or "test", where the data set says.
    """

    id: str
    touch: Frame
    picture: Frame | None = None
    background: Frame | None = None
    sensor: str | None = None
    object: str | None = None
    recording: str | None = None
    labels: Mapping[str, Any] = field(default_factory=dict)
    caption: str | None = None
    sound: str | None = None
    split: str | None = None

    @property
    def files(self) -> set[str]:
        """Paths of all its files."""
        frames = (self.touch, self.picture, self.background)
        return {frame.path for frame in frames if frame} | ({self.sound} if self.sound else set())


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
