"""Figures of the joint space: zero-shot accuracy of every modality, sensor retrieval, touch encoders of other runs."""

import json
import statistics
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from tests.benchmarks import Figures
from tests.benchmarks.held_out import held_out
from unitouch_gen import weights
from unitouch_gen.evaluation.zero_shot import PROMPTS, accuracy, class_embeddings, zero_shot_scores
from unitouch_gen.models import UniTouchModel, UniTouchProcessor
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.models.sensors import SensorMatch
from unitouch_gen.pipelines.tiny import joint_space
from unitouch_gen.world import COLLECTIONS, MATERIAL_NAMES, SAMPLE_RATE, Scene

BATCH = 256


@torch.no_grad()
def touch_features(model: UniTouchModel, touches: Tensor) -> tuple[Tensor, list[SensorMatch]]:
    """Features (N, D) of touches (N, 3, S, S) in [0, 1], and the sensor retrieved for each."""
    rows, matches = [], []
    for part in normalise_pixels(touches).split(BATCH):
        found = model.match_sensors(part)
        matches += found
        rows.append(model.get_touch_features(part, model.sensor_ids(found)))
    return torch.cat(rows), matches


@torch.no_grad()
def features(model: UniTouchModel, processor: UniTouchProcessor, scene: Scene, modality: str) -> Tensor:
    """Features of a scene's pictures or sounds, (N, D)."""
    if modality == "image":
        assert scene.image is not None
        return torch.cat([model.get_image_features(part) for part in normalise_pixels(scene.image).split(BATCH)])
    assert scene.audio is not None
    sounds = [(sound, SAMPLE_RATE) for sound in scene.audio]
    parts = [sounds[start : start + BATCH] for start in range(0, len(sounds), BATCH)]
    return torch.cat([model.get_audio_features(processor.sounds(part)) for part in parts])


def joint_figures(split: str, family: Path = weights.FAMILY) -> Figures:
    """Zero-shot accuracy of every modality and collection, and sensor retrieval."""
    model, processor = joint_space(family)
    classes = {
        modality: class_embeddings(model, processor, MATERIAL_NAMES, template) for modality, template in PROMPTS.items()
    }
    figures: Figures = {"image": {}, "audio": {}, "touch": {}, "sensor_retrieval": {}, "touch_image_cosine": {}}
    for name, collection in COLLECTIONS.items():
        scene = held_out(name, split, ("image", "touch", "audio"))
        touch, matches = touch_features(model, scene.touch[collection.sensor])
        embeddings = {modality: features(model, processor, scene, modality) for modality in ("image", "audio")}
        for modality, embeds in {**embeddings, "touch": touch}.items():
            figures[modality][name] = accuracy(zero_shot_scores(embeds, classes[modality]), scene.material)
        figures["touch_image_cosine"][name] = F.cosine_similarity(touch, embeddings["image"]).mean().item()
        if collection.sensor in model.sensor_bank.names:
            figures["sensor_retrieval"][name] = sum(m.name == collection.sensor for m in matches) / len(matches)
    trained = [name for name, collection in COLLECTIONS.items() if collection.training]
    for modality in ("image", "audio"):
        figures[f"{modality}_mean"] = statistics.mean(figures[modality].values())
    figures["touch_in_domain_mean"] = statistics.mean(figures["touch"][name] for name in trained)
    figures["sensor_retrieval_mean"] = statistics.mean(figures["sensor_retrieval"].values())
    return figures


def touch_run_figures(run: Path, split: str, family: Path = weights.FAMILY) -> Figures:
    """Zero-shot accuracy of another touch encoder, bound to the family's pictures by its own training run.

    Args:
        run: What `training.touch` has left: `model/` and `record.json`.
        split: "val" or "test".
        family: Whose text encoder names the materials.
    """
    model, processor = joint_space(family)
    classes = class_embeddings(model, processor, MATERIAL_NAMES, PROMPTS["touch"])
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
