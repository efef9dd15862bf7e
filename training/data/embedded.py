"""Contacts as evaluation takes them: what a joint space and its controls make of the world's, or of a data set's.

Everything is computed once for each state of an encoder, and found again in the cache.
"""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from unitouch_gen import weights
from unitouch_gen.errors import InvalidInputError, check_choice
from unitouch_gen.evaluation.contacts import SPLITS, Contacts, EvaluationSet
from unitouch_gen.evaluation.controls import UNTRAINED, relief_statistics, statistics, untrained_like
from unitouch_gen.evaluation.generated import load_classifier
from unitouch_gen.evaluation.zero_shot import text_embeddings
from unitouch_gen.models import SensorMatch, UniTouchModel, UniTouchProcessor
from unitouch_gen.models.classifier import ContactClassifier, ContactClassifierOutput
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.training.data.columns import (
    NEEDS,
    DataConfig,
    Rendered,
    computed_once,
    decoded,
    object_numbers,
    pixels_of,
    weights_hash,
)
from unitouch_gen.training.data.decoding import Computed
from unitouch_gen.training.data.drawn import GROUP, DrawnContacts
from unitouch_gen.training.data.held import Held, HeldOut, HeldRecords, float_pixels, held_of
from unitouch_gen.training.data.records import RecordSet
from unitouch_gen.world import SENSORS

AT_ONCE = 128

TRAIN_OBJECTS, CONTACTS = 10, 5
"""Objects of each material that probes are fitted to, and contacts of each object."""

FIRST_SEED = 1000
"""Seed of the first of the worlds that models are held against: beyond those that recipes train on."""


def world_source(sensor: str | None, seed: int, objects: int = 8, textures: str | None = None) -> DrawnContacts:
    """Contacts of a world that a model is held against, yet to be rendered.

    Args:
        sensor: Name of a sensor of the world; `None` draws one for every sixteen contacts.
        seed: Of the world.
        objects: Of each material, to test on, and as many to validate on.
        textures: Folder of scanned materials among the surfaces.

    Raises:
        InvalidInputError: If the world has no such sensor.
    """
    if sensor is not None:
        check_choice("sensor", sensor, SENSORS)
    return DrawnContacts(0, sensor, TRAIN_OBJECTS, CONTACTS, seed, textures, objects)


def world_splits(cache: Path, processor: UniTouchProcessor, source: DrawnContacts) -> dict[str, Held]:
    """All splits of a `world_source`, rendered once."""
    return {split: held_of(cache, processor, source, split) for split in SPLITS}


def world_set(
    model: UniTouchModel, processor: UniTouchProcessor, splits: Mapping[str, Held], cache: Path, *, grasps: bool = False
) -> EvaluationSet:
    """Contacts of a world by a sensor, or by sensors drawn anew.

    Args:
        model: Every modality that it has is embedded.
        processor: Of the model.
        splits: See `world_splits`.
        cache: Folder of what is embedded.
        grasps: Whether to lift each object, too, for the label "grasp" and, where pictures are embedded, the features
            "outcome".

    Raises:
        InvalidInputError: If the cache cannot be used.
    """
    source = splits["test"].source
    classes = {"material": source.materials} | ({"grasp": ("dropped", "lifted")} if grasps else {})
    contacts = {}
    for split, held in splits.items():
        seen, (material, number, _) = held.seen, source.contacts(split)
        labels, lifted = {"material": material}, dict[str, Tensor]()
        if grasps:
            labels["grasp"], lifted = _grasps(model, held, cache)
        gels = [source.untouched(split, processor.image_size, group)[0] for group in range(-(-len(seen) // GROUP))]
        at_rest = (torch.stack(gels) * 255).round().byte().numpy().repeat(GROUP, axis=0)[: len(seen)]
        features = embedded(
            model, processor, seen, seen.fingerprint, known(model, [seen.sensor] * len(seen)), at_rest, cache
        )
        contacts[split] = Contacts(features | lifted, labels, 10**6 * material + number)
    name = "sensors drawn anew" if source.sensor is None else source.sensor
    prints = "-".join(held.seen.fingerprint for held in splits.values())
    return EvaluationSet(name, source.sensor in model.sensors, classes, contacts, source.seed, prints)


def with_classifier(one: EvaluationSet, splits: Mapping[str, HeldOut], cache: Path) -> EvaluationSet:
    """A set with the features of the built-in classifier of touches, as "supervised": it learned by labels."""
    classifier = load_classifier(weights.TOUCH_CLASSIFIER)
    contacts = {}
    for split, held in splits.items():
        said = observed_once(classifier, held.seen.touch, f"{held.seen.fingerprint}-touch", cache)
        assert said.features is not None
        features = {**one.splits[split].features, "supervised": said.features}
        contacts[split] = replace(one.splits[split], features=features)
    return replace(one, splits=contacts)


def observed_once(classifier: ContactClassifier, images: np.ndarray, key: str, cache: Path) -> ContactClassifierOutput:
    """What a classifier says of images, uint8 (N, 3, S, S), computed once for each key, which names them."""

    def read(rows: Tensor) -> Tensor:
        said = classifier.observe(float_pixels(images[rows.numpy()]))
        return torch.cat([part for part in (said.logits, said.features, said.attributes) if part is not None], dim=1)

    file = cache / f"observed-{key}-{weights_hash(classifier)}.safetensors"
    values = computed_once(file, read, [np.arange(len(images))], AT_ONCE)
    words, numbers = len(classifier.config.id2label or ()), len(classifier.attributes)
    logits, features, attributes = values.split([words, values.shape[1] - words - numbers, numbers], dim=1)
    return ContactClassifierOutput(logits=logits, features=features, attributes=attributes if numbers else None)


@torch.no_grad()
def _grasps(model: UniTouchModel, held: Held, cache: Path) -> tuple[Tensor, dict[str, Tensor]]:
    """Whether a grasp holds at each contact, int64 (N,), and as "outcome" embeddings (N, D) of pictures of that."""
    pictured, size = "image" in model.known_modalities, held.seen.touch.shape[-1]
    asked = ("grasp", "outcome") if pictured else ("grasp",)

    def scene_of(group: int) -> tuple[Tensor, Tensor | None]:
        scene = held.source.grasped(held.split, group, size, *asked)
        assert scene.grasp is not None
        return scene.grasp[:, None], None if scene.outcome is None else scene.outcome.image

    def computed(rows: Tensor) -> Tensor:
        margin, image = scene_of(int(rows[0]) // GROUP)
        if image is None:
            return margin
        embeds = model.get_image_features(normalise_pixels(image).to(model.device))
        return torch.cat([margin, embeds.float().cpu()], dim=1)

    margin, image = scene_of(0)  # which has friction, weight, force and what pictures show in it
    digest = hashlib.sha256(f"{held.seen.fingerprint} {size} {len(held.seen)}".encode())
    digest.update(margin.numpy().round(4).tobytes())
    if image is not None:
        digest.update(encoder_hash(model, "image").encode() + (255 * image).round().byte().numpy().tobytes())
    file = cache / f"grasps-{digest.hexdigest()[:16]}.safetensors"
    values = computed_once(file, computed, [np.arange(len(held.seen))], GROUP)
    return (values[:, 0] > 1.0).long(), {"outcome": values[:, 1:]} if pictured else {}


def listed_set(model: UniTouchModel, data: RecordSet, splits: Sequence[str] = SPLITS) -> EvaluationSet:
    """A data set's labels and objects, with features of no width: what can be checked before a file is read.

    Args:
        model, data, splits: See `folder_set`.

    Raises:
        InvalidInputError: If it cannot be split.
    """
    contacts = {}
    for split, part in _parts(data, splits).items():
        empty = torch.empty(len(part), 0)
        features = {name: empty for name in ("touch", *_besides(part)) if name in model.known_modalities}
        contacts[split] = Contacts(features, _labels(part), torch.from_numpy(object_numbers(part)))
    return EvaluationSet(data.name, _of_known_sensors(model, data), dict(data.classes), contacts)


def folder_set(
    model: UniTouchModel, processor: UniTouchProcessor, data: RecordSet, cache: Path, splits: Sequence[str] = SPLITS
) -> EvaluationSet:
    """A data set, with the modalities that every one of its records has.

    Args:
        model, processor, cache: See `world_set`.
        data: As `open_dataset` gives it.
        splits: It is split as it says, or by its objects, into those of these names; all of it is tested on if there
            are none. Lists without "val" leave a share of the objects or recordings to train on to it.

    Raises:
        InvalidInputError: If it cannot be split, a file cannot be read, or the cache not be used.
    """
    listed, contacts, prints = listed_set(model, data, splits), {}, []
    for split, held in record_splits(cache, processor, data, splits).items():
        seen, part, behind = held.seen, held.source, None
        if all(record.background is not None for record in part.records):
            size = processor.image_size
            behind = Computed(len(part), (3, size, size), np.uint8, partial(pixels_of, part, "background", size))
        names = known(model, [record.sensor for record in part.records])
        features = embedded(
            model, processor, seen, seen.fingerprint, names, behind, cache, untrained=1 if splits else UNTRAINED
        )
        contacts[split] = replace(listed.splits[split], features=features)
        prints.append(seen.fingerprint)
    return replace(listed, splits=contacts, fingerprint="-".join(prints))


def record_splits(
    cache: Path, processor: UniTouchProcessor, data: RecordSet, splits: Sequence[str]
) -> dict[str, HeldRecords]:
    """The parts of a `folder_set`, decoded once."""
    return {
        split: HeldRecords(
            part, split, decoded(cache, part, DataConfig(), processor, ["touch", *_besides(part)], data.materials)
        )
        for split, part in _parts(data, splits).items()
    }


def with_joint_space(
    one: EvaluationSet, data: RecordSet, name: str, model: UniTouchModel, processor: UniTouchProcessor, cache: Path
) -> EvaluationSet:
    """A whole `folder_set` with the features of another joint space's touch encoder, at its own size, by name."""
    seen = decoded(cache, data, DataConfig(), processor, ["touch"], data.materials)
    sensors = known(model, [record.sensor for record in data.records])
    key = f"{seen.fingerprint}-{processor.image_size}"
    features = {**one.splits["test"].features, name: touch_features(model, seen.touch, sensors, key, cache)}
    return replace(one, splits={"test": replace(one.splits["test"], features=features)})


def _parts(data: RecordSet, splits: Sequence[str]) -> dict[str, RecordSet]:
    """By split; what is validated on is dealt out of the training split where the data set's own lists name none."""
    listed = {record.split for record in data.records} - {None}
    if "val" not in splits or not listed or "val" in listed or data.apart == "none":
        return {split: data.split(split) for split in splits} or {"test": data}
    known = data.split("train")
    try:
        held = known.split("val", data.apart)
    except InvalidInputError as error:
        raise InvalidInputError(
            f"{data} lists no split 'val', and fewer than three {data.apart}s to train on that it could be dealt out "
            "of; list some records as 'val'."
        ) from error
    chosen = {record.id for record in held.records}
    rest = known.part(f"{known.chosen}, less {held.chosen}", lambda record: record.id not in chosen)
    own = {"train": rest, "val": held}
    return {split: own[split] if split in own else data.split(split) for split in splits}


def _besides(data: RecordSet) -> list[str]:
    """Modalities beside touch that every record has."""
    return [name for name in ("image", "audio", "text") if all(NEEDS[name](r) is not None for r in data.records)]


def _labels(data: RecordSet) -> dict[str, Tensor]:
    return {name: torch.tensor([record.labels.get(name, -1) for record in data.records]) for name in data.classes}


def _of_known_sensors(model: UniTouchModel, data: RecordSet) -> bool:
    return {record.sensor for record in data.records} <= set(model.sensors)


def known(model: UniTouchModel, sensors: Sequence[str | None]) -> list[str | None]:
    """Names of sensors that a model knows, and `None` for others, which it is to retrieve."""
    return [name if name in model.sensors else None for name in sensors]


@torch.no_grad()
def embedded(
    model: UniTouchModel,
    processor: UniTouchProcessor,
    seen: Rendered,
    key: str,
    sensors: Sequence[str | None],
    gels: np.ndarray | Computed | None,
    cache: Path,
    untrained: int = 1,
) -> dict[str, Tensor]:
    """Features (N, D) of contacts by name; see `Contacts`.

    Args:
        model, processor, cache: See `world_set`.
        seen: Columns of the contacts.
        key: What changes when these do.
        sensors: Of each contact, one that the model knows, or `None` to retrieve it.
        gels: What each sensor sees untouched, uint8 (N, 3, S, S), where it is known.
        untrained: How many encoders that have learned nothing there are beside the model's.
    """
    if len(seen) == 0:
        raise InvalidInputError("A split has no contacts; pass a larger data set.")

    def once(name: str, state: str, compute: Callable[[np.ndarray], Tensor]) -> Tensor:
        file = cache / f"embeddings-{key}-{name}-{state}.safetensors"
        return computed_once(file, lambda rows: compute(rows.numpy()).float().cpu(), [np.arange(len(seen))], AT_ONCE)

    def plain(rows: np.ndarray) -> Tensor:
        behind = mean if gels is None else float_pixels(gels[rows])
        apart = float_pixels(seen.touch[rows]) - behind
        return torch.from_numpy(statistics(list(255 * apart.movedim(1, -1).numpy())))

    def looked_at(rows: np.ndarray) -> Tensor:
        return model.get_image_features(normalise_pixels(float_pixels(seen.image[rows])).to(model.device))

    def heard(rows: np.ndarray) -> Tensor:
        return model.get_audio_features(torch.from_numpy(np.array(seen.audio[rows])).float()[:, None].to(model.device))

    def told(rows: np.ndarray) -> Tensor:
        return text_embeddings(model, processor, [seen.text[row] for row in rows])

    mean = float_pixels(seen.touch).mean(dim=0) if gels is None else torch.empty(0)
    encoders: dict[str, UniTouchModel] = {"touch": model}
    for seed in range(untrained):
        name = f"untrained {seed}" if seed else "untrained"
        encoders[name] = untrained_like(model, seed).to(model.device)  # type: ignore[arg-type]
    found = {
        **{name: touch_features(encoder, seen.touch, sensors, key, cache) for name, encoder in encoders.items()},
        "statistics": once("statistics", "mean" if gels is None else "gel", plain),
        "relief": once("relief", "", lambda rows: torch.from_numpy(relief_statistics(float_pixels(seen.touch[rows])))),
    }
    if gels is not None:
        found["gel"] = touch_features(model, gels, sensors, f"{key}-gel", cache)
    columns = {"image": (seen.image is not None, looked_at), "audio": (seen.audio is not None, heard)}
    for name, (there, embed) in {**columns, "text": (any(seen.text), told)}.items():
        if there and name in model.known_modalities:
            found[name] = once(name, encoder_hash(model, name), embed)
    return found


@torch.no_grad()
def touch_features(
    encoder: UniTouchModel, touches: np.ndarray | Computed, sensors: Sequence[str | None], key: str, cache: Path
) -> Tensor:
    """Features (N, D) of touches, uint8 (N, 3, S, S), by a touch encoder.

    Args:
        encoder: With touch.
        touches, sensors: See `embedded`.
        key: What changes when the touches do.
        cache: See `world_set`.
    """

    def compute(rows: Tensor) -> Tensor:
        some = [sensors[row] for row in rows.tolist()]
        return touch_embeddings(encoder, float_pixels(touches[rows.numpy()]), some)[0]

    file = cache / f"embeddings-{key}-touch-{encoder_hash(encoder, 'touch')}.safetensors"
    return computed_once(file, compute, [np.arange(len(touches))], AT_ONCE)


@torch.no_grad()
def touch_embeddings(
    encoder: UniTouchModel, touches: Tensor, sensors: Sequence[str | None] | None = None
) -> tuple[Tensor, list[SensorMatch]]:
    """Features (N, D) of touches (N, 3, S, S) in [0, 1], a few at a time, and the sensor of each.

    Args:
        encoder: With touch.
        touches: Of any number.
        sensors: Names that the encoder knows, or `None` to retrieve one.
    """
    rows, matches = list[Tensor](), list[SensorMatch]()
    for start in range(0, len(touches), AT_ONCE):
        pixels = normalise_pixels(touches[start : start + AT_ONCE]).to(encoder.device)
        found = encoder.match_sensors(pixels, None if sensors is None else sensors[start : start + AT_ONCE])
        rows.append(encoder.get_touch_features(pixels, encoder.sensor_ids(found)).float().cpu())
        matches += found
    return torch.cat(rows), matches


def encoder_hash(model: UniTouchModel, modality: str) -> str:
    """What changes with any weight of a modality's encoder."""
    return "".join(weights_hash(module) for module in model.load(modality) if isinstance(module, nn.Module))
