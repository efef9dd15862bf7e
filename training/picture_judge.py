"""A supervised classifier of materials in pictures, the independent judge of generated ones.

    python -m unitouch_gen.training.picture_judge --output runs/picture_judge

It has never seen an embedding of the joint space, so it cannot share an error with what conditioned a generator.
"""

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from transformers import ResNetConfig, ResNetForImageClassification

from unitouch_gen.encoders import UniTouchProcessor
from unitouch_gen.encoders.pixels import normalise_pixels
from unitouch_gen.training.augment import jitter_colours, shift_pixels
from unitouch_gen.training.core import Batch, Trainer
from unitouch_gen.training.data import ArrayDataset
from unitouch_gen.training.sampler import ShuffledSampler
from unitouch_gen.training.stages import parse, training_splits, write_folder, write_record
from unitouch_gen.world import MATERIAL_NAMES


class JudgeObjective(nn.Module):
    """Cross-entropy of the material, under shifts, mirrorings and colour jitter."""

    def __init__(self, judge: ResNetForImageClassification):
        super().__init__()
        self.trained = judge

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        raw = jitter_colours(shift_pixels(batch["image"].float() / 255, 6), gain=0.1, offset=0.05)
        if torch.rand(()) < 0.5:
            raw = raw.flip(3)
        logits = self.trained(normalise_pixels(raw)).logits
        loss = F.cross_entropy(logits, batch["material"], label_smoothing=0.05)
        return {"loss": loss, "accuracy": (logits.argmax(dim=1) == batch["material"]).float().mean()}


def main() -> None:
    stage = parse("picture_judge")
    torch.manual_seed(stage.trainer.seed)
    processor = UniTouchProcessor(image_size=stage.recipe["data"]["image_size"], audio=stage.recipe["data"]["audio"])
    splits = training_splits(stage, processor)
    material = np.concatenate([split.material for split in splits])
    dataset = ArrayDataset(image=[split.image for split in splits], material=material)
    labels = dict(enumerate(MATERIAL_NAMES))
    config = ResNetConfig(**stage.recipe["model"], id2label=labels, label2id={name: i for i, name in labels.items()})
    judge = ResNetForImageClassification(config)
    sampler = ShuffledSampler(len(dataset), stage.trainer.batch_size, stage.trainer.seed)
    trainer = Trainer(JudgeObjective(judge), dataset, sampler, stage.trainer, stage.output)
    if stage.resume:
        trainer.resume()
    trainer.fit()
    write_folder(stage.output / "model", lambda folder: judge.save_pretrained(folder))
    write_record(stage, trainer.seconds)


if __name__ == "__main__":
    main()
