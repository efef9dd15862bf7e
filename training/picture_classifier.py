"""Stage 6, the classifier that names the material in a picture, and the objective that stage 9, of touches, shares.

    python -m unitouch_gen.training.picture_classifier --output runs/picture_classifier

They have never seen an embedding of the joint space, so they cannot share an error with what conditioned a generator.
"""

import numpy as np
import torch
import torch.nn.functional as F
from pydantic import NonNegativeFloat
from torch import Tensor, nn
from transformers import ResNetConfig, ResNetForImageClassification
from transformers.activations import ACT2FN

from unitouch_gen.errors import check_choice
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.training.batches import ArrayDataset, Batch, add_noise, blur_some, jitter_colours, shift_pixels
from unitouch_gen.training.data import material_names
from unitouch_gen.training.recipe import Settings, Share
from unitouch_gen.training.stages import Stage, run


class ClassifierAugmentation(Settings):
    """What a classifier learns to overlook.

    Attributes:
        mirror: Probability of mirroring an image; 0 for touches, whose lights come from known sides.
        blur: Probability of softening an image, drawn twice: a classifier of generated images should go by what they
            show, not by the last bit of sharpness that tells a rendered image from a decoded one.
        noise: Largest standard deviation of noise.
    """

    mirror: Share
    blur: Share
    noise: NonNegativeFloat


class ClassifierObjective(nn.Module):
    """Cross-entropy of the material, under shifts, mirrorings, colour jitter, softening and noise.

    Args:
        classifier: What is trained.
        augment: Done to what it sees.
    """

    def __init__(self, classifier: ResNetForImageClassification, augment: ClassifierAugmentation):
        super().__init__()
        self.trained, self.augment = classifier, augment

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        raw = jitter_colours(shift_pixels(batch["pixels"].float() / 255, 6), gain=0.1, offset=0.05)
        raw = blur_some(blur_some(raw, self.augment.blur), self.augment.blur)
        raw = add_noise(raw, self.augment.noise)
        mirrored = torch.rand(len(raw), 1, 1, 1, device=raw.device) < self.augment.mirror
        raw = torch.where(mirrored, raw.flip(3), raw)
        logits = self.trained(normalise_pixels(raw)).logits
        loss = F.cross_entropy(logits, batch["material"], label_smoothing=0.05)
        return {"loss": loss, "accuracy": (logits.argmax(dim=1) == batch["material"]).float().mean()}


def main(stage: Stage, modality: str = "image") -> None:
    labels = dict(enumerate(material_names(stage.sources)))
    numbers = {name: number for number, name in labels.items()}
    config = stage.section("model", ResNetConfig, id2label=labels, label2id=numbers)
    check_choice("model.hidden_act", config.hidden_act, ACT2FN)
    classifier = ResNetForImageClassification(config)
    objective = ClassifierObjective(classifier, stage.section("augment", ClassifierAugmentation))
    splits = stage.splits(stage.processor(), modality, "material")
    material = np.concatenate([split.material for split in splits])
    stage.fit(objective, ArrayDataset(pixels=[getattr(split, modality) for split in splits], material=material))
    with stage.saving() as folder:
        classifier.save_pretrained(folder)


if __name__ == "__main__":
    run("picture_classifier", main)
