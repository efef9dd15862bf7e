"""A folder of one's own: with a table, or with folders that are named by materials.

    labels.csv       touch,picture,background,sensor,material,object,recording,caption,sound,split, and further labels
    a.jpg, ...       named in the table

    train/wood/a.jpg, ...      or wood/a.jpg without splits, or a.jpg without materials
    touch/..., picture/..., background/...      trees of the same names, with any endings; background.png is that of all
                                                in its folder

A table needs `touch` alone.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.files import read_table
from unitouch_gen.training.data.records import Frame, Record, column_of, few, found, images_in

LOOKS_LIKE = ()
FRAMES = ("touch", "picture", "background")
TEXTS = ("id", "sensor", "object", "recording", "caption", "split")
COLUMNS = (*FRAMES, *TEXTS, "sound")
SPLITS = ("train", "val", "test")
UNKNOWN = ("", "-1", "-1.0", "nan")  # as labels; pandas writes integers and blanks as floats


def read(folder: Path) -> Iterator[Record | str]:
    """What its table names, or the images in it; and which files are left out."""
    tables = [file for file in found(folder, "*") if file.suffix.lower() in (".csv", ".tsv")]
    if len(tables) > 1:
        raise InvalidInputError(f"It holds {len(tables)} tables, {few([table.name for table in tables])}; leave one.")
    records = list(read_rows(folder, tables[0]) if tables else read_tree(folder))
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
        known |= {name: Frame(str(folder / row[name])) for name in FRAMES if row.get(name)}
        known |= {"sound": str(folder / row["sound"])} if row.get("sound") else {}
        if known.get("split") not in (None, *SPLITS):
            raise InvalidInputError(f"{str(table)!r} has the split {known['split']!r}; there are {', '.join(SPLITS)}.")
        labels = {name: text for name, text in row.items() if name not in COLUMNS and text.lower() not in UNKNOWN}
        yield Record(**known, labels=labels)


def read_tree(folder: Path) -> Iterator[Record]:
    """The images in folders that are named by materials."""
    root = folder / "touch" if (folder / "touch").is_dir() else folder
    parts = [root / part for part in SPLITS if (root / part).is_dir()] or [root]
    pictures, backgrounds = (by_name(folder / tree) if root != folder else {} for tree in ("picture", "background"))
    for place in [place for part in parts for place in (part, *filter(Path.is_dir, found(part, "*")))]:
        general = next((Frame(str(image)) for image in images_in(place) if image.stem == "background"), None)
        for image in images_in(place):
            if image.stem == "background":
                continue
            name = image.relative_to(root)
            picture, background = (tree.get(name.with_suffix("")) for tree in (pictures, backgrounds))
            labels = {} if place in parts else {"material": place.name}
            split = None if parts == [root] else name.parts[0]
            yield Record(name.as_posix(), Frame(str(image)), picture, background or general, labels=labels, split=split)


def by_name(folder: Path) -> dict[Path, Frame]:
    """The images of a tree by their paths in it, without endings."""
    return {image.relative_to(folder).with_suffix(""): Frame(str(image)) for image in images_in(folder, "**/*")}
