"""The Feeling of Success (Calandra et al., 2017): a gripper with a GelSight in each finger tries to lift objects.

    calandra_corl2017_000.h5, ...      as deepdish writes a list of dictionaries: groups data/i0, data/i1, ...

Each attempt makes two records, of fingers A and B, with the camera's picture of the same moment, "during", and the gel
"before" as background. The label is whether the object was lifted. There is no official split; the paper keeps objects
apart.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from unitouch_gen.errors import InvalidInputError, check_file, first_line, import_optional
from unitouch_gen.files import natural
from unitouch_gen.training.data.records import Frame, Record, find_paths

LOOKS_LIKE = ("calandra_corl2017_*.h5",)
CLASSES = {"grasp": ("dropped", "lifted")}


def read(folder: Path) -> Iterator[Record]:
    """Two records for each attempt."""
    for file in find_paths(folder, "*.h5"):
        check_file("path", file, "an HDF5 file")
        try:
            with import_optional("h5py").File(file) as opened:
                attempts = opened["data"]  # what deepdish calls a list that is a file's only value
                for name in sorted(attempts, key=natural):
                    yield record_of(file, name, attempts[name], finger="A")
                    yield record_of(file, name, attempts[name], finger="B")
        except (OSError, KeyError, AttributeError) as error:
            raise InvalidInputError(f"{str(file)!r} is no list of attempts: {first_line(error)}.") from error


def record_of(file: Path, name: str, attempt: Any, finger: str) -> Record:
    """The touch of one finger in an attempt; raises `KeyError` if something is missing."""

    def frame(array: str) -> Frame:
        return Frame(str(file), key=attempt[array].name)

    recording = f"{file.stem.rpartition('_')[2]}/{name}"
    return Record(
        f"{recording}/{finger}",
        touch=frame(f"gelsight{finger}_during"),
        picture=frame("kinectA_rgb_during"),
        background=frame(f"gelsight{finger}_before"),
        sensor="gelsight",
        object=str(value_of(attempt, "object_name")),
        recording=recording,
        labels={"grasp": "lifted" if value_of(attempt, "is_gripping") else "dropped"},
    )


def value_of(attempt: Any, name: str) -> Any:
    """A number or a text. deepdish keeps these among the attributes of a group, and arrays of them as data sets."""
    value = attempt.attrs[name] if name in attempt.attrs else attempt[name][()]
    value = value.item() if hasattr(value, "item") else value
    return value.decode() if isinstance(value, bytes) else value
