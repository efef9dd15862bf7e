"""Stage 7, touches from image embeddings: a latent diffusion model (Rombach et al., 2022; Section 4.6 of the paper).

It is trained on image embeddings alone, so text and sound, bound to images, can take their place. The autoencoder and
the encoder of the condition are frozen: what they say of the training data is computed once.

Of drawn contacts, the network is shown what the sensor sees untouched beside the noise, as InstructPix2Pix (Brooks et
al., 2023) is shown its picture. So it learns sensors that have no name, too: their class is the one behind those of the
named ones.
"""

import json
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
    """What the conditions go through in training."""

    condition_dropout: Share  # probability of training a sample without condition, for guidance; its token is zeros
    noisy_share: Share  # of perturbed conditions, since those of other modalities lie beside the images' own
    condition_noise: NonNegativeFloat  # largest norm of that perturbation, relative to the embedding's
    step_power: StepPower


class BankSettings(Settings):
    size: PositiveInt  # image embeddings that are kept for conditions to be moved to


class TouchDiffusionRecipe(Recipe):
    model: Arguments
    scheduler: Arguments
    objective: TouchDiffusionSettings
    embedding_bank: BankSettings


class TouchDiffusionObjective(nn.Module):
    """Denoising of touch latents, conditioned on one token: the embedding of the picture of the same contact.

    Conditions are brought to `embedding_norm`, as in the pipeline. The class label is the sensor whose image is drawn.
    `backgrounds` are latents (M, C, h, w) of what sensors see untouched, of which a batch names one for each sample.
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
        self.backgrounds = backgrounds  # no buffer, which every process would send around at every step

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        latents = batch["latents"].float()
        settings = self.settings
        kept = torch.rand(len(latents), device=latents.device) >= settings.condition_dropout
        conditions = self.conditions(batch, kept)
        return {"loss": denoising_loss(self.trained, self.scheduler, latents, settings.step_power, **conditions)}

    def conditions(self, batch: Batch, kept: Tensor) -> dict[str, Tensor]:
        """Conditions of each sample, as the network takes them; unconditional ones where `kept` (B,) is false."""
        embeds = batch["image_embeds"].float()
        settings = self.settings
        count, width = embeds.shape
        device = embeds.device
        size = settings.condition_noise * torch.rand(count, 1, device=device)
        size = size * (torch.rand(count, 1, device=device) < settings.noisy_share)
        noisy = match_norm(embeds, 1.0) + size * torch.randn_like(embeds) / width**0.5
        condition = match_norm(noisy, self.embedding_norm) * kept[:, None]
        conditions = {"encoder_hidden_states": condition[:, None], "class_labels": batch["sensor"]}
        if self.backgrounds is not None:
            conditions["extra_channels"] = self.backgrounds[batch["background"].cpu()].to(embeds)
        return conditions


def places_of(splits: Sequence[Contacts]) -> list[np.ndarray]:
    """Where each contact's first sensor is among the untouched gels of all splits; its second is the next."""
    starts = np.cumsum([0, *(2 * -(-len(split) // GROUP) for split in splits)])
    return [start + np.arange(len(split)) // GROUP * 2 for start, split in zip(starts, splits, strict=False)]


def inputs(
    stage: Stage, joint: UniTouchModel, vae: Autoencoder, sensors: Sequence[str], with_gels: bool
) -> tuple[ArrayDataset, Tensor | None]:
    """Columns of latents of touches, embeddings of their pictures, sensors and, with gels, places of their backgrounds.

    `sensors` are the names of the class labels. With gels, it also returns the latents (M, C, h, w) of all backgrounds.
    """
    splits = stage.splits("image", "touch", "sensor")
    embeds = stage.image_embeddings(joint, splits)
    size = splits[0].touch.shape[-1]
    latents = cached_latents(stage, vae, f"touch{size}", splits, [split.touch for split in splits])
    sensor = torch.from_numpy(sensor_numbers(splits, sensors, unnamed=len(sensors)))
    if not with_gels:
        return ArrayDataset(latents=latents, image_embeds=embeds, sensor=sensor), None
    gels = (as_bytes(source.untouched("train", size).flatten(0, 1)) for source in stage.sources)  # type: ignore[union-attr]
    places = torch.from_numpy(np.concatenate(places_of(splits)))
    # Each contact is learnt by its second sensor as well, which has no name.
    images = [split.second for split in splits if split.second is not None]
    seconds = cached_latents(stage, vae, f"second{size}", splits, images)
    dataset = ArrayDataset(
        latents=torch.cat([latents, seconds]),
        image_embeds=torch.cat([embeds, embeds]),
        sensor=torch.cat([sensor, torch.full_like(sensor, len(sensors))]),
        background=torch.cat([places, places + 1]),
    )
    return dataset, cached_latents(stage, vae, f"untouched{size}", splits, gels)


def main(stage: Stage, recipe: TouchDiffusionRecipe) -> None:
    joint = stage.joint_space("image")
    vae = read_autoencoder(stage.folders["vae"])
    channels = vae.config.latent_channels
    sensors = [name for name in dict.fromkeys(source.sensor for source in stage.sources) if name is not None]
    with_gels = stage.data.drawn is not None
    classes = len(sensors) + 1 if with_gels and sensors else len(sensors) or None
    unet = stage.unet(recipe.model, num_class_embeds=classes)
    wanted = {"num_class_embeds": classes, "in_channels": channels * (1 + with_gels), "out_channels": channels}
    if wrong := {key: unet.config[key] for key in wanted if unet.config[key] != wanted[key]}:
        takes = f"for latents of `vae` and the sensors of `data` it takes {wanted}"
        raise InvalidInputError(f"The network has {wrong}; {takes}. Change `model`, or name another `init`.")
    scheduler = build("scheduler", DDPMScheduler, recipe.scheduler)

    dataset, table = inputs(stage, joint, vae, sensors, with_gels)
    objective = TouchDiffusionObjective(unet, scheduler, joint.config.embedding_norm, recipe.objective, table)
    stage.fit(objective, dataset)
    embeds: Any = dataset.columns["image_embeds"][: len(dataset) // (1 + with_gels)]  # those of first sensors
    rows = torch.randperm(len(embeds), generator=torch.Generator().manual_seed(0))[: recipe.embedding_bank.size]
    with stage.saving() as folder:
        unet.save_pretrained(folder / "unet")
        scheduler.save_pretrained(folder / "scheduler")
        EmbeddingBank.of(embeds[rows]).save_pretrained(folder / "embedding_bank")
        (folder / "sensors.json").write_text(json.dumps(sensors))
        if table is not None and sensors:
            labels, places = (np.asarray(dataset.columns[name]) for name in ("sensor", "background"))
            own = [int(places[labels == label][0]) for label in range(len(sensors))]
            SensorBackgrounds.of(table[own]).save_pretrained(folder / "backgrounds")
