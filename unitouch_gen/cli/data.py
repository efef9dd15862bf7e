"""`unitouch-gen data check`: what is in a data set, and what is wrong with it."""

from collections import Counter, defaultdict
from hashlib import blake2b
from pathlib import Path
from typing import Annotated

from typer import Argument, Exit, Option, Typer, echo

from unitouch_gen.cli.options import Materials, by_comma, is_quiet, print_table

app = Typer(no_args_is_help=True, help="Data sets to train on.")


@app.command()
def check(
    path: Annotated[Path, Argument(help="Folder of a data set.", metavar="DIR")],
    kind: Annotated[str, Option(help="Its layout, such as touch_and_go; or auto, to see which it is.")] = "auto",
    sensor: Annotated[str | None, Option(help="Name of the sensor of all touches.")] = None,
    materials: Materials = None,
) -> None:
    """Reads every file of a data set, says what it is and what is wrong with it; exits with 1 if files are broken.

    Example: unitouch-gen data check touches/
    """
    from unitouch_gen.models.sounds import load_sounds
    from unitouch_gen.training.data import open_dataset
    from unitouch_gen.training.data.cache import for_each
    from unitouch_gen.training.data.columns import sound_of
    from unitouch_gen.training.data.records import abbreviate

    data = open_dataset(path, kind, sensor=sensor, materials=by_comma(materials))
    same = defaultdict[bytes, list[int]](list)  # records by their touches

    def read(row: int) -> None:
        record = data.records[row]
        for frame in filter(None, (record.picture, record.background)):
            frame.read()
        if record.sound:
            sound = sound_of(record, data)
            if isinstance(sound, str):
                load_sounds("sound", sound)
        same[blake2b(record.touch.read().contiguous().numpy().tobytes()).digest()].append(row)

    broken = for_each(read, data, is_quiet(False))
    counts = Counter[tuple[str, str]]()
    lines = [*data.notes]
    for record in data.records:
        counts.update([("", "all"), ("sensor", record.sensor or "unknown"), ("split", record.split or "none")])
        counts.update(("with", name) for name in ("picture", "background", "caption", "sound") if getattr(record, name))
        counts.update((label, data.classes[label][number]) for label, number in record.labels.items())
    for what in ("object", "recording"):
        pairs = {(getattr(record, what), record.split) for record in data.records if record.split}
        splits = Counter(name for name, _ in pairs if name is not None)
        if shared := sum(count > 1 for count in splits.values()):
            lines.append(f"{shared} of {len(splits)} {what}s are in more than one of its own splits")
    if broken:
        reasons = [f"{data.records[row].id}: {why}" for row, why in broken.items()]
        lines.append(f"{len(broken)} of {len(data)} records cannot be read: {abbreviate(reasons)}")
    if twice := sorted(sorted(rows) for rows in same.values() if len(rows) > 1):
        equal = [" = ".join(data.records[row].id for row in rows) for rows in twice]
        lines.append(f"{len(twice)} of {len(data)} touches are there more than once: {abbreviate(equal)}")
    print_table([data.name, data.kind, "records"], [[*kind, str(count)] for kind, count in sorted(counts.items())])
    echo("\n".join(lines or ["Nothing is wrong with it"]))
    raise Exit(1 if broken else 0)
