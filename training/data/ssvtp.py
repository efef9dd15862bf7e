"""SSVTP (Kerr et al., 2022) as TVL has it, and TVL's own HCT (Fu et al., 2024): a DIGIT, a camera, and words.

    ssvtp/images_rgb/image_<id>_rgb.jpg  images_tac/image_<id>_tac.jpg  text/labels_<id>.txt  train.csv  test.csv
    hct/data1/<session>/{vision,tactile}/<n>-<t>.jpg                    data1/train.csv  data1/test.csv

HCT's tables have a picture, a touch, the gel before it and a caption in each row. A release of it has the folders of
pictures and touches exchanged, so some of both of each session are compared with the untouched gel: what is less like
it is the picture.
"""

import re
from dataclasses import replace
from pathlib import Path

import torch.nn.functional as F

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.training.data.frames import Frame
from unitouch_gen.training.data.reading import column_of, found, frame_at, images_in, read_table, read_text
from unitouch_gen.training.data.records import Record, RecordSet

LOOKS_LIKE = ("images_tac",)
TABLES = ("data*/train.csv", "data*/test.csv")


def read(folder: Path) -> RecordSet:
    """SSVTP's touches."""
    splits: dict[str, str] = {}
    for file in found(folder, "train.csv", "test.csv"):
        for row in read_table(file):
            name = next(iter(row.values()))  # the first column is the picture's
            if splits.setdefault(number_of(name), file.stem) != file.stem:
                raise InvalidInputError(f"{str(file)!r} has {name!r}, which is in another split, too.")
    records = []
    for image in images_in(folder / "images_tac"):
        number = number_of(image.name)
        records.append(
            Record(
                id=number,
                touch=Frame(str(image)),
                picture=frame_at(folder / "images_rgb" / f"image_{number}_rgb.jpg"),
                sensor="digit",
                caption=read_text(folder / "text" / f"labels_{number}.txt").strip() or None,
                split=splits.get(number),
            )
        )
    return RecordSet(folder.name, "ssvtp", tuple(records), apart="none")


def number_of(name: str) -> str:
    if (match := re.search(r"image_(\d+)_(?:rgb|tac)", name)) is None:
        raise InvalidInputError(f"{name!r} is no name of an image of SSVTP, such as images_rgb/image_12_rgb.jpg.")
    return match[1]


def read_hct(folder: Path) -> RecordSet:
    """HCT's touches."""
    sessions: dict[str, list[Record]] = {}
    for file in found(folder, *TABLES):
        rows, base = read_table(file), file.parent
        vision = column_of(file, rows[0], ("url", "vision", "image", "rgb"))
        tactile = column_of(file, rows[0], ("tactile", "touch"))
        untouched = column_of(file, rows[0], ("tactile_background", "background"))
        caption = column_of(file, rows[0], ("caption", "text"))
        for row in rows:
            background = base / row[untouched]
            session = f"{base.name}/{Path(row[tactile]).parts[0]}"
            record = Record(
                id=f"{base.name}/{row[tactile]}",
                touch=Frame(str(base / row[tactile])),
                picture=Frame(str(base / row[vision])),
                background=frame_at(background) or frame_at(background.parents[2] / "digit_background.png"),
                sensor="digit",
                recording=session,
                caption=row[caption] or None,
                split=file.stem,
            )
            sessions.setdefault(session, []).append(record)
    swapped = {name for name, records in sessions.items() if is_swapped(records)}
    records = tuple(
        replace(record, touch=record.picture, picture=record.touch) if name in swapped and record.picture else record
        for name, members in sessions.items()
        for record in members
    )
    note = f"pictures and touches of {len(swapped)} of {len(sessions)} sessions lie in each other's folders; exchanged"
    return RecordSet(folder.name, "hct", records, apart="recording", notes=(note,) if swapped else ())


def is_swapped(session: list[Record]) -> bool:
    """Whether, in most of three places of a session, the picture is more like the untouched gel than the touch is."""
    votes = 0
    for record in session[:: max(len(session) // 3, 1)][:3]:
        if record.background and record.picture:
            frames = (record.touch, record.picture, record.background)
            touch, picture, gel = (F.adaptive_avg_pool2d(frame.read().float(), 8) for frame in frames)
            votes += 1 if (picture - gel).abs().mean() < (touch - gel).abs().mean() else -1
    return votes > 0
