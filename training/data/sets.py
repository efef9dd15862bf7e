"""Data sets: named sequences of records, and their splits."""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from hashlib import sha256
from typing import Any, Literal

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.training.data.records import Record, few

SplitBy = Literal["official", "object", "recording", "none"]
"""What keeps the records of splits apart: the data set's own lists, objects, recordings; or nothing, as all train."""


@dataclass(frozen=True)
class RecordSet:
    """A data set, or a part of one, which holds one record at least.

    Attributes:
        name, kind: That of its folder, and the layout it was read as.
        classes: Names of the classes of each label, by number; numbers as text where nobody named them.
        apart: What keeps splits apart where the data set has none of its own.
        notes: What a user should know of how it was read, in words.
        sampling_rate: Of sounds in .npy files, Hz.
        chosen: Which of its records these are, in words.
    """

    name: str
    kind: str
    records: tuple[Record, ...]
    classes: Mapping[str, tuple[str, ...]]
    apart: SplitBy = "object"
    notes: tuple[str, ...] = ()
    sampling_rate: int | None = None
    chosen: str = "all"

    def __post_init__(self) -> None:
        twice = [name for name, count in Counter(record.id for record in self.records).items() if count > 1]
        if not self.records or twice:
            wrong = f"several records of one id: {few(twice)}" if twice else "no records"
            raise InvalidInputError(f"{self} has {wrong}.")

    def __str__(self) -> str:
        return f"Data set {self.name!r} ({self.kind}; {self.chosen})"

    def __len__(self) -> int:
        return len(self.records)

    def __getitem__(self, index: int) -> Record:
        return self.records[index]

    @property
    def materials(self) -> tuple[str, ...]:
        """Names of the materials; none where it has no such label."""
        return self.classes.get("material", ())

    @property
    def sensor(self) -> str | None:
        """The sensor of its first record: that of all in a part of `by_sensor`."""
        return self.records[0].sensor

    @property
    def leaks(self) -> list[str]:
        """Objects and recordings that are in more than one of its own splits, in words."""
        found = []
        for what in ("object", "recording"):
            pairs = {(getattr(record, what), record.split) for record in self.records if record.split}
            counts = Counter(name for name, _ in pairs if name is not None)
            if shared := sum(count > 1 for count in counts.values()):
                found.append(f"{shared} of {len(counts)} {what}s are in more than one of its own splits")
        return found

    @property
    def summary(self) -> dict[str, Any]:
        """What a training run keeps on record of it."""
        return {"set": self.name, "kind": self.kind, "split": self.chosen, "sensor": self.sensor, "records": len(self)}

    def part(self, chosen: str, keep: Callable[[Record], bool]) -> "RecordSet":
        """The records that are to be kept."""
        return replace(self, chosen=chosen, records=tuple(filter(keep, self.records)))

    def thinned(self, count: int) -> "RecordSet":
        """At most `count` of its records, one in every so many."""
        return replace(self, records=self.records[:: -(-len(self) // count)])

    def by_sensor(self) -> "list[RecordSet]":
        """A part for each sensor, in the order of their first records."""
        sensors = dict.fromkeys(record.sensor for record in self.records)
        return [replace(self, records=tuple(r for r in self.records if r.sensor == sensor)) for sensor in sensors]

    def split(self, name: str, by: SplitBy | None = None) -> "RecordSet":
        """The records of a split: "train", "val" or "test".

        What keeps splits apart is the data set's own lists, or else `apart`, if `by` is left out. Objects and
        recordings are dealt out 8:1:1 by the hash of their names, so that none is in two splits.

        Raises:
            InvalidInputError: If the data set has no such split, or records do not say what is to be kept apart, or
                there are fewer than three of it.
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
        if by == "official":
            return self.part(f"{name} of the official split", lambda record: record.split == name)
        order = sorted(groups, key=lambda group: sha256(group.encode()).digest())
        tenth = max(round(len(order) / 10), 1)
        kept = set({"val": order[:tenth], "test": order[tenth : 2 * tenth], "train": order[2 * tenth :]}[name])
        return self.part(f"{name}, {by}s kept apart", lambda record: getattr(record, by) in kept)
