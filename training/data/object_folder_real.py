"""ObjectFolder Real (Gao et al., 2023): a hundred objects pressed by a GelSlim.

<object>/tactile_data/<trial>/0/gelsight/<frame>.png, and a table of objects with their materials
"""

from collections.abc import Iterator
from pathlib import Path

from unitouch_gen.files import read_table
from unitouch_gen.training.data.records import Frame, Record, column_of, found

LOOKS_LIKE = ("*/tactile_data/*/0/gelsight/*.png",)


def read(folder: Path) -> Iterator[Record]:
    """The frames of all trials."""
    materials: dict[str, str] = {}
    for file in found(folder, "*.csv"):
        rows = read_table(file)
        item = column_of(file, rows[0], ("object", "id", "object_id", "index", "no", "number"))
        material = column_of(file, rows[0], ("material", "materials"))
        materials |= {row[item]: row[material].lower() for row in rows if row[material]}
    for image in found(folder, *LOOKS_LIKE):
        item = image.parents[4].name
        trial = f"{image.parents[4].name}/{image.parents[2].name}"
        labels = {"material": materials[item]} if item in materials else {}
        touch = Frame(str(image))
        yield Record(f"{trial}/{image.stem}", touch, sensor="gelslim", object=item, recording=trial, labels=labels)
