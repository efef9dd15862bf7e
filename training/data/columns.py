"""Training data of stages: contacts of the built-in world and of data sets, as memory-mapped arrays."""

import hashlib
import json
import math
import os
import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field, PositiveInt
from torch import Tensor
from tqdm.auto import tqdm

from unitouch_gen.errors import InvalidInputError, check_file
from unitouch_gen.models import UniTouchProcessor
from unitouch_gen.models.images import centre_rectangle
from unitouch_gen.models.sounds import LogMel
from unitouch_gen.training.data.cache import Arrays, for_each, mapped
from unitouch_gen.training.data.contacts import Contacts
from unitouch_gen.training.data.drawn import GROUP, DrawnConfig, DrawnContacts, Relit
from unitouch_gen.training.data.records import FRAMES, Record, abbreviate
from unitouch_gen.training.data.sets import RecordSet, SplitBy, open_dataset
from unitouch_gen.training.recipe import Settings
from unitouch_gen.world import ATTRIBUTES, CELLS, MAPS, MATERIAL_NAMES, SAMPLE_RATE

Source = DrawnContacts | RecordSet


class SetConfig(Settings):
    """A data set to train on: the arguments of `open_dataset`, and `split`, by what its splits are kept apart."""

    path: str
    kind: str = "auto"
    split: SplitBy | None = None
    sensor: str | None = None
    sampling_rate: PositiveInt | None = None


class DataConfig(Settings):
    """Training data of a stage: data sets or the built-in world."""

    sets: list[SetConfig] = []
    drawn: DrawnConfig | None = None  # contacts of the world
    image_size: int | None = None  # side of the pictures, pixels; a joint space has its own
    touch_size: Annotated[int, Field(ge=8)] | None = None  # side of the touches, pixels; `image_size` if left out
    audio: dict[str, Any] | None = None  # fields of `LogMel`, the paper's if left out; a joint space has its own

    def sources(self) -> list[Source]:
        """All sources of training data, not yet rendered or decoded, each of one sensor."""
        if (self.drawn is None) == (not self.sets):
            raise InvalidInputError("`data` takes one of the two: `sets`, as [{path: FOLDER}], or `drawn`.")
        sources: list[Source] = [*self.drawn.sources()] if self.drawn else []
        for config in self.sets:
            data = open_dataset(config.path, **config.model_dump(exclude={"path", "split"}))
            sources += data.split("train", config.split).by_sensor()
        return sources


FIELDS = {"image": "picture", "gel": "background", "audio": "sound", "text": "caption"}
"""Fields of a record by the names of columns; other columns have the names of their fields."""

OF_WORLD = ("image", "touch", "audio", "text", "sensor")
"""Columns that drawn contacts have, of those that a stage may need."""

ColumnKind = tuple[Any, ...]  # dtype, then shape of a row


def has(record: Record, column: str) -> bool:
    """Whether a record has a column that a stage may need, such as touch, image, gel, audio, text or sensor."""
    return getattr(record, FIELDS.get(column, column)) is not None


def columns_of(
    sources: Sequence[Source],
    cache: Path,
    config: DataConfig,
    processor: UniTouchProcessor,
    needs: Sequence[str],
) -> list[Contacts]:
    """The columns of each source to train on, rendered or decoded if the cache does not hold them yet.

    `needs` are names of columns, see `has`. Other columns of data sets stay empty.

    Raises:
        InvalidInputError: If a data set or the world lacks a column, or files cannot be read.
    """
    for source in sources:
        if isinstance(source, RecordSet):
            check_columns(source, needs)
    if config.drawn is not None and config.drawn.colours_alone and "touch" in needs:
        raise InvalidInputError(
            "`data.drawn.colours_alone` is true, but this stage needs touches, and surfaces without heights feel flat; "
            "leave it out."
        )
    unknown = [column for column in needs if column not in OF_WORLD]
    if config.drawn is not None and unknown:
        raise InvalidInputError(
            f"`data.drawn` renders no {' and no '.join(unknown)}, which this stage needs; pass `data.sets`."
        )
    if config.touch_size not in (None, processor.image_size) and config.drawn is not None:
        raise InvalidInputError(f"`touch_size` is {config.touch_size}; with drawn sensors it is that of the pictures.")
    columns = list[Contacts]()
    for source in sources:
        if isinstance(source, RecordSet):
            columns.append(decoded(cache, source, processor, needs, config.touch_size))
        else:
            columns.append(drawn(cache, source, "train", processor))
    return columns


def check_columns(data: RecordSet, needs: Sequence[str]) -> None:
    """Raises if a record of a data set lacks a column, or there is only one record."""
    lacking = [f"{column} for {record.id!r}" for column in needs for record in data.records if not has(record, column)]
    if lacking or len(data) < 2:
        wrong = f"no {abbreviate(lacking)}" if lacking else "a single record, where two are the least"
        raise InvalidInputError(f"{data} has {wrong}; this stage needs {', '.join(needs)} of every record.")


def drawn(cache: Path, source: DrawnContacts, split: str, processor: UniTouchProcessor) -> Contacts:
    """Renders a split of the world if the cache does not hold it yet, and opens it."""
    material, number, _ = source.contacts(split)
    size = processor.image_size
    mel = processor.audio
    mel_hash = hashlib.sha256(str(mel).encode()).hexdigest()
    fingerprint = f"{source.fingerprint(split)}-{size}-{mel_hash[:8]}"
    folder = Path(cache) / f"{source.name}-{split}-{fingerprint}"
    columns: dict[str, ColumnKind] = {
        **dict.fromkeys(("image", "touch", "second"), (np.uint8, 3, size, size)),
        "audio": (np.float16, 1, mel.mel_bins, mel.frames),
        "attributes": (np.float32, 2, len(ATTRIBUTES)),
        "maps": (np.float16, 2, len(MAPS), CELLS, CELLS),
    }

    def write(arrays: Arrays, folder: Path) -> None:
        text = list[str]()
        scenes = source.scenes(split, size)
        for scene, of_sensors in tqdm(scenes, source.name, total=math.ceil(len(material) / GROUP), mininterval=5):
            first, second = of_sensors["touch"].unbind(dim=1)
            rows = {
                "image": as_bytes(scene.image),
                "touch": as_bytes(first),
                "second": as_bytes(second),
                "audio": processor.sounds([(sound, SAMPLE_RATE) for sound in scene.audio])[:, 0],
                "attributes": of_sensors["attributes"],
                "maps": of_sensors["maps"],
            }
            for name, values in rows.items():
                arrays[name][len(text) : len(text) + len(values)] = values
            text += scene.text
        (folder / "text.json").write_text(json.dumps(text))

    arrays: Any = mapped(folder, len(material), columns, write)
    arrays["attributes"] = torch.from_numpy(np.array(arrays["attributes"]))
    return Contacts(
        **arrays,
        sensors=[source.sensor] * len(material),
        objects=10**6 * material + number,
        labels={"material": material},
        classes={"material": MATERIAL_NAMES},
        text=json.loads((folder / "text.json").read_text()),
        fingerprint=fingerprint,
    )


def relit(cache: Path, source: DrawnContacts, split: str, contacts: Contacts) -> np.ndarray:
    """The pictures of a rendered split under other lamps, uint8 (N, 3, S, S), rendered once into the cache."""

    def write(arrays: Arrays, _: Path) -> None:
        scenes = source.rendered(split, contacts.image.shape[-1], "image", kind=Relit)
        for group, (scene, _) in enumerate(tqdm(scenes, f"{source.name}, relit", mininterval=5)):
            start = GROUP * group
            arrays["image"][start : start + GROUP] = as_bytes(scene.image)

    folder = Path(cache) / f"{source.name}-{split}-relit-{contacts.fingerprint}"
    columns: dict[str, ColumnKind] = {"image": (np.uint8, *contacts.image.shape[1:])}
    return mapped(folder, len(contacts), columns, write)["image"]


def decoded(
    cache: Path, data: RecordSet, processor: UniTouchProcessor, needs: Sequence[str], touch_size: int | None = None
) -> Contacts:
    """Decodes the columns `needs` of a data set of one sensor, if the cache does not hold them yet, and opens them.

    Raises:
        InvalidInputError: If files cannot be read. Nothing is left in the cache.
    """
    size = processor.image_size
    mel = processor.audio
    side = touch_size or size
    columns_of_frames = {frame: column for column, frame in FIELDS.items()}
    images = [columns_of_frames.get(frame, frame) for frame in FRAMES]
    kinds: dict[str, ColumnKind] = {
        **dict.fromkeys(images, (np.uint8, 3, size, size)),
        **dict.fromkeys(("touch", "gel"), (np.uint8, 3, side, side)),
        "audio": (np.float16, 1, mel.mel_bins, mel.frames),
    }

    def decode(name: str, arrays: Arrays, _: Path) -> None:
        rows = arrays["values"]

        def decode_row(row: int) -> None:
            record = data.records[row]
            value = getattr(record, FIELDS.get(name, name))
            if name == "audio":
                rows[row] = processor.sounds([sound_of(record, data)], name=value)[0, 0]
            else:
                rows[row] = as_bytes(centre_rectangle(value.read(), *rows.shape[2:]))

        broken = for_each(decode_row, data)
        if broken:
            reasons = abbreviate([*broken.values()])
            raise InvalidInputError(f"{data}: {len(broken)} of {len(data)} records cannot be read: {reasons}")

    fingerprint = fingerprint_of(data, size, side, mel)
    safe_name = re.sub(r"[^A-Za-z0-9_-]+", "_", data.name)
    columns: dict[str, Any] = dict.fromkeys(kinds)
    for name, kind in kinds.items():
        if name in needs:
            folder = Path(cache) / f"{safe_name}-{name}-{fingerprint}"
            columns[name] = mapped(folder, len(data), {"values": kind}, partial(decode, name))["values"]
    labels = {name: torch.tensor([record.labels.get(name, -1) for record in data.records]) for name in data.classes}
    _, objects = np.unique([record.object or record.id for record in data.records], return_inverse=True)
    return Contacts(
        **columns,
        sensors=[record.sensor for record in data.records],
        objects=torch.from_numpy(objects),
        labels=labels,
        classes=data.classes,
        fingerprint=fingerprint,
        text=[record.caption or "" for record in data.records] if "text" in needs else (),
    )


def fingerprint_of(data: RecordSet, size: int, side: int, mel: LogMel) -> str:
    """A hash of the records, of the size and time of their files, and of the sizes they are decoded to."""
    stats = {file: os.stat(file) for record in data.records for file in record.files}
    states = [f"{file} {stat.st_size} {stat.st_mtime_ns}" for file, stat in sorted(stats.items())]
    state = "\n".join([*map(str, data.records), *states, str((size, side, mel))])
    return hashlib.sha256(state.encode()).hexdigest()[:16]


def as_bytes(pixels: Tensor) -> np.ndarray:
    """Pixels in [0, 1] as uint8."""
    return (pixels * 255).round().byte().numpy()


def sound_of(record: Record, data: RecordSet) -> Any:
    """A record's sound as processors take it: its file, or samples and their rate."""
    file = str(record.sound)
    check_file("sound", file, "a sound file")
    if file.endswith(".npy"):
        return np.load(file, allow_pickle=False), data.sampling_rate
    return file


def sensor_numbers(splits: Sequence[Contacts], names: Sequence[str], unnamed: int = -1) -> np.ndarray:
    """The index of each sample's sensor in `names`, int64 (N,); `unnamed` if it is not among them."""
    numbers: dict[str | None, int] = {name: number for number, name in enumerate(names)}
    return np.array([numbers.get(sensor, unnamed) for split in splits for sensor in split.sensors])
