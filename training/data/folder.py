"""A folder of one's own: with a table, or with folders that are named by materials.

    labels.csv       touch,picture,background,sensor,material,object,recording,caption,sound,split, and further labels
    a.jpg, ...       named in the table

    train/wood/a.jpg, ...      or wood/a.jpg without splits, or a.jpg without materials
    train/wood/plank/a.jpg     with a folder for each object of a material
    touch/..., picture/..., background/...      trees of the same names, with any suffixes; background.png is the
                                                background of all images in its folder

A table needs only the column `touch`.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.files import find_file, read_table
from unitouch_gen.training.data.records import FRAMES, Frame, Record, abbreviate, column_of, find_paths, images_in

LOOKS_LIKE = ()
TEXTS = ("id", "sensor", "object", "recording", "caption", "split")
COLUMNS = (*FRAMES, *TEXTS, "sound")
SPLITS = ("train", "val", "test")
SPLIT_FOLDERS = {
    **dict.fromkeys(("train", "training"), "train"),
    **dict.fromkeys(("val", "valid", "validation", "dev"), "val"),
    **dict.fromkeys(("test", "testing"), "test"),
}
"""Splits by names of folders; case does not matter."""
UNKNOWN = ("", "-1", "-1.0", "nan")  # labels that mean none; pandas writes integers in a column with blanks as floats


def read(folder: Path) -> Iterator[Record | str]:
    """The rows of its table, or the images in it, and a note on files that are left out."""
    tables = [file for file in find_paths(folder, "*") if file.suffix.lower() in (".csv", ".tsv")]
    if len(tables) > 1:
        raise InvalidInputError(
            f"It holds {len(tables)} tables, {abbreviate([table.name for table in tables])}; leave one."
        )
    records = list(read_rows(folder, tables[0]) if tables else read_tree(folder))
    if not records:
        expected = (
            "MATERIAL/x.png or MATERIAL/OBJECT/x.png, perhaps in train/, val/ and test/; or name them in labels.csv"
        )
        raise InvalidInputError(f"it has no touches where they are expected: {expected}.")
    yield from records
    read_files = set(map(str, tables)).union(*(record.files for record in records))
    files = find_paths(folder, "**/*")
    unread = [file.relative_to(folder).as_posix() for file in files if str(file) not in read_files]
    if unread:
        yield f"{len(unread)} other files are not read, as they belong to no touch: {abbreviate(unread)}"


def read_rows(folder: Path, table: Path) -> Iterator[Record]:
    """A record for each row of the table. Columns that are no fields of a record are labels."""
    rows = read_table(table)
    column_of(table, rows[0], ("touch",))
    for row in rows:
        fields: dict[str, Any] = {"id": row["touch"]}
        for name in TEXTS:
            if name in row:
                fields[name] = row[name] or None
        for name in FRAMES:
            if row.get(name):
                fields[name] = Frame(str(find_file(folder, row[name])))
        if row.get("sound"):
            fields["sound"] = str(find_file(folder, row["sound"]))
        split = fields.get("split")
        if split not in (None, *SPLITS):
            raise InvalidInputError(f"{str(table)!r} has the split {split!r}; there are {', '.join(SPLITS)}.")
        labels = {name: text for name, text in row.items() if name not in COLUMNS and text.lower() not in UNKNOWN}
        yield Record(**fields, labels=labels)


def read_tree(folder: Path) -> Iterator[Record]:
    """The images in folders that are named by materials, or by the objects of a material."""
    root = folder
    trees: dict[str, dict[Path, Frame]] = {"picture": {}, "background": {}}
    if (folder / "touch").is_dir():
        root = folder / "touch"
        trees = {name: by_name(folder / name) for name in trees}
    split_of: dict[Path, str] = {}
    for subfolder in folders_in(root):
        split = SPLIT_FOLDERS.get(subfolder.name.casefold())
        if split is not None:
            split_of[subfolder] = split
    for part in sorted(split_of, key=lambda subfolder: SPLITS.index(split_of[subfolder])) or [root]:
        fields: dict[str, Any] = {"split": split_of.get(part)}
        yield from read_images(part, root, trees, **fields)
        for material in folders_in(part):
            fields["labels"] = {"material": material.name}
            yield from read_images(material, root, trees, **fields)
            for item in folders_in(material):
                yield from read_images(item, root, trees, **fields, object=f"{material.name}/{item.name}")


def read_images(folder: Path, root: Path, trees: dict[str, dict[Path, Frame]], **fields: Any) -> Iterator[Record]:
    """The touches in one folder, with the pictures and backgrounds of the same names in other trees."""
    images = images_in(folder)
    common_background = next((Frame(str(image)) for image in images if image.stem == "background"), None)
    for image in images:
        if image.stem == "background":
            continue
        path = image.relative_to(root)
        yield Record(
            path.as_posix(),
            touch=Frame(str(image)),
            picture=trees["picture"].get(path.with_suffix("")),
            background=trees["background"].get(path.with_suffix("")) or common_background,
            **fields,
        )


def folders_in(folder: Path) -> list[Path]:
    """The folders in a folder, in natural order."""
    return [path for path in find_paths(folder, "*") if path.is_dir()]


def by_name(folder: Path) -> dict[Path, Frame]:
    """The images of a tree by their paths in it, without suffixes."""
    return {image.relative_to(folder).with_suffix(""): Frame(str(image)) for image in images_in(folder, "**/*")}
