"""What stages are trained on: contacts of the built-in world and data sets, as arrays that are mapped into memory."""

import hashlib
import json
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
from unitouch_gen.evaluation.contacts import Contacts
from unitouch_gen.models import UniTouchProcessor
from unitouch_gen.models.images import centre_rectangle
from unitouch_gen.training.data.cache import Arrays, for_each, mapped
from unitouch_gen.training.data.drawn import GROUP, DrawnConfig, DrawnContacts, Relit
from unitouch_gen.training.data.records import Record, few
from unitouch_gen.training.data.sets import RecordSet, SplitBy, open_dataset
from unitouch_gen.training.recipe import Settings
from unitouch_gen.world import ATTRIBUTES, CELLS, MAPS, MATERIAL_NAMES, SAMPLE_RATE

Source = DrawnContacts | RecordSet


class SetConfig(Settings):
    """A data set to train on: the arguments of `open_dataset`, and `split`, what keeps its training split apart."""

    path: str
    kind: str = "auto"
    split: SplitBy | None = None
    sensor: str | None = None
    sampling_rate: PositiveInt | None = None


class DataConfig(Settings):
    """What a stage is trained on: data sets or the built-in world."""

    sets: list[SetConfig] = []
    drawn: DrawnConfig | None = None  # contacts of the world
    image_size: int | None = None  # side of the pictures, pixels, where no joint space says it
    touch_size: Annotated[int, Field(ge=8)] | None = None  # side of the touches, pixels; `image_size` if left out
    audio: dict[str, Any] | None = None  # fields of `LogMel`, where no joint space says them; the paper's if left out

    def sources(self) -> list[Source]:
        """All there is to train on, yet to be rendered or decoded: contacts or data sets of one sensor each."""
        if (self.drawn is None) == (not self.sets):
            raise InvalidInputError("`data` takes one of the two: `sets`, as [{path: FOLDER}], or `drawn`.")
        sources: list[Source] = [*self.drawn.sources()] if self.drawn else []
        for one in self.sets:
            data = open_dataset(one.path, **one.model_dump(exclude={"path", "split"}))
            sources += data.split("train", one.split).by_sensor()
        return sources


FIELDS = {"image": "picture", "gel": "background", "audio": "sound", "text": "caption"}  # in a record


def has(record: Record, need: str) -> bool:
    """Whether a record has a column that a stage may need: touch, image, gel, audio, text, sensor."""
    return getattr(record, FIELDS.get(need, need)) is not None


def columns_of(
    sources: Sequence[Source],
    cache: Path,
    config: DataConfig,
    processor: UniTouchProcessor,
    needs: Sequence[str],
) -> list[Contacts]:
    """The columns of each source to train on, rendered or decoded if the cache does not hold them yet.

    `needs` are those of `has`; other columns of data sets stay empty. Raises `InvalidInputError` if a data set lacks
    what is needed, or files cannot be read.
    """
    for data in (source for source in sources if isinstance(source, RecordSet)):
        lacking = [f"{need} for {r.id!r}" for need in needs for r in data.records if not has(r, need)]
        if lacking or len(data) < 2:
            wrong = f"no {few(lacking)}" if lacking else "a single record, where two are the least"
            raise InvalidInputError(f"{data} has {wrong}; this stage needs {', '.join(needs)} of every record.")
    if config.drawn is not None and config.drawn.colours_alone and "touch" in needs:
        raise InvalidInputError(
            "`data.drawn.colours_alone` is true, but this stage needs touches, and surfaces without heights feel flat; "
            "leave it out."
        )
    if config.touch_size not in (None, processor.image_size) and config.drawn is not None:
        raise InvalidInputError(f"`touch_size` is {config.touch_size}; with drawn sensors it is that of the pictures.")
    return [
        decoded(cache, source, processor, needs, config.touch_size)
        if isinstance(source, RecordSet)
        else drawn(cache, source, "train", processor)
        for source in sources
    ]


def drawn(cache: Path, source: DrawnContacts, split: str, processor: UniTouchProcessor) -> Contacts:
    """Renders a split of the world if the cache does not hold it yet, and opens it."""
    material, number, _ = source.contacts(split)
    size = processor.image_size
    mel = processor.audio
    fingerprint = f"{source.fingerprint(split)}-{size}-{hashlib.sha256(str(mel).encode()).hexdigest()[:8]}"
    folder = Path(cache) / f"{source.name}-{split}-{fingerprint}"
    columns: dict[str, tuple[Any, ...]] = {
        **dict.fromkeys(("image", "touch", "second"), (np.uint8, 3, size, size)),
        "audio": (np.float16, 1, mel.mel_bins, mel.frames),
        "attributes": (np.float32, 2, len(ATTRIBUTES)),
        "maps": (np.float16, 2, len(MAPS), CELLS, CELLS),
    }

    def write(arrays: Arrays, place: Path) -> None:
        text = list[str]()
        for scene, seen in tqdm(source.scenes(split, size), source.name, -(-len(material) // GROUP), mininterval=5):
            first, second = seen["touch"].unbind(dim=1)
            clips = processor.sounds([(sound, SAMPLE_RATE) for sound in scene.audio])[:, 0]
            made = {
                "image": as_bytes(scene.image),
                "touch": as_bytes(first),
                "second": as_bytes(second),
                "audio": clips,
                "attributes": seen["attributes"],
                "maps": seen["maps"],
            }
            for name, values in made.items():
                arrays[name][len(text) : len(text) + len(values)] = values
            text += scene.text
        (place / "text.json").write_text(json.dumps(text))

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


def relit(cache: Path, source: DrawnContacts, split: str, seen: Contacts) -> np.ndarray:
    """The pictures of a rendered split under other lamps, uint8 (N, 3, S, S), once into the cache."""

    def write(arrays: Arrays, _: Path) -> None:
        scenes = source.rendered(split, seen.image.shape[-1], "image", kind=Relit)
        for group, (scene, _) in enumerate(tqdm(scenes, f"{source.name}, relit", mininterval=5)):
            arrays["image"][GROUP * group :][:GROUP] = as_bytes(scene.image)

    folder = Path(cache) / f"{source.name}-{split}-relit-{seen.fingerprint}"
    return mapped(folder, len(seen), {"image": (np.uint8, *seen.image.shape[1:])}, write)["image"]


def decoded(
    cache: Path, data: RecordSet, processor: UniTouchProcessor, needs: Sequence[str], touch_size: int | None = None
) -> Contacts:
    """Decodes what is needed of the records of one sensor, if the cache does not hold it yet, and opens it.

    Files that cannot be read are refused in a list, and leave nothing in the cache.
    """
    size = processor.image_size
    mel = processor.audio
    side = touch_size or size
    kinds: dict[str, tuple[Any, ...]] = {
        "image": (np.uint8, 3, size, size),
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

        if broken := for_each(decode_row, data):
            reasons = few([*broken.values()])
            raise InvalidInputError(f"{data}: {len(broken)} of {len(data)} records cannot be read: {reasons}")

    files = {file: os.stat(file) for record in data.records for file in record.files}
    states = [f"{file} {state.st_size} {state.st_mtime_ns}" for file, state in sorted(files.items())]
    state = "\n".join([*map(str, data.records), *states, str((size, side, mel))])
    fingerprint = hashlib.sha256(state.encode()).hexdigest()[:16]
    columns: dict[str, Any] = dict.fromkeys(kinds)
    for name, kind in kinds.items():
        if name in needs:
            folder = Path(cache) / f"{re.sub(r'[^A-Za-z0-9_-]+', '_', data.name)}-{name}-{fingerprint}"
            columns[name] = mapped(folder, len(data), {"values": kind}, partial(decode, name))["values"]
    labels = {name: torch.tensor([record.labels.get(name, -1) for record in data.records]) for name in data.classes}
    objects = np.unique([record.object or record.id for record in data.records], return_inverse=True)[1]
    return Contacts(
        **columns,
        sensors=[record.sensor for record in data.records],
        objects=torch.from_numpy(objects),
        labels=labels,
        classes=data.classes,
        fingerprint=fingerprint,
        text=[record.caption or "" for record in data.records] if "text" in needs else (),
    )


def as_bytes(pixels: Tensor) -> np.ndarray:
    """Pixels in [0, 1] as uint8."""
    return (pixels * 255).round().byte().numpy()


def sound_of(record: Record, data: RecordSet) -> Any:
    """A record's sound as processors take it: its file, or samples and their rate."""
    file = str(record.sound)
    check_file("sound", file, "a sound file")
    return (np.load(file, allow_pickle=False), data.sampling_rate) if file.endswith(".npy") else file


def sensor_numbers(splits: Sequence[Contacts], names: Sequence[str], unnamed: int = -1) -> np.ndarray:
    """The place of each sample's sensor in `names`, int64 (N,); `unnamed` where it has none."""
    numbers: dict[str | None, int] = {name: number for number, name in enumerate(names)}
    return np.array([numbers.get(sensor, unnamed) for split in splits for sensor in split.sensors])
