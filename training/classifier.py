"""Supervised classifiers of materials, independent of the generators whose pictures and touches they name.

They have never seen an embedding of the joint space, so they cannot share an error with what conditioned a generator.
"""

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from transformers import ResNetConfig, ResNetForImageClassification

from unitouch_gen.errors import check_number
from unitouch_gen.files import replacing_folder
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.training.augment import add_noise, blur_some, jitter_colours, shift_pixels
from unitouch_gen.training.data import ArrayDataset, Batch
from unitouch_gen.training.recipe import check_probabilities, read_section
from unitouch_gen.training.sampler import ShuffledSampler
from unitouch_gen.training.stages import command, own_processor, parse, train, training_splits, write_record
from unitouch_gen.world import MATERIAL_NAMES


@dataclass(frozen=True)
class ClassifierAugmentation:
    """What a classifier learns to overlook.

    Attributes:
        mirror: Probability of mirroring an image; 0 for touches, whose lights come from known sides.
        blur: Probability of softening an image, drawn twice: a classifier of generated images should go by what they
            show, not by the last bit of sharpness that tells a rendered image from a decoded one.
        noise: Largest standard deviation of noise.
    """

    mirror: float
    blur: float
    noise: float

    def __post_init__(self) -> None:
        check_probabilities(self, "mirror", "blur")
        check_number("noise", self.noise, 0.0)


class ClassifierObjective(nn.Module):
    """Cross-entropy of the material, under shifts, mirrorings, colour jitter, softening and noise.

    Args:
        classifier: What is trained.
        augment: Of what it sees.
    """

    def __init__(self, classifier: ResNetForImageClassification, augment: ClassifierAugmentation):
        super().__init__()
        self.trained = classifier
        self.augment = augment

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        raw = jitter_colours(shift_pixels(batch["pixels"].float() / 255, 6), gain=0.1, offset=0.05)
        raw = blur_some(blur_some(raw, self.augment.blur), self.augment.blur)
        raw = add_noise(raw, self.augment.noise)
        mirrored = torch.rand(len(raw), 1, 1, 1, device=raw.device) < self.augment.mirror
        raw = torch.where(mirrored, raw.flip(3), raw)
        logits = self.trained(normalise_pixels(raw)).logits
        loss = F.cross_entropy(logits, batch["material"], label_smoothing=0.05)
        return {"loss": loss, "accuracy": (logits.argmax(dim=1) == batch["material"]).float().mean()}


@command
def train_classifier(name: str, modality: str) -> None:
    """The whole stage of one classifier.

    Args:
        name: Of the stage.
        modality: "image" or "touch": what it classifies.
    """
    stage = parse(name)
    torch.manual_seed(stage.trainer.seed)
    labels = dict(enumerate(MATERIAL_NAMES))
    config = read_section(
        stage.recipe, "model", ResNetConfig, id2label=labels, label2id={name: i for i, name in labels.items()}
    )
    classifier = ResNetForImageClassification(config)
    objective = ClassifierObjective(classifier, read_section(stage.recipe, "augment", ClassifierAugmentation))

    splits = training_splits(stage, own_processor(stage))
    material = np.concatenate([split.material for split in splits])
    dataset = ArrayDataset(pixels=[getattr(split, modality) for split in splits], material=material)
    sampler = ShuffledSampler(len(dataset), stage.trainer.batch_size, stage.trainer.seed)
    trainer = train(stage, objective, dataset, sampler)
    with replacing_folder(stage.output / "model") as folder:
        classifier.save_pretrained(folder)
    write_record(stage, trainer.seconds)
