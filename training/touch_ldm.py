"""Stage 8, touches from image embeddings: a latent diffusion model (Rombach et al., 2022; Section 4.6 of the paper).

    python -m unitouch_gen.training.touch_ldm --joint runs/image_text/model --vae runs/touch_vae/model \
        --output runs/touch_ldm

It is trained on image embeddings alone, so text and sound, bound to images, can take their place. The autoencoder and
the encoder of the condition are frozen: what they say of the training data is computed once.

A network with twice the input channels of a latent is shown what the sensor sees untouched beside the noise, as
InstructPix2Pix (Brooks et al., 2023) is shown its picture. So it learns sensors that have no name, too: their class is
the one behind those of the named ones.
"""

import json
from collections.abc import Sequence
from functools import partial

import numpy as np
import torch
from diffusers import DDPMScheduler, UNet2DConditionModel
from PIL import Image
from pydantic import NonNegativeFloat, PositiveInt
from torch import Tensor, nn

from unitouch_gen.conditioning import EmbeddingBank, SensorBackgrounds, match_norm
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.models import UniTouchModel
from unitouch_gen.models.autoencoders import Autoencoder, encode
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.training.batches import ArrayDataset, Batch
from unitouch_gen.training.data import DrawnContacts, Rendered, image_embeddings, sensor_numbers
from unitouch_gen.training.data.cache import Computed
from unitouch_gen.training.data.drawn import GROUP
from unitouch_gen.training.image_vae import cached_latents, read_autoencoder, to_signed
from unitouch_gen.training.losses import SnrGamma, denoising_losses
from unitouch_gen.training.recipe import Settings, Share, section_of
from unitouch_gen.training.stages import Stage, run
from unitouch_gen.training.watching import GRID_ROWS, Watch, decoded, denoised, grid, on_device_of, pixels_of, spread


class TouchDiffusionSettings(Settings):
    """What the conditions go through in training.

    Attributes:
        condition_dropout: Probability of training a sample without condition, for guidance; its token is zeros.
        noisy_share: Share of the conditions that are perturbed, since those that come from other modalities lie beside
            the images' own.
        condition_noise: Largest norm of that perturbation, relative to the embedding's.
        snr_gamma: Largest weight of an error; see `denoising_losses`.
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
        backgrounds: Latents (M, C, h, w) of what sensors see untouched, of which a batch names one for each sample;
            none where the network is shown none.
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
        self.scheduler, self.embedding_norm, self.settings = scheduler, embedding_norm, settings
        self.backgrounds = backgrounds  # no buffer, which every process would send around at every step

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        condition, latents = self._condition(batch["image_embeds"].float()), batch["latents"].float()
        beside = None if self.backgrounds is None else self.backgrounds[batch["background"].cpu()].to(latents)
        return denoising_losses(
            self.trained,
            self.scheduler,
            latents,
            self.settings.snr_gamma,
            beside,
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
    sensors: list[str],
    held: list[Rendered],
) -> Watch:
    """A grid of pictures, the touches of the same contacts, and the touches that are drawn from the pictures."""
    pictures, touches = (pixels_of(held, name, GRID_ROWS).float() / 255 for name in ("image", "touch"))
    labels = torch.from_numpy(class_labels(held, sensors))
    labels = labels[spread(len(labels), GRID_ROWS)]
    beside = None
    if objective.backgrounds is not None:
        with torch.no_grad():
            beside = encode(vae, to_signed(pixels_of(held, "untouched", GRID_ROWS)[:, 0]))
    with torch.no_grad():
        condition = match_norm(joint.get_image_features(normalise_pixels(pictures)), objective.embedding_norm)[:, None]
        shape = encode(vae, 2.0 * touches - 1.0).shape

    def watch() -> dict[str, Image.Image]:
        hidden, numbers = on_device_of(objective.trained, condition, labels)
        conditions = {"encoder_hidden_states": hidden, "class_labels": numbers}
        latents = denoised(objective.trained, objective.scheduler, shape, beside, **conditions)
        return {"samples": grid(pictures, touches, decoded(vae, latents))}

    return watch


def class_labels(splits: Sequence[Rendered], sensors: Sequence[str]) -> np.ndarray:
    """Class of each sample's sensor, int64 (N,): its place in `sensors`, and behind them of one without a name."""
    numbers = sensor_numbers(splits, sensors)
    return np.where(numbers < 0, len(sensors), numbers)


def untouched_gels(split: Rendered) -> Computed:
    """What the sensors of drawn contacts see untouched, uint8 (2 G, 3, S, S): two for each of G groups of contacts."""
    gels, groups, size = split.untouched, -(-len(split) // GROUP), split.touch.shape[-1]
    assert gels is not None
    return Computed(2 * groups, (3, size, size), np.uint8, lambda row: gels[row // 2 * GROUP][row % 2])


def places_of(splits: Sequence[Rendered]) -> list[np.ndarray]:
    """Where each contact's first sensor is among the untouched gels of all splits; its second is the next."""
    starts = np.cumsum([0, *(len(untouched_gels(split)) for split in splits)])
    return [start + np.arange(len(split)) // GROUP * 2 for start, split in zip(starts, splits, strict=False)]


def main(stage: Stage) -> None:
    settings = stage.section("objective", TouchDiffusionSettings)
    bank_size = stage.section("embedding_bank", BankSettings).size
    processor = stage.processor()
    joint = UniTouchModel.from_pretrained(stage.folders["joint"], modalities=("image",))
    vae = read_autoencoder(stage.folders["vae"]).eval().requires_grad_(False)
    channels = vae.config.latent_channels
    sensors = [name for name in dict.fromkeys(source.sensor for source in stage.sources) if name is not None]
    shown = section_of(stage.recipe, "model").get("in_channels") == 2 * channels
    if shown and not all(isinstance(source, DrawnContacts) for source in stage.sources):
        raise InvalidInputError(
            f"`model.in_channels` is {2 * channels}, to be shown untouched gels as well, which `data.drawn` alone has; "
            f"train on nothing else, or set it to {channels}."
        )
    if not shown and any(isinstance(source, DrawnContacts) and source.sensor is None for source in stage.sources):
        raise InvalidInputError(
            "`data.drawn.sensors` holds null, for sensors that are drawn anew, which this stage learns by what they "
            f"see untouched; set `model.in_channels` to {2 * channels}, or leave null out and name one at least."
        )
    classes = len(sensors) + 1 if shown and sensors else len(sensors) or None
    unet = stage.unet(num_class_embeds=classes)
    if unet.config.num_class_embeds != classes:
        raise InvalidInputError(
            f"`init` is {str(stage.init)!r}, a network that draws {unet.config.num_class_embeds} sensors, and the data "
            f"is of {classes}: {sensors}; they have to be as many, in the same order."
        )
    found, wanted = (unet.config.in_channels, unet.config.out_channels), (channels * (1 + shown), channels)
    if found != wanted:
        raise InvalidInputError(
            f"The network takes {found[0]} channels and makes {found[1]}, and latents of `vae` have {channels}; in "
            f"`model`, `out_channels` has to be {channels}, and `in_channels` that or twice as many."
        )
    scheduler = stage.section("scheduler", DDPMScheduler)

    needs = ("image", "touch", "sensor")
    splits = stage.splits(processor, *needs)
    key = stage.key(splits)
    embeds = image_embeddings(joint, [split.image for split in splits], key, stage.cache)
    touches, size = [split.touch for split in splits], splits[0].touch.shape[-1]
    columns = {
        "latents": cached_latents(vae, touches, f"touch{size}-latents-{key}", stage.cache),
        "image_embeds": embeds,
        "sensor": torch.from_numpy(class_labels(splits, sensors)),
    }
    table, places = None, list[np.ndarray]()
    if shown:
        gels = [untouched_gels(split) for split in splits]
        table = cached_latents(vae, gels, f"untouched{size}-latents-{key}", stage.cache)
        places = places_of(splits)
        columns["background"] = torch.from_numpy(np.concatenate(places))
        # Each contact is learnt by its second sensor as well, which has no name.
        second = [split.second for split in splits if split.second is not None]
        others = {
            "latents": cached_latents(vae, second, f"second{size}-latents-{key}", stage.cache),
            "image_embeds": embeds,
            "sensor": torch.full_like(columns["sensor"], len(sensors)),
            "background": columns["background"] + 1,
        }
        columns = {name: torch.cat([values, others[name]]) for name, values in columns.items()}
    dataset = ArrayDataset(**columns)
    objective = TouchDiffusionObjective(unet, scheduler, joint.config.embedding_norm, settings, table)
    watch = stage.watching(partial(watch_samples, objective, joint, vae, sensors), processor, *needs)
    stage.fit(objective, dataset, watch=watch)
    rows = torch.randperm(len(embeds), generator=torch.Generator().manual_seed(0))[:bank_size]
    with stage.saving() as folder:
        unet.save_pretrained(folder / "unet")
        scheduler.save_pretrained(folder / "scheduler")
        EmbeddingBank.of(embeds[rows]).save_pretrained(folder / "embedding_bank")
        (folder / "sensors.json").write_text(json.dumps(sensors))
        if table is not None and sensors:
            named = [split.sensor for split in splits]
            own = [int(places[named.index(name)][0]) for name in sensors]
            SensorBackgrounds.of(table[own]).save_pretrained(folder / "backgrounds")


if __name__ == "__main__":
    run("touch_ldm", main)
