"""Supervised classifiers of materials, the independent judges of generated pictures and touches.

They have never seen an embedding of the joint space, so they cannot share an error with what conditioned a generator.
"""

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from transformers import ResNetConfig, ResNetForImageClassification

from unitouch_gen.encoders import UniTouchProcessor
from unitouch_gen.encoders.pixels import normalise_pixels
from unitouch_gen.training.augment import add_noise, blur_some, jitter_colours, shift_pixels
from unitouch_gen.training.core import Batch
from unitouch_gen.training.data import ArrayDataset
from unitouch_gen.training.folders import write_folder
from unitouch_gen.training.sampler import ShuffledSampler
from unitouch_gen.training.stages import parse, train, training_splits, write_record
from unitouch_gen.world import MATERIAL_NAMES


class JudgeObjective(nn.Module):
    """Cross-entropy of the material, under shifts, mirrorings, colour jitter, softening and noise.

    Args:
        judge: What is trained.
        mirror: Probability of mirroring an image; 0 for touches, whose lights come from known sides.
        blur: Probability of softening an image, drawn twice: a judge of generated images should go by what they
            show, not by the last bit of sharpness that tells a rendered image from a decoded one.
        noise: Largest standard deviation of noise.
    """

    def __init__(self, judge: ResNetForImageClassification, *, mirror: float, blur: float, noise: float):
        super().__init__()
        self.trained = judge
        self.mirror, self.blur, self.noise = mirror, blur, noise

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        raw = jitter_colours(shift_pixels(batch["pixels"].float() / 255, 6), gain=0.1, offset=0.05)
        raw = blur_some(blur_some(raw, self.blur), self.blur)
        raw = add_noise(raw, self.noise)
        mirrored = torch.rand(len(raw), 1, 1, 1, device=raw.device) < self.mirror
        raw = torch.where(mirrored, raw.flip(3), raw)
        logits = self.trained(normalise_pixels(raw)).logits
        loss = F.cross_entropy(logits, batch["material"], label_smoothing=0.05)
        return {"loss": loss, "accuracy": (logits.argmax(dim=1) == batch["material"]).float().mean()}


def train_judge(name: str, sense: str) -> None:
    """The whole stage of one judge.

    Args:
        name: Of the stage.
        sense: "image" or "touch": what it judges.
    """
    stage = parse(name)
    torch.manual_seed(stage.trainer.seed)
    processor = UniTouchProcessor(image_size=stage.recipe["data"]["image_size"], audio=stage.recipe["data"]["audio"])
    splits = training_splits(stage, processor)
    material = np.concatenate([split.material for split in splits])
    dataset = ArrayDataset(pixels=[getattr(split, sense) for split in splits], material=material)
    labels = dict(enumerate(MATERIAL_NAMES))
    config = ResNetConfig(**stage.recipe["model"], id2label=labels, label2id={name: i for i, name in labels.items()})
    judge = ResNetForImageClassification(config)
    sampler = ShuffledSampler(len(dataset), stage.trainer.batch_size, stage.trainer.seed)
    trainer = train(stage, JudgeObjective(judge, **stage.recipe["augment"]), dataset, sampler)
    write_folder(stage.output / "model", lambda folder: judge.save_pretrained(folder))
    write_record(stage, trainer.seconds)
