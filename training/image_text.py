"""Stage 1, the space itself: image and text, as CLIP (Radford et al., 2021).

Pictures of a drawn contact under two lamps can be bound to each other, as SimCLR binds views of an image (Chen et al.,
2020). Captions do not say which contact a picture shows, and touches are bound to single pictures later.

`--init` continues training from the encoders, tokenizer and sizes of a joint space, in place of the recipe's and of
the built-in tokenizer, which knows the world's words and every byte.
"""

import math
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from pydantic import NonNegativeFloat, PositiveInt
from torch import Tensor, nn

from unitouch_gen.models import UniTouchConfig, UniTouchModel
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.models.processing import read_tokenizer
from unitouch_gen.training import batches
from unitouch_gen.training.batches import ArrayDataset, Batch, SamplerSettings, in_deviations
from unitouch_gen.training.data.columns import relit
from unitouch_gen.training.losses import symmetric_info_nce
from unitouch_gen.training.recipe import Arguments, Settings, build
from unitouch_gen.training.stages import Recipe, Stage
from unitouch_gen.weights import JOINT
from unitouch_gen.world import ATTRIBUTES

SHOWN = tuple(name for name in ATTRIBUTES if name not in ("depth", "load"))
"""Attributes that a picture shows: how hard a sensor is pressed leaves no trace in it."""


class ImageTextSettings(Settings):
    """What drawn contacts add to CLIP."""

    attributes: NonNegativeFloat = 0.0  # weight of the squared error of attributes, in units of their deviations
    captions: PositiveInt = 1  # of each drawn contact, one of which is drawn at every step
    views: NonNegativeFloat = 0.0  # weight of InfoNCE between pictures of a contact under two lamps


class ImageTextRecipe(Recipe):
    model: Arguments
    objective: ImageTextSettings = ImageTextSettings()
    sampler: SamplerSettings = SamplerSettings()  # alike to the weights that training starts from


class ImageTextObjective(nn.Module):
    """Symmetric InfoNCE between pictures and captions with a learned temperature, and what drawn contacts add to it.

    The squared error of attributes (B, K), in deviations, is of what is read linearly off a picture's embedding.
    """

    def __init__(self, model: UniTouchModel, settings: ImageTextSettings):
        super().__init__()
        self.model = model
        self.settings = settings
        self.log_scale = nn.Parameter(torch.tensor(math.log(1.0 / model.config.temperature)))
        self.reader = nn.Linear(model.config.projection_dim, len(SHOWN)) if settings.attributes else None

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        raw = batches.shift_pixels(batch["image"].float() / 255, 4)
        raw = batches.jitter_colours(raw, gain=0.08, offset=0.03)
        image = self.model.get_image_features(normalise_pixels(raw))
        captions = batch["input_ids"]  # (B, captions, L)
        rows = torch.arange(len(captions))
        text = self.model.get_text_features(captions[rows, torch.randint(captions.shape[1], (len(captions),))])
        temperature = 1.0 / self.log_scale.exp().clamp(max=100.0)
        parts = {"text": symmetric_info_nce(image, text, temperature)}
        if self.settings.views:
            second = self.model.get_image_features(normalise_pixels(recoloured(batch["relit"].float() / 255)))
            parts["views"] = symmetric_info_nce(image, second, self.model.config.temperature)
        if self.reader is not None:
            parts["attributes"] = F.mse_loss(self.reader(image.float()), batch["attributes"])
        loss = torch.stack([getattr(self.settings, name, 1.0) * part for name, part in parts.items()]).sum()
        logged = {"temperature": temperature, **parts}
        return {"loss": loss, **{name: value.detach() for name, value in logged.items()}}


def recoloured(pictures: Tensor) -> Tensor:
    """Pictures (B, 3, S, S) in [0, 1] of which colour and brightness tell no more: shifted, some blurred or grey."""
    other = batches.permute_channels(batches.shift_pixels(pictures, 2), 0.5)
    other = batches.jitter_colours(batches.blur_some(other, 0.3), gain=0.4, offset=0.12)
    grey = torch.rand(len(other), 1, 1, 1, device=other.device) < 0.3
    return batches.add_noise(torch.where(grey, other.mean(dim=1, keepdim=True), other), 0.03)


def main(stage: Stage, recipe: ImageTextRecipe) -> None:
    init = stage.folders.get("init")
    objective = recipe.objective
    config = build("model", UniTouchConfig, recipe.model)
    stage.check_drawn(*(name for name in ("views", "attributes") if getattr(objective, name)))
    splits = stage.splits("image", "text")
    processor = stage.processor
    captions = [texts for source in stage.sources for texts in source.captions(objective.captions)]
    texts = [caption for one in captions for caption in one]
    if init is not None:
        begun = UniTouchModel.from_pretrained(init, modalities=("image", "text"))
        begun.config.ood_thresholds = {}
        begun.config.sensor_reaches = {}
        # Its touch and audio are bound to what its pictures were.
        model = UniTouchModel(begun.config, modalities=())  # type: ignore[arg-type]
        for modality in ("image", "text"):
            model.load_tensors(modality, begun.state_dict())
    else:
        processor.tokenizer = tokenizer = read_tokenizer("tokenizer", JOINT)
        special = {f"{name}_token_id": getattr(tokenizer, f"{name}_token_id") for name in ("bos", "eos", "pad")}
        config.text_config.update({"vocab_size": len(tokenizer), **special})  # type: ignore[union-attr]
        model = UniTouchModel(config, modalities=("image", "text"))

    data: dict[str, Any] = {"image": [split.image for split in splits]}
    if objective.attributes:
        chosen = [ATTRIBUTES.index(name) for name in SHOWN]
        measured = [split.attributes[:, :, chosen].mean(dim=1) for split in splits]  # by both sensors
        data["attributes"] = in_deviations(torch.cat(measured).numpy())
    data["input_ids"] = processor.text(texts)["input_ids"].unflatten(0, (len(captions), objective.captions))
    if objective.views:
        pairs = zip(stage.sources, splits, strict=True)
        data["relit"] = [relit(stage.cache, source, "train", split) for source, split in pairs]  # type: ignore[arg-type]
    sampler = None
    if recipe.sampler.group > 1:
        sampler = stage.sampler(recipe.sampler, splits, stage.image_embeddings(model, splits))
    trained = ImageTextObjective(model, objective)
    stage.fit(trained, ArrayDataset(**data), sampler)

    embeddings = stage.image_embeddings(model, splits).numpy()
    model.config.embedding_norm = float(np.linalg.norm(embeddings, axis=1).mean())
    with stage.saving(embedding_norm=model.config.embedding_norm) as folder:
        model.save_pretrained(folder)
        processor.save_pretrained(folder)
