"""Which data sets there are, and how a folder is recognised as one of them."""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from unitouch_gen.errors import InvalidInputError, check_choice, check_flag, check_kind, check_texts, first_line
from unitouch_gen.files import as_path, natural
from unitouch_gen.training.data import (
    feeling_of_success,
    folder,
    hct,
    object_folder,
    object_folder_real,
    ssvtp,
    tacquad,
    touch_and_go,
    ycb_slide,
)
from unitouch_gen.training.data.records import Record, few
from unitouch_gen.training.data.sets import RecordSet, SplitBy


class Layout(NamedTuple):
    """What lists the records of a folder, and patterns of what only such a folder holds."""

    read: Callable[..., Iterator[Record | str]]  # the texts are for what a user should know of how it was read
    looks_like: Sequence[str] = ()
    classes: Mapping[str, tuple[str, ...]] = {}  # of labels, in order; those that there are, if left out
    apart: SplitBy | None = None  # what keeps splits apart; objects, or else recordings, if left out


KINDS = {
    "touch_and_go": Layout(touch_and_go.read, ["dataset/[0-9]*_[0-9]*"], touch_and_go.CLASSES),
    "feeling_of_success": Layout(feeling_of_success.read, ["calandra_corl2017_*.h5"], {"grasp": ("dropped", "lifted")}),
    "ycb_slide": Layout(ycb_slide.read, [*ycb_slide.REAL, *ycb_slide.SIMULATED], apart="recording"),
    "object_folder": Layout(object_folder.read, ["label.json"], {"material": object_folder.MATERIALS}),
    "object_folder_real": Layout(object_folder_real.read, [object_folder_real.IMAGES]),
    "ssvtp": Layout(ssvtp.read, ["images_tac"]),
    "hct": Layout(hct.read, hct.TABLES),
    "tacquad": Layout(tacquad.read, ["contact_indoor.csv", "contact_outdoor.csv"]),
    "folder": Layout(folder.read),
}
"""Layouts by name; `folder` is what no other one is."""


def open_dataset(
    path: str | Path,
    kind: str = "auto",
    *,
    sensor: str | None = None,
    materials: Sequence[str] | None = None,
    bgr: bool = False,
    sampling_rate: int | None = None,
    patterns: Mapping[str, str] | None = None,
) -> RecordSet:
    """Lists the records of a data set in the layout it was published in, or of a folder of one's own.

    No image is read, but for a few of HCT's, to see whether its folders are exchanged.

    Args:
        path: Its folder.
        kind: One of `KINDS`, or "auto" to see which it is.
        sensor: Name for the sensor of all touches, in place of what the data set says.
        materials: Names for its materials, by their numbers.
        bgr: Whether touches are stored with blue in the place of red.
        sampling_rate: Of sounds in .npy files, Hz.
        patterns: For a folder with a table: "touch", "picture", "background" and "sound" as patterns of file names over
            its columns, such as "{clip}_peak.jpg".

    Raises:
        InvalidInputError: If the folder is missing, empty or of no known layout, its lists cannot be used, or files are
            missing, some of which the message names.
    """
    check_choice("kind", kind, ("auto", *KINDS)), check_flag("bgr", bgr)
    for name, value, wanted in (("sensor", sensor, str), ("patterns", patterns, Mapping)):
        if value is not None:
            check_kind(name, value, wanted)
    names = None if materials is None else check_texts("materials", materials)
    place = Path(os.path.realpath(as_path("path", path)))
    if not place.is_dir() or not any(place.iterdir()):
        what = "is no folder; unpack it if it is an archive" if place.is_file() else "is not there or empty"
        raise InvalidInputError(f"`path` is {str(path)!r}, which {what}; name the folder of a data set.")
    if kind == "auto":
        known = [name for name, one in KINDS.items() if any(any(place.glob(pattern)) for pattern in one.looks_like)]
        if len(known) > 1:
            raise InvalidInputError(f"`path` is {str(path)!r}, which looks like {' and '.join(known)}; say its `kind`.")
        kind = known[0] if known else "folder"
    if patterns and kind != "folder":
        raise InvalidInputError(f"`patterns` are for folders with a table, and {str(path)!r} is read as {kind}.")
    try:
        found = list(KINDS[kind].read(place, **({"patterns": patterns} if patterns else {})))
        records = [record for record in found if isinstance(record, Record)]
        files = {file for record in records for file in record.files}
        if missing := sorted(file for file in files if not os.path.isfile(file)):
            raise ValueError(f"{len(missing)} of {len(files)} files are not there: {few(missing)}")
        classes = classes_of(records) | dict(KINDS[kind].classes)
        numbered = tuple(
            replace(
                record,
                sensor=sensor or record.sensor,
                touch=replace(record.touch, bgr=bgr),
                background=record.background and replace(record.background, bgr=bgr),
                labels={label: classes[label].index(name) for label, name in record.labels.items()},
            )
            for record in records
        )
        if names is not None:
            classes["material"] = renamed(classes.get("material", ()), names)
        apart: SplitBy = "none"
        if any(record.object or record.recording for record in records):
            apart = KINDS[kind].apart or ("object" if any(record.object for record in records) else "recording")
        notes = tuple(note for note in found if isinstance(note, str))
        return RecordSet(place.name, kind, numbered, classes, apart, notes, sampling_rate)
    except (OSError, LookupError, ValueError, TypeError, AttributeError) as error:  # of lists that hold something else
        raise InvalidInputError(f"`path` is {str(path)!r}, read as {kind}: {first_line(error)}") from error


def classes_of(records: Sequence[Record]) -> dict[str, tuple[str, ...]]:
    """Names of the classes of each label, in natural order."""
    names: dict[str, set[str]] = {}
    for record in records:
        for label, name in record.labels.items():
            names.setdefault(label, set()).add(name)
    return {label: tuple(sorted(known, key=natural)) for label, known in names.items()}


def renamed(known: Sequence[str], names: Sequence[str]) -> tuple[str, ...]:
    """Other names for classes: where they are numbers, by these, and else by their order."""
    numbers = [int(name) if name.isdecimal() else number for number, name in enumerate(known)]
    if max(numbers, default=-1) >= len(names):
        raise InvalidInputError(f"`materials` names {len(names)} of {max(numbers) + 1}; name each by number.")
    return tuple(names[number] for number in numbers)
