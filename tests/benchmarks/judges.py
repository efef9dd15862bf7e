"""Trains the classifiers that generated images are held to, on the built-in world.

    python -m tests.benchmarks.judges --output runs/judges    # hours; goes on where it was stopped

They have never seen an embedding of the joint space, so they cannot share an error with what conditioned a generator.
Figures compare under the same classifiers alone: train them anew after a change to the world, not for a new family.
"""

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from transformers import ResNetConfig

from unitouch_gen.models import UniTouchProcessor
from unitouch_gen.models.classifier import ContactClassifier
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.models.relief import RELIEF_CHANNELS
from unitouch_gen.training import batches
from unitouch_gen.training.checkpoints import checkpoints_in
from unitouch_gen.training.data import Contacts, DataConfig, columns_of
from unitouch_gen.training.image_text import SHOWN
from unitouch_gen.training.recipe import read, read_recipe
from unitouch_gen.training.trainer import Trainer, TrainerConfig
from unitouch_gen.world import ATTRIBUTES, MATERIAL_NAMES

SIZES = {"embedding_size": 32, "hidden_sizes": [64, 128, 256, 256], "depths": [1, 2, 3, 2]}
STEPS = {"picture": 1800, "touch": 3000}


class ClassifierObjective(nn.Module):
    """Cross-entropy of the material, and squared error of attributes (B, K) in deviations, under augmentations."""

    def __init__(self, classifier: ContactClassifier):
        super().__init__()
        self.trained = classifier

    def forward(self, batch: batches.Batch) -> dict[str, Tensor]:
        raw = batches.jitter_colours(batches.shift_pixels(batch["pixels"].float() / 255, 2), gain=0.1, offset=0.05)
        raw = batches.blur_some(batches.blur_some(raw, 0.4), 0.4)  # decoded images are softer than rendered ones
        seen = self.trained(normalise_pixels(batches.add_noise(raw, 0.05)))
        mean, deviation = self.trained.scale_of_attributes(raw.device)
        error = F.mse_loss((seen.attributes - mean) / deviation, batch["attributes"])
        return {"loss": F.cross_entropy(seen.logits, batch["material"], label_smoothing=0.05) + error}


def columns(splits: Sequence[Contacts], kind: str) -> tuple[list[Any], np.ndarray, np.ndarray]:
    """Images, their materials (N,) and attributes (N, K): of touches by either sensor, of pictures the mean of both."""
    material = np.concatenate([split.material.numpy() for split in splits])
    measured = [split.attributes.numpy() for split in splits]
    if kind == "touch":
        pixels = [split.touch for split in splits] + [split.second for split in splits]
        return pixels, np.tile(material, 2), np.concatenate([one[:, by] for by in (0, 1) for one in measured])
    chosen = [ATTRIBUTES.index(name) for name in SHOWN]
    return [split.image for split in splits], material, np.concatenate(measured)[:, :, chosen].mean(axis=1)


def train(kind: str, data: DataConfig, trainer: TrainerConfig, output: Path, cache: Path) -> None:
    """Trains a classifier of "picture" or "touch" on drawn contacts, and writes it to `output`."""
    torch.manual_seed(trainer.seed)
    processor: Any = UniTouchProcessor(image_size=data.image_size, audio=data.audio)
    pixels, material, values = columns(columns_of(data.sources(), cache, data, processor, ()), kind)
    names = dict(enumerate(MATERIAL_NAMES))
    touch = kind == "touch"
    config = ResNetConfig(
        **SIZES,
        layer_type="bottleneck",
        id2label=names,
        label2id={name: number for number, name in names.items()},
        num_channels=3 + RELIEF_CHANNELS * touch,
        relief=touch,
        attributes=[*(ATTRIBUTES if touch else SHOWN)],
        attribute_means=values.mean(axis=0, dtype=np.float64).tolist(),
        attribute_deviations=values.std(axis=0, dtype=np.float64).clip(1e-3).tolist(),
    )
    classifier = ContactClassifier(config)
    dataset = batches.ArrayDataset(pixels=pixels, material=material, attributes=batches.in_deviations(values))
    indices = partial(batches.shuffled_indices, size=len(material), batch_size=trainer.batch_size, seed=trainer.seed)
    run = Trainer(ClassifierObjective(classifier), dataset, indices, trainer, output)
    if checkpoints_in(output):
        run.resume()
    run.fit()
    classifier.half().save_pretrained(output)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.judges")
    parser.add_argument("--output", type=Path, default=Path("runs/judges"), help="folder for both")
    given = parser.parse_args()
    data = read(DataConfig, read_recipe("image_vae")["data"])
    for kind, steps in STEPS.items():
        trainer = TrainerConfig(steps=steps, batch_size=64, learning_rate=2e-3, ema_decay=0.998)
        train(kind, data, trainer, given.output / f"{kind}-classifier", Path("runs/cache"))
