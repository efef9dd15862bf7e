"""TacQuad (Feng et al., 2025): objects pressed by a GelSight Mini, a DIGIT and a DuraGel, with a camera beside them.

    contact_indoor.csv  contact_outdoor.csv       item, then first and last frame of the contact of each sensor
    data_indoor/<item>/{gelsight,digit,duragel}/0.png
    data_indoor/<item>/{img_gelsight,img_digit,img_duragel}/0.png

Camera and sensors have frames of different length, so a touch is paired with the picture of the same share of its
recording, as its authors do. The first frame of a recording is the background of a contact that begins later.
"""

from collections.abc import Iterator
from pathlib import Path

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.files import read_table
from unitouch_gen.training.data.records import Frame, Record, find_paths, images_in

LOOKS_LIKE = ("contact_indoor.csv", "contact_outdoor.csv")
SENSORS = {"gelsight": "gelsight_mini", "digit": "digit", "duragel": "duragel"}  # by their folders
HEADER = ("item", *(f"{sensor}_{end}" for sensor in SENSORS for end in ("start", "end")))


def read(folder: Path) -> Iterator[Record]:
    """The frames of all contacts."""
    for table in find_paths(folder, *LOOKS_LIKE):
        for row in read_table(table, HEADER):
            if row["item"] == "item":  # some copies have a header
                continue
            item = folder / table.stem.replace("contact", "data") / row["item"]
            for sensor in SENSORS:
                yield from contact(item, sensor, int(row[f"{sensor}_start"]), int(row[f"{sensor}_end"]))


def contact(item: Path, sensor: str, start: int, end: int) -> Iterator[Record]:
    """The frames of one sensor's contact."""
    touches = [Frame(str(image)) for image in images_in(item / sensor)]
    pictures = [Frame(str(image)) for image in images_in(item / f"img_{sensor}")]
    if not 0 <= start <= end < len(touches):
        raise InvalidInputError(f"{str(item / sensor)!r} has {len(touches)} images, but contact from {start} to {end}.")
    recording = f"{item.parent.name}/{item.name}/{sensor}"
    gel = touches[0] if start > 0 else None
    for number in range(start, end + 1):
        picture = pictures[number * len(pictures) // len(touches)] if pictures else None
        yield Record(
            f"{recording}/{number}",
            touch=touches[number],
            picture=picture,
            background=gel,
            sensor=SENSORS[sensor],
            object=item.name,
            recording=recording,
        )
