"""A folder of one's own: with a table, or with folders that are named by materials.

    labels.csv       touch,picture,background,sensor,material,object,recording,caption,sound,split, and further labels
    a.jpg, ...       named in the table

    train/wood/a.jpg, ...      or wood/a.jpg without splits, or a.jpg without materials
    touch/..., picture/..., background/...      trees of the same names, with any endings; background.png is that of all
                                                in its folder

A table needs `touch` alone: a column, or a pattern over the other columns, such as {clip}_peak.jpg.
"""

import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from unitouch_gen.errors import InvalidInputError, first_of
from unitouch_gen.files import natural
from unitouch_gen.training.data.frames import Frame
from unitouch_gen.training.data.reading import column_of, found, images_below, images_in, read_table
from unitouch_gen.training.data.records import MATERIAL, Record, RecordSet, SplitBy

LOOKS_LIKE = ()
FILES = ("touch", "picture", "background", "sound")
TEXTS = ("id", "sensor", "object", "recording", "caption", "split")
SPLITS = ("train", "val", "test")
TOUCH = ("touch", "tactile", "file", "filename", "path", "image")
"""Names of the column of touches."""

TREES = ("picture", "background")
NO_TOUCHES = {"background", "camera", "image", "images", "photo", "photos", "picture", "pictures", "rgb", "vision"}
"""Names of folders that hardly hold touches."""

UNLABELLED = ("", "-1")


def read(folder: Path, patterns: Mapping[str, str] | None = None) -> RecordSet:
    """What its table names, or the images in it."""
    tables = found(folder, "*.csv")
    if len(tables) > 1:
        raise InvalidInputError(
            f"{str(folder)!r} holds {len(tables)} tables, {first_of([t.name for t in tables])}; leave one."
        )
    return read_rows(folder, tables[0], patterns or {}) if tables else read_tree(folder)


def read_rows(folder: Path, table: Path, patterns: Mapping[str, str]) -> RecordSet:
    rows = read_table(table)
    names = list(rows[0])
    sources = {name: f"{{{name}}}" for name in FILES if name in names} | dict(patterns)
    if "touch" not in sources:
        sources["touch"] = f"{{{column_of(table, names, TOUCH)}}}"
    used = {name for name in names if any(f"{{{name}}}" in pattern for pattern in sources.values())}
    labels = [name for name in names if name not in (*FILES, *TEXTS) and (name == MATERIAL or name not in used)]
    numbers = {name: numbers_of(table, name, {row[name] for row in rows}) for name in labels}
    records, missing = [], []
    for row in rows:
        try:
            paths = {name: pattern.format(**row) for name, pattern in sources.items()}
        except (LookupError, ValueError) as error:
            raise InvalidInputError(f"`patterns` is {patterns}; the columns of {table.name} are {names}.") from error
        files = {name: folder / path for name, path in paths.items() if path}
        missing += [str(file) for file in files.values() if not file.is_file()]
        known: dict[str, Any] = {"id": paths["touch"]} | {name: row[name] or None for name in TEXTS if name in row}
        known |= {name: str(file) if name == "sound" else Frame(str(file)) for name, file in files.items()}
        known["labels"] = {name: numbers[name][row[name]] for name in labels if row[name] not in UNLABELLED}
        records.append(Record(**known))
    others = {record.split for record in records} - {None, *SPLITS}
    if missing or others:
        wrong = (
            f"files that are not there: {first_of(missing, ', ')}"
            if missing
            else f"splits other than {SPLITS}: {others}"
        )
        raise InvalidInputError(f"{str(table)!r} names {wrong}.")
    classes = {name: names_of(numbers[name]) for name in labels}
    apart: SplitBy = "object" if "object" in names else "recording" if "recording" in names else "none"
    return RecordSet(folder.name, "folder", tuple(records), classes, apart=apart)


def numbers_of(table: Path, name: str, values: Iterable[str]) -> dict[str, int]:
    """The number of each class in a column: numbers as they are, names in alphabetical order."""
    known = sorted(set(values) - set(UNLABELLED))
    if not all(re.fullmatch(r"-?\d+", value) for value in known):
        return {value: number for number, value in enumerate(known)}
    wrong = [value for value in known if not 0 <= int(value) <= 10 * len(known)]
    if wrong:
        raise InvalidInputError(
            f"{str(table)!r} has {name} {first_of(wrong, ', ')}; number classes from 0, unknown ones -1."
        )
    return {value: int(value) for value in known}


def names_of(numbers: Mapping[str, int]) -> tuple[str, ...]:
    """Names of classes by their numbers."""
    names = {number: name for name, number in numbers.items()}
    return tuple(names.get(number, str(number)) for number in range(max(names, default=-1) + 1))


def read_tree(folder: Path) -> RecordSet:
    root = folder / "touch" if (folder / "touch").is_dir() else folder
    parts = [part for part in SPLITS if (root / part).is_dir()] or [""]
    places = [place for part in parts for place in (root / part, *filter(Path.is_dir, found(root / part, "*")))]
    materials = sorted({place.name for place in places if place not in [root / part for part in parts]})
    records, used = [], set[Path]()
    for place in places:
        images = images_in(place)
        general = next((image for image in images if image.stem == "background"), None)
        below = {tree: images_in(folder / tree / place.relative_to(root)) if root != folder else [] for tree in TREES}
        beside = {tree: {other.stem: other for other in others} | {other.name: other for other in others}
                  for tree, others in below.items()}  # fmt: skip
        for image in images:
            if image == general:
                continue
            name = image.relative_to(root)
            picture, background = (beside[tree].get(image.name, beside[tree].get(image.stem)) for tree in TREES)
            used |= {picture} if picture else set()
            background = background or general
            records.append(
                Record(
                    id=name.as_posix(),
                    touch=Frame(str(image)),
                    picture=None if picture is None else Frame(str(picture)),
                    background=None if background is None else Frame(str(background)),
                    labels={MATERIAL: materials.index(place.name)} if place.name in materials else {},
                    split=name.parts[0] if parts != [""] else None,
                )
            )
    if not records:
        folders = [place.name for place in places if place != root]
        raise InvalidInputError(f"It has no table and no images, but the folders {first_of(folders, ', ') or 'none'}.")
    notes = tuple(unread(folder, used) if root != folder else taken_for_touches(materials))
    return RecordSet(folder.name, "folder", tuple(records), {MATERIAL: tuple(materials)}, apart="none", notes=notes)


def unread(folder: Path, used: Iterable[Path]) -> Iterator[str]:
    """What lies beside a folder `touch` and is not read, in words."""
    pictures = images_below(folder / "picture")
    if left := sorted(set(pictures) - set(used), key=natural):
        names = [file.relative_to(folder).as_posix() for file in left]
        yield f"{len(left)} of {len(pictures)} pictures have no touch of their name and are not read: {first_of(names)}"
    places = [place for place in found(folder, "*") if place.is_dir() and place.name not in ("touch", *TREES)]
    if names := [place.name for place in places if images_below(place)]:
        yield f"Its folders {first_of(names, ', ')} are not read; photos of what is touched go into a folder picture"


def taken_for_touches(materials: Iterable[str]) -> Iterator[str]:
    """Folders whose images are taken for touches, though their names say something else, in words."""
    if names := [name for name in materials if name.lower() in NO_TOUCHES]:
        yield (
            f"The images in {first_of(names, ', ')} are taken for touches; if they are none, put touches into a folder "
            "touch, and photos into picture"
        )
