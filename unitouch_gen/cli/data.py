"""`unitouch-gen data check`: the content of a data set, and what is wrong with it."""

from collections import Counter, defaultdict
from collections.abc import Sequence
from hashlib import blake2b
from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Exit, Option, Typer, echo

from unitouch_gen.cli.options import Materials, by_comma, is_quiet, print_table

app = Typer(no_args_is_help=True, help="Data sets to train on.")


@app.command()
def check(
    path: Annotated[Path, Argument(help="Folder of a data set.", metavar="DIR")],
    kind: Annotated[str, Option(help="Its layout, such as touch_and_go; auto recognises it.")] = "auto",
    sensor: Annotated[str | None, Option(help="Name of the sensor of all touches.")] = None,
    materials: Materials = None,
) -> None:
    """Reads every file of a data set, and reports its content and problems; exits with 1 if files are broken.

    Example: unitouch-gen data check touches/
    """
    from unitouch_gen.models.sounds import load_sounds
    from unitouch_gen.training.data import open_dataset
    from unitouch_gen.training.data.cache import for_each
    from unitouch_gen.training.data.columns import sound_of
    from unitouch_gen.training.data.records import abbreviate

    data = open_dataset(path, kind, sensor=sensor, materials=by_comma(materials))
    rows_by_touch = defaultdict[bytes, list[int]](list)

    def read(row: int) -> None:
        record = data.records[row]
        for frame in (record.picture, record.background):
            if frame is not None:
                frame.read()
        if record.sound:
            sound = sound_of(record, data)
            if isinstance(sound, str):
                load_sounds("sound", sound)
        pixels = record.touch.read().contiguous().numpy()
        rows_by_touch[blake2b(pixels.tobytes()).digest()].append(row)

    broken = for_each(read, data, is_quiet(False))
    lines = [*data.notes, *shared_between_splits(data.records)]
    if broken:
        reasons = [f"{data.records[row].id}: {reason}" for row, reason in broken.items()]
        lines.append(f"{len(broken)} of {len(data)} records cannot be read: {abbreviate(reasons)}")
    repeated = sorted(sorted(rows) for rows in rows_by_touch.values() if len(rows) > 1)
    if repeated:
        equal = [" = ".join(data.records[row].id for row in rows) for rows in repeated]
        lines.append(f"{len(repeated)} of {len(data)} touches are there more than once: {abbreviate(equal)}")
    counts = sorted(counts_of(data).items())
    print_table([data.name, data.kind, "records"], [[name, value, str(count)] for (name, value), count in counts])
    echo("\n".join(lines or ["Nothing is wrong with it"]))
    raise Exit(1 if broken else 0)


def counts_of(data: Any) -> Counter[tuple[str, str]]:
    """Numbers of records by sensor, split, column and label."""
    counts = Counter[tuple[str, str]]()
    for record in data.records:
        counts["", "all"] += 1
        counts["sensor", record.sensor or "unknown"] += 1
        counts["split", record.split or "none"] += 1
        for name in ("picture", "background", "caption", "sound"):
            if getattr(record, name):
                counts["with", name] += 1
        for label, number in record.labels.items():
            counts[label, data.classes[label][number]] += 1
    return counts


def shared_between_splits(records: Sequence[Any]) -> list[str]:
    """A line for objects, and one for recordings, that are in several of the data set's own splits."""
    lines = list[str]()
    for field in ("object", "recording"):
        pairs = {(getattr(record, field), record.split) for record in records if record.split}
        splits = Counter(name for name, _ in pairs if name is not None)
        shared = sum(count > 1 for count in splits.values())
        if shared:
            lines.append(f"{shared} of {len(splits)} {field}s are in more than one of its own splits")
    return lines
