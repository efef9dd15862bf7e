"""How good the built-in family is: zero-shot accuracy, and how often a classifier sees in an image what it was made of.

The classifiers share nothing with the joint space. Contacts are of the held-out split, and numbers depend on the
weights and the seeds alone.
"""

import json
import statistics
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from tests.benchmarks.measuring import Figures, quiet
from unitouch_gen import weights
from unitouch_gen.evaluation.consistency import agreement, consistency
from unitouch_gen.evaluation.controls import others
from unitouch_gen.evaluation.zero_shot import PROMPTS, accuracy, class_embeddings, zero_shot_scores
from unitouch_gen.models import UniTouchModel, UniTouchProcessor
from unitouch_gen.models.autoencoders import decode, encode
from unitouch_gen.models.classifier import ContactClassifier
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.models.sensors import SensorMatch
from unitouch_gen.pipelines.tiny import joint_space
from unitouch_gen.world import COLLECTION_MATERIALS, COLLECTIONS, SAMPLE_RATE, Scene, World, contacts

CONTACTS = 4
"""Contacts of each held-out object."""

COLLECTIONS_SHOWN = ("world_gelsight", "world_digit", "world_taxim", "world_tacto")
"""Touches to make pictures of, one collection a sensor: GelSight, DIGIT and Taxim, and TACTO, which nothing was trained
on."""

SENSOR_OF = {"world_gelsight": "gelsight", "world_digit": "digit", "world_taxim": "taxim"}
"""A collection for each sensor that is drawn, and the sensor that took it."""

TOUCH_WEIGHTS = (0.0, 0.3, 0.5, 0.7, 1.0)
"""Weights of the touch in restyled pictures; 0.3 is the paper's."""

FEATURES_AT_ONCE, IMAGES_AT_ONCE = 256, 64

# Held-out contacts ----------------------------------------------------------------------------------------------------


def held_out(name: str, split: str, modalities: tuple[str, ...], sensors: tuple[str, ...] | None = None) -> Scene:
    """The held-out contacts of one collection, ordered by material; touches of its own sensor, or of those named."""
    collection = COLLECTIONS[name]
    sensors = (collection.sensor,) if sensors is None else sensors
    rows = contacts(collection, split, CONTACTS)
    return World().render(*rows, modalities=modalities, sensors=sensors, style=collection.style)


def some_of_each(material: Tensor, per_material: int) -> Tensor:
    """Rows of a few contacts of every material, spread over its objects; `material` is ordered, each equally often."""
    rows = torch.arange(len(material)).view(len(COLLECTION_MATERIALS), -1)
    chosen = torch.linspace(0, rows.shape[1] - 1, per_material).round().long()
    return rows[:, chosen].flatten()


# The joint space ------------------------------------------------------------------------------------------------------


@torch.no_grad()
def touch_features(model: UniTouchModel, touches: Tensor) -> tuple[Tensor, list[SensorMatch]]:
    """Features (N, D) of touches (N, 3, S, S) in [0, 1], and the sensor retrieved for each."""
    rows, matches = [], []
    for part in normalise_pixels(touches).split(FEATURES_AT_ONCE):
        found = model.match_sensors(part)
        matches += found
        rows.append(model.get_touch_features(part, model.sensor_ids(found)))
    return torch.cat(rows), matches


@torch.no_grad()
def features(model: UniTouchModel, processor: UniTouchProcessor, scene: Scene) -> dict[str, Tensor]:
    """Features of a scene's pictures and sounds, (N, D)."""
    pictures = normalise_pixels(scene.image).split(FEATURES_AT_ONCE)
    sounds = [(sound, SAMPLE_RATE) for sound in scene.audio]
    parts = [sounds[start : start + FEATURES_AT_ONCE] for start in range(0, len(sounds), FEATURES_AT_ONCE)]
    return {
        "image": torch.cat([model.get_image_features(part) for part in pictures]),
        "audio": torch.cat([model.get_audio_features(processor.sounds(part)) for part in parts]),
    }


def joint_figures(split: str) -> Figures:
    """Zero-shot accuracy of every modality and collection, and sensor retrieval."""
    model, processor = joint_space()
    classes = {
        modality: class_embeddings(model, processor, COLLECTION_MATERIALS, template)
        for modality, template in PROMPTS.items()
        if modality != "text"
    }
    figures: Figures = {"image": {}, "audio": {}, "touch": {}, "sensor_retrieval": {}, "touch_image_cosine": {}}
    for name, collection in COLLECTIONS.items():
        scene = held_out(name, split, ("image", "touch", "audio"))
        touch, matches = touch_features(model, scene.touch[collection.sensor])
        embeddings = features(model, processor, scene)
        for modality, embeds in {**embeddings, "touch": touch}.items():
            figures[modality][name] = accuracy(zero_shot_scores(embeds, classes[modality]), scene.material)
        figures["touch_image_cosine"][name] = F.cosine_similarity(touch, embeddings["image"]).mean().item()
        if collection.sensor in model.sensor_bank.names:
            figures["sensor_retrieval"][name] = sum(m.name == collection.sensor for m in matches) / len(matches)
    for table in ("image", "audio", "sensor_retrieval"):
        figures[f"{table}_mean"] = statistics.mean(figures[table].values())
    trained = [name for name, collection in COLLECTIONS.items() if collection.training]
    figures["touch_in_domain_mean"] = statistics.mean(figures["touch"][name] for name in trained)
    return figures


def touch_run_figures(run: Path, split: str) -> Figures:
    """Zero-shot accuracy of another touch encoder, that of a folder that `training.touch` has left."""
    model, processor = joint_space()
    classes = class_embeddings(model, processor, COLLECTION_MATERIALS, PROMPTS["touch"])
    touch = UniTouchModel.from_pretrained(run / "model", modalities=("touch",)).eval()
    record = json.loads((run / "record.json").read_text())
    accuracies = {}
    for name, collection in COLLECTIONS.items():
        scene = held_out(name, split, ("touch",))
        embeds, _ = touch_features(touch, scene.touch[collection.sensor])
        accuracies[name] = accuracy(zero_shot_scores(embeds, classes), scene.material)
    trained = record["recipe"]["data"]["collections"]
    if trained is None:
        trained = [name for name, collection in COLLECTIONS.items() if collection.training]
    return {
        "seed": record["seed"],
        "steps": record["trainer"]["steps"],
        "seconds": record["seconds"],
        "collections": trained,
        "touch": accuracies,
        "in_domain_mean": statistics.mean(accuracies[name] for name in trained),
    }


# What is generated ----------------------------------------------------------------------------------------------------


def load_classifier(folder: Path) -> ContactClassifier:
    """A classifier in float32."""
    return ContactClassifier.from_pretrained(folder, dtype=torch.float32).eval()


def generate(pipe: Any, seed: int, inputs: Mapping[str, Any], **options: Any) -> Tensor:
    """An image (N, 3, H, W) for each of N inputs, arguments of the pipeline's call beside its options, in batches."""
    images = []
    count = len(next(iter(inputs.values())))
    for number, start in enumerate(range(0, count, IMAGES_AT_ONCE)):
        part = {name: values[start : start + IMAGES_AT_ONCE] for name, values in inputs.items()}
        generator = torch.Generator().manual_seed(seed * 1_000 + number)
        images.append(pipe(**part, **options, generator=generator, output_type="pt").images)
    return torch.cat(images)


def touch_to_image_figures(
    split: str,
    seeds: int = 3,
    per_material: int = 8,
    collections: Sequence[str] = COLLECTIONS_SHOWN,
    **options: Any,
) -> Figures:
    """Material consistency of pictures generated from touches, with its largest difference over noise seeds.

    The `ceiling` is that of the true pictures of the same contacts, the `floor` that of generated pictures against
    shuffled labels.
    """
    classifier, pipe = load_classifier(weights.PICTURE_CLASSIFIER), quiet("touch-to-image")
    tables: dict[str, dict[str, float]] = defaultdict(dict)
    for name in collections:
        scene = held_out(name, split, ("image", "touch"))
        rows = some_of_each(scene.material, per_material)
        touches, material = scene.touch[COLLECTIONS[name].sensor][rows], scene.material[rows]
        made = [generate(pipe, seed, {"touch": touches}, **options) for seed in range(seeds)]
        scores = [consistency(classifier, pictures, material) for pictures in made]
        tables["consistency"][name] = statistics.mean(scores)
        tables["spread"][name] = max(scores) - min(scores)
        tables["ceiling"][name] = consistency(classifier, scene.image[rows], material)
        tables["floor"][name] = consistency(classifier, made[-1], material[others(len(material))])
    means = {f"{key}_mean": statistics.mean(tables[key].values()) for key in ("consistency", "ceiling", "floor")}
    return {**tables, "pictures_each": len(material), "seeds": seeds, **means}


@torch.no_grad()
def psnr(vae: Any, touches: Tensor) -> float:
    """PSNR, dB, of touches (N, 3, H, W) in [0, 1] that an autoencoder has restored."""
    restored = torch.cat([decode(vae, encode(vae, 2 * part - 1)) for part in touches.split(128)])
    return -10 * torch.log10(F.mse_loss((restored / 2 + 0.5).clamp(0, 1), touches)).item()


def x_to_touch_figures(split: str, seeds: int = 3, per_material: int = 8, **options: Any) -> Figures:
    """Material consistency of generated touches, by what they are made of and by sensor.

    `translation` is to a sensor from the other two, `agreement` that of touches from a picture and from its caption,
    `ceiling` of real touches, `floor` against shuffled labels; `deviation` is that of pixels, relative to real ones.
    """
    classifier, pipe = load_classifier(weights.TOUCH_CLASSIFIER), quiet("x-to-touch")
    tables: dict[str, dict[str, float]] = defaultdict(dict)
    spreads = []
    for name, sensor in SENSOR_OF.items():
        scene = held_out(name, split, ("image", "touch", "audio", "text"), tuple(SENSOR_OF.values()))
        rows = some_of_each(scene.material, per_material)
        material, real = scene.material[rows], {key: touches[rows] for key, touches in scene.touch.items()}
        image, caption = scene.image[rows], [scene.text[row] for row in rows.tolist()]
        sounds = [(scene.audio[row], SAMPLE_RATE) for row in rows.tolist()]
        made = {}
        for table, inputs, bridge in (
            ("image", {"image": image}, None),
            ("caption", {"text": caption}, None),
            ("caption_bridged", {"text": caption}, "nearest"),
            ("audio", {"audio": sounds}, None),
            ("audio_bridged", {"audio": sounds}, "nearest"),
        ):
            drawn = [generate(pipe, seed, inputs, sensor=sensor, bridge=bridge, **options) for seed in range(seeds)]
            scores = [consistency(classifier, images, material) for images in drawn]
            spreads.append(max(scores) - min(scores))
            tables[table][sensor] = statistics.mean(scores)
            made[table] = drawn[0]
        tables["translation"][sensor] = statistics.mean(
            consistency(classifier, generate(pipe, 0, {"touch": real[other]}, sensor=sensor, **options), material)
            for other in SENSOR_OF.values()
            if other != sensor
        )
        tables["agreement"][sensor] = agreement(classifier, made["image"], made["caption_bridged"])
        tables["agreement_raw"][sensor] = agreement(classifier, made["image"], made["caption"])
        tables["ceiling"][sensor] = consistency(classifier, real[sensor], material)
        tables["floor"][sensor] = consistency(classifier, made["image"], material[others(len(material))])
        tables["deviation"][sensor] = (made["image"].std() / real[sensor].std()).item()
        tables["psnr"][sensor] = psnr(pipe.vae, real[sensor])
    averages = {f"{table}_mean": statistics.mean(values.values()) for table, values in tables.items()}
    return {**tables, **averages, "spread": max(spreads), "seeds": seeds, "touches_each": len(material)}


def stylization_figures(
    split: str, seeds: int = 3, per_material: int = 4, mix: str = "paper", **options: Any
) -> Figures:
    """Share of restyled pictures that a classifier names as the touch's material, and as the photo's, by touch weight.

    Every seed is another noise, and another way in which touches meet photos of another material.
    """
    classifier, pipe = load_classifier(weights.PICTURE_CLASSIFIER), quiet("stylization")
    scene = held_out("world_gelsight", split, ("image", "touch"), ("gelsight",))
    rows = some_of_each(scene.material, per_material)
    photos, touches, material = scene.image[rows], scene.touch["gelsight"][rows], scene.material[rows]
    figures: Figures = {"touch": {}, "photo": {}, "pictures_each": len(rows), "seeds": seeds}
    spreads = []
    for weight in TOUCH_WEIGHTS:
        found: dict[str, list[float]] = {"touch": [], "photo": []}
        for seed in range(seeds):
            other = torch.arange(len(rows)).roll((1 + seed) * per_material)  # of the first, second, third next material
            inputs = {"image": photos, "touch": touches[other]}
            pictures = generate(pipe, seed, inputs, touch_weight=weight, mix=mix, **options)
            found["touch"].append(consistency(classifier, pictures, material[other]))
            found["photo"].append(consistency(classifier, pictures, material))
        for key, scores in found.items():
            figures[key][f"{weight:g}"] = statistics.mean(scores)
            spreads.append(max(scores) - min(scores))
    return {**figures, "spread": max(spreads)}
