"""Touches from image embeddings by latent diffusion (Rombach et al., 2022; Section 4.6 of the paper).

The model is trained on image embeddings alone, so text and sound, bound to images, can take their place. The
autoencoder and the encoder of the condition are frozen, and their outputs on the training data are computed once.

With drawn contacts, the untouched image of the sensor is a second input beside the noise, as the picture is in
InstructPix2Pix (Brooks et al., 2023). So the model learns sensors without a name, too. They share the last class label.
"""

import json
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from diffusers import DDPMScheduler, UNet2DConditionModel
from pydantic import NonNegativeFloat, PositiveInt
from torch import Tensor, nn

from unitouch_gen.conditioning import EmbeddingBank, SensorBackgrounds, match_norm
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.models import UniTouchModel
from unitouch_gen.models.autoencoders import Autoencoder, read_autoencoder
from unitouch_gen.training.batches import ArrayDataset, Batch
from unitouch_gen.training.data import Contacts, sensor_numbers
from unitouch_gen.training.data.columns import as_bytes
from unitouch_gen.training.data.drawn import GROUP
from unitouch_gen.training.image_vae import cached_latents
from unitouch_gen.training.losses import StepPower, denoising_loss
from unitouch_gen.training.recipe import Arguments, Settings, Share, build
from unitouch_gen.training.stages import Recipe, Stage


class TouchDiffusionSettings(Settings):
    """Dropout and noise of the conditions."""

    condition_dropout: Share  # probability of training a sample without condition, for guidance; its token is zeros
    noisy_share: Share  # share of perturbed conditions; embeddings of other modalities lie beside the images' own
    condition_noise: NonNegativeFloat  # largest norm of the perturbation, relative to the embedding's
    step_power: StepPower


class BankSettings(Settings):
    size: PositiveInt  # number of image embeddings to keep


class TouchDiffusionRecipe(Recipe):
    model: Arguments
    scheduler: Arguments
    objective: TouchDiffusionSettings
    embedding_bank: BankSettings


class TouchDiffusionObjective(nn.Module):
    """Denoising of touch latents, conditioned on one token: the embedding of the picture of the same contact.

    Conditions are scaled to `embedding_norm`, as in the pipeline. The class label is the sensor whose image is drawn.
    `backgrounds` are latents (M, C, h, w) of untouched sensors. A batch has the row of one for each sample.
    """

    def __init__(
        self,
        unet: UNet2DConditionModel,
        scheduler: DDPMScheduler,
        embedding_norm: float,
        settings: TouchDiffusionSettings,
        backgrounds: Tensor | None = None,
    ):
        super().__init__()
        self.trained = unet
        self.scheduler = scheduler
        self.embedding_norm = embedding_norm
        self.settings = settings
        self.backgrounds = backgrounds  # a buffer would be sent to all processes at every step

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        latents = batch["latents"].float()
        settings = self.settings
        kept = torch.rand(len(latents), device=latents.device) >= settings.condition_dropout
        conditions = self.conditions(batch, kept)
        return {"loss": denoising_loss(self.trained, self.scheduler, latents, settings.step_power, **conditions)}

    def conditions(self, batch: Batch, kept: Tensor) -> dict[str, Tensor]:
        """The network's conditions for each sample; unconditional where `kept` (B,) is false."""
        embeds = batch["image_embeds"].float()
        count, width = embeds.shape
        noise_norm = self.settings.condition_noise * torch.rand(count, 1, device=embeds.device)
        is_noisy = torch.rand(count, 1, device=embeds.device) < self.settings.noisy_share
        noise = noise_norm * is_noisy * torch.randn_like(embeds) / width**0.5
        noisy = match_norm(embeds, 1.0) + noise
        condition = match_norm(noisy, self.embedding_norm) * kept[:, None]
        conditions = {"encoder_hidden_states": condition[:, None], "class_labels": batch["sensor"]}
        if self.backgrounds is not None:
            conditions["extra_channels"] = self.backgrounds[batch["background"].cpu()].to(embeds)
        return conditions


def places_of(splits: Sequence[Contacts]) -> list[np.ndarray]:
    """The row of each contact's first sensor among the untouched gels of all splits; its second sensor is the next row.

    A split has two sensors for every `GROUP` contacts.
    """
    places = list[np.ndarray]()
    start = 0
    for split in splits:
        places.append(start + np.arange(len(split)) // GROUP * 2)
        start += 2 * math.ceil(len(split) / GROUP)
    return places


def inputs(
    stage: Stage, joint: UniTouchModel, vae: Autoencoder, sensors: Sequence[str], with_gels: bool
) -> tuple[ArrayDataset, Tensor | None]:
    """Columns of touch latents, embeddings of their pictures, sensors and, with gels, rows of their backgrounds.

    `sensors` are the names of the class labels. With gels, the latents (M, C, h, w) of all backgrounds are returned,
    too.
    """
    splits = stage.splits("image", "touch", "sensor")
    embeds = stage.image_embeddings(joint, splits)
    size = splits[0].touch.shape[-1]
    latents = cached_latents(stage, vae, f"touch{size}", splits, [split.touch for split in splits])
    sensor = torch.from_numpy(sensor_numbers(splits, sensors, unnamed=len(sensors)))
    if not with_gels:
        return ArrayDataset(latents=latents, image_embeds=embeds, sensor=sensor), None
    gels = (as_bytes(source.untouched("train", size).flatten(0, 1)) for source in stage.sources)  # type: ignore[union-attr]
    rows = torch.from_numpy(np.concatenate(places_of(splits)))
    # Every contact is a sample under its second sensor, too. That sensor has no name.
    second_touches = [split.second for split in splits if split.second is not None]
    second_latents = cached_latents(stage, vae, f"second{size}", splits, second_touches)
    dataset = ArrayDataset(
        latents=torch.cat([latents, second_latents]),
        image_embeds=torch.cat([embeds, embeds]),
        sensor=torch.cat([sensor, torch.full_like(sensor, len(sensors))]),
        background=torch.cat([rows, rows + 1]),
    )
    return dataset, cached_latents(stage, vae, f"untouched{size}", splits, gels)


def check_unet(unet: UNet2DConditionModel, expected: dict[str, int | None]) -> None:
    """Raises if the network is for other latents or another number of sensors than `expected`."""
    wrong = {key: unet.config[key] for key in expected if unet.config[key] != expected[key]}
    if wrong:
        takes = f"for latents of `vae` and the sensors of `data` it takes {expected}"
        raise InvalidInputError(f"The network has {wrong}; {takes}. Change `model`, or name another `init`.")


def class_count(sensors: Sequence[str], with_gels: bool) -> int | None:
    """The number of class labels: one for each named sensor and, with gels, one for all others; `None` for none."""
    if not sensors:
        return None
    return len(sensors) + 1 if with_gels else len(sensors)


def main(stage: Stage, recipe: TouchDiffusionRecipe) -> None:
    joint = stage.joint_space("image")
    vae = read_autoencoder(stage.folders["vae"])
    channels = vae.config.latent_channels
    sensors = [name for name in dict.fromkeys(source.sensor for source in stage.sources) if name is not None]
    with_gels = stage.data.drawn is not None
    classes = class_count(sensors, with_gels)
    in_channels = 2 * channels if with_gels else channels
    unet = stage.unet(recipe.model, num_class_embeds=classes)
    check_unet(unet, {"num_class_embeds": classes, "in_channels": in_channels, "out_channels": channels})
    scheduler = build("scheduler", DDPMScheduler, recipe.scheduler)

    dataset, backgrounds = inputs(stage, joint, vae, sensors, with_gels)
    objective = TouchDiffusionObjective(
        unet, scheduler, joint.config.embedding_norm, settings=recipe.objective, backgrounds=backgrounds
    )
    stage.fit(objective, dataset)
    embeds: Any = dataset.columns["image_embeds"]
    if with_gels:
        embeds = embeds[: len(embeds) // 2]  # the second half repeats them for second sensors
    chosen = torch.randperm(len(embeds), generator=torch.Generator().manual_seed(0))[: recipe.embedding_bank.size]
    with stage.saving() as folder:
        unet.save_pretrained(folder / "unet")
        scheduler.save_pretrained(folder / "scheduler")
        EmbeddingBank.of(embeds[chosen]).save_pretrained(folder / "embedding_bank")
        (folder / "sensors.json").write_text(json.dumps(sensors))
        if backgrounds is not None and sensors:
            labels = np.asarray(dataset.columns["sensor"])
            rows = np.asarray(dataset.columns["background"])
            first_rows = [int(rows[labels == label][0]) for label in range(len(sensors))]
            SensorBackgrounds.of(backgrounds[first_rows]).save_pretrained(folder / "backgrounds")
