"""Contacts that nothing was trained on, for evaluation: of the world, or of a data set."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from hashlib import sha256
from itertools import product
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.models import UniTouchProcessor
from unitouch_gen.models.features import float_pixels
from unitouch_gen.training.data.columns import as_bytes, decoded, drawn, has, relit, sound_of
from unitouch_gen.training.data.contacts import SPLITS, Contacts, Splits
from unitouch_gen.training.data.drawn import GROUP, DrawnContacts
from unitouch_gen.training.data.records import Record
from unitouch_gen.training.data.sets import RecordSet
from unitouch_gen.world import SAMPLE_RATE
from unitouch_gen.world.questions import TOPICS, asked_of

FIRST_SEED = 1000  # of the worlds that models are held against: beyond those that recipes train on
OBJECTS, CONTACTS = 10, 5  # objects of each material that probes are fitted to, and contacts of each object


def world_contacts(
    cache: Path, processor: UniTouchProcessor, source: DrawnContacts, split: str, *, grasps: bool = False
) -> Contacts:
    """Contacts of a split of the world, rendered once into `cache`; with the label "grasp", if asked for."""
    seen = drawn(cache, source, split, processor)
    size = processor.image_size

    def sounds() -> list[tuple[Tensor, int]]:
        return [(sound, SAMPLE_RATE) for scene, _ in source.rendered(split, 32, "audio") for sound in scene.audio]

    labels = {**seen.labels}
    classes = {**seen.classes}
    if grasps:
        margins = [scene.grasp for scene, _ in source.rendered(split, 32, "grasp")]
        labels["grasp"] = (torch.cat(margins) > 1.0).long()
        classes["grasp"] = ("dropped", "lifted")
    return replace(
        seen,
        labels=labels,
        classes=classes,
        sounds=sounds,
        relit=lambda: float_pixels(relit(cache, source, split, seen)),
        gel=as_bytes(source.untouched(split, size)[:, 0]).repeat(GROUP, axis=0)[: len(seen)],
        asked=lambda: asked_of(source.world().draw(*source.contacts(split)), seen.attributes[:, 0]),
    )


def dataset_contacts(cache: Path, processor: UniTouchProcessor, data: RecordSet) -> Contacts:
    """Contacts of a data set, with what every one of its records has, decoded once into `cache`."""
    modalities = modalities_of(data)
    gel = ["gel"] if all(has(record, "gel") for record in data.records) else []
    seen = decoded(cache, data, processor, ["touch", *gel, *modalities])
    answers = {"caption": list(seen.text)} if "text" in modalities else {}
    if bool((seen.material >= 0).all()):
        names = data.classes["material"]
        answers["material"] = [f"it is {names[label]}." for label in seen.material.tolist()]
    asked = []
    for row in range(len(data) if answers else 0):
        asked.append({topic: (TOPICS[topic].questions[0], [texts[row]]) for topic, texts in answers.items()})

    def sounds() -> list[Any]:
        return [sound_of(record, data) for record in data.records]

    return replace(seen, sounds=sounds if "audio" in modalities else None, asked=lambda: asked)


def modalities_of(data: RecordSet) -> list[str]:
    """Modalities other than touch that every record has."""
    return [name for name in ("image", "audio", "text") if all(has(record, name) for record in data.records)]


def parts_of(data: RecordSet) -> dict[str, RecordSet]:
    """A data set by split, as its own lists or its objects say; a "val" that lists lack is a share of their "train"."""
    own = {record.split for record in data.records} - {None}
    if not own and data.apart == "none":
        raise InvalidInputError(
            f"{data} has neither splits nor objects nor recordings that keep contacts apart; nothing may be fitted to "
            "what figures are of, so give its table a column `split` or `object`."
        )
    if not own or "val" in own:
        return {split: data.split(split) for split in SPLITS}
    train = data.split("train")
    val = train.split("val", data.apart) if data.apart != "none" else tenth_of_each_material(train)
    chosen = {record.id for record in val.records}
    rest = [record for record in train.records if record.id not in chosen]
    return {"train": replace(train, records=tuple(rest)), "val": val, "test": data.split("test")}


def tenth_of_each_material(data: RecordSet) -> RecordSet:
    """A tenth of the records of each material, by the hash of their names: where nothing keeps them apart.

    At least one, unless it is the only record of its material.
    """
    materials: dict[int | None, list[Record]] = {}
    for record in sorted(data.records, key=lambda record: sha256(record.id.encode()).digest()):
        materials.setdefault(record.labels.get("material"), []).append(record)
    chosen = list[Record]()
    for records in materials.values():
        count = max(round(len(records) / 10), 1)
        chosen += records[: min(count, len(records) - 1)]
    return replace(data, records=tuple(chosen), chosen="val, a tenth of train")


Sets = Iterator[tuple[str, int, Splits]]
"""Names of sensors or data sets, seeds, and contacts by split."""


def of_world(
    cache: Path,
    processor: UniTouchProcessor,
    sensors: Sequence[str],
    seeds: Sequence[int],
    objects: int,
    *,
    grasps: bool = False,
    scanned: float = 0.0,
    recordings: float = 0.0,
) -> Sets:
    """Worlds of some seeds, each by named sensors and by sensors drawn anew, with so many objects of each material.

    Shares of the objects are scanned, and of the sounds recorded, as in `DrawnContacts`.
    """
    for seed, sensor in product(seeds, (*sensors, None)):
        source = DrawnContacts(
            number=0,
            sensor=sensor,
            objects=OBJECTS,
            contacts_per_object=CONTACTS,
            seed=FIRST_SEED + seed,
            held_out=objects,
            scanned=scanned,
            recordings=recordings,
        )
        splits = {split: world_contacts(cache, processor, source, split, grasps=grasps) for split in SPLITS}
        yield sensor or "sensors drawn anew", source.seed, splits


def of_datasets(cache: Path, processor: UniTouchProcessor, sets: Sequence[RecordSet]) -> Sets:
    """Data sets, each in all of its splits."""
    for data in sets:
        splits = {split: dataset_contacts(cache, processor, part) for split, part in parts_of(data).items()}
        yield data.name, 0, splits
