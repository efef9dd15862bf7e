"""Stage 8, touches from image embeddings: a latent diffusion model (Rombach et al., 2022; Section 4.6 of the paper).

    python -m unitouch_gen.training.touch_ldm --joint runs/image_text/model --vae runs/touch_vae/model \
        --output runs/touch_ldm

It is trained on image embeddings alone, so text and sound, bound to images, can take their place. The autoencoder and
the encoder of the condition are frozen: what they say of the training data is computed once.
"""

import json
from dataclasses import dataclass

import numpy as np
import torch
from diffusers import DDPMScheduler, UNet2DConditionModel
from torch import Tensor, nn

from unitouch_gen.conditioning import match_norm
from unitouch_gen.embedding_bank import EmbeddingBank
from unitouch_gen.errors import check_integer, check_number
from unitouch_gen.files import replacing_folder
from unitouch_gen.models import UniTouchModel, UniTouchProcessor
from unitouch_gen.training.autoencoder import cached_latents, read_autoencoder
from unitouch_gen.training.data import ArrayDataset, Batch
from unitouch_gen.training.diffusion import check_snr_gamma, denoising_losses, starting_unet
from unitouch_gen.training.recipe import check_probabilities, read_section
from unitouch_gen.training.sampler import ShuffledSampler
from unitouch_gen.training.stages import (
    command,
    data_key,
    image_embeddings,
    parse,
    train,
    training_splits,
    write_record,
)
from unitouch_gen.world import COLLECTIONS


@dataclass(frozen=True)
class TouchDiffusionSettings:
    """What the conditions go through in training.

    Attributes:
        condition_dropout: Probability of training a sample without condition, for guidance; its token is zeros.
        noisy_share: Share of the conditions that are perturbed, since those that come from other modalities lie beside
            the images' own.
        condition_noise: Largest norm of that perturbation, relative to the embedding's.
        snr_gamma: Of the min-SNR weighting.
    """

    condition_dropout: float
    noisy_share: float
    condition_noise: float
    snr_gamma: float

    def __post_init__(self) -> None:
        check_probabilities(self, "condition_dropout", "noisy_share")
        check_number("condition_noise", self.condition_noise, 0.0)
        check_snr_gamma(self.snr_gamma)


@dataclass(frozen=True)
class StoreSettings:
    """The image embeddings that conditions may be moved to.

    Attributes:
        size: How many are kept.
    """

    size: int

    def __post_init__(self) -> None:
        check_integer("size", self.size, 1)


class TouchDiffusionObjective(nn.Module):
    """Denoising of touch latents, conditioned on one token: the embedding of the picture of the same contact.

    Args:
        unet: What is trained. Its class label is the sensor whose image is drawn.
        scheduler: Schedule of the latents.
        embedding_norm: L2 norm every condition is brought to, as in the pipeline.
        settings: Of the conditions.
    """

    def __init__(
        self,
        unet: UNet2DConditionModel,
        scheduler: DDPMScheduler,
        embedding_norm: float,
        settings: TouchDiffusionSettings,
    ):
        super().__init__()
        self.trained = unet
        self.scheduler, self.embedding_norm, self.settings = scheduler, embedding_norm, settings

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        condition = self._condition(batch["image_embeds"].float())
        return denoising_losses(
            self.trained,
            self.scheduler,
            batch["latents"].float(),
            self.settings.snr_gamma,
            encoder_hidden_states=condition[:, None],
            class_labels=batch["sensor"],
        )

    def _condition(self, embeds: Tensor) -> Tensor:
        """Embeddings (B, D) of one norm, some perturbed, some dropped."""
        count, width = embeds.shape
        device = embeds.device
        size = self.settings.condition_noise * torch.rand(count, 1, device=device)
        size = size * (torch.rand(count, 1, device=device) < self.settings.noisy_share)
        unit = match_norm(embeds, 1.0) + size * torch.randn_like(embeds) / width**0.5
        kept = torch.rand(count, 1, device=device) >= self.settings.condition_dropout
        return match_norm(unit, self.embedding_norm) * kept


@command
def main() -> None:
    stage = parse("touch_ldm", takes_init=True)
    settings = read_section(stage.recipe, "objective", TouchDiffusionSettings)
    bank_size = read_section(stage.recipe, "embedding_bank", StoreSettings).size
    torch.manual_seed(stage.trainer.seed)
    processor = UniTouchProcessor.from_pretrained(stage.folders["joint"])
    joint = UniTouchModel.from_pretrained(stage.folders["joint"], modalities=("image",))
    vae = read_autoencoder(stage.folders["vae"]).eval().requires_grad_(False)
    sensors = list(dict.fromkeys(COLLECTIONS[name].sensor for name in stage.data.collections))
    unet = starting_unet(stage, num_class_embeds=len(sensors))
    scheduler = read_section(stage.recipe, "scheduler", DDPMScheduler)
    objective = TouchDiffusionObjective(unet, scheduler, joint.config.embedding_norm, settings)

    splits = training_splits(stage, processor)
    key = data_key(stage, splits)
    embeds = image_embeddings(joint, [split.image for split in splits], key, stage.cache)
    touches = [split.touch for split in splits]
    latents = cached_latents(vae, touches, f"touch{touches[0].shape[-1]}-latents-{key}", stage.cache)
    sensor = np.concatenate([np.full(len(split), sensors.index(split.sensor)) for split in splits])
    dataset = ArrayDataset(latents=latents, image_embeds=embeds, sensor=sensor)
    sampler = ShuffledSampler(len(dataset), stage.trainer.batch_size, stage.trainer.seed)
    trainer = train(stage, objective, dataset, sampler)
    rows = torch.randperm(len(embeds), generator=torch.Generator().manual_seed(0))[:bank_size]
    bank = EmbeddingBank.of(embeds[rows])
    with replacing_folder(stage.output / "model") as folder:
        unet.save_pretrained(folder / "unet")
        scheduler.save_pretrained(folder / "scheduler")
        bank.save_pretrained(folder / "embedding_bank")
        (folder / "sensors.json").write_text(json.dumps(sensors))
    write_record(stage, trainer.seconds)


if __name__ == "__main__":
    main()
