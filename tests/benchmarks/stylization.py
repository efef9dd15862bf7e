"""Figures of stylisation: how much of the touch and of the photo a restyled picture shows, by weight."""

import statistics
from pathlib import Path
from typing import Any

import torch

from tests.benchmarks import Figures
from tests.benchmarks.generation import generate, load_classifier
from tests.benchmarks.held_out import held_out, some_of_each
from unitouch_gen import weights
from unitouch_gen.evaluation.consistency import consistency
from unitouch_gen.pipelines.tiny import tiny

COLLECTION, SENSOR = "world_gelsight", "gelsight"

TOUCH_WEIGHTS = (0.0, 0.3, 0.5, 0.7, 1.0)
"""0.3 is the paper's."""


def stylization_figures(
    split: str, family: Path = weights.FAMILY, seeds: int = 3, per_material: int = 4, **options: Any
) -> Figures:
    """Share of restyled pictures that an independent judge names as the touch's material, and as the photo's.

    Args:
        split: "val" or "test".
        family: Folder of weights.
        seeds: Of the noise, and of which touch meets which photo; always one of another material.
        per_material: Photos of each material.
        options: Of the pipeline's call.

    Returns:
        `touch` and `photo` by the weight of the touch, and the largest `spread` over seeds.
    """
    classifier = load_classifier(family / weights.PICTURE_CLASSIFIER.name)
    pipe = tiny("stylization", family=family)
    pipe.set_progress_bar_config(disable=True)
    scene = held_out(COLLECTION, split, ("image", "touch"), (SENSOR,))
    assert scene.image is not None
    rows = some_of_each(scene.material, per_material)
    photos, touches, material = scene.image[rows], scene.touch[SENSOR][rows], scene.material[rows]
    figures: Figures = {"touch": {}, "photo": {}, "pictures_each": len(rows), "seeds": seeds}
    spreads = []
    for weight in TOUCH_WEIGHTS:
        found: dict[str, list[float]] = {"touch": [], "photo": []}
        for seed in range(seeds):
            other = torch.arange(len(rows)).roll((1 + seed) * per_material)  # of the first, second, third next material
            pictures = generate(pipe, seed, "image", photos, {"touch": touches[other]}, touch_weight=weight, **options)
            found["touch"].append(consistency(classifier, pictures, material[other]))
            found["photo"].append(consistency(classifier, pictures, material))
        for key, scores in found.items():
            figures[key][f"{weight:g}"] = statistics.mean(scores)
            spreads.append(max(scores) - min(scores))
    return {**figures, "spread": max(spreads)}
