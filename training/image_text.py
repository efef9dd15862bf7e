"""Stage 1, the space itself: image and text, as CLIP (Radford et al., 2021).

python -m unitouch_gen.training.image_text --output runs/image_text
"""

import math

import numpy as np
import torch
from torch import Tensor, nn

from unitouch_gen.models import UniTouchModel
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.training.augment import jitter_colours, shift_pixels
from unitouch_gen.training.data import ArrayDataset, Batch
from unitouch_gen.training.losses import symmetric_info_nce
from unitouch_gen.training.recipe import check_keys, section_of
from unitouch_gen.training.sampler import ShuffledSampler
from unitouch_gen.training.stages import (
    command,
    data_key,
    image_embeddings,
    joint_of,
    own_processor,
    parse,
    save_modalities,
    train,
    training_splits,
    write_record,
)
from unitouch_gen.training.tokenizer import train_tokenizer

MAX_LOGIT_SCALE = 100.0


class ImageTextObjective(nn.Module):
    """Symmetric InfoNCE between pictures and captions with a learned temperature."""

    def __init__(self, model: UniTouchModel, temperature: float):
        super().__init__()
        self.model = model
        self.log_scale = nn.Parameter(torch.tensor(math.log(1.0 / temperature)))

    @property
    def trained(self) -> nn.Module:
        return self

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        raw = jitter_colours(shift_pixels(batch["image"].float() / 255, 4), gain=0.08, offset=0.03)
        image = self.model.get_image_features(normalise_pixels(raw))
        text = self.model.get_text_features(batch["input_ids"])
        temperature = 1.0 / self.log_scale.exp().clamp(max=MAX_LOGIT_SCALE)
        return {"loss": symmetric_info_nce(image, text, temperature), "temperature": temperature.detach()}


@command
def main() -> None:
    stage = parse("image_text")
    torch.manual_seed(stage.trainer.seed)
    config, tokenizer = joint_of(stage.recipe), section_of(stage.recipe, "tokenizer")
    check_keys("tokenizer", tokenizer, train_tokenizer, given=("texts",))
    processor = own_processor(stage)
    splits = training_splits(stage, processor)
    texts = [caption for split in splits for caption in split.text]
    processor.tokenizer = train_tokenizer(texts, **tokenizer)

    special = {f"{name}_token_id": getattr(processor.tokenizer, f"{name}_token_id") for name in ("bos", "eos", "pad")}
    config.text_config.update({"vocab_size": len(processor.tokenizer), **special})  # type: ignore[union-attr]
    model = UniTouchModel(config, modalities=("image", "text"))

    images = [split.image for split in splits]
    dataset = ArrayDataset(image=images, input_ids=processor.text(texts)["input_ids"])
    sampler = ShuffledSampler(len(dataset), stage.trainer.batch_size, stage.trainer.seed)
    objective = ImageTextObjective(model, config.temperature)
    trainer = train(stage, objective, dataset, sampler)

    embeddings = image_embeddings(model, images, data_key(stage, splits), stage.cache)
    config.embedding_norm = float(np.linalg.norm(embeddings.numpy(), axis=1).mean())
    save_modalities(model, ("image", "text"), processor, stage.output / "model")
    write_record(stage, trainer.seconds, embedding_norm=config.embedding_norm)


if __name__ == "__main__":
    main()
