"""Stage 6, the classifier that names the material in a picture, and the objective that stage 9, of touches, shares.

    python -m unitouch_gen.training.picture_classifier --output runs/picture_classifier

They have never seen an embedding of the joint space, so they cannot share an error with what conditioned a generator.
On drawn contacts they also read what can be measured of one, so that what is generated is held to more than a word.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from pydantic import NonNegativeFloat, NonNegativeInt
from torch import Tensor, nn
from transformers import ResNetConfig

from unitouch_gen.models.classifier import ContactClassifier
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.models.relief import RELIEF_CHANNELS
from unitouch_gen.training import batches
from unitouch_gen.training.batches import FARTHEST, ArrayDataset, Batch
from unitouch_gen.training.data import Rendered, material_names
from unitouch_gen.training.recipe import Arguments, Settings, Share, build
from unitouch_gen.training.stages import Recipe, Stage, run
from unitouch_gen.world import ATTRIBUTES

SHOWN = {"image": tuple(name for name in ATTRIBUTES if name not in ("depth", "load")), "touch": ATTRIBUTES}
"""Attributes that a modality shows: how hard a sensor is pressed leaves no trace in a picture."""

MIRRORED = ("grain y", "place x")  # attributes whose sign changes with left and right


class ClassifierAugmentation(Settings):
    """What a classifier learns to overlook."""

    mirror: Share  # probability of mirroring; 0 for touches, whose lights come from known sides
    # Probability of softening, drawn twice: generated images are judged by what they show, and not by the last bit of
    # sharpness that tells a rendered image from a decoded one.
    blur: Share
    noise: NonNegativeFloat  # its largest standard deviation
    shift: NonNegativeInt = 6  # pixels at most; few where the place of a contact is to be read


class AttributeSettings(Settings):
    """The weight of the attributes' squared error, in units of their deviations; 0 reads none."""

    attributes: NonNegativeFloat = 0.0


class ClassifierRecipe(Recipe):
    model: Arguments
    augment: ClassifierAugmentation
    objective: AttributeSettings = AttributeSettings()


class ClassifierObjective(nn.Module):
    """Cross-entropy of the material and, at a weight, the squared error of attributes (B, K), under augmentations."""

    def __init__(self, classifier: ContactClassifier, augment: ClassifierAugmentation, weight: float = 0.0):
        super().__init__()
        self.trained, self.augment, self.weight = classifier, augment, weight

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        raw = batches.shift_pixels(batch["pixels"].float() / 255, self.augment.shift)
        raw = batches.jitter_colours(raw, gain=0.1, offset=0.05)
        raw = batches.blur_some(batches.blur_some(raw, self.augment.blur), self.augment.blur)
        raw = batches.add_noise(raw, self.augment.noise)
        mirrored = torch.rand(len(raw), 1, 1, 1, device=raw.device) < self.augment.mirror
        raw = torch.where(mirrored, raw.flip(3), raw)
        seen = self.trained(normalise_pixels(raw))
        loss = F.cross_entropy(seen.logits, batch["material"], label_smoothing=0.05)
        parts = {"accuracy": (seen.logits.argmax(dim=1) == batch["material"]).float().mean()}
        if seen.attributes is not None:
            signs = seen.attributes.new_tensor([-1.0 if name in MIRRORED else 1.0 for name in self.trained.attributes])
            truth = torch.where(mirrored[:, :, 0, 0], signs * batch["attributes"], batch["attributes"])
            mean, deviation = self.trained.scale_of_attributes(raw.device)
            target = ((truth - mean) / deviation).clamp(-FARTHEST, FARTHEST)
            error = F.mse_loss((seen.attributes - mean) / deviation, target)
            loss, parts["attributes"] = loss + self.weight * error, error.detach()
        return {"loss": loss, **parts}


def columns(splits: Sequence[Rendered], modality: str, names: Sequence[str] = ()) -> ArrayDataset:
    """Images, their materials, and the attributes named: of touches by either sensor, of pictures the mean of both."""
    chosen = [ATTRIBUTES.index(name) for name in names]
    pixels, material, attributes = list[Any](), list[Any](), list[Any]()
    for split in splits:
        views = [split.touch, split.second] if modality == "touch" else [split.image]
        views = [view for view in views if view is not None]
        pixels += views
        material += [split.material] * len(views)
        if names:
            measured = np.asarray(split.attributes)[:, :, chosen]  # (N, 2, K)
            attributes += [*measured.swapaxes(0, 1)] if len(views) == 2 else [measured.mean(axis=1)]
    read = {"attributes": np.concatenate(attributes)} if names else {}
    return ArrayDataset(pixels=pixels, material=np.concatenate(material), **read)


def main(stage: Stage) -> None:
    recipe: ClassifierRecipe = stage.recipe
    modality = "touch" if stage.name == "touch_classifier" else "image"
    labels = dict(enumerate(material_names(stage.sources)))
    numbers = {name: number for number, name in labels.items()}
    config = build("model", ResNetConfig, recipe.model, id2label=labels, label2id=numbers)
    names = SHOWN[modality] if recipe.objective.attributes else ()
    stage.check_drawn(*(["attributes"] if names else []))
    dataset = columns(stage.splits(modality, "material"), modality, names)
    if names:
        values = np.asarray(dataset.columns["attributes"], np.float64)
        config.attributes, config.attribute_means = list(names), values.mean(axis=0).tolist()
        config.attribute_deviations = values.std(axis=0).clip(1e-3).tolist()
    if modality == "touch":
        config.relief, config.num_channels = True, config.num_channels + RELIEF_CHANNELS
    classifier = ContactClassifier(config)
    stage.fit(ClassifierObjective(classifier, recipe.augment, recipe.objective.attributes), dataset)
    with stage.saving() as folder:
        classifier.save_pretrained(folder)


if __name__ == "__main__":
    run("picture_classifier", ClassifierRecipe, main)
