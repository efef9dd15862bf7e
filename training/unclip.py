"""Stage 5, pictures from image embeddings: an unCLIP UNet (Ramesh et al., 2022; Rombach et al., 2022).

    python -m unitouch_gen.training.unclip --joint runs/image_text/model --vae runs/image_vae/model --output runs/unclip

It is trained on image embeddings alone, so whatever else is bound to images can take their place.
"""

from dataclasses import dataclass
from functools import partial
from typing import Self

import torch
from diffusers import DDPMScheduler, UNet2DConditionModel
from diffusers.pipelines.stable_diffusion.stable_unclip_image_normalizer import StableUnCLIPImageNormalizer
from PIL import Image
from pydantic import model_validator
from torch import Tensor, nn

from unitouch_gen.conditioning import QUALITY_PROMPT, noise_embeddings
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.models import UniTouchModel, UniTouchProcessor
from unitouch_gen.models.autoencoders import Autoencoder, encode
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.training.batches import ArrayDataset, Batch
from unitouch_gen.training.data import Rendered, image_embeddings
from unitouch_gen.training.image_vae import cached_latents, read_autoencoder
from unitouch_gen.training.losses import SnrGamma, denoising_losses
from unitouch_gen.training.recipe import Settings, Share
from unitouch_gen.training.stages import Stage, run
from unitouch_gen.training.watching import GRID_ROWS, Watch, decoded, denoised, grid, on_device_of, pixels_of


class UnclipSettings(Settings):
    """What the conditions go through in training.

    Attributes:
        condition_dropout: Probability of training a sample without embedding and prompt, for guidance.
        caption_share, empty_share: Probabilities of the caption or no prompt; the rest reads "high quality".
        clean_share: Share of the embeddings at noise level 0; the levels of the others are uniform.
        gain: Lowest gain on the embedding; uniform up to 1, so that a strength below 1 is known in training.
        snr_gamma: Largest weight of an error; see `denoising_losses`.
    """

    condition_dropout: Share
    caption_share: Share
    empty_share: Share
    clean_share: Share
    gain: Share
    snr_gamma: SnrGamma

    @model_validator(mode="after")
    def _prompts_are_at_most_all(self) -> Self:
        if self.caption_share + self.empty_share > 1.0:
            raise InvalidInputError(
                f"`caption_share` is {self.caption_share} and `empty_share` {self.empty_share}; together they may be "
                "at most 1."
            )
        return self


@dataclass(frozen=True)
class Frozen:
    """What an objective uses and does not train; as no module itself, it keeps its modules out of the objective's."""

    text_encoder: nn.Module
    normalizer: StableUnCLIPImageNormalizer


class UnclipObjective(nn.Module):
    """Denoising of latents, conditioned on a noised image embedding and a prompt.

    Args:
        unet: What is trained.
        text_encoder: Frozen; only its hidden states are used.
        processor: Tokenizes the prompts.
        captions: The data set's; some steps use them as prompts.
        normalizer, noising: What embeddings are noised with.
        scheduler: Schedule of the latents.
        settings: What the conditions go through.
    """

    def __init__(
        self,
        unet: UNet2DConditionModel,
        text_encoder: nn.Module,
        processor: UniTouchProcessor,
        captions: list[str],
        normalizer: StableUnCLIPImageNormalizer,
        noising: DDPMScheduler,
        scheduler: DDPMScheduler,
        settings: UnclipSettings,
    ):
        super().__init__()
        self.trained = unet
        self.frozen = Frozen(text_encoder.eval(), normalizer)
        self.processor, self.captions = processor, captions
        self.noising, self.scheduler, self.settings = noising, scheduler, settings

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        latents, embeds = batch["latents"].float(), batch["image_embeds"]
        count, device = len(latents), latents.device
        kept = torch.rand(count, device=device) >= self.settings.condition_dropout
        labels = self._labels(embeds) * kept[:, None]
        hidden = self._prompts(batch["index"].tolist(), kept.tolist(), device)
        conditions = {"encoder_hidden_states": hidden, "class_labels": labels}
        return denoising_losses(self.trained, self.scheduler, latents, self.settings.snr_gamma, **conditions)

    def _labels(self, embeds: Tensor) -> Tensor:
        """Noised embeddings; some at level 0, where a picture's own embedding is used, the others at any level."""
        count, device = len(embeds), embeds.device
        top = self.noising.config.num_train_timesteps
        noised = torch.rand(count, device=device) >= self.settings.clean_share
        level = torch.randint(0, top, (count,), device=device) * noised
        low = self.settings.gain
        gain = low + (1.0 - low) * torch.rand(count, 1, device=device)
        return noise_embeddings(gain * embeds, level, torch.randn_like(embeds), self.frozen.normalizer, self.noising)

    @torch.no_grad()
    def _prompts(self, index: list[int], kept: list[bool], device: torch.device) -> Tensor:
        prompts = []
        draws = torch.rand(len(index)).tolist()
        for row, keep, draw in zip(index, kept, draws, strict=True):
            caption = self.captions[row] if draw < self.settings.caption_share else QUALITY_PROMPT
            prompts.append("" if not keep or draw > 1.0 - self.settings.empty_share else caption)
        unique = list(dict.fromkeys(prompts))
        text_encoder = self.frozen.text_encoder.to(device)  # accelerate moves only what is registered
        hidden = text_encoder(self.processor.text(unique)["input_ids"].to(device)).last_hidden_state
        return hidden[[unique.index(prompt) for prompt in prompts]]


def fit_normalizer(embeds: Tensor) -> StableUnCLIPImageNormalizer:
    """Mean and standard deviation of each dimension of the training embeddings (N, D)."""
    normalizer = StableUnCLIPImageNormalizer(embedding_dim=embeds.shape[1]).requires_grad_(False)
    normalizer.mean.copy_(embeds.mean(dim=0, keepdim=True))
    normalizer.std.copy_(embeds.std(dim=0, keepdim=True).clamp_min(1e-3))
    return normalizer


def watch_samples(objective: UnclipObjective, joint: UniTouchModel, vae: Autoencoder, held: list[Rendered]) -> Watch:
    """A grid of pictures, what the autoencoder makes of them, and what is drawn from their embeddings."""
    pictures = pixels_of(held, "image", GRID_ROWS).float() / 255
    with torch.no_grad():
        latents = encode(vae, 2.0 * pictures - 1.0)
        embeds = joint.get_image_features(normalise_pixels(pictures))
        noise = torch.randn(embeds.shape, generator=torch.Generator().manual_seed(0))
        level = torch.zeros(len(embeds), dtype=torch.int64)
        labels = noise_embeddings(embeds, level, noise, objective.frozen.normalizer, objective.noising)
        prompts = objective.processor.text([QUALITY_PROMPT] * len(embeds))["input_ids"]
        prompts = objective.frozen.text_encoder(prompts).last_hidden_state
    restored = decoded(vae, latents)

    def watch() -> dict[str, Image.Image]:
        hidden, classes = on_device_of(objective.trained, prompts, labels)
        conditions = {"encoder_hidden_states": hidden, "class_labels": classes}
        sampled = denoised(objective.trained, objective.scheduler, latents.shape, **conditions)
        return {"samples": grid(pictures, restored, decoded(vae, sampled))}

    return watch


def main(stage: Stage) -> None:
    settings = stage.section("objective", UnclipSettings)
    processor = stage.processor()
    joint = UniTouchModel.from_pretrained(stage.folders["joint"], modalities=("image", "text"))
    vae = read_autoencoder(stage.folders["vae"]).eval().requires_grad_(False)
    unet = stage.unet()
    scheduler = stage.section("scheduler", DDPMScheduler)
    noising = DDPMScheduler(beta_schedule="squaredcos_cap_v2")

    splits = stage.splits(processor, "image", "text")
    images, key = [split.image for split in splits], stage.key(splits)
    embeds = image_embeddings(joint, images, key, stage.cache)
    latents = cached_latents(vae, images, f"image-latents-{key}", stage.cache)
    normalizer = fit_normalizer(embeds)
    captions = [caption for split in splits for caption in split.text]
    text_encoder = joint.text_model.text_model
    objective = UnclipObjective(unet, text_encoder, processor, captions, normalizer, noising, scheduler, settings)
    dataset = ArrayDataset(latents=latents, image_embeds=embeds, index=torch.arange(len(embeds)))
    watch = stage.watching(partial(watch_samples, objective, joint, vae), processor, "image")
    stage.fit(objective, dataset, watch=watch)
    with stage.saving() as folder:
        unet.save_pretrained(folder / "unet")
        scheduler.save_pretrained(folder / "scheduler")
        normalizer.save_pretrained(folder / "image_normalizer")
        noising.save_pretrained(folder / "image_noising_scheduler")


if __name__ == "__main__":
    run("unclip", main)
