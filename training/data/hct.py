"""HCT, the part of TVL that its authors recorded (Fu et al., 2024): a DIGIT, a camera, and words.

    data1/<session>/{vision,tactile}/<n>-<t>.jpg      data1/train.csv  data1/test.csv

The tables have a picture, a touch, the gel before it and a caption in each row.
"""

from collections.abc import Iterator
from pathlib import Path

from unitouch_gen.files import read_table
from unitouch_gen.training.data.records import Frame, Record, column_of, found, frame_at

LOOKS_LIKE = ("data*/train.csv", "data*/test.csv")
COLUMNS = (
    ("url", "vision", "image", "rgb"),
    ("tactile", "touch"),
    ("tactile_background", "background"),
    ("caption", "text"),
)
"""What releases call the columns of picture, touch, background and caption."""


def read(folder: Path) -> Iterator[Record]:
    """Its touches."""
    for file in found(folder, *LOOKS_LIKE):
        rows = read_table(file)
        base = file.parent
        columns = [column_of(file, rows[0], names) for names in COLUMNS]
        for row in rows:
            picture, touch, background, caption = (row[column] for column in columns)
            gel = frame_at(base / background) or frame_at((base / background).parents[2] / "digit_background.png")
            yield Record(
                f"{base.name}/{touch}",
                Frame(str(base / touch)),
                Frame(str(base / picture)),
                gel,
                sensor="digit",
                recording=f"{base.name}/{Path(touch).parts[0]}",
                caption=caption or None,
                split=file.stem,
            )
