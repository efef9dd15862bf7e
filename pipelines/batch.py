"""Pictures by the thousand: the items of a manifest, several in a call, over processes, gone on with after a kill.

A picture depends on its item alone, but for rounding in calls of another size. Which calls there are depends on the
manifest and that size: a run that was killed makes the same pictures, to the bit, as one that was not, and so do
several processes. Each writes a ledger of its own, a line for an item when its picture is in its place; the one that
comes to its end last makes one ledger of all.
"""

import hashlib
import io
import json
import os
import shutil
import tarfile
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from PIL import Image

from unitouch_gen.errors import (
    REFUSALS,
    InvalidInputError,
    UnfamiliarInputWarning,
    check_integer,
    check_kind,
    first_line,
)
from unitouch_gen.files import (
    appending,
    as_path,
    check_writable,
    hidden_folder,
    holding,
    read_json,
    read_text,
    replacing,
    write_file,
    writing,
)
from unitouch_gen.models.images import load_images
from unitouch_gen.models.sounds import load_sounds
from unitouch_gen.pipelines.manifest import ARGUMENTS, FILES, LARGEST, OWN, Item, Manifest
from unitouch_gen.sampling import ReturnCode, RunReport

MOST_AT_ONCE = 100_000
"""Items of a call, or of a shard."""

RUN, LEDGER, PARTS, PENDING = "run.json", "ledger.jsonl", "ledger.*.jsonl", "pending"
"""In the folder of a run: what it is of, its ledger, those of its processes, and pictures that wait for their shard."""


@dataclass(frozen=True)
class BatchResult:
    """What came of a run.

    Attributes:
        ledger: Its ledger: a JSON object for each item, in the order of the manifest.
        made: Number of items that have a picture.
        failed: Of the others: names, and why in one line.
        unknown: Items with inputs that the model abstains from naming: names, and why by modality. Others may be
            guesses, too.
    """

    ledger: Path
    made: int
    failed: dict[str, str]
    unknown: dict[str, dict[str, str]]


def run_batch(
    pipes: Mapping[str, Any],
    manifest: Manifest,
    output: str | os.PathLike,
    *,
    batch_size: int = 8,
    shard_size: int | None = None,
    settings: Mapping[str, Any] | None = None,
    process: tuple[int, int] = (0, 1),
    progress: Callable[[int, int], object] | None = None,
) -> BatchResult | None:
    """Makes the pictures of a manifest, and goes on with those that are missing where it was ended before.

    Items that cannot be used, because a file is broken say, are left out and noted; where all others are done, calling
    it again tries them once more.

    Args:
        pipes: The pipelines, by the names that the manifest has for them.
        manifest: As `read_manifest` gives it.
        output: A folder: pictures by their names, and the ledger. Nothing that was there is replaced.
        batch_size: Items of a call. They are of one pipeline, shape and settings; one to a tolerance is alone, as the
            pipeline chooses its steps by all samples of a call.
        shard_size: Items of a WebDataset shard, `shard-00000.tar` and so on, which take the place of the pictures: of
            each item NAME.png and NAME.json, its line of the ledger.
        settings: What else makes a run another one, such as a model's folder; values as JSON has them.
        process: Number of this process, from 0, and of all of them, which make a share each.
        progress: Called after every call with the number of items of this process that are done, and of all it has.

    Returns:
        What came of all items, or `None` where other processes are still at work.

    Raises:
        InvalidInputError, InvalidTypeError: If the folder holds another run, or what would be replaced, or cannot be
            written to; pictures that are made stay.

    Example:
        >>> pipe, manifest = unitouch_gen.tiny("touch-to-image"), read_manifest("touches/")  # doctest: +SKIP
        >>> run_batch({"touch-to-image": pipe}, manifest, "pictures").made  # doctest: +SKIP
        120
    """
    for name in check_kind("manifest", manifest, Manifest).plans:
        if name not in pipes:
            raise InvalidInputError(f"`pipes` holds no {name!r}, which the manifest names; pass it, too.")
    run = check_batch(manifest, output, batch_size=batch_size, shard_size=shard_size, settings=settings)
    folder = Path(output)
    with holding("output", folder):
        check_batch(manifest, output, batch_size=batch_size, shard_size=shard_size, settings=settings)
        if not (folder / RUN).is_file():
            write_file("output", folder / RUN, json.dumps(run, indent=1))
    number, count = process
    with ExitStack() as held:
        append = held.enter_context(appending("output", folder / PARTS.replace("*", f"{number:05d}")))
        hidden = held.enter_context(hidden_folder("output", folder))
        with holding("output", folder):  # or another process might just put ledgers together
            ledger = _read_ledgers(folder)
        shares, finished = _shares(manifest.items, batch_size, shard_size)[number::count], 0
        mine = sum(len(call) for _, calls in shares for call in calls)
        for shard, calls in shares:
            held_by_shard = _names_in(folder, shard)
            for call in calls:
                missing = [item for item in call if not _is_done(folder, item, ledger.get(item.name), held_by_shard)]
                if missing:
                    came = _make(pipes[call[0].pipeline], manifest, missing)
                    lines = [_kept(folder, hidden, shard, *one) for one in came]
                    append("".join(f"{line.text}\n" for line in lines))
                    ledger |= {item.name: line for item, line in zip(missing, lines, strict=True)}
                finished += len(call)
                if progress is not None:
                    progress(finished, mine)
            if shard is not None:
                _pack(folder, hidden, shard, [item for call in calls for item in call], ledger)
    return _end(folder, manifest.items, number)


def check_batch(
    manifest: Manifest,
    output: str | os.PathLike,
    *,
    batch_size: int = 8,
    shard_size: int | None = None,
    settings: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Checks, before a model is loaded, that a folder can be that of a run, or is; see `run_batch`.

    Returns:
        What the run is of.

    Raises:
        InvalidInputError, InvalidTypeError: If the folder is that of another run, holds what would be replaced, or
            cannot be written to.
    """
    folder = as_path("output", output)
    check_integer("batch_size", batch_size, 1, MOST_AT_ONCE)
    if shard_size is not None:
        check_integer("shard_size", shard_size, 1, MOST_AT_ONCE)
    digest = hashlib.sha256()
    for item in manifest.items:
        digest.update(json.dumps([item.name, item.pipeline, item.seed, item.cells]).encode())
    run = {"items": digest.hexdigest(), "shard_size": shard_size, **(settings or {})}
    check_writable("output", folder / RUN)
    if (folder / RUN).is_file():
        before = read_json("output", folder / RUN)
        for key in {**run, **before}:
            if run.get(key) != before.get(key):
                what = "other items, or other settings of them" if key == "items" else f"another `{key}`"
                raise InvalidInputError(
                    f"`output` is {str(folder)!r}, which holds a run of {what}; name another folder, or go on with "
                    "what it was begun with."
                )
        return run
    pictures = (f"{item.name}.png" for item in manifest.items)
    for name in (LEDGER, *(pictures if shard_size is None else (_shard(item, shard_size) for item in manifest.items))):
        if os.path.lexists(folder / name):
            raise InvalidInputError(f"`output` is {str(folder)!r}, which holds another {name!r}; name another folder.")
    return run


# Which items go together ----------------------------------------------------------------------------------------------


def _shares(
    items: Sequence[Item], batch_size: int, shard_size: int | None
) -> list[tuple[str | None, list[list[Item]]]]:
    """What one process does at a time: a call, or all calls of a shard, with its name."""
    if shard_size is None:
        return [(None, [call]) for call in _calls(items, batch_size)]
    shards = (items[start : start + shard_size] for start in range(0, len(items), shard_size))
    return [(_shard(inside[0], shard_size), _calls(inside, batch_size)) for inside in shards]


def _shard(item: Item, shard_size: int) -> str:
    return f"shard-{item.number // shard_size:05d}.tar"


def _calls(items: Sequence[Item], batch_size: int) -> list[list[Item]]:
    """Items that go into one call, by their settings; calls in the order of their first items."""
    open_calls, calls = dict[Any, list[Item]](), list[list[Item]]()
    for item in items:
        call = open_calls.get(item.settings)
        if call is None or len(call) == batch_size or "tolerance" in item.cells:
            open_calls[item.settings] = call = []
            calls.append(call)
        call.append(item)
    return calls


# Making them ----------------------------------------------------------------------------------------------------------

Made = tuple[Item, Image.Image | None, dict[str, Any]]
"""An item, its picture if there is one, and what else there is to say of it."""


def _make(pipe: Any, manifest: Manifest, items: Sequence[Item]) -> list[Made]:
    """What one call makes of some items; where it is refused, each is tried alone."""
    loaded, failed = dict[str, dict[str, Any]](), dict[str, Made]()
    for item in items:
        try:
            loaded[item.name] = load_item(manifest, item)
        except REFUSALS as error:
            failed[item.name] = item, None, {"error": first_line(error)}
    usable = [item for item in items if item.name in loaded]
    try:
        made = call_together(pipe, usable, loaded) if usable else []
    except REFUSALS as error:
        if len(usable) == 1:
            made = [(usable[0], None, {"error": first_line(error)})]
        else:
            made = [one for item in usable for one in _make(pipe, manifest, [item])]
    found = failed | {one[0].name: one for one in made}
    return [found[item.name] for item in items]


def load_item(manifest: Manifest, item: Item) -> dict[str, Any]:
    """Arguments of the pipeline's call for an item, its files read."""
    arguments = dict[str, Any]()
    for column, value in item.cells.items():
        if column == "audio":
            sound = load_sounds(column, manifest.folder / value)[0]
            value = (sound.samples, sound.rate)
        elif column in FILES:
            value = load_images(column, manifest.folder / value)[0]
        arguments[column] = value
    return arguments


def call_together(pipe: Any, items: Sequence[Item], loaded: Mapping[str, dict[str, Any]]) -> list[Made]:
    """One call of a pipeline, in which each item has generators of its own."""
    arguments: dict[str, Any] = {
        ARGUMENTS.get(column, column): [loaded[item.name][column] for item in items] if column in OWN else value
        for column, value in loaded[items[0].name].items()
    }
    candidates = arguments.get("num_candidates", 1)
    generator = [torch.Generator().manual_seed(item.seed + more) for item in items for more in range(candidates)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnfamiliarInputWarning)  # the ledger has them, each at its item
        result = pipe(**arguments, generator=generator, throw=False)
    report: RunReport = result.report
    samples = report.chosen or [sample for sample, code in enumerate(report.codes) if code.finite]
    pictures = {sample // candidates: (sample, image) for sample, image in zip(samples, result.images, strict=True)}
    made = list[Made]()
    for row, item in enumerate(items):
        sample, picture = pictures.get(row, (row * candidates, None))
        code = report.codes[sample]
        if code is not ReturnCode.SUCCESS:
            made.append((item, None, {"error": f"{code.value}: {code.message}"}))
            continue
        said = dict[str, Any]()
        if report.sensors:
            distance = report.sensor_distances[row]
            said = {"touch_sensor": report.sensors[row], "sensor_distance": distance and round(distance, 4)}
        if unknown := {modality: why[row] for modality, why in report.unknown.items() if why[row] is not None}:
            said["unknown"] = unknown
        made.append((item, picture, said))
    return made


# Files ----------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Line:
    """A line of a ledger.

    Attributes:
        text: The line, JSON.
        failed: Whether its item has no picture.
        fresh: Whether it is of a run that has not come to its end.
    """

    text: str
    failed: bool
    fresh: bool = True


def _kept(folder: Path, hidden: Path, shard: str | None, item: Item, picture: Image.Image | None, said: dict) -> Line:
    """Writes an item's picture, and says so."""
    place = {"shard": shard} if shard is not None else {"file": f"{item.name}.png"}
    if picture is not None:
        file = _picture(folder, item, shard is not None)
        with writing("output", file):
            file.parent.mkdir(parents=True, exist_ok=True)
        with replacing("output", file, hidden) as partial:
            picture.save(partial, format="PNG")
    line = {"item": item.number, "name": item.name, **(place if picture is not None else {}), "pipeline": item.pipeline,
            "seed": item.seed, **item.cells, **said}  # fmt: skip
    return Line(json.dumps(line), picture is None)


def _picture(folder: Path, item: Item, sharded: bool) -> Path:
    return (folder / PENDING if sharded else folder) / f"{item.name}.png"


def _is_done(folder: Path, item: Item, line: Line | None, in_shard: set[str] | None) -> bool:
    """Whether an item has its picture, or has failed in this run."""
    if line is None or line.failed:
        return line is not None and line.fresh
    return (in_shard is not None and item.name in in_shard) or _picture(folder, item, in_shard is not None).is_file()


def _names_in(folder: Path, shard: str | None) -> set[str] | None:
    """The items in a shard, none where it is not there yet; `None` without shards."""
    if shard is None:
        return None
    if not (folder / shard).is_file():
        return set()
    with tarfile.open(folder / shard) as tar:
        return {name.removesuffix(".png") for name in tar.getnames() if name.endswith(".png")}


def _pack(folder: Path, hidden: Path, shard: str, items: Sequence[Item], ledger: Mapping[str, Line]) -> None:
    """Moves pictures into their shard, beside those that it may hold already."""
    items = sorted(items, key=lambda item: item.number)
    waiting = {item.name: file for item in items if (file := _picture(folder, item, True)).is_file()}
    if not waiting:
        return
    with ExitStack() as held:
        before = held.enter_context(tarfile.open(folder / shard)) if (folder / shard).is_file() else None
        partial = held.enter_context(replacing("output", folder / shard, hidden))
        packed = held.enter_context(tarfile.open(partial, "w"))
        names = set(before.getnames()) if before is not None else set()
        for item in items:
            for suffix, text in (("png", None), ("json", ledger[item.name].text)):
                name = f"{item.name}.{suffix}"
                if item.name in waiting:
                    data = waiting[item.name].read_bytes() if text is None else text.encode()
                elif before is not None and name in names:
                    data = before.extractfile(name).read()  # type: ignore[union-attr]
                else:
                    continue
                member = tarfile.TarInfo(name)  # of no time and nobody, so that the same items are the same bytes
                member.size = len(data)
                packed.addfile(member, io.BytesIO(data))
    for file in waiting.values():
        file.unlink()


def _read_ledgers(folder: Path) -> dict[str, Line]:
    """The last line of each item, by names."""
    found = dict[str, Line]()
    for file in (folder / LEDGER, *sorted(folder.glob(PARTS))):
        text = read_text("output", file, "JSON lines", LARGEST) if file.is_file() else ""
        for number, line in enumerate(text.split("\n")[:-1], 1):  # a kill may cut the last one short
            try:
                said = json.loads(line)
                found[said["name"]] = Line(line, "error" in said, file.name != LEDGER)
            except (ValueError, KeyError, TypeError) as error:
                raise InvalidInputError(
                    f"`output` holds {file.name}, whose line {number} is not what was written; remove the line."
                ) from error
    return found


def _end(folder: Path, items: Sequence[Item], number: int) -> BatchResult | None:
    """Makes one ledger of all, where every item has come to its end."""
    with holding("output", folder):
        ledger = _read_ledgers(folder)
        lines = [ledger.get(item.name) for item in items]
        parts = sorted(folder.glob(PARTS))
        if not all(line is not None and (line.fresh or not line.failed) for line in lines):
            own = folder / PARTS.replace("*", f"{number:05d}")
            if own.is_file() and not own.stat().st_size:
                own.unlink()
            return None
        write_file("output", folder / LEDGER, "".join(f"{line.text}\n" for line in lines if line is not None))
        for part in parts:
            part.unlink()
        shutil.rmtree(folder / PENDING, ignore_errors=True)
    said = {item.name: json.loads(line.text) for item, line in zip(items, lines, strict=True) if line is not None}
    failed = {name: one["error"] for name, one in said.items() if "error" in one}
    unknown = {name: one["unknown"] for name, one in said.items() if "unknown" in one}
    return BatchResult(folder / LEDGER, len(items) - len(failed), failed, unknown)
