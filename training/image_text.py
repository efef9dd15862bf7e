"""Stage 1, the space itself: image and text, as CLIP (Radford et al., 2021).

With `--init` it goes on from the encoders, tokenizer and sizes of a joint space, whatever the recipe says of these.

python -m unitouch_gen.training.image_text --output runs/image_text
"""

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from pydantic import NonNegativeFloat, PositiveInt
from torch import Tensor, nn

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.models import UniTouchConfig, UniTouchModel, UniTouchProcessor
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.training.batches import ArrayDataset, Batch, in_deviations, jitter_colours, shift_pixels
from unitouch_gen.training.data import DrawnContacts, Rendered, Source, image_embeddings, shown
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
        kept: Weight of the relative squared error of pictures' embeddings against those of the weights that training
            starts from (Li & Hoiem, 2016, "Learning without forgetting"): what is bound to the space stays so.
            Pictures of grasps may move.
    """

    captions: PositiveInt = 1
    kept: NonNegativeFloat = 0.0


class ImageTextObjective(nn.Module):
    """Symmetric InfoNCE between pictures and captions with a learned temperature, and what drawn contacts add to it.

    Args:
        model: With image and text encoders.
        temperature: That it begins with.
        weight: Of the squared error of attributes (B, K), in units of their deviations, read linearly off a picture's
            embedding: captions do not say where an object lies, and a touch is to be bound to its own picture.
        kept: See `ImageTextSettings`.
    """

    def __init__(self, model: UniTouchModel, temperature: float, weight: float = 0.0, kept: float = 0.0):
        super().__init__()
        self.model, self.weight, self.kept = model, weight, kept
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
        parts, near = {"text": symmetric_info_nce(image, text, temperature)}, batch["shown"]
        if self.reader is not None:
            error = (self.reader(image.float()) - batch["attributes"]).square().mean(dim=1)
            parts["attributes"] = (near * error).mean()
        if self.kept:
            before = batch["before"]
            error = (image.float() - before).square().mean(dim=1) / before.square().mean()
            parts["kept"] = (near * error).mean()
        weights = {"text": 1.0, "attributes": self.weight, "kept": self.kept}
        loss = torch.stack([weights[name] * part for name, part in parts.items()]).sum()
        said = {name: part.detach() for name, part in parts.items()}
        return {"loss": loss, "temperature": temperature.detach(), **said}


def watch_retrieval(model: UniTouchModel, processor: UniTouchProcessor, held: list[Rendered]) -> Watch:
    """Retrieval of captions by pictures."""
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
            told += source.captions("train", count, split.text)
        else:
            told += [[caption] * count for caption in split.text]
    return told


def attributes_of(splits: list[Rendered], names: Sequence[str]) -> dict[str, np.ndarray]:
    """Attributes named, (N, K), in units of their deviations; see `picture_classifier.columns`."""
    if not names:
        return {}
    return {"attributes": in_deviations(np.asarray(columns(splits, "image", names).columns["attributes"]))}


def fresh(stage: Stage, config: UniTouchConfig, processor: UniTouchProcessor, texts: Sequence[str]) -> UniTouchModel:
    """Encoders with random weights, for a tokenizer of the texts, which the processor gets."""
    processor.tokenizer = stage.section("tokenizer", train_tokenizer, texts=texts)
    special = {f"{name}_token_id": getattr(processor.tokenizer, f"{name}_token_id") for name in ("bos", "eos", "pad")}
    config.text_config.update({"vocab_size": len(processor.tokenizer), **special})  # type: ignore[union-attr]
    return UniTouchModel(config, modalities=("image", "text"))


def main(stage: Stage) -> None:
    config = stage.section("model", UniTouchConfig)
    check_keys("tokenizer", section_of(stage.recipe, "tokenizer"), train_tokenizer, given=("texts",))
    settings = stage.settings("objective", ImageTextSettings)
    if settings.kept and stage.init is None:
        raise InvalidInputError("`objective.kept` is above 0, and `init` names no weights to keep to; pass both.")
    processor = stage.processor() if stage.init is None else UniTouchProcessor.from_pretrained(stage.init)
    splits = stage.splits(processor, "image", "text")
    told = captions_of(stage.sources, splits, settings.captions)
    texts = [caption for captions in told for caption in captions]
    if stage.init is None:
        model = fresh(stage, config, processor, texts)
    else:
        model = UniTouchModel.from_pretrained(stage.init, modalities=("image", "text"), dtype=torch.float32)

    images, key = [split.image for split in splits], stage.key(splits)
    near = shown(stage.sources, splits)
    names = SHOWN["image"] if settings.attributes else ()
    data: dict[str, Any] = {"image": images, "shown": near, **attributes_of(splits, names)}
    data["input_ids"] = processor.text(texts)["input_ids"].unflatten(0, (len(told), settings.captions))
    if settings.kept:
        data["before"] = image_embeddings(model, images, key, stage.cache)
    objective = ImageTextObjective(model, model.config.temperature, settings.attributes, settings.kept)
    watch = stage.watching(partial(watch_retrieval, model, processor), processor, "image", "text")
    stage.fit(objective, ArrayDataset(**data), watch=watch)

    embeddings = image_embeddings(model, images, key, stage.cache).numpy()
    model.config.embedding_norm = float(np.linalg.norm(embeddings[near > 0], axis=1).mean())
    with stage.saving(embedding_norm=model.config.embedding_norm) as folder:
        save_modalities(model, ("image", "text"), processor, folder)


if __name__ == "__main__":
    run("image_text", main)
