"""What is in a data set, and what is wrong with it: every file is read."""

from collections import Counter
from hashlib import blake2b

import numpy as np

from unitouch_gen.models.sounds import load_sounds
from unitouch_gen.training.data.cache import for_each
from unitouch_gen.training.data.records import few
from unitouch_gen.training.data.sets import RecordSet


def check(data: RecordSet, quiet: bool = False) -> tuple[dict[int, str], list[str]]:
    """Why records, by number, cannot be read, and all that was found, in words; `quiet` shows no progress."""
    same: dict[bytes, list[int]] = {}

    def read(row: int) -> None:
        record = data.records[row]
        for frame in filter(None, (record.picture, record.background)):
            frame.read()
        if record.sound:
            np.load(record.sound) if record.sound.endswith(".npy") else load_sounds("sound", record.sound)
        same.setdefault(blake2b(record.touch.read().contiguous().numpy().tobytes()).digest(), []).append(row)

    broken = for_each(read, data, quiet)
    lines = [*data.notes]
    for what in ("object", "recording"):
        pairs = {(getattr(record, what), record.split) for record in data.records if record.split}
        counts = Counter(name for name, _ in pairs if name is not None)
        if shared := sum(count > 1 for count in counts.values()):
            lines.append(f"{shared} of {len(counts)} {what}s are in more than one of its own splits")
    twice = sorted(sorted(rows) for rows in same.values() if len(rows) > 1)
    odd = {
        "records cannot be read": [f"{data.records[row].id}: {why}" for row, why in broken.items()],
        "touches are there more than once": [" = ".join(data.records[row].id for row in rows) for rows in twice],
    }
    lines += [f"{len(names)} of {len(data)} {what}: {few(names)}" for what, names in odd.items() if names]
    return broken, lines


def contents(data: RecordSet) -> tuple[list[str], list[list[str]]]:
    """Names of its own splits, and rows of how many records there are of each kind, in all and in these."""
    splits = dict.fromkeys(record.split for record in data.records if record.split)
    counts: Counter[tuple] = Counter()
    for record in data.records:
        having = [name for name in ("picture", "background", "caption", "sound") if getattr(record, name) is not None]
        labels = [(label, data.classes[label][number]) for label, number in record.labels.items()]
        kinds = [("", "all"), ("sensor", record.sensor or "unknown"), *(("with", name) for name in having), *labels]
        counts.update((*kind, split) for kind in kinds for split in {None, record.split})
    rows = sorted({kind[:2] for kind in counts})
    return [*splits], [[*row, *(str(counts[*row, split]) for split in (None, *splits))] for row in rows]
