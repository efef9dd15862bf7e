"""Figures of the generators: material consistency by judges that know nothing of the joint space."""

import statistics
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from diffusers import DiffusionPipeline
from torch import Tensor
from transformers import ResNetForImageClassification

from tests.benchmarks import Figures
from tests.benchmarks.held_out import held_out, some_of_each
from unitouch_gen import weights
from unitouch_gen.evaluation.consistency import consistency
from unitouch_gen.pipelines.tiny import tiny
from unitouch_gen.world import COLLECTIONS, MATERIAL_NAMES

COLLECTIONS_SHOWN = ("world_gelsight", "world_digit", "world_taxim", "world_tacto")
"""One collection a sensor: GelSight, DIGIT and Taxim, and TACTO, which no stage was trained on."""

BATCH = 64


def load_classifier(folder: Path) -> ResNetForImageClassification:
    """A judge in float32."""
    return ResNetForImageClassification.from_pretrained(folder, dtype=torch.float32).eval()


def generate(
    pipe: DiffusionPipeline,
    seed: int,
    modality: str,
    values: Any,
    also: Mapping[str, Any] | None = None,
    **options: Any,
) -> Tensor:
    """An image (N, 3, H, W) for each input, in batches.

    Args:
        pipe: Of any kind.
        seed: Of the noise.
        modality: Name of the pipeline's argument.
        values: Its inputs, a list or a tensor of N.
        also: More arguments with as many inputs, by name.
        options: Of the pipeline's call.
    """
    images = []
    for number, start in enumerate(range(0, len(values), BATCH)):
        generator = torch.Generator().manual_seed(seed * 1_000 + number)
        inputs = {name: each[start : start + BATCH] for name, each in {modality: values, **(also or {})}.items()}
        images.append(pipe(**inputs, **options, generator=generator, output_type="pt").images)
    return torch.cat(images)


def shuffled(labels: Tensor) -> Tensor:
    """The same labels in another order: what a judge agrees with by chance."""
    return labels[torch.randperm(len(labels), generator=torch.Generator().manual_seed(0))]


def means(figures: Figures, keys: tuple[str, ...] = ("consistency", "ceiling", "floor")) -> Figures:
    """`figures` with the mean of each of its tables beside them."""
    return {**figures, **{f"{key}_mean": statistics.mean(figures[key].values()) for key in keys}}


def touch_to_image_figures(
    split: str, family: Path = weights.FAMILY, seeds: int = 3, per_material: int = 8, **options: Any
) -> Figures:
    """Material consistency of pictures generated from touches.

    Args:
        split: "val" or "test".
        family: Folder of weights.
        seeds: Of the noise that pictures start from; the spread is over them.
        per_material: Touches of each material and collection.
        options: Of the pipeline's call.

    Returns:
        By collection and on the mean: `consistency`, its `ceiling` on the true pictures of the same contacts, and its
        `floor` on the generated pictures of shuffled touches.
    """
    classifier = load_classifier(family / weights.PICTURE_CLASSIFIER.name)
    pipe = tiny("touch-to-image", family=family)
    pipe.set_progress_bar_config(disable=True)
    count = len(MATERIAL_NAMES) * per_material
    figures: Figures = {
        "consistency": {},
        "spread": {},
        "ceiling": {},
        "floor": {},
        "pictures_each": count,
        "seeds": seeds,
    }
    for name in COLLECTIONS_SHOWN:
        scene = held_out(name, split, ("image", "touch"))
        assert scene.image is not None
        rows = some_of_each(scene.material, per_material)
        touches, material = scene.touch[COLLECTIONS[name].sensor][rows], scene.material[rows]
        made = [generate(pipe, seed, "touch", touches, **options) for seed in range(seeds)]
        scores = [consistency(classifier, pictures, material) for pictures in made]
        figures["consistency"][name] = statistics.mean(scores)
        figures["spread"][name] = max(scores) - min(scores)
        figures["ceiling"][name] = consistency(classifier, scene.image[rows], material)
        figures["floor"][name] = consistency(classifier, made[-1], shuffled(material))
    return means(figures)
