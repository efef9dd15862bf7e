"""ObjectFolder 1.0 and 2.0 in the form of its benchmark, and ObjectFolder Real (Gao et al., 2021, 2022, 2023).

    {vision,touch}/<object>/<point>.png  audio_examples/<object>/<point>.npy
    label.json  {object: 0 to 6}         split.json  {train, val, test: [[object, point], ...]}

    <object>/tactile_data/<trial>/0/gelsight/<frame>.png, and a table of objects with their materials

Objects 1 to 100 are those of 1.0, touched by TACTO, and those above of 2.0, touched by Taxim. What the numbers of
materials stand for was never published: name them with `materials`, or they stay numbers.
"""

from pathlib import Path

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.files import read_json
from unitouch_gen.training.data.frames import Frame
from unitouch_gen.training.data.reading import beside, column_of, found, frame_at, integer, read_table
from unitouch_gen.training.data.records import MATERIAL, Record, RecordSet

LOOKS_LIKE = ("label.json",)
REAL = "*/tactile_data/*/0/gelsight/*.png"
LOOKS_LIKE_REAL = (REAL,)
MATERIALS = tuple("0123456")
LAST_OF_FIRST = 100
"""The last object of ObjectFolder 1.0."""


def read(folder: Path) -> RecordSet:
    """The points of its split, or all there are without one."""
    labels = read_json("label.json", folder / "label.json")
    records = []
    for item, point, split in points_of(folder):
        sound = beside(folder, "audio_examples", item, f"{point}.npy")
        if item not in labels:
            raise InvalidInputError(f"{str(folder / 'label.json')!r} has no label for object {item!r}.")
        records.append(
            Record(
                id=f"{item}/{point}",
                touch=Frame(str(folder / "touch" / item / f"{point}.png")),
                picture=frame_at(folder, "vision", item, f"{point}.png"),
                sensor="tacto" if integer(item, "An object") <= LAST_OF_FIRST else "taxim",
                object=item,
                labels={MATERIAL: integer(labels[item], f"The label of object {item!r}")},
                sound=None if sound is None else str(sound),
                split=split,
            )
        )
    return RecordSet(folder.name, "object_folder", tuple(records), {MATERIAL: MATERIALS})


def points_of(folder: Path) -> list[tuple[str, str, str | None]]:
    """Object, point and split of each touch."""
    file = folder / "split.json"
    if not file.is_file():
        return [(image.parent.name, image.stem, None) for image in found(folder, "touch/*/*.png")]
    try:
        return [(str(item), str(at), name) for name, pairs in read_json(file.name, file).items() for item, at in pairs]
    except (TypeError, ValueError) as error:
        raise InvalidInputError(
            f"{str(file)!r} is no list of [object, point] for each split; download it again."
        ) from error


def read_real(folder: Path) -> RecordSet:
    """The frames of all trials."""
    materials: dict[str, str] = {}
    for file in found(folder, "*.csv"):
        rows = read_table(file)
        item = column_of(file, rows[0], ("object", "id", "object_id", "index", "no", "number"))
        material = column_of(file, rows[0], (MATERIAL, "materials"))
        materials.update({row[item]: row[material].lower() for row in rows if row[material]})
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
