"""Manifests: tables and folders that say what pictures to make, checked as a whole before anything runs."""

import csv
import io
import json
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from inspect import signature
from pathlib import Path
from types import MappingProxyType
from typing import Any

from PIL import Image

from unitouch_gen.errors import (
    InvalidInputError,
    InvalidTypeError,
    check_choice,
    check_flag,
    check_integer,
    check_kind,
    check_number,
    check_texts,
    describe,
    did_you_mean,
    first_line,
)
from unitouch_gen.files import SOUNDS, as_path, read_text
from unitouch_gen.pipelines.common import MAX_GAIN, TIGHTEST, Plan
from unitouch_gen.pipelines.tactile_stylization import MIXES
from unitouch_gen.pipelines.tiny import PIPELINES
from unitouch_gen.pipelines.x_to_touch import ALL
from unitouch_gen.sampling import MOST_STEPS
from unitouch_gen.schedulers.solvers import SOLVERS

LARGEST = 2**30
"""Bytes of a manifest."""

LONGEST_NAME = 200
"""Bytes of each part of an item's name: file systems allow 255, with the suffix."""

MOST_CANDIDATES = 1000
"""Of an item; they have the seeds that follow its own."""

# Columns --------------------------------------------------------------------------------------------------------------

INPUTS = ("touch", "image", "text", "audio")
"""What pictures are made of, in the order in which an item is named after one of them."""

FILES = ("touch", "image", "audio", "background")
"""Columns that name files."""

OWN = (*INPUTS, "background", "prompt", "negative_prompt", "sensor", "source_sensor")
"""Texts and files, in which the items of one call may differ; in all others they are alike."""

NUMBERS: dict[str, tuple[Any, float, float]] = {
    "seed": (check_integer, 0, 2**63 - 1 - MOST_CANDIDATES),
    "steps": (check_integer, 1, MOST_STEPS),
    "tolerance": (check_number, TIGHTEST, 1.0),
    "guidance": (check_number, 0.0, MAX_GAIN),
    "strength": (check_number, 0.0, MAX_GAIN),
    "noise_level": (check_integer, 0, MOST_STEPS),
    "touch_weight": (check_number, 0.0, 1.0),
    "init_strength": (check_number, 0.0, 1.0),
    "candidates": (check_integer, 1, MOST_CANDIDATES),
    "height": (check_integer, 1, 2**14),
    "width": (check_integer, 1, 2**14),
}
CHOICES = {"pipeline": [*PIPELINES], "solver": [*SOLVERS], "mix": [*MIXES]}
COLUMNS = ("name", *OWN, "bridge", *NUMBERS, *CHOICES)
ARGUMENTS = {"steps": "num_inference_steps", "guidance": "guidance_scale", "candidates": "num_candidates"}
"""What calls of pipelines know columns as, where they know them by other names."""

TAKEN = {
    name: [column for column in COLUMNS if ARGUMENTS.get(column, column) in signature(kind.__call__).parameters]
    for name, kind in PIPELINES.items()
}
"""Columns that are arguments of a pipeline's call."""


@dataclass(frozen=True, slots=True)
class Item:
    """A picture to be made.

    Attributes:
        number: Its place in the manifest, from 0.
        name: Of its file, without suffix; unlike those of all others, also where case is ignored.
        pipeline: A name of `unitouch_gen.tiny`.
        seed: Of its noise.
        cells: What the manifest says beside, by columns; files as they are written there.
    """

    number: int
    name: str
    pipeline: str
    seed: int
    cells: dict[str, Any]

    @property
    def settings(self) -> tuple[Any, ...]:
        """What items of one call have in common."""
        shared = tuple(sorted((column, value) for column, value in self.cells.items() if column not in OWN))
        return self.pipeline, shared, tuple(column for column in OWN if column in self.cells)


@dataclass(frozen=True)
class Manifest:
    """Pictures to be made.

    Attributes:
        folder: That names of files start from.
        items: The pictures, each of another name.
        plans: What their calls need, by pipelines, for `from_pretrained(..., plan=...)` and `unitouch_gen.tiny`.
    """

    folder: Path
    items: list[Item] = field(repr=False)
    plans: dict[str, Plan] = field(repr=False)


def read_manifest(
    manifest: str | os.PathLike,
    pipeline: str = "touch-to-image",
    *,
    defaults: Mapping[str, Any] | None = None,
    kind: str | None = None,
) -> Manifest:
    """Reads a manifest and checks all that can be said without its files and a model.

    Args:
        manifest: A table, .csv or .tsv with a header or .jsonl with an object a line, in UTF-8, whose columns are
            `COLUMNS`: inputs and settings of the pipelines' calls, and `name`, `pipeline` and `seed`. Names of files
            start from the table's folder, and what is blank is left out. Or a folder, of which every picture, and for
            "x-to-touch" every sound, is an item.
        pipeline: Of items that name none.
        defaults: What columns say where an item says nothing; of those that a pipeline takes.
        kind: What the pictures of a folder are, "touch" or "image"; photos for "x-to-touch", touches for others.

    Raises:
        InvalidInputError, InvalidTypeError: If it is none, or something in it cannot be used; with the line.

    Example:
        >>> read_manifest("touches.csv", defaults={"steps": 10}).items[0].name  # doctest: +SKIP
        'brick'
    """
    place = as_path("manifest", manifest)
    check_choice("pipeline", pipeline, PIPELINES)
    if kind is not None:
        check_choice("kind", kind, [column for column in ("touch", "image") if column in TAKEN[pipeline]])
    given = {"seed": 0, **_checked(defaults or {}, ARGUMENTS), "pipeline": pipeline}
    if place.is_dir():
        rows, folder = _in_folder(place, pipeline, kind), place
    elif kind is not None:
        raise InvalidInputError(
            f"`kind` is {kind!r}, but `manifest` is no folder, whose columns say that; leave it out."
        )
    else:
        rows, folder = _in_table(place), place.parent
    items, plans, seen = [], dict[str, Plan](), set[Any]()
    for number, (where, row, stem) in enumerate(rows):
        try:
            item = _item(number, _checked(row), given, stem)
            if item.settings not in seen:
                seen.add(item.settings)
                plan = _plan(item)
                plans[item.pipeline] = _joined(plans.get(item.pipeline, plan), plan)
        except (InvalidInputError, InvalidTypeError) as error:
            raise InvalidInputError(
                f"`manifest` is {str(manifest)!r}, of which {where} cannot be used: {error}"
            ) from error
        items.append((where, "name" in row, item))
    for column in {**given}:
        if column not in ("name", "pipeline", "seed") and items and not any(column in TAKEN[name] for name in plans):
            raise InvalidInputError(
                f"`{ARGUMENTS.get(column, column)}` came, which {' and '.join(plans)} takes nothing of; leave it out."
            )
    if not items:
        raise InvalidInputError(f"`manifest` is {str(manifest)!r}, which holds nothing to make a picture of.")
    return Manifest(folder, _named(str(manifest), items), plans)


# What is in it --------------------------------------------------------------------------------------------------------

Rows = Iterator[tuple[str, dict[str, Any], str]]
"""Of each item where it is, its cells, and what to call it unless it says so itself or is made of a file."""


def _in_folder(folder: Path, pipeline: str, kind: str | None) -> Rows:
    hears = "audio" in TAKEN[pipeline]
    picture = kind or ("image" if hears else "touch")
    readable = {suffix for suffix, name in Image.registered_extensions().items() if name in Image.OPEN}
    kinds = {**dict.fromkeys(readable, picture), **(dict.fromkeys(SOUNDS, "audio") if hears else {})}
    for file in sorted(folder.rglob("*")):
        name = file.relative_to(folder)
        column = kinds.get(file.suffix.lower())
        if column and file.is_file() and not any(part.startswith(".") for part in name.parts):
            yield f"the file {str(name)!r}", {column: str(name)}, str(name.with_suffix(""))


def _in_table(file: Path) -> Rows:
    readers = {".csv": _lines_of_csv, ".tsv": _lines_of_csv, ".jsonl": _lines_of_json}
    suffix = file.suffix.lower()
    if not suffix and not file.exists():
        raise InvalidInputError(f"`manifest` is {describe(str(file))}, which is not there; pass a folder or a table.")
    if suffix not in readers:
        raise InvalidInputError(
            f"`manifest` is {describe(str(file))}; pass a folder, or a file whose name ends on {', '.join(readers)}."
        )
    text = read_text("manifest", file, suffix[1:].upper(), LARGEST).removeprefix("\ufeff")
    lines = readers[suffix](text, str(file), "\t" if suffix == ".tsv" else ",")
    for count, (line, row) in enumerate(lines):
        cells = {column: value for column, value in row.items() if not _is_blank(value)}
        made_of = next((cells[column] for column in INPUTS if column in FILES and column in cells), None)
        yield f"line {line}", cells, Path(made_of).stem if isinstance(made_of, str) else f"{count:06d}"


def _is_blank(value: Any) -> bool:
    return value is None or (isinstance(value, str) and not value.strip())


def _lines_of_csv(text: str, file: str, delimiter: str) -> Iterator[tuple[int, dict[str, Any]]]:
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter, strict=True)
    header: list[str] = []
    try:
        for row in reader:
            if not any(cell.strip() for cell in row):
                continue
            if not header:
                header = [cell.strip() for cell in row]
                _check_columns(f"`manifest` is {file!r}, whose header", header)
            elif len(row) != len(header):
                raise InvalidInputError(
                    f"`manifest` is {file!r}, whose line {reader.line_num} has {len(row)} cells under {len(header)} "
                    "columns; put those with commas into quotes."
                )
            else:
                yield reader.line_num, dict(zip(header, row, strict=True))
    except csv.Error as error:
        raise InvalidInputError(
            f"`manifest` is {file!r}, whose line {reader.line_num} cannot be read as a table: {error}."
        ) from error


def _lines_of_json(text: str, file: str, delimiter: str) -> Iterator[tuple[int, dict[str, Any]]]:
    for number, line in enumerate(text.split("\n"), 1):
        if line.strip():
            where = f"`manifest` is {file!r}, whose line {number}"
            try:
                pairs = json.loads(line, object_pairs_hook=tuple)
            except (ValueError, RecursionError) as error:  # integers of thousands of digits are the former, too
                raise InvalidInputError(f"{where} cannot be read as JSON: {first_line(error)}.") from error
            if not line.lstrip().startswith("{"):
                raise InvalidInputError(f'{where} is no JSON object; write one a line, as {{"touch": "brick.png"}}.')
            _check_columns(where, [column for column, _ in pairs])
            yield number, dict(pairs)


def _check_columns(where: str, columns: list[str]) -> None:
    for column in columns:
        if column not in COLUMNS:
            raise InvalidInputError(
                f"{where} names {describe(column)}; columns are {', '.join(COLUMNS)}. {did_you_mean(column, COLUMNS)}"
            )
        if columns.count(column) > 1:
            raise InvalidInputError(f"{where} names {column!r} twice; leave one out.")


# Cells ----------------------------------------------------------------------------------------------------------------


def _checked(row: Mapping[str, Any], names: Mapping[str, str] = MappingProxyType({})) -> dict[str, Any]:
    """Cells as values, by columns; `names` are what messages call them, where they have another name for them."""
    return {column: _value(column, names.get(column, column), value) for column, value in row.items()}


def _value(column: str, name: str, value: Any) -> Any:
    """What a cell says, which in a table is a text."""
    if column in NUMBERS:
        check, least, most = NUMBERS[column]
        return check(name, _number(name, value) if isinstance(value, str) else value, least, most)
    if column == "bridge":
        words = {"true": True, "false": False, "yes": True, "no": False, "1": True, "0": False}
        return words[check_choice(name, value.lower(), words)] if isinstance(value, str) else check_flag(name, value)
    if column in CHOICES:
        return check_choice(name, value, CHOICES[column])
    text = check_texts(name, check_kind(name, value, str))[0]
    if "\0" in text:
        raise InvalidInputError(f"`{name}` is {describe(text)}, with a zero in it; write texts and names of files.")
    if column == "name":
        return _name(name, text)
    if column == "sensor" and text == ALL:
        raise InvalidInputError(f"`{name}` is {ALL!r}, which makes several pictures; write an item for each sensor.")
    return text


def _number(name: str, text: str) -> int | float:
    try:
        return int(text)
    except ValueError:
        try:
            return float(text)
        except ValueError as error:
            raise InvalidInputError(f"`{name}` is {describe(text)}, which is no number.") from error


def _name(name: str, text: str) -> str:
    for part in text.split("/"):
        if part != _fit(part) or part != part.strip() or not part:
            raise InvalidInputError(
                f"`{name}` is {describe(text)}; write a name such as brick, or walls/brick to be in a folder, without "
                f"dots, colons and backslashes, and of at most {LONGEST_NAME} bytes."
            )
    return text


def _fit(part: str) -> str:
    """What a file may be called by, where it has no suffix yet."""
    return os.fsdecode(os.fsencode(re.sub(r"[.:\\\x00-\x1f]", "_", part))[:LONGEST_NAME])


# Items ----------------------------------------------------------------------------------------------------------------


def _item(number: int, row: dict[str, Any], defaults: Mapping[str, Any], stem: str) -> Item:
    """What a row asks for."""
    pipeline = row.get("pipeline", defaults["pipeline"])
    for column in row:
        if column not in (*TAKEN[pipeline], "name", "pipeline", "seed"):
            raise InvalidInputError(
                f"`{column}` came, which {pipeline} does not take; leave it out, or name another `pipeline`."
            )
    cells = {column: value for column, value in {**defaults, **row}.items() if column in TAKEN[pipeline]}
    for column in {"steps", "solver"}.intersection(cells):
        if "tolerance" in cells:
            raise InvalidInputError(f"`{column}` and `tolerance` came, which chooses solver and steps; leave one out.")
    name = row.get("name") or "/".join(_fit(part).strip() or "_" for part in stem.split("/"))
    return Item(number, name, pipeline, row.get("seed", defaults["seed"]), dict(sorted(cells.items())))


def _plan(item: Item) -> Plan:
    arguments = {ARGUMENTS.get(column, column): value for column, value in item.cells.items()}
    return PIPELINES[item.pipeline].plan(**arguments)


def _joined(first: Plan, second: Plan) -> Plan:
    """A plan of what either needs."""
    return replace(first, parts={part: needed or second.parts[part] for part, needed in first.parts.items()})


def _named(manifest: str, items: list[tuple[str, bool, Item]]) -> list[Item]:
    """The items, no two by one name: those named by their files get a number where another has the name."""
    taken: dict[str, str] = {}
    for where, chosen, item in items:
        if chosen and taken.setdefault(item.name.casefold(), where) != where:
            raise InvalidInputError(
                f"`manifest` is {manifest!r}, of which {taken[item.name.casefold()]} and {where} have the `name` "
                f"{item.name!r}; name each item once, also where capitals do not count."
            )
    found, counts = [], dict[str, int]()
    for where, chosen, item in items:
        name, key = item.name, item.name.casefold()
        while not chosen and taken.setdefault(name.casefold(), where) != where:
            counts[key] = counts.get(key, 1) + 1
            name = f"{item.name}-{counts[key]}"
        found.append(item if name == item.name else replace(item, name=name))
    return found
