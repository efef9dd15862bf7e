"""Contacts as evaluation takes them: what a joint space and its controls make of the world's, or of a data set's.

Everything is computed once for each state of an encoder, and found again in the cache.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from unitouch_gen.errors import InvalidInputError, check_choice
from unitouch_gen.evaluation.contacts import SPLITS, Contacts, EvaluationSet
from unitouch_gen.evaluation.controls import relief_statistics, statistics, untrained_like
from unitouch_gen.evaluation.zero_shot import text_embeddings
from unitouch_gen.models import UniTouchModel, UniTouchProcessor
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.training.data.columns import (
    NEEDS,
    DataConfig,
    Rendered,
    computed_once,
    decoded,
    drawn,
    object_numbers,
    pixels_of,
    weights_hash,
)
from unitouch_gen.training.data.decoding import Computed
from unitouch_gen.training.data.drawn import GROUP, DrawnConfig, DrawnContacts
from unitouch_gen.training.data.records import RecordSet
from unitouch_gen.world import SENSORS

AT_ONCE = 128

TRAIN_OBJECTS, CONTACTS = 10, 5
"""Of each material, that probes are fitted to; and contacts of each."""

FIRST_SEED = 1000
"""Of the worlds that models are held against: beyond those that recipes train on."""


def world_set(
    model: UniTouchModel,
    processor: UniTouchProcessor,
    sensor: str | None,
    seed: int,
    cache: Path,
    *,
    objects: int = 8,
    textures: str | None = None,
    grasps: bool = False,
) -> EvaluationSet:
    """Contacts of a world by a sensor, or by sensors drawn anew.

    Args:
        model: Every modality that it has is embedded.
        processor: Of the model.
        sensor: Name of a sensor of the world; `None` draws one for every sixteen contacts.
        seed: Of the world.
        cache: Folder of what is rendered and embedded.
        objects: Of each material, to test on, and as many to validate on.
        textures: Folder of scanned materials among the surfaces.
        grasps: Whether to lift each object, too, for the label "grasp".

    Raises:
        InvalidInputError: If the world has no such sensor, or the cache cannot be used.
    """
    if sensor is not None:
        check_choice("sensor", sensor, SENSORS)
    source = DrawnContacts(0, sensor, TRAIN_OBJECTS, CONTACTS, seed, textures, objects)
    classes = {"material": source.materials} | ({"grasp": ("dropped", "lifted")} if grasps else {})
    splits, prints = {}, []
    for split in SPLITS:
        seen = drawn(cache, source, split, DataConfig(drawn=DrawnConfig()), processor)
        material, number, _ = source.contacts(split)
        labels = {"material": material}
        if grasps:
            labels["grasp"] = _grasps(source, split, cache / f"grasps-{seen.fingerprint}.safetensors")
        gels = [source.untouched(split, processor.image_size, group)[0] for group in range(-(-len(seen) // GROUP))]
        at_rest = (torch.stack(gels) * 255).round().byte().numpy().repeat(GROUP, axis=0)[: len(seen)]
        names = [sensor if sensor in model.sensors else None] * len(seen)
        features = embedded(model, processor, seen, seen.fingerprint, names, at_rest, cache)
        splits[split] = Contacts(features, labels, 10**6 * material + number)
        prints.append(seen.fingerprint)
    name = "sensors drawn anew" if sensor is None else sensor
    return EvaluationSet(name, sensor in model.sensors, classes, splits, seed, "-".join(prints))


def _grasps(source: DrawnContacts, split: str, file: Path) -> Tensor:
    """Whether a grasp holds at each contact, int64 (N,)."""
    names, world = source.contacts(split), source.world(32)

    def lifted(rows: Tensor) -> Tensor:
        chunk = (part[rows[0].item() : rows[-1].item() + 1] for part in names)
        scene = world.render(*chunk, modalities=("grasp",), sensors=source.pair(split, int(rows[0]) // GROUP)[:1])
        assert scene.grasp is not None
        return scene.grasp.held.float()

    return computed_once(file, lifted, [np.arange(len(names[0]))], GROUP).long()


def listed_set(model: UniTouchModel, data: RecordSet, *, whole: bool = False) -> EvaluationSet:
    """A data set's labels and objects, with features of no width: what can be checked before a file is read.

    Args:
        model, data, whole: See `folder_set`.

    Raises:
        InvalidInputError: If it cannot be split.
    """
    splits = {}
    for split, part in _parts(data, whole).items():
        empty = torch.empty(len(part), 0)
        features = {name: empty for name in ("touch", *_besides(part)) if name in model.known_modalities}
        splits[split] = Contacts(features, _labels(part), torch.from_numpy(object_numbers(part)))
    return EvaluationSet(data.name, _known(model, data), dict(data.classes), splits)


def folder_set(
    model: UniTouchModel, processor: UniTouchProcessor, data: RecordSet, cache: Path, *, whole: bool = False
) -> EvaluationSet:
    """A data set, with the modalities that every one of its records has.

    Args:
        model, processor, cache: See `world_set`.
        data: As `open_dataset` gives it.
        whole: Whether all of it is to be tested on; else it is split as it says, or by its objects.

    Raises:
        InvalidInputError: If it cannot be split, a file cannot be read, or the cache not be used.
    """
    listed, splits, prints = listed_set(model, data, whole=whole), {}, []
    for split, part in _parts(data, whole).items():
        seen = decoded(cache, part, DataConfig(), processor, ["touch", *_besides(part)], data.materials)
        behind = None
        if all(record.background is not None for record in part.records):
            size = processor.image_size
            behind = Computed(len(part), (3, size, size), np.uint8, partial(pixels_of, part, "background", size))
        names = [record.sensor if record.sensor in model.sensors else None for record in part.records]
        features = embedded(model, processor, seen, seen.fingerprint, names, behind, cache)
        splits[split] = replace(listed.splits[split], features=features)
        prints.append(seen.fingerprint)
    return replace(listed, splits=splits, fingerprint="-".join(prints))


def _parts(data: RecordSet, whole: bool) -> dict[str, RecordSet]:
    return {"test": data} if whole else {split: data.split(split) for split in SPLITS}


def _besides(data: RecordSet) -> list[str]:
    """Modalities beside touch that every record has."""
    return [name for name in ("image", "audio", "text") if all(NEEDS[name](r) is not None for r in data.records)]


def _labels(data: RecordSet) -> dict[str, Tensor]:
    return {name: torch.tensor([record.labels.get(name, -1) for record in data.records]) for name in data.classes}


def _known(model: UniTouchModel, data: RecordSet) -> bool:
    return {record.sensor for record in data.records} <= set(model.sensors)


@torch.no_grad()
def embedded(
    model: UniTouchModel,
    processor: UniTouchProcessor,
    seen: Rendered,
    key: str,
    sensors: Sequence[str | None],
    gels: np.ndarray | Computed | None,
    cache: Path,
) -> dict[str, Tensor]:
    """Features (N, D) of contacts by name; see `Contacts`.

    Args:
        model, processor, cache: See `world_set`.
        seen: Columns of the contacts.
        key: What changes when these do.
        sensors: Of each contact, one that the model knows, or `None` to retrieve it.
        gels: What each sensor sees untouched, uint8 (N, 3, S, S), where it is known.
    """
    if len(seen) == 0:
        raise InvalidInputError("A split has no contacts; pass a larger data set.")

    def once(name: str, state: str, compute: Callable[[np.ndarray], Tensor]) -> Tensor:
        file = cache / f"embeddings-{key}-{name}-{state}.safetensors"
        return computed_once(file, lambda rows: compute(rows.numpy()).float().cpu(), [np.arange(len(seen))], AT_ONCE)

    def bytes_of(column: Any, rows: np.ndarray) -> Tensor:
        return torch.from_numpy(np.array(column[rows])).float() / 255

    def felt(encoder: UniTouchModel, column: Any, rows: np.ndarray) -> Tensor:
        pixels = normalise_pixels(bytes_of(column, rows)).to(encoder.device)
        matches = encoder.match_sensors(pixels, [sensors[row] for row in rows])
        return encoder.get_touch_features(pixels, encoder.sensor_ids(matches))

    def plain(rows: np.ndarray) -> Tensor:
        behind = mean if gels is None else bytes_of(gels, rows)
        return torch.from_numpy(statistics(list(255 * (bytes_of(seen.touch, rows) - behind).movedim(1, -1).numpy())))

    def looked_at(rows: np.ndarray) -> Tensor:
        return model.get_image_features(normalise_pixels(bytes_of(seen.image, rows)).to(model.device))

    def heard(rows: np.ndarray) -> Tensor:
        return model.get_audio_features(torch.from_numpy(np.array(seen.audio[rows])).float()[:, None].to(model.device))

    def told(rows: np.ndarray) -> Tensor:
        return text_embeddings(model, processor, [seen.text[row] for row in rows])

    mean = bytes_of(seen.touch, np.arange(len(seen))).mean(dim=0) if gels is None else torch.empty(0)
    state, untrained = _state(model, "touch"), untrained_like(model).to(model.device)  # type: ignore[arg-type]
    found = {
        "touch": once("touch", state, partial(felt, model, seen.touch)),
        "untrained": once("untrained", _state(untrained, "touch"), partial(felt, untrained, seen.touch)),
        "statistics": once("statistics", "mean" if gels is None else "gel", plain),
        "relief": once("relief", "", lambda rows: torch.from_numpy(relief_statistics(bytes_of(seen.touch, rows)))),
    }
    if gels is not None:
        found["gel"] = once("gel", state, partial(felt, model, gels))
    columns = {"image": (seen.image is not None, looked_at), "audio": (seen.audio is not None, heard)}
    for name, (there, embed) in {**columns, "text": (any(seen.text), told)}.items():
        if there and name in model.known_modalities:
            found[name] = once(name, _state(model, name), embed)
    return found


def _state(model: UniTouchModel, modality: str) -> str:
    return "".join(weights_hash(module) for module in model.load(modality) if isinstance(module, nn.Module))
