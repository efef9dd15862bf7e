"""Data sets: layouts, how a folder is recognised as one of them, and how records are split.

A layout is a module of this folder. It has
- `LOOKS_LIKE`: glob patterns of files that only a folder of this layout holds;
- `read(folder)`: an iterator of records, and of strings, notes to the user on how the folder was read;
- perhaps `CLASSES`: by label, the names of the classes in the order of their numbers. Without it, classes are the names
  that occur, in natural order;
- perhaps `APART`: a `SplitBy`. Without it, splits are kept apart by objects, or by recordings if there are no objects.
"""

import os
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from hashlib import sha256
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import Any, Literal

from unitouch_gen.errors import InvalidInputError, check_choice, check_kind, check_texts, first_line
from unitouch_gen.files import as_path, natural
from unitouch_gen.training.data.records import Record, abbreviate


@cache
def layouts() -> dict[str, Any]:
    """The layouts of this folder, by name. `folder` is for folders that look like no other layout."""
    names = [module.name for module in iter_modules([os.path.dirname(__file__)])]
    modules = {name: import_module(f"unitouch_gen.training.data.{name}") for name in names}
    return {name: module for name, module in modules.items() if hasattr(module, "LOOKS_LIKE")}


SplitBy = Literal["official", "object", "recording", "none"]
"""What the records of two splits never share: the data set's own lists decide, an object, a recording; or no splits."""


@dataclass(frozen=True)
class RecordSet:
    """A data set, or a part of one, with at least one record."""

    name: str  # name of its folder
    kind: str  # the layout it was read as
    records: tuple[Record, ...]
    classes: Mapping[str, tuple[str, ...]]  # names of classes by label, in the order of their numbers
    apart: SplitBy = "object"  # what keeps splits apart, if the data set has no splits of its own
    notes: tuple[str, ...] = ()  # sentences for the user on how it was read
    sampling_rate: int | None = None  # of sounds in .npy files, Hz
    chosen: str = "all"  # which records of the data set these are, in words

    def __post_init__(self) -> None:
        if not self.records:
            raise InvalidInputError(f"{self} has no records.")
        counts = Counter(record.id for record in self.records)
        repeated = [name for name, count in counts.items() if count > 1]
        if repeated:
            raise InvalidInputError(f"{self} has several records of one id: {abbreviate(repeated)}.")

    def __str__(self) -> str:
        return f"Data set {self.name!r} ({self.kind}; {self.chosen})"

    def __len__(self) -> int:
        return len(self.records)

    @property
    def sensor(self) -> str | None:
        """The sensor of its first record; in a part by `by_sensor`, that of all records."""
        return self.records[0].sensor

    @property
    def summary(self) -> dict[str, Any]:
        """The entry of this data set in the record of a training run; `ids` is a hash of the ids of its records."""
        ids = sha256("\n".join(record.id for record in self.records).encode()).hexdigest()[:16]
        return {
            "set": self.name,
            "kind": self.kind,
            "split": self.chosen,
            "sensor": self.sensor,
            "records": len(self),
            "ids": ids,
        }

    def captions(self, variants: int) -> list[list[str]]:
        """The caption of each record, `variants` times."""
        return [[record.caption or ""] * variants for record in self.records]

    def by_sensor(self) -> "list[RecordSet]":
        """A part for each sensor, in the order of their first records."""
        records_of: dict[str | None, list[Record]] = {}
        for record in self.records:
            records_of.setdefault(record.sensor, []).append(record)
        return [replace(self, records=tuple(records)) for records in records_of.values()]

    def split(self, name: str, by: SplitBy | None = None) -> "RecordSet":
        """The records of a split: "train", "val" or "test".

        If `by` is left out, the data set's own splits are taken, or those by `apart` if it has none. Objects and
        recordings are dealt out 8:1:1 by the hash of their names, so that none is in two splits.

        Raises:
            InvalidInputError: If there is no such split, or fewer than three objects or recordings to deal out.
        """
        own_splits = {record.split for record in self.records} - {None}
        by = by or ("official" if own_splits else self.apart)
        if by == "none":
            return replace(self, chosen="all, none held out")
        field = "split" if by == "official" else by
        groups = {getattr(record, field) for record in self.records}
        not_listed = by == "official" and name not in own_splits
        too_few = by != "official" and (None in groups or len(groups) < 3)
        if not_listed or too_few:
            names = abbreviate(sorted(map(str, groups)))
            raise InvalidInputError(
                f"`split` is {by!r}, but {self} has the {field}s {names}, and no {name!r}; pass "
                "another of official, object, recording and none."
            )
        if by == "official":
            kept = {name}
            chosen = f"{name} of the official split"
        else:
            kept = deal_out(groups)[name]
            chosen = f"{name}, {by}s kept apart"
        records = tuple(record for record in self.records if getattr(record, field) in kept)
        return replace(self, chosen=chosen, records=records)


def deal_out(names: Collection[str]) -> dict[str, set[str]]:
    """Names by split, 8:1:1, by their hashes; at least one in "val" and in "test"."""
    order = sorted(names, key=lambda name: sha256(name.encode()).digest())
    tenth = max(round(len(order) / 10), 1)
    return {
        "val": set(order[:tenth]),
        "test": set(order[tenth : 2 * tenth]),
        "train": set(order[2 * tenth :]),
    }


def open_dataset(
    path: str | Path,
    kind: str = "auto",
    *,
    sensor: str | None = None,
    materials: Sequence[str] | None = None,
    sampling_rate: int | None = None,
) -> RecordSet:
    """Lists the records of a data set in the layout it was published in, or of a folder of one's own.

    No image is read.

    Args:
        path: Its folder.
        kind: One of `layouts()`, or "auto" to recognise the layout.
        sensor: Name for the sensor of all touches, in place of the data set's.
        materials: Names for its materials, by their numbers.
        sampling_rate: Of sounds in .npy files, Hz.

    Raises:
        InvalidInputError: If the folder is missing, empty or of no known layout, its lists cannot be used, or files are
            missing, some of which the message names.
    """
    check_choice("kind", kind, ("auto", *layouts()))
    if sensor is not None:
        check_kind("sensor", sensor, str)
    names = None if materials is None else check_texts("materials", materials)
    folder = Path(os.path.realpath(as_path("path", path)))
    if not folder.is_dir() or not any(folder.iterdir()):
        what = "is no folder; unpack it if it is an archive" if folder.is_file() else "is not there or empty"
        raise InvalidInputError(f"`path` is {str(path)!r}, which {what}; name the folder of a data set.")
    read_as = kind
    if kind == "auto":
        recognised = recognise(path, folder)
        kind = recognised or "folder"
        read_as = recognised or "a folder of one's own, as it looks like no data set that is known"
    layout = layouts()[kind]
    try:
        items = list(layout.read(folder))
        records = [item for item in items if isinstance(item, Record)]
        notes = tuple(item for item in items if isinstance(item, str))
        check_files(records)
        classes = class_names(records) | getattr(layout, "CLASSES", {})
        records = [numbered(record, classes, sensor) for record in records]
        if names is not None:
            classes["material"] = renamed(classes.get("material", ()), names)
        return RecordSet(
            folder.name,
            kind,
            tuple(records),
            classes,
            apart=getattr(layout, "APART", default_apart(records)),
            notes=notes,
            sampling_rate=sampling_rate,
        )
    except (OSError, LookupError, ValueError, TypeError, AttributeError) as error:  # if lists hold something else
        reason = f"its lists have no {error}" if isinstance(error, KeyError) else first_line(error)
        raise InvalidInputError(f"`path` is {str(path)!r}, read as {read_as}: {reason}") from error


def recognise(path: str | Path, folder: Path) -> str | None:
    """The layout that a folder looks like, or `None`; raises if it looks like several."""
    kinds = list[str]()
    for name, layout in layouts().items():
        if any(any(folder.glob(pattern)) for pattern in layout.LOOKS_LIKE):
            kinds.append(name)
    if len(kinds) > 1:
        raise InvalidInputError(f"`path` is {str(path)!r}, which looks like {' and '.join(kinds)}; say its `kind`.")
    return kinds[0] if kinds else None


def check_files(records: Sequence[Record]) -> None:
    """Raises `ValueError` if files of records are missing."""
    files = {file for record in records for file in record.files}
    missing = sorted(file for file in files if not os.path.isfile(file))
    if missing:
        raise ValueError(f"{len(missing)} of {len(files)} files are not there: {abbreviate(missing)}")


def class_names(records: Sequence[Record]) -> dict[str, tuple[str, ...]]:
    """The names of classes that occur, by label, in natural order."""
    pairs = {pair for record in records for pair in record.labels.items()}
    classes: dict[str, tuple[str, ...]] = {}
    for label, name in sorted(pairs, key=lambda pair: natural(pair[1])):
        classes[label] = (*classes.get(label, ()), name)
    return classes


def numbered(record: Record, classes: Mapping[str, tuple[str, ...]], sensor: str | None) -> Record:
    """A record with numbers for the names of its classes, and of another sensor, if one is named."""
    labels = {label: classes[label].index(name) for label, name in record.labels.items()}
    return replace(record, sensor=sensor or record.sensor, labels=labels)


def renamed(materials: Sequence[str], names: Sequence[str]) -> tuple[str, ...]:
    """New names for materials: by the number that a material's name is, or else by its place among them."""
    numbers = list[int]()
    for place, material in enumerate(materials):
        digits = material.removesuffix(".0")  # pandas writes 1 as 1.0 in a column with blanks
        numbers.append(int(digits) if digits.isdecimal() else place)
    if max(numbers, default=-1) >= len(names):
        raise InvalidInputError(f"`materials` names {len(names)} of {max(numbers) + 1}; name each by number.")
    return tuple(names[number] for number in numbers)


def default_apart(records: Sequence[Record]) -> SplitBy:
    """What splits may be kept apart by: objects, else recordings, if any record has one."""
    if any(record.object for record in records):
        return "object"
    return "recording" if any(record.recording for record in records) else "none"
