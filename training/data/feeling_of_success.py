"""The Feeling of Success (Calandra et al., 2017): a gripper with a GelSight in each finger tries to lift objects.

    calandra_corl2017_000.h5, ...      as deepdish writes a list of dictionaries: groups data/i0, data/i1, ...

Each attempt makes two records, of fingers A and B, with the camera's picture of the same moment, "during", and the gel
"before" as background. The label is whether the object was lifted. There is no official split; the paper keeps objects
apart.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from unitouch_gen.errors import InvalidInputError, check_file, first_line, needed
from unitouch_gen.files import natural
from unitouch_gen.training.data.records import Frame, Record, found

LOOKS_LIKE = ("calandra_corl2017_*.h5",)
CLASSES = {"grasp": ("dropped", "lifted")}


def read(folder: Path) -> Iterator[Record]:
    """Two records for each attempt."""
    for file in found(folder, "*.h5"):
        check_file("path", file, "an HDF5 file")
        try:
            with needed("h5py").File(file) as opened:
                attempts = opened["data"]  # what deepdish calls a list that is a file's only value
                for name in sorted(attempts, key=natural):
                    yield from (record_of(file, name, attempts[name], finger) for finger in "AB")
        except (OSError, KeyError, AttributeError) as error:
            raise InvalidInputError(f"{str(file)!r} is no list of attempts: {first_line(error)}.") from error


def record_of(file: Path, name: str, attempt: Any, finger: str) -> Record:
    """What a finger felt; a `KeyError` says what is missing."""
    parts = [f"gelsight{finger}_during", "kinectA_rgb_during", f"gelsight{finger}_before"]
    touch, picture, gel = (Frame(str(file), key=attempt[part].name) for part in parts)
    item = str(value_of(attempt, "object_name"))
    recording = f"{file.stem.rpartition('_')[2]}/{name}"
    labels = {"grasp": "lifted" if value_of(attempt, "is_gripping") else "dropped"}
    place = f"{recording}/{finger}"
    return Record(place, touch, picture, gel, sensor="gelsight", object=item, recording=recording, labels=labels)


def value_of(attempt: Any, name: str) -> Any:
    """A number or a text: deepdish keeps these among the attributes of a group, and arrays of them beside those."""
    value = attempt.attrs[name] if name in attempt.attrs else attempt[name][()]
    value = value.item() if hasattr(value, "item") else value
    return value.decode() if isinstance(value, bytes) else value
