"""Which data sets there are, and how a folder is recognised as one of them."""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from unitouch_gen.errors import InvalidInputError, check_choice, check_flag, check_kind, check_texts, first_line
from unitouch_gen.files import as_path
from unitouch_gen.training.data import (
    feeling_of_success,
    folder,
    object_folder,
    ssvtp,
    tacquad,
    touch_and_go,
    ycb_slide,
)
from unitouch_gen.training.data.reading import few
from unitouch_gen.training.data.records import MATERIAL, RecordSet

KINDS: dict[str, tuple[Sequence[str], Callable[..., RecordSet]]] = {
    "touch_and_go": (touch_and_go.LOOKS_LIKE, touch_and_go.read),
    "feeling_of_success": (feeling_of_success.LOOKS_LIKE, feeling_of_success.read),
    "ycb_slide": (ycb_slide.LOOKS_LIKE, ycb_slide.read),
    "object_folder": (object_folder.LOOKS_LIKE, object_folder.read),
    "object_folder_real": (object_folder.LOOKS_LIKE_REAL, object_folder.read_real),
    "ssvtp": (ssvtp.LOOKS_LIKE, ssvtp.read),
    "hct": (ssvtp.TABLES, ssvtp.read_hct),
    "tacquad": (tacquad.LOOKS_LIKE, tacquad.read),
    "folder": ((), folder.read),
}
"""Layouts: patterns of what only such a folder holds, and what lists its records. `folder` is what no other one is."""


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
        known = [name for name, (looks_like, _) in KINDS.items() if any(any(place.glob(one)) for one in looks_like)]
        if len(known) > 1:
            raise InvalidInputError(f"`path` is {str(path)!r}, which looks like {' and '.join(known)}; say its `kind`.")
        kind = known[0] if known else "folder"
    if patterns and kind != "folder":
        raise InvalidInputError(f"`patterns` are for folders with a table, and {str(path)!r} is read as {kind}.")
    try:
        data = KINDS[kind][1](place, **({"patterns": patterns} if patterns else {}))
        numbers = [int(name) if name.isdecimal() else number for number, name in enumerate(data.materials)]
        if names is not None and len(names) <= max(numbers, default=-1):
            raise ValueError(f"`materials` names {len(names)} of {max(numbers) + 1}; name each by number")
        files = {file for record in data.records for file in record.files}
        if missing := sorted(file for file in files if not os.path.isfile(file)):
            raise ValueError(f"{len(missing)} of {len(files)} files are not there: {few(missing)}")
    except (OSError, LookupError, ValueError, TypeError, AttributeError) as error:  # of lists that hold something else
        raise InvalidInputError(f"`path` is {str(path)!r}, read as {kind}: {first_line(error)}") from error
    classes = data.classes if names is None else {**data.classes, MATERIAL: tuple(names[number] for number in numbers)}
    records = tuple(
        replace(
            record,
            sensor=sensor or record.sensor,
            touch=replace(record.touch, bgr=bgr),
            background=record.background and replace(record.background, bgr=bgr),
        )
        for record in data.records
    )
    return replace(data, records=records, classes=classes, sampling_rate=sampling_rate)
