"""Pictures from image embeddings by unCLIP (Ramesh et al., 2022; Rombach et al., 2022).

The model is trained on image embeddings alone. Embeddings of other modalities, bound to images, can take their place.
"""

from typing import Any, Self

import torch
from diffusers import DDPMScheduler, UNet2DConditionModel
from diffusers.pipelines.stable_diffusion.stable_unclip_image_normalizer import StableUnCLIPImageNormalizer
from pydantic import model_validator
from torch import Tensor, nn

from unitouch_gen.conditioning import QUALITY_PROMPT, noise_embeddings
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.models import UniTouchModel, UniTouchProcessor
from unitouch_gen.models.autoencoders import Autoencoder, read_autoencoder
from unitouch_gen.training.batches import ArrayDataset, Batch
from unitouch_gen.training.image_vae import cached_latents
from unitouch_gen.training.losses import StepPower, denoising_loss
from unitouch_gen.training.recipe import Arguments, Settings, Share, build
from unitouch_gen.training.stages import Recipe, Stage


class UnclipSettings(Settings):
    """Dropout, prompts and noise of the conditions."""

    condition_dropout: Share  # probability of training a sample without embedding and prompt, for guidance
    caption_share: Share  # probability of the caption as the prompt
    empty_share: Share  # probability of an empty prompt; the remaining prompts are "high quality"
    clean_share: Share  # share of embeddings at noise level 0; the levels of the others are uniform
    gain: Share  # lowest scale of the embedding, uniform up to 1, so that a `strength` below 1 is seen in training
    step_power: StepPower

    @model_validator(mode="after")
    def _check_shares(self) -> Self:
        if self.caption_share + self.empty_share > 1.0:
            raise InvalidInputError("`caption_share` and `empty_share` are more than 1 together; lower one.")
        return self


class UnclipRecipe(Recipe):
    model: Arguments
    scheduler: Arguments
    objective: UnclipSettings


class UnclipObjective(nn.Module):
    """Denoising of latents, conditioned on a prompt and on an image embedding noised by `normalizer` and `noising`.

    `captions` are those of all samples; the frozen text encoder gives the hidden states of prompts. `level` is the
    noise level of embeddings; if it is left out, each sample draws one.
    """

    def __init__(
        self,
        unet: UNet2DConditionModel,
        scheduler: DDPMScheduler,
        settings: UnclipSettings,
        normalizer: StableUnCLIPImageNormalizer,
        noising: DDPMScheduler,
        captions: list[str],
        processor: UniTouchProcessor,
        text_encoder: nn.Module,
        level: int | None = None,
    ):
        super().__init__()
        self.trained = unet
        self.scheduler = scheduler
        self.settings = settings
        self.level = level
        self.frozen = (normalizer, text_encoder.eval())  # a tuple hides them from `modules()`
        self.noising = noising
        self.captions = captions
        self.processor = processor

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        latents = batch["latents"].float()
        settings = self.settings
        kept = torch.rand(len(latents), device=latents.device) >= settings.condition_dropout
        conditions = self.conditions(batch, kept)
        return {"loss": denoising_loss(self.trained, self.scheduler, latents, settings.step_power, **conditions)}

    def conditions(self, batch: Batch, kept: Tensor) -> dict[str, Tensor]:
        """The network's conditions for each sample; unconditional where `kept` (B,) is false."""
        embeds = batch["image_embeds"]
        count = len(embeds)
        device = embeds.device
        level = self._noise_levels(count, device)
        lowest = self.settings.gain
        gain = lowest + (1.0 - lowest) * torch.rand(count, 1, device=device)
        noise = torch.randn_like(embeds)
        labels = noise_embeddings(gain * embeds, level, noise, self.frozen[0], self.noising)  # (B, 2 D)
        prompts = self._draw_prompts(batch["index"].tolist(), kept.tolist())
        hidden_states = self._encode_prompts(prompts, device)
        return {"encoder_hidden_states": hidden_states, "class_labels": labels * kept[:, None]}

    def _noise_levels(self, count: int, device: torch.device) -> Tensor:
        """Noise levels (B,) of embeddings: `level`; else 0, as for a picture's own embedding, or any level."""
        if self.level is not None:
            return torch.full((count,), self.level, device=device)
        is_noisy = torch.rand(count, device=device) >= self.settings.clean_share
        return torch.randint(0, self.noising.config.num_train_timesteps, (count,), device=device) * is_noisy

    def _draw_prompts(self, index: list[int], kept: list[bool]) -> list[str]:
        """A caption, "high quality" or nothing for each sample."""
        prompts = list[str]()
        for row, keep, draw in zip(index, kept, torch.rand(len(index)).tolist(), strict=True):
            if not keep or draw > 1.0 - self.settings.empty_share:
                prompts.append("")
            elif draw < self.settings.caption_share:
                prompts.append(self.captions[row])
            else:
                prompts.append(QUALITY_PROMPT)
        return prompts

    @torch.no_grad()
    def _encode_prompts(self, prompts: list[str], device: torch.device) -> Tensor:
        """Hidden states (B, L, width) of prompts."""
        unique = list(dict.fromkeys(prompts))
        text_encoder = self.frozen[1].to(device)  # accelerate moves only modules of the objective
        input_ids = self.processor.text(unique)["input_ids"].to(device)
        hidden = text_encoder(input_ids).last_hidden_state
        return hidden[[unique.index(prompt) for prompt in prompts]]


def fit_normalizer(embeds: Tensor) -> StableUnCLIPImageNormalizer:
    """Mean and standard deviation of each dimension of the training embeddings (N, D)."""
    normalizer = StableUnCLIPImageNormalizer(embedding_dim=embeds.shape[1]).requires_grad_(False)
    normalizer.mean.copy_(embeds.mean(dim=0, keepdim=True))
    normalizer.std.copy_(embeds.std(dim=0, keepdim=True).clamp_min(1e-3))
    return normalizer


def inputs(stage: Stage, joint: UniTouchModel, vae: Autoencoder) -> tuple[ArrayDataset, list[str]]:
    """Columns of the pictures' latents, embeddings and indices, and the caption of each picture."""
    splits = stage.splits("image", "text")
    embeds = stage.image_embeddings(joint, splits)
    captions = [caption for split in splits for caption in split.text]
    latents = cached_latents(stage, vae, "image", splits, [split.image for split in splits])
    return ArrayDataset(latents=latents, image_embeds=embeds, index=torch.arange(len(embeds))), captions


def main(stage: Stage, recipe: UnclipRecipe) -> None:
    joint = stage.joint_space("image", "text")
    unet = stage.unet(recipe.model)
    scheduler = build("scheduler", DDPMScheduler, recipe.scheduler)
    dataset, captions = inputs(stage, joint, read_autoencoder(stage.folders["vae"]))
    embeds: Any = dataset.columns["image_embeds"]
    normalizer = fit_normalizer(embeds)
    noising = DDPMScheduler(beta_schedule="squaredcos_cap_v2")
    objective = UnclipObjective(
        unet,
        scheduler,
        settings=recipe.objective,
        normalizer=normalizer,
        noising=noising,
        captions=captions,
        processor=stage.processor,
        text_encoder=joint.text_model.text_model,
    )
    stage.fit(objective, dataset)
    with stage.saving() as folder:
        unet.save_pretrained(folder / "unet")
        scheduler.save_pretrained(folder / "scheduler")
        normalizer.save_pretrained(folder / "image_normalizer")
        noising.save_pretrained(folder / "image_noising_scheduler")
