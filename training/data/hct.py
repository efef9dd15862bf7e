"""HCT, the part of TVL that its authors recorded (Fu et al., 2024): a DIGIT, a camera, and words.

    data1/<session>/{vision,tactile}/<n>-<t>.jpg      data1/train.csv  data1/test.csv

The tables have a picture, a touch, the gel before it and a caption in each row. A release of it has the folders of
pictures and touches exchanged, so some of both of each session are compared with the untouched gel: what is less like
it is the picture.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import torch.nn.functional as F

from unitouch_gen.files import read_table
from unitouch_gen.training.data.records import Frame, Record, column_of, found, frame_at

LOOKS_LIKE = ("data*/train.csv", "data*/test.csv")
COLUMNS = (("url", "vision", "image", "rgb"), ("tactile", "touch"), ("tactile_background", "background"),
           ("caption", "text"))  # fmt: skip
"""What releases call the columns of picture, touch, background and caption."""


def read(folder: Path) -> Iterator[Record | str]:
    """Its touches, by session."""
    sessions: dict[str, list[Record]] = {}
    for file in found(folder, *LOOKS_LIKE):
        rows, base = read_table(file), file.parent
        columns = [column_of(file, rows[0], names) for names in COLUMNS]
        for row in rows:
            picture, touch, background, caption = (row[column] for column in columns)
            session = f"{base.name}/{Path(touch).parts[0]}"
            gel = frame_at(base / background) or frame_at((base / background).parents[2] / "digit_background.png")
            record = Record(
                f"{base.name}/{touch}", Frame(str(base / touch)), Frame(str(base / picture)), gel,
                sensor="digit", recording=session, caption=caption or None, split=file.stem,
            )  # fmt: skip
            sessions.setdefault(session, []).append(record)
    swapped = {session for session, records in sessions.items() if is_swapped(records)}
    for session, records in sessions.items():
        for record in records:
            exchanged = replace(record, touch=record.picture or record.touch, picture=record.touch)
            yield exchanged if session in swapped else record
    if swapped:
        yield f"pictures and touches of {len(swapped)} of {len(sessions)} sessions lay in each other's folders"


def is_swapped(session: list[Record]) -> bool:
    """Whether, in most of three places of a session, the picture is more like the untouched gel than the touch is."""
    votes = list[bool]()
    for record in session[:: max(len(session) // 3, 1)][:3]:
        if record.background and record.picture:
            frames = (record.touch, record.picture, record.background)
            touch, picture, gel = (F.adaptive_avg_pool2d(frame.read().float(), 8) for frame in frames)
            votes.append(bool((picture - gel).abs().mean() < (touch - gel).abs().mean()))
    return sum(votes) > len(votes) / 2
