"""Data sets: which there are, how a folder is recognised as one of them, and how records are split.

A layout is a module of this folder with `LOOKS_LIKE`, patterns of what only such a folder holds, and `read`, which
gives the records of a folder, and strings for what a user should know of how it was read. It may have `CLASSES`, names
of the classes of a label in the order of their numbers, where these are not all that occur, in natural order; and
`APART`, a `SplitBy`, where splits are not kept apart by objects, or else by recordings.
"""

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from hashlib import sha256
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import Any, Literal

from unitouch_gen.errors import InvalidInputError, check_choice, check_kind, check_texts, first_line
from unitouch_gen.files import as_path, natural
from unitouch_gen.training.data.records import Record, few


@cache
def layouts() -> dict[str, Any]:
    """Modules of this folder that have `LOOKS_LIKE`, by name; `folder` is what no other one is."""
    names = [module.name for module in iter_modules([os.path.dirname(__file__)])]
    modules = {name: import_module(f"unitouch_gen.training.data.{name}") for name in names}
    return {name: module for name, module in modules.items() if hasattr(module, "LOOKS_LIKE")}


SplitBy = Literal["official", "object", "recording", "none"]
"""What keeps the records of splits apart: the data set's own lists, objects, recordings; or nothing, as all train."""


@dataclass(frozen=True)
class RecordSet:
    """A data set, or a part of one, which holds one record at least."""

    name: str  # that of its folder
    kind: str  # the layout it was read as
    records: tuple[Record, ...]
    classes: Mapping[str, tuple[str, ...]]  # names by label, in the order of their numbers
    apart: SplitBy = "object"  # what keeps splits apart where the data set has none of its own
    notes: tuple[str, ...] = ()  # what a user should know of how it was read, in words
    sampling_rate: int | None = None  # of sounds in .npy files, Hz
    chosen: str = "all"  # which of its records these are, in words

    def __post_init__(self) -> None:
        twice = [name for name, count in Counter(record.id for record in self.records).items() if count > 1]
        if not self.records or twice:
            wrong = f"several records of one id: {few(twice)}" if twice else "no records"
            raise InvalidInputError(f"{self} has {wrong}.")

    def __str__(self) -> str:
        return f"Data set {self.name!r} ({self.kind}; {self.chosen})"

    def __len__(self) -> int:
        return len(self.records)

    @property
    def sensor(self) -> str | None:
        """The sensor of its first record: that of all in a part of `by_sensor`."""
        return self.records[0].sensor

    @property
    def summary(self) -> dict[str, Any]:
        """What a training run keeps on record of it; `ids` is a hash of the names of its records."""
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
        """The caption of each record, as many times as asked for."""
        return [[record.caption or ""] * variants for record in self.records]

    def by_sensor(self) -> "list[RecordSet]":
        """A part for each sensor, in the order of their first records."""
        sensors = dict.fromkeys(record.sensor for record in self.records)
        return [replace(self, records=tuple(r for r in self.records if r.sensor == sensor)) for sensor in sensors]

    def split(self, name: str, by: SplitBy | None = None) -> "RecordSet":
        """The records of a split: "train", "val" or "test".

        What keeps splits apart is the data set's own lists, or else `apart`, if `by` is left out. Objects and
        recordings are dealt out 8:1:1 by the hash of their names, so that none is in two splits. Raises
        `InvalidInputError` if there is no such split, or fewer than three of what is to be kept apart.
        """
        own = {record.split for record in self.records} - {None}
        by = by or ("official" if own else self.apart)
        if by == "none":
            return replace(self, chosen="all, none held out")
        of = "split" if by == "official" else by
        groups = {getattr(record, of) for record in self.records}
        if (name not in own) if by == "official" else (None in groups or len(groups) < 3):
            raise InvalidInputError(
                f"`split` is {by!r}, but {self} has the {of}s {few(sorted(map(str, groups)))}, and no {name!r}; pass "
                "another of official, object, recording and none."
            )
        kept = {name}
        chosen = f"{name} of the official split"
        if by != "official":
            order = sorted(groups, key=lambda group: sha256(group.encode()).digest())
            tenth = max(round(len(order) / 10), 1)
            kept = set({"val": order[:tenth], "test": order[tenth : 2 * tenth], "train": order[2 * tenth :]}[name])
            chosen = f"{name}, {by}s kept apart"
        return replace(self, chosen=chosen, records=tuple(r for r in self.records if getattr(r, of) in kept))


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
        kind: One of `layouts()`, or "auto" to see which it is.
        sensor: Name for the sensor of all touches, in place of what the data set says.
        materials: Names for its materials, by their numbers.
        sampling_rate: Of sounds in .npy files, Hz.

    Raises:
        InvalidInputError: If the folder is missing, empty or of no known layout, its lists cannot be used, or files are
            missing, some of which the message names.
    """
    kinds = layouts()
    how = kind
    check_choice("kind", kind, ("auto", *kinds))
    if sensor is not None:
        check_kind("sensor", sensor, str)
    names = None if materials is None else check_texts("materials", materials)
    place = Path(os.path.realpath(as_path("path", path)))
    if not place.is_dir() or not any(place.iterdir()):
        what = "is no folder; unpack it if it is an archive" if place.is_file() else "is not there or empty"
        raise InvalidInputError(f"`path` is {str(path)!r}, which {what}; name the folder of a data set.")
    if kind == "auto":
        known = [name for name, one in kinds.items() if any(any(place.glob(pattern)) for pattern in one.LOOKS_LIKE)]
        if len(known) > 1:
            raise InvalidInputError(f"`path` is {str(path)!r}, which looks like {' and '.join(known)}; say its `kind`.")
        kind = known[0] if known else "folder"
        how = kind if known else "a folder of one's own, as it looks like no data set that is known"
    try:
        found = list(kinds[kind].read(place))
        records = [record for record in found if isinstance(record, Record)]
        files = {file for record in records for file in record.files}
        if missing := sorted(file for file in files if not os.path.isfile(file)):
            raise ValueError(f"{len(missing)} of {len(files)} files are not there: {few(missing)}")
        pairs = sorted({pair for one in records for pair in one.labels.items()}, key=lambda pair: natural(pair[1]))
        classes = {label: tuple(name for of, name in pairs if of == label) for label, _ in pairs}
        classes |= getattr(kinds[kind], "CLASSES", {})
        for number, record in enumerate(records):
            labels = {label: classes[label].index(name) for label, name in record.labels.items()}
            records[number] = replace(record, sensor=sensor or record.sensor, labels=labels)
        if names is not None:  # by their numbers, where they are numbers
            digits = [name.removesuffix(".0") for name in classes.get("material", ())]  # 1.0, as pandas writes 1
            numbers = [int(n) if n.isdecimal() else place for place, n in enumerate(digits)]
            if max(numbers, default=-1) >= len(names):
                raise InvalidInputError(f"`materials` names {len(names)} of {max(numbers) + 1}; name each by number.")
            classes["material"] = tuple(names[number] for number in numbers)
        said = [of for of in ("object", "recording") if any(getattr(record, of) for record in records)]
        apart: Any = getattr(kinds[kind], "APART", said[0] if said else "none")
        notes = tuple(note for note in found if isinstance(note, str))
        return RecordSet(place.name, kind, tuple(records), classes, apart, notes, sampling_rate)
    except (OSError, LookupError, ValueError, TypeError, AttributeError) as error:  # of lists that hold something else
        reason = f"its lists have no {error}" if isinstance(error, KeyError) else first_line(error)
        raise InvalidInputError(f"`path` is {str(path)!r}, read as {how}: {reason}") from error
