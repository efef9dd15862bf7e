"""A folder of one's own: with a table, or with folders that are named by materials.

    labels.csv       touch,picture,background,sensor,material,object,recording,caption,sound,split, and further labels
    a.jpg, ...       named in the table

    train/wood/a.jpg, ...      or wood/a.jpg without splits, or a.jpg without materials
    train/wood/plank/a.jpg     with a folder for each object of a material
    touch/..., picture/..., background/...      trees of the same names, with any endings; background.png is that of all
                                                in its folder

A table needs `touch` alone.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.files import find_file, read_table
from unitouch_gen.training.data.records import Frame, Record, column_of, few, found, images_in

LOOKS_LIKE = ()
FRAMES = ("touch", "picture", "background")
TEXTS = ("id", "sensor", "object", "recording", "caption", "split")
COLUMNS = (*FRAMES, *TEXTS, "sound")
SPLITS = ("train", "val", "test")
SPLIT_FOLDERS = {
    **dict.fromkeys(("train", "training"), "train"),
    **dict.fromkeys(("val", "valid", "validation", "dev"), "val"),
    **dict.fromkeys(("test", "testing"), "test"),
}
"""Splits by names of folders, which may be in capitals."""
UNKNOWN = ("", "-1", "-1.0", "nan")  # as labels; pandas writes integers and blanks as floats


def read(folder: Path) -> Iterator[Record | str]:
    """What its table names, or the images in it; and which files are left out."""
    tables = [file for file in found(folder, "*") if file.suffix.lower() in (".csv", ".tsv")]
    if len(tables) > 1:
        raise InvalidInputError(f"It holds {len(tables)} tables, {few([table.name for table in tables])}; leave one.")
    records = list(read_rows(folder, tables[0]) if tables else read_tree(folder))
    if not records:
        expected = (
            "MATERIAL/x.png or MATERIAL/OBJECT/x.png, perhaps in train/, val/ and test/; or name them in labels.csv"
        )
        raise InvalidInputError(f"it has no touches where they are expected: {expected}.")
    yield from records
    used = set(map(str, tables)).union(*(record.files for record in records))
    unread = [file.relative_to(folder).as_posix() for file in found(folder, "**/*") if str(file) not in used]
    if unread:
        yield f"{len(unread)} other files are not read, as they belong to no touch: {few(unread)}"


def read_rows(folder: Path, table: Path) -> Iterator[Record]:
    """What each row of the table names; columns that are none of a record's are labels."""
    rows = read_table(table)
    column_of(table, rows[0], ("touch",))
    for row in rows:
        known: dict[str, Any] = {"id": row["touch"]} | {name: row[name] or None for name in TEXTS if name in row}
        known |= {name: Frame(str(find_file(folder, row[name]))) for name in FRAMES if row.get(name)}
        known |= {"sound": str(find_file(folder, row["sound"]))} if row.get("sound") else {}
        if known.get("split") not in (None, *SPLITS):
            raise InvalidInputError(f"{str(table)!r} has the split {known['split']!r}; there are {', '.join(SPLITS)}.")
        labels = {name: text for name, text in row.items() if name not in COLUMNS and text.lower() not in UNKNOWN}
        yield Record(**known, labels=labels)


def read_tree(folder: Path) -> Iterator[Record]:
    """The images in folders that are named by materials, or by the objects of a material."""
    root = folder / "touch" if (folder / "touch").is_dir() else folder
    trees = {tree: by_name(folder / tree) if root != folder else {} for tree in ("picture", "background")}
    splits = {place: SPLIT_FOLDERS.get(place.name.casefold(), "") for place in folders_in(root)}
    parts = sorted((place for place in splits if splits[place]), key=lambda place: SPLITS.index(splits[place]))
    for part in parts or [root]:
        split = splits.get(part)
        yield from read_images(part, root, trees, split=split)
        for material in folders_in(part):
            labels = {"material": material.name}
            yield from read_images(material, root, trees, split=split, labels=labels)
            for item in folders_in(material):
                name = f"{material.name}/{item.name}"
                yield from read_images(item, root, trees, split=split, labels=labels, object=name)


def read_images(place: Path, root: Path, trees: dict[str, dict[Path, Frame]], **known: Any) -> Iterator[Record]:
    """The touches in one folder, with the pictures and backgrounds of the same names in other trees."""
    images = images_in(place)
    general = next((Frame(str(image)) for image in images if image.stem == "background"), None)
    for image in images:
        if image.stem == "background":
            continue
        name = image.relative_to(root)
        picture = trees["picture"].get(name.with_suffix(""))
        background = trees["background"].get(name.with_suffix("")) or general
        yield Record(name.as_posix(), Frame(str(image)), picture, background, **known)


def folders_in(place: Path) -> list[Path]:
    """The folders in a folder, in natural order."""
    return [path for path in found(place, "*") if path.is_dir()]


def by_name(folder: Path) -> dict[Path, Frame]:
    """The images of a tree by their paths in it, without endings."""
    return {image.relative_to(folder).with_suffix(""): Frame(str(image)) for image in images_in(folder, "**/*")}
