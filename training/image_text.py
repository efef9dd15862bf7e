"""Stage 1, the space itself: image and text, as CLIP (Radford et al., 2021).

python -m unitouch_gen.training.image_text --output runs/image_text
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from pydantic import PositiveInt
from torch import Tensor, nn

from unitouch_gen.models import UniTouchConfig, UniTouchModel, UniTouchProcessor
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.training.batches import ArrayDataset, Batch, in_deviations, jitter_colours, shift_pixels
from unitouch_gen.training.data import DrawnContacts, Rendered, Source, image_embeddings
from unitouch_gen.training.losses import symmetric_info_nce
from unitouch_gen.training.picture_classifier import SHOWN, AttributeSettings, columns
from unitouch_gen.training.recipe import check_keys, section_of
from unitouch_gen.training.stages import Stage, run, save_modalities
from unitouch_gen.training.tokenizer import train_tokenizer
from unitouch_gen.training.watching import Watch, on_device_of, pixels_of, retrieval

MAX_LOGIT_SCALE = 100.0


class ImageTextSettings(AttributeSettings):
    """What drawn contacts add to CLIP.

    Attributes:
        captions: Of each drawn contact, one of which is drawn at every step.
    """

    captions: PositiveInt = 1


class ImageTextObjective(nn.Module):
    """Symmetric InfoNCE between pictures and captions with a learned temperature, and what drawn contacts add to it.

    Args:
        model: With image and text encoders.
        temperature: That it begins with.
        weight: Of the squared error of attributes (B, K), in units of their deviations, read linearly off a picture's
            embedding: captions do not say where an object lies, and a touch is to be bound to its own picture.
    """

    def __init__(self, model: UniTouchModel, temperature: float, weight: float = 0.0):
        super().__init__()
        self.model, self.weight = model, weight
        self.log_scale = nn.Parameter(torch.tensor(math.log(1.0 / temperature)))
        self.reader = nn.Linear(model.config.projection_dim, len(SHOWN["image"])) if weight else None

    @property
    def trained(self) -> nn.Module:
        return self

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        raw = jitter_colours(shift_pixels(batch["image"].float() / 255, 4), gain=0.08, offset=0.03)
        image = self.model.get_image_features(normalise_pixels(raw))
        told = batch["input_ids"]  # (B, captions, L)
        told = told[torch.arange(len(told)), torch.randint(told.shape[1], (len(told),))]
        text = self.model.get_text_features(told)
        temperature = 1.0 / self.log_scale.exp().clamp(max=MAX_LOGIT_SCALE)
        losses = {"loss": symmetric_info_nce(image, text, temperature), "temperature": temperature.detach()}
        if self.reader is None:
            return losses
        attributes = F.mse_loss(self.reader(image.float()), batch["attributes"])
        loss = losses["loss"] + self.weight * attributes
        return {**losses, "loss": loss, "text": losses["loss"].detach(), "attributes": attributes.detach()}


def watch_retrieval(model: UniTouchModel, held: list[Rendered], processor: UniTouchProcessor) -> Watch | None:
    """Retrieval of captions by pictures."""
    if not held:
        return None
    pictures = normalise_pixels(pixels_of(held, "image").float() / 255)
    input_ids = processor.text([caption for split in held for caption in split.text])["input_ids"]

    def watch() -> dict[str, float]:
        image, text = on_device_of(model, pictures, input_ids)
        return retrieval(model.get_image_features(image), model.get_text_features(text))

    return watch


def captions_of(sources: Sequence[Source], splits: list[Rendered], count: int) -> list[list[str]]:
    """`count` captions of each sample; what is not drawn has one, again and again."""
    told = list[list[str]]()
    for source, split in zip(sources, splits, strict=True):
        if isinstance(source, DrawnContacts):
            told += source.captions("train", count)
        else:
            told += [[caption] * count for caption in split.text]
    return told


def attributes_of(splits: list[Rendered], names: Sequence[str]) -> dict[str, np.ndarray]:
    """Attributes named, (N, K), in units of their deviations; see `picture_classifier.columns`."""
    if not names:
        return {}
    return {"attributes": in_deviations(np.asarray(columns(splits, "image", names).columns["attributes"]))}


def main(stage: Stage) -> None:
    config = stage.section("model", UniTouchConfig)
    check_keys("tokenizer", section_of(stage.recipe, "tokenizer"), train_tokenizer, given=("texts",))
    processor = stage.processor()
    settings = stage.settings("objective", ImageTextSettings)
    weight = settings.attributes
    splits = stage.splits(processor, "image", "text")
    told = captions_of(stage.sources, splits, settings.captions)
    texts = [caption for captions in told for caption in captions]
    processor.tokenizer = stage.section("tokenizer", train_tokenizer, texts=texts)

    special = {f"{name}_token_id": getattr(processor.tokenizer, f"{name}_token_id") for name in ("bos", "eos", "pad")}
    config.text_config.update({"vocab_size": len(processor.tokenizer), **special})  # type: ignore[union-attr]
    model = UniTouchModel(config, modalities=("image", "text"))

    images = [split.image for split in splits]
    names = SHOWN["image"] if weight else ()
    input_ids = processor.text(texts)["input_ids"].unflatten(0, (len(told), settings.captions))
    dataset = ArrayDataset(image=images, input_ids=input_ids, **attributes_of(splits, names))
    objective = ImageTextObjective(model, config.temperature, weight)
    stage.fit(objective, dataset, watch=watch_retrieval(model, stage.held_out(processor, "image", "text"), processor))

    embeddings = image_embeddings(model, images, stage.key(splits), stage.cache)
    config.embedding_norm = float(np.linalg.norm(embeddings.numpy(), axis=1).mean())
    with stage.saving(embedding_norm=config.embedding_norm) as folder:
        save_modalities(model, ("image", "text"), processor, folder)


if __name__ == "__main__":
    run("image_text", main)
