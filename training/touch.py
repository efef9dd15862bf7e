"""Stage 3, touch bound to frozen images, with sensor tokens and in-batch sampling (Section 3 of the paper).

python -m unitouch_gen.training.touch --joint runs/image_text/model --output runs/touch
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from unitouch_gen.models import UniTouchModel, UniTouchProcessor
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.training.augment import (
    add_noise,
    blur_some,
    jitter_colours,
    permute_channels,
    shift_pixels,
    turn_and_flip,
)
from unitouch_gen.training.data import ArrayDataset, Batch, Rendered
from unitouch_gen.training.losses import symmetric_info_nce
from unitouch_gen.training.recipe import check_probabilities, read_section
from unitouch_gen.training.sampler import InBatchSampler
from unitouch_gen.training.stages import (
    command,
    data_key,
    image_embeddings,
    parse,
    save_modalities,
    train,
    training_splits,
    write_record,
)


@dataclass(frozen=True)
class TouchAugmentation:
    """Probabilities of what imitates other lights and gels.

    Attributes:
        turn: Of turning and mirroring.
        permute: Of exchanging colours.
        blur: Of softening.
    """

    turn: float
    permute: float
    blur: float

    def __post_init__(self) -> None:
        check_probabilities(self, "turn", "permute", "blur")


@dataclass(frozen=True)
class SamplerSettings:
    """How batches are put together.

    Attributes:
        sigma: Share of a batch from one collection; see `InBatchSampler`.
    """

    sigma: float

    def __post_init__(self) -> None:
        check_probabilities(self, "sigma")


class TouchEncoder(nn.Module):
    """What is trained: the touch transformer and the sensor tokens."""

    def __init__(self, model: UniTouchModel):
        super().__init__()
        self.transformer, self.bank = model.touch_model, model.sensor_bank

    def forward(self, pixel_values: Tensor, sensor_ids: Tensor) -> Tensor:
        return self.transformer(pixel_values, self.bank(sensor_ids) if len(self.bank) else None)


class TouchObjective(nn.Module):
    """Eq. 2-3: L_{T -> V} + L_{V -> T} between touches and the frozen embeddings of their pictures.

    Args:
        model: With a fresh touch encoder.
        augment: Of the touches.
    """

    def __init__(self, model: UniTouchModel, augment: TouchAugmentation):
        super().__init__()
        self.trained = TouchEncoder(model)
        self.temperature = model.config.temperature
        self.augment = augment

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        raw = shift_pixels(batch["touch"].float() / 255, 4)
        raw = permute_channels(turn_and_flip(raw, self.augment.turn), self.augment.permute)
        raw = add_noise(jitter_colours(blur_some(raw, self.augment.blur), gain=0.15, offset=0.08), 0.02)
        touch = self.trained(normalise_pixels(raw), batch["sensor"])
        return {"loss": symmetric_info_nce(touch, batch["image_embeds"], self.temperature)}


def set_prototypes(model: UniTouchModel, splits: list[Rendered]) -> None:
    """Each sensor's prototype: the mean of all raw images it took in training."""
    for name in model.sensor_bank.names:
        parts = [split.touch for split in splits if split.sensor == name]
        total = sum(part.sum(axis=0, dtype=np.float64) for part in parts)
        mean = total / sum(len(part) for part in parts) / 255.0
        model.sensor_bank.set_prototype(name, torch.from_numpy(np.asarray(mean, dtype=np.float32)))


@command
def main() -> None:
    stage = parse("touch")
    augment = read_section(stage.recipe, "augment", TouchAugmentation)
    sigma = read_section(stage.recipe, "sampler", SamplerSettings).sigma
    torch.manual_seed(stage.trainer.seed)
    processor = UniTouchProcessor.from_pretrained(stage.folders["joint"])
    model = UniTouchModel.from_pretrained(stage.folders["joint"], modalities=("image",))
    splits = training_splits(stage, processor)
    embeds = image_embeddings(model, [split.image for split in splits], data_key(stage, splits), stage.cache)
    model.config.sensors = list(dict.fromkeys(split.sensor for split in splits))
    model.add("touch")
    set_prototypes(model, splits)

    sensor = np.concatenate([np.full(len(s), model.sensor_bank.index(s.sensor)) for s in splits])
    dataset = ArrayDataset(touch=[split.touch for split in splits], image_embeds=embeds, sensor=sensor)
    sampler = InBatchSampler([len(s) for s in splits], stage.trainer.batch_size, sigma, stage.trainer.seed)
    trainer = train(stage, TouchObjective(model, augment), dataset, sampler)
    save_modalities(model, ("touch",), processor, stage.output / "model")
    write_record(stage, trainer.seconds)


if __name__ == "__main__":
    main()
