"""Stage 8, touches from image embeddings: a latent diffusion model (Rombach et al., 2022; Section 4.7 of the paper).

    python -m unitouch_gen.training.touch_ldm --joint runs/image_text/model --vae runs/touch_vae/model \
        --output runs/touch_ldm

It is trained on image embeddings alone, so text and sound, bound to images, can take their place. The autoencoder and
the encoder of the condition are frozen: what they say of the training data is computed once.
"""

import json
from pathlib import Path

import diffusers
import numpy as np
import torch
from diffusers import DDPMScheduler, UNet2DConditionModel
from torch import Tensor, nn

from unitouch_gen.diffusion.conditioning import match_norm
from unitouch_gen.diffusion.store import EmbeddingStore
from unitouch_gen.encoders import UniTouchModel, UniTouchProcessor
from unitouch_gen.training.autoencoder import cached_latents
from unitouch_gen.training.core import Batch
from unitouch_gen.training.data import ArrayDataset
from unitouch_gen.training.diffusion import denoising_losses
from unitouch_gen.training.folders import write_folder
from unitouch_gen.training.sampler import ShuffledSampler
from unitouch_gen.training.stages import (
    data_key,
    image_embeddings,
    parse,
    train,
    training_splits,
    write_record,
)


class TouchDiffusionObjective(nn.Module):
    """Denoising of touch latents, conditioned on one token: the embedding of the picture of the same contact.

    Args:
        unet: What is trained. Its class label is the sensor whose image is drawn.
        scheduler: Schedule of the latents.
        embedding_norm: L2 norm every condition is brought to, as in the pipeline.
        drop: Probability of training a sample without condition, for guidance; its token is zeros.
        noisy_share: Share of the conditions that are perturbed, since those that come from other senses lie beside the
            images' own.
        condition_noise: Largest norm of that perturbation, relative to the embedding's.
        snr_gamma: Of the min-SNR weighting.
    """

    def __init__(
        self,
        unet: UNet2DConditionModel,
        scheduler: DDPMScheduler,
        embedding_norm: float,
        *,
        drop: float,
        noisy_share: float,
        condition_noise: float,
        snr_gamma: float,
    ):
        super().__init__()
        self.trained = unet
        self.scheduler, self.embedding_norm = scheduler, embedding_norm
        self.drop, self.noisy_share, self.condition_noise = drop, noisy_share, condition_noise
        self.snr_gamma = snr_gamma

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        condition = self._condition(batch["image_embeds"].float())
        return denoising_losses(
            self.trained,
            self.scheduler,
            batch["latents"].float(),
            self.snr_gamma,
            encoder_hidden_states=condition[:, None],
            class_labels=batch["sensor"],
        )

    def _condition(self, embeds: Tensor) -> Tensor:
        """Embeddings (B, D) of one norm, some perturbed, some dropped."""
        count, width = embeds.shape
        device = embeds.device
        size = self.condition_noise * torch.rand(count, 1, device=device)
        size = size * (torch.rand(count, 1, device=device) < self.noisy_share)
        unit = match_norm(embeds, 1.0) + size * torch.randn_like(embeds) / width**0.5
        kept = torch.rand(count, 1, device=device) >= self.drop
        return match_norm(unit, self.embedding_norm) * kept


def main() -> None:
    stage = parse("touch_ldm", needs=("joint", "vae"), takes_init=True)
    torch.manual_seed(stage.trainer.seed)
    processor = UniTouchProcessor.from_pretrained(stage.folders["joint"])
    splits = training_splits(stage, processor)
    key = data_key(stage)
    joint = UniTouchModel.from_pretrained(stage.folders["joint"], senses=("image",))
    embeds = image_embeddings(joint, [split.image for split in splits], key, stage.cache)
    config = stage.folders["vae"] / "config.json"
    kind = getattr(diffusers, json.loads(config.read_text())["_class_name"])
    vae = kind.from_pretrained(stage.folders["vae"]).eval().requires_grad_(False)
    latents = cached_latents(vae, [split.touch for split in splits], f"touch-latents-{key}", stage.cache)

    sensors = list(dict.fromkeys(split.sensor for split in splits))
    sensor = np.concatenate([np.full(len(split), sensors.index(split.sensor)) for split in splits])
    if stage.init is None:
        unet = UNet2DConditionModel(**stage.recipe["model"], num_class_embeds=len(sensors))
    else:
        unet = UNet2DConditionModel.from_pretrained(stage.init, torch_dtype=torch.float32)
    scheduler = DDPMScheduler(**stage.recipe["scheduler"])
    objective = TouchDiffusionObjective(unet, scheduler, joint.config.embedding_norm, **stage.recipe["objective"])
    dataset = ArrayDataset(latents=latents, image_embeds=embeds, sensor=sensor)
    sampler = ShuffledSampler(len(dataset), stage.trainer.batch_size, stage.trainer.seed)
    trainer = train(stage, objective, dataset, sampler)
    rows = torch.randperm(len(embeds), generator=torch.Generator().manual_seed(0))[: stage.recipe["store"]["size"]]
    store = EmbeddingStore.of(embeds[rows])

    def write(folder: Path) -> None:
        unet.save_pretrained(folder / "unet")
        scheduler.save_pretrained(folder / "scheduler")
        store.save_pretrained(folder / "store")
        (folder / "sensors.json").write_text(json.dumps(sensors))

    write_folder(stage.output / "model", write)
    write_record(stage, trainer.seconds)


if __name__ == "__main__":
    main()
