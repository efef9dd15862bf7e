"""The joint space of image and text, trained as CLIP (Radford et al., 2021).

Pictures of a drawn contact under two lamps can be bound to each other, as SimCLR binds views of an image (Chen et al.,
2020). Captions do not say which contact a picture shows, and touches are bound to single pictures later.

Training starts from random encoders of the recipe's sizes and the built-in tokenizer, which knows the world's words and
every byte. With `--init` it continues from the encoders, tokenizer and sizes of a joint space.
"""

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from pydantic import NonNegativeFloat, PositiveInt
from torch import Tensor, nn
from transformers import PreTrainedTokenizerBase

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
    """Losses and captions that drawn contacts add to CLIP."""

    attributes: NonNegativeFloat = 0.0  # weight of the squared error of attributes, in units of their deviations
    captions: PositiveInt = 1  # number for each drawn contact; every step draws one of them
    views: NonNegativeFloat = 0.0  # weight of InfoNCE between pictures of a contact under two lamps


class ImageTextRecipe(Recipe):
    model: Arguments
    objective: ImageTextSettings = ImageTextSettings()
    sampler: SamplerSettings = SamplerSettings()  # groups are by the embeddings at the start


class ImageTextObjective(nn.Module):
    """Symmetric InfoNCE between pictures and captions with a learned temperature, and losses of drawn contacts.

    Attributes (B, K), in deviations, are predicted linearly from a picture's embedding.
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
        chosen = torch.randint(captions.shape[1], (len(captions),))
        text = self.model.get_text_features(captions[rows, chosen])
        temperature = 1.0 / self.log_scale.exp().clamp(max=100.0)
        parts = {"text": symmetric_info_nce(image, text, temperature)}
        if self.settings.views:
            relit_pixels = recoloured(batch["relit"].float() / 255)
            second = self.model.get_image_features(normalise_pixels(relit_pixels))
            parts["views"] = symmetric_info_nce(image, second, self.model.config.temperature)
        if self.reader is not None:
            parts["attributes"] = F.mse_loss(self.reader(image.float()), batch["attributes"])
        loss = torch.stack([getattr(self.settings, name, 1.0) * part for name, part in parts.items()]).sum()
        logged = {"temperature": temperature, **parts}
        return {"loss": loss, **{name: value.detach() for name, value in logged.items()}}


def recoloured(pictures: Tensor) -> Tensor:
    """Pictures (B, 3, S, S) in [0, 1], shifted, with other colours and brightness, some blurred or grey."""
    changed = batches.shift_pixels(pictures, 2)
    changed = batches.permute_channels(changed, 0.5)
    changed = batches.blur_some(changed, 0.3)
    changed = batches.jitter_colours(changed, gain=0.4, offset=0.12)
    is_grey = torch.rand(len(changed), 1, 1, 1, device=changed.device) < 0.3
    changed = torch.where(is_grey, changed.mean(dim=1, keepdim=True), changed)
    return batches.add_noise(changed, 0.03)


def continued_model(init: Path) -> UniTouchModel:
    """The image and text encoders of a joint space; its touch and audio were bound to the pictures' old embeddings."""
    initial = UniTouchModel.from_pretrained(init, modalities=("image", "text"))
    initial.config.ood_thresholds = {}
    initial.config.sensor_reaches = {}
    model = UniTouchModel(initial.config, modalities=())  # type: ignore[arg-type]
    for modality in ("image", "text"):
        model.load_tensors(modality, initial.state_dict())
    return model


def fresh_model(config: UniTouchConfig, tokenizer: PreTrainedTokenizerBase) -> UniTouchModel:
    """Random image and text encoders for the words of a tokenizer."""
    special = {f"{name}_token_id": getattr(tokenizer, f"{name}_token_id") for name in ("bos", "eos", "pad")}
    config.text_config.update({"vocab_size": len(tokenizer), **special})  # type: ignore[union-attr]
    return UniTouchModel(config, modalities=("image", "text"))


def main(stage: Stage, recipe: ImageTextRecipe) -> None:
    init = stage.folders.get("init")
    objective = recipe.objective
    config = build("model", UniTouchConfig, recipe.model)
    stage.check_drawn(*(name for name in ("views", "attributes") if getattr(objective, name)))
    splits = stage.splits("image", "text")
    processor = stage.processor
    captions_of_contacts = [texts for source in stage.sources for texts in source.captions(objective.captions)]
    captions = [caption for texts in captions_of_contacts for caption in texts]
    if init is not None:
        model = continued_model(init)
    else:
        processor.tokenizer = read_tokenizer("tokenizer", JOINT)
        model = fresh_model(config, processor.tokenizer)

    data: dict[str, Any] = {"image": [split.image for split in splits]}
    if objective.attributes:
        shown = [ATTRIBUTES.index(name) for name in SHOWN]
        measured = [split.attributes[:, :, shown].mean(dim=1) for split in splits]  # mean over both sensors
        data["attributes"] = in_deviations(torch.cat(measured).numpy())
    tokens = processor.text(captions)["input_ids"]
    data["input_ids"] = tokens.unflatten(0, (len(captions_of_contacts), objective.captions))
    if objective.views:
        pairs = zip(stage.sources, splits, strict=True)
        data["relit"] = [relit(stage.cache, source, "train", split) for source, split in pairs]  # type: ignore[arg-type]
    sampler = None
    if recipe.sampler.group > 1:
        sampler = stage.sampler(recipe.sampler, splits, stage.image_embeddings(model, splits))
    stage.fit(ImageTextObjective(model, objective), ArrayDataset(**data), sampler)

    embeddings = stage.image_embeddings(model, splits).numpy()
    model.config.embedding_norm = float(np.linalg.norm(embeddings, axis=1).mean())
    with stage.saving(embedding_norm=model.config.embedding_norm) as folder:
        model.save_pretrained(folder)
        processor.save_pretrained(folder)
