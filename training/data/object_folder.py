"""ObjectFolder 1.0 and 2.0 in the form of its benchmark, and ObjectFolder Real (Gao et al., 2021, 2022, 2023).

    {vision,touch}/<object>/<point>.png  audio_examples/<object>/<point>.npy
    label.json  {object: 0 to 6}         split.json  {train, val, test: [[object, point], ...]}

    <object>/tactile_data/<trial>/0/gelsight/<frame>.png, and a table of objects with their materials

Objects 1 to 100 are those of 1.0, touched by TACTO, and those above of 2.0, touched by Taxim. What the numbers of
materials stand for was never published: name them with `materials`, or they stay numbers.
"""

import json
from pathlib import Path

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.training.data.frames import Frame
from unitouch_gen.training.data.reading import column_of, few, found, frame_at, read_table, read_text
from unitouch_gen.training.data.records import MATERIAL, Record, RecordSet

LOOKS_LIKE = ("label.json",)
REAL = "*/tactile_data/*/0/gelsight/*.png"
LOOKS_LIKE_REAL = (REAL,)


def read(folder: Path) -> RecordSet:
    """The points of its split, or all there are without one."""
    labels = json.loads(read_text(folder / "label.json"))
    points = [(image.parent.name, image.stem, None) for image in found(folder, "touch/*/*.png")]
    if (folder / "split.json").is_file():
        splits = json.loads(read_text(folder / "split.json"))
        points = [(str(item), str(point), split) for split, pairs in splits.items() for item, point in pairs]
    if unknown := sorted({item for item, _, _ in points} - labels.keys()):
        raise InvalidInputError(f"label.json has no label for the objects {few(unknown)}.")
    records = []
    for item, point, split in points:
        sound = folder / "audio_examples" / item / f"{point}.npy"
        records.append(
            Record(
                id=f"{item}/{point}",
                touch=Frame(str(folder / "touch" / item / f"{point}.png")),
                picture=frame_at(folder / "vision" / item / f"{point}.png"),
                sensor="tacto" if int(item) <= 100 else "taxim",
                object=item,
                labels={MATERIAL: int(labels[item])},
                sound=str(sound) if sound.is_file() else None,
                split=split,
            )
        )
    return RecordSet(folder.name, "object_folder", tuple(records), {MATERIAL: tuple("0123456")})


def read_real(folder: Path) -> RecordSet:
    """The frames of all trials."""
    materials: dict[str, str] = {}
    for file in found(folder, "*.csv"):
        rows = read_table(file)
        item = column_of(file, rows[0], ("object", "id", "object_id", "index", "no", "number"))
        material = column_of(file, rows[0], (MATERIAL, "materials"))
        materials |= {row[item]: row[material].lower() for row in rows if row[material]}
    names = sorted(set(materials.values()))
    records = []
    for image in found(folder, REAL):
        item, trial = image.parents[4].name, image.parents[2].name
        records.append(
            Record(
                id=f"{item}/{trial}/{image.stem}",
                touch=Frame(str(image)),
                sensor="gelslim",
                object=item,
                recording=f"{item}/{trial}",
                labels={MATERIAL: names.index(materials[item])} if item in materials else {},
            )
        )
    return RecordSet(folder.name, "object_folder_real", tuple(records), {MATERIAL: tuple(names)})
