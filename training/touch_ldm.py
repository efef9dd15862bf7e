"""Stage 8, touches from image embeddings: a latent diffusion model (Rombach et al., 2022; Section 4.6 of the paper).

    python -m unitouch_gen.training.touch_ldm --joint runs/image_text/model --vae runs/touch_vae/model \
        --output runs/touch_ldm

It is trained on image embeddings alone, so text and sound, bound to images, can take their place. The autoencoder and
the encoder of the condition are frozen: what they say of the training data is computed once.
"""

import json

import torch
from diffusers import DDPMScheduler, UNet2DConditionModel
from PIL import Image
from pydantic import NonNegativeFloat, PositiveInt
from torch import Tensor, nn

from unitouch_gen.conditioning import EmbeddingBank, match_norm
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.models import UniTouchModel
from unitouch_gen.models.autoencoders import Autoencoder, encode
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.training.batches import ArrayDataset, Batch
from unitouch_gen.training.data import Rendered, image_embeddings, sensor_numbers
from unitouch_gen.training.image_vae import cached_latents, read_autoencoder
from unitouch_gen.training.losses import SnrGamma, denoising_losses
from unitouch_gen.training.recipe import Settings, Share
from unitouch_gen.training.stages import Stage, run
from unitouch_gen.training.watching import GRID_ROWS, Watch, decoded, denoised, grid, on_device_of, pixels_of, spread


class TouchDiffusionSettings(Settings):
    """What the conditions go through in training.

    Attributes:
        condition_dropout: Probability of training a sample without condition, for guidance; its token is zeros.
        noisy_share: Share of the conditions that are perturbed, since those that come from other modalities lie beside
            the images' own.
        condition_noise: Largest norm of that perturbation, relative to the embedding's.
        snr_gamma: Bound of the min-SNR weighting.
    """

    condition_dropout: Share
    noisy_share: Share
    condition_noise: NonNegativeFloat
    snr_gamma: SnrGamma


class BankSettings(Settings):
    """How many image embeddings are kept for conditions to be moved to."""

    size: PositiveInt


class TouchDiffusionObjective(nn.Module):
    """Denoising of touch latents, conditioned on one token: the embedding of the picture of the same contact.

    Args:
        unet: What is trained. Its class label is the sensor whose image is drawn.
        scheduler: Schedule of the latents.
        embedding_norm: L2 norm every condition is brought to, as in the pipeline.
        settings: What the conditions go through.
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


def watch_samples(
    objective: TouchDiffusionObjective,
    joint: UniTouchModel,
    vae: Autoencoder,
    held: list[Rendered],
    sensors: list[str | None],
) -> Watch | None:
    """A grid of pictures, the touches of the same contacts, and the touches that are drawn from the pictures."""
    if not held:
        return None
    pictures, touches = (pixels_of(held, name, GRID_ROWS).float() / 255 for name in ("image", "touch"))
    labels = torch.from_numpy(sensor_numbers(held, sensors))
    labels = labels[spread(len(labels), GRID_ROWS)]
    with torch.no_grad():
        condition = match_norm(joint.get_image_features(normalise_pixels(pictures)), objective.embedding_norm)[:, None]
        shape = encode(vae, 2.0 * touches - 1.0).shape

    def watch() -> dict[str, Image.Image]:
        hidden, numbers = on_device_of(objective.trained, condition, labels)
        conditions = {"encoder_hidden_states": hidden, "class_labels": numbers}
        latents = denoised(objective.trained, objective.scheduler, shape, **conditions)
        return {"samples": grid(pictures, touches, decoded(vae, latents))}

    return watch


def main(stage: Stage) -> None:
    settings = stage.section("objective", TouchDiffusionSettings)
    bank_size = stage.section("embedding_bank", BankSettings).size
    processor = stage.processor()
    joint = UniTouchModel.from_pretrained(stage.folders["joint"], modalities=("image",))
    vae = read_autoencoder(stage.folders["vae"]).eval().requires_grad_(False)
    sensors = list(dict.fromkeys(source.sensor for source in stage.sources))
    if None in sensors and stage.data.drawn is not None:
        raise InvalidInputError(
            "`data.drawn.sensors` holds null, for sensors that are drawn anew, of which this stage can learn none; "
            "leave it out, and name one at least."
        )
    unet = stage.unet(num_class_embeds=len(sensors))
    if unet.config.num_class_embeds != len(sensors):
        raise InvalidInputError(
            f"`init` is {str(stage.init)!r}, a network that draws {unet.config.num_class_embeds} sensors, and the data "
            f"is of {len(sensors)}: {sensors}; they have to be as many, in the same order."
        )
    scheduler = stage.section("scheduler", DDPMScheduler)

    splits = stage.splits(processor, "image", "touch", "sensor")
    key = stage.key(splits)
    embeds = image_embeddings(joint, [split.image for split in splits], key, stage.cache)
    touches = [split.touch for split in splits]
    latents = cached_latents(vae, touches, f"touch{touches[0].shape[-1]}-latents-{key}", stage.cache)
    dataset = ArrayDataset(latents=latents, image_embeds=embeds, sensor=sensor_numbers(splits, sensors))
    objective = TouchDiffusionObjective(unet, scheduler, joint.config.embedding_norm, settings)
    held = stage.held_out(processor, "image", "touch", "sensor")
    stage.fit(objective, dataset, watch=watch_samples(objective, joint, vae, held, sensors))
    rows = torch.randperm(len(embeds), generator=torch.Generator().manual_seed(0))[:bank_size]
    with stage.saving() as folder:
        unet.save_pretrained(folder / "unet")
        scheduler.save_pretrained(folder / "scheduler")
        EmbeddingBank.of(embeds[rows]).save_pretrained(folder / "embedding_bank")
        (folder / "sensors.json").write_text(json.dumps(sensors))


if __name__ == "__main__":
    run("touch_ldm", main)
