"""What is in a data set, and what is wrong with it: every file is read."""

from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import blake2b

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from unitouch_gen import weights
from unitouch_gen.errors import InvalidInputError, first_of
from unitouch_gen.models import SensorBank, UniTouchModel
from unitouch_gen.models.images import centre_rectangle
from unitouch_gen.models.out_of_distribution import SIDE, is_untouched
from unitouch_gen.training.data.decoding import for_each
from unitouch_gen.training.data.frames import Frame
from unitouch_gen.training.data.records import Record, RecordSet

NEARER = 0.6
"""Exchanged channels are suspected where exchanging them brings a touch so much nearer to the gel at rest."""

UNLIKE_ANY = "touches look like those of no sensor that the model knows, as photos would; see that they are touches"

BLUE = -0.1
"""(red - blue) / (red + blue) of pictures below which they are bluer than photographs are on average."""

TILE, IN_A_ROW, ROWS = 112, 12, 4
"""Of the contact sheet: a tile's side in pixels, tiles in a row, rows of a sensor."""


@dataclass
class Seen:
    """What was seen of a record: its touch (3, SIDE, SIDE), a hash of it, its gel at rest, how red its picture is."""

    touch: Tensor
    digest: bytes
    rest: Tensor | None
    warmth: float | None


@dataclass
class Report:
    """What was found.

    Attributes:
        data: The data set.
        broken: Ids of records that cannot be read, with the reason.
        flagged: Ids of touches by what is odd about them: "untouched", "exchanged", "no touch".
        lines: All of it in words.
    """

    data: RecordSet
    broken: dict[str, str]
    flagged: dict[str, list[str]]
    lines: list[str]


def check(data: RecordSet, quiet: bool = False) -> Report:
    """Reads every file of a data set once, in several threads; `quiet` shows no progress."""
    files = [record.touch for record in data.records]
    found = for_each(lambda row: (data[row].id, look_at(data[row])), files, data.name, quiet)
    seen = {name: what for name, what in found if isinstance(what, Seen)}
    broken = {name: what for name, what in found if isinstance(what, str)}
    flagged = odd_touches([part.records for part in data.by_sensor()], seen)
    touches = np.stack([one.touch.numpy() for one in seen.values()]) if seen else np.zeros(0)
    flagged["no touch"] = [list(seen)[row] for row in unlike_any(built_in_sensors(), touches)] if seen else []
    same: dict[bytes, list[Record]] = {}
    for record in data.records:
        if record.id in seen:
            same.setdefault(seen[record.id].digest, []).append(record)
    twice = [" = ".join(record.id for record in records) for records in same.values() if len(records) > 1]
    leaks = sum(len({record.split for record in records} - {None}) > 1 for records in same.values())
    warmth = [one.warmth for one in seen.values() if one.warmth is not None]
    odd = {
        "records cannot be read": [f"{name}: {why}" for name, why in broken.items()],
        "touches look untouched": flagged["untouched"],
        "touches may have red and blue exchanged": flagged["exchanged"],
        UNLIKE_ANY: flagged["no touch"],
        "touches are there more than once": twice,
    }
    lines = [*data.notes, *data.leaks]
    lines += [f"{leaks} touches are in more than one of its own splits"] if leaks else []
    lines += [f"{len(names)} of {len(data)} {what}: {first_of(names)}" for what, names in odd.items() if names]
    if warmth and sum(warmth) / len(warmth) < BLUE:
        lines.append("Pictures are bluer than photographs are: they may have red and blue exchanged")
    if any(name.isdecimal() for name in data.materials):
        lines.append("Its materials are numbers; name them by `materials`")
    return Report(data, broken, flagged, lines)


def look_at(record: Record) -> Seen | str:
    """What is seen of a record, or why it cannot be read."""
    try:
        pixels = record.touch.read()
        digest = blake2b(pixels.contiguous().numpy().tobytes(), digest_size=16).digest()
        warmth = None
        if record.picture is not None:
            red, _, blue = record.picture.read().float().mean(dim=(1, 2)).tolist()
            warmth = (red - blue) / max(red + blue, 1e-6)
        rest = None if record.background is None else small(record.background.read())
        return Seen(small(pixels), digest, rest, warmth)
    except InvalidInputError as error:
        return str(error)


def small(pixels: Tensor) -> Tensor:
    return (centre_rectangle(pixels, SIDE, SIDE) * 255).byte()


def odd_touches(sensors: Sequence[Sequence[Record]], seen: dict[str, Seen]) -> dict[str, list[str]]:
    """Touches that differ little from their backgrounds, or from the median of their sensor; or more than exchanged."""
    flagged: dict[str, list[str]] = {"untouched": [], "exchanged": []}
    for records in sensors:
        known = {record.id: seen[record.id] for record in records if record.id in seen}
        if not known:
            continue
        median = torch.stack([one.touch for one in known.values()]).float().median(dim=0).values
        for name, one in known.items():
            rest = median if one.rest is None else one.rest.float()
            change = (one.touch.float() - rest).abs()
            if one.rest is None and len(known) < IN_A_ROW:
                continue  # too few for a median
            if is_untouched(one.touch.float()[None] / 255, rest[None] / 255):
                flagged["untouched"].append(name)
            elif (one.touch.float().flip(0) - rest).abs().mean() < NEARER * change.mean():
                flagged["exchanged"].append(name)
    return flagged


def built_in_sensors() -> SensorBank | None:
    """The sensors that the built-in joint space knows, if it is there."""
    if not (weights.JOINT / "config.json").is_file():
        return None
    return UniTouchModel.from_pretrained(weights.JOINT).load("touch")[1]


def unlike_any(bank: SensorBank | None, touches: np.ndarray) -> list[int]:
    """Rows of touches, uint8 (N, 3, S, S), that are 20 % of full scale from every sensor's mean."""
    if bank is None or not bool(bank.known.any()):
        return []
    distances: list[float] = []
    for part in torch.from_numpy(touches).split(64):
        raw = F.interpolate(part.float() / 255, (bank.prototype_size,) * 2, mode="bilinear", antialias=True)
        distances += bank.distances(raw).min(dim=1).values.tolist()
    return [row for row, distance in enumerate(distances) if distance > 0.2]


def contact_sheet(report: Report) -> Image.Image:
    """Some touches of each sensor by label, with their pictures below; then those that look untouched or exchanged."""
    data, labels = report.data, list(report.data.classes)
    rows: list[tuple[str, list[Record]]] = []
    for part in data.by_sensor():
        whole = [record for record in part.records if record.id not in report.broken]
        whole.sort(key=lambda record: [record.labels.get(label, -1) for label in labels])
        count = min(len(whole), IN_A_ROW * ROWS)
        chosen = [whole[place * len(whole) // count] for place in range(count)]
        rows += [(part.sensor or "", chosen[start : start + IN_A_ROW]) for start in range(0, count, IN_A_ROW)]
    for what, names in report.flagged.items():
        if few := set(names[:IN_A_ROW]):
            rows.append((f"{what}?", [record for record in data.records if record.id in few]))
    heights = [TILE * (2 if any(record.picture for record in records) else 1) + 32 for _, records in rows]
    sheet = Image.new("RGB", (IN_A_ROW * (TILE + 4) + 4, sum(heights) + 4), "white")
    pen, font, top = ImageDraw.Draw(sheet), ImageFont.load_default(11), 2
    for (title, records), height in zip(rows, heights, strict=True):
        pen.text((4, top), title, "black", font)
        for column, record in enumerate(records):
            left = 4 + column * (TILE + 4)
            for place, frame in enumerate(filter(None, (record.touch, record.picture))):
                sheet.paste(tile(frame), (left, top + 15 + place * TILE))
            words = [data.classes[label][record.labels[label]] for label in labels if label in record.labels]
            pen.text((left, top + height - 17), (", ".join(words) or record.id)[:16], "black", font)
        top += height
    return sheet


def tile(frame: Frame) -> Image.Image:
    return Image.fromarray((centre_rectangle(frame.read(), TILE, TILE) * 255).round().byte().permute(1, 2, 0).numpy())
