"""HCT, the part of TVL that its authors recorded (Fu et al., 2024): a DIGIT, a camera, and words.

    data1/<session>/{vision,tactile}/<n>-<t>.jpg      data1/train.csv  data1/test.csv

The tables have a picture, a touch, the gel before it and a caption in each row.
"""

from collections.abc import Iterator
from pathlib import Path

from unitouch_gen.files import read_table
from unitouch_gen.training.data.records import Frame, Record, column_of, find_paths, frame_at

LOOKS_LIKE = ("data*/train.csv", "data*/test.csv")
COLUMNS = {
    "picture": ("url", "vision", "image", "rgb"),
    "touch": ("tactile", "touch"),
    "background": ("tactile_background", "background"),
    "caption": ("caption", "text"),
}
"""Names of columns in the releases."""


def read(folder: Path) -> Iterator[Record]:
    """A record for each row of the tables."""
    for file in find_paths(folder, *LOOKS_LIKE):
        rows = read_table(file)
        base = file.parent
        columns = {name: column_of(file, rows[0], alternatives) for name, alternatives in COLUMNS.items()}
        for row in rows:
            touch = row[columns["touch"]]
            background = base / row[columns["background"]]
            yield Record(
                f"{base.name}/{touch}",
                touch=Frame(str(base / touch)),
                picture=Frame(str(base / row[columns["picture"]])),
                background=frame_at(background) or frame_at(background.parents[2] / "digit_background.png"),
                sensor="digit",
                recording=f"{base.name}/{Path(touch).parts[0]}",
                caption=row[columns["caption"]] or None,
                split=file.stem,
            )
