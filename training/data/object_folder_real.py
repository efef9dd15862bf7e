"""ObjectFolder Real (Gao et al., 2023): a hundred objects pressed by a GelSlim.

<object>/tactile_data/<trial>/0/gelsight/<frame>.png, and a table of objects with their materials
"""

from collections.abc import Iterator
from pathlib import Path

from unitouch_gen.files import read_table
from unitouch_gen.training.data.records import Frame, Record, column_of, find_paths

LOOKS_LIKE = ("*/tactile_data/*/0/gelsight/*.png",)


def read(folder: Path) -> Iterator[Record]:
    """The frames of all trials."""
    materials: dict[str, str] = {}
    for file in find_paths(folder, "*.csv"):
        rows = read_table(file)
        item_column = column_of(file, rows[0], ("object", "id", "object_id", "index", "no", "number"))
        material_column = column_of(file, rows[0], ("material", "materials"))
        materials |= {row[item_column]: row[material_column].lower() for row in rows if row[material_column]}
    for image in find_paths(folder, *LOOKS_LIKE):
        item = image.parents[4].name
        trial = f"{item}/{image.parents[2].name}"
        yield Record(
            f"{trial}/{image.stem}",
            touch=Frame(str(image)),
            sensor="gelslim",
            object=item,
            recording=trial,
            labels={"material": materials[item]} if item in materials else {},
        )
