"""Stage 4, the autoencoder of pictures, and the objective that stage 6, of touches, shares.

Recipes take `AutoencoderTiny` (after TAESD, Boer Bohan, 2023), which diffusers' own unCLIP pipelines take as well as an
`AutoencoderKL`, at a fraction of its time, and the paper's `VQModel` (Esser et al., 2021).
"""

import json
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from diffusers import AutoencoderTiny, VQModel
from pydantic import NonNegativeFloat, PositiveInt
from torch import Tensor, nn

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.evaluation.contacts import in_batches
from unitouch_gen.models.autoencoders import (
    Autoencoder,
    autoencoder_class,
    encode,
    encode_raw,
    read_autoencoder,
    scale_factor,
)
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.models.vit import Residual
from unitouch_gen.training.batches import ArrayDataset, Batch
from unitouch_gen.training.data import Contacts
from unitouch_gen.training.recipe import Arguments, Settings, build
from unitouch_gen.training.stages import Recipe, Stage


class AutoencoderLoss(Settings):
    """What is added to the L1 error of the pixels."""

    gradient_weight: NonNegativeFloat  # of the L1 error of differences between neighbouring pixels, for crisp edges
    # Deviation of noise on the latents, relative to theirs, so that the decoder forgives a generator its last errors.
    latent_noise: NonNegativeFloat
    latent_weight: NonNegativeFloat  # of the latents' mean square, which keeps them bounded
    feature_weight: NonNegativeFloat = 0.0  # of `feature_error`, by the touch encoder of the joint space


class AutoencoderAugmentation(Settings):
    # Side of the squares that a network of convolutions learns from; null for whole images. A quarter of the pixels
    # cost a quarter of the time, and twice as many images are worth more than whole ones.
    crop: PositiveInt | None = None


class AutoencoderRecipe(Recipe):
    model: Arguments  # `class`, and that one's arguments
    loss: AutoencoderLoss
    augment: AutoencoderAugmentation = AutoencoderAugmentation()


class AutoencoderObjective(nn.Module):
    """Reconstruction of pixels from noisy latents, and a VQ model's commitment (van den Oord et al., 2017, Eq. 3)."""

    def __init__(self, vae: Autoencoder, weights: AutoencoderLoss, crop: int | None = None, layers: Any = ()):
        super().__init__()
        self.trained = vae
        self.weights = weights
        self.crop = crop
        self.layers = layers

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        pixels = to_signed(batch["pixels"])
        if self.crop is not None:  # a square at one random place for all, no larger than they are
            top, left = (int(torch.randint(max(size - self.crop, 0) + 1, ())) for size in pixels.shape[-2:])
            pixels = pixels[..., top : top + self.crop, left : left + self.crop]
        latents = encode_raw(self.trained, pixels).float()
        size = latents.square().mean()
        noise = self.weights.latent_noise * latents.detach().std() * torch.randn_like(latents)
        decoded = self.trained.decode(latents + noise)
        restored = decoded.sample.float()
        edges = sum(F.l1_loss(restored.diff(dim=dim), pixels.diff(dim=dim)) for dim in (2, 3))
        loss = F.l1_loss(restored, pixels) + self.weights.gradient_weight * edges + self.weights.latent_weight * size
        if isinstance(self.trained, VQModel):
            loss = loss + decoded.commit_loss.mean()
        if self.layers:
            loss = loss + self.weights.feature_weight * feature_error(self.layers, restored, pixels)
        psnr = -10.0 * torch.log10(F.mse_loss(restored.detach(), pixels) / 4.0)  # on [0, 1]
        return {"loss": loss, "psnr": psnr, "latent": size.detach()}


def feature_error(layers: Sequence[nn.Module], images: Tensor, wanted: Tensor) -> Tensor:
    """L1 error of a stem's features of images in [-1, 1], relative to their deviation (after Johnson et al., 2016)."""
    a = normalise_pixels(images / 2 + 0.5)
    b = normalise_pixels(wanted / 2 + 0.5)
    errors = list[Tensor]()
    for layer in layers:
        a = layer.to(a.device)(a)
        b = layer(b)
        if isinstance(layer, Residual) or layer is layers[-1]:
            errors.append(((a - b).abs().mean((0, 2, 3)) / b.std((0, 2, 3)).clamp_min(1e-3)).mean())
    return torch.stack(errors).mean()


def to_signed(pixels: Tensor) -> Tensor:
    """uint8 pixels -> [-1, 1]."""
    return pixels.float() / 127.5 - 1.0


@torch.no_grad()
def latent_scale(vae: Autoencoder, dataset: ArrayDataset) -> float:
    """1 / standard deviation of the latents of 2,048 images (Rombach et al., 2022, appendix G)."""
    order = torch.randperm(len(dataset), generator=torch.Generator().manual_seed(0))[:2048].tolist()
    batches = (dataset[order[start : start + 128]]["pixels"] for start in range(0, len(order), 128))
    return 1.0 / torch.cat([encode_raw(vae, to_signed(pixels).to(vae.device)) for pixels in batches]).std().item()


@torch.no_grad()
def cached_latents(
    stage: Stage, vae: Autoencoder, name: str, splits: list[Contacts], images: Iterable[np.ndarray]
) -> Tensor:
    """Scaled latents of all arrays of images, which are columns of the splits, by the autoencoder to build on."""

    def latents_of(part: Any) -> Tensor:
        return in_batches(len(part), lambda rows: encode(vae, to_signed(torch.from_numpy(np.array(part[rows])))))

    file = f"{name}-latents-scale{vae.config.scaling_factor:.6g}"
    return stage.computed_once(file, "vae", splits, lambda: torch.cat([latents_of(part) for part in images]))


def main(stage: Stage, recipe: AutoencoderRecipe) -> None:
    modality = "touch" if stage.name == "touch_vae" else "image"
    init = stage.folders.get("init")
    crop = recipe.augment.crop
    sizes = {**recipe.model}
    kind = autoencoder_class("model.class", sizes.pop("class", None))
    vae: Any = build("model", kind, sizes) if init is None else read_autoencoder(init).requires_grad_(True)
    if crop is not None and crop % scale_factor(vae):
        raise InvalidInputError(f"`augment.crop` is {crop}; take a multiple of {scale_factor(vae)}, a latent's side.")
    layers: list[nn.Module] = []
    if recipe.loss.feature_weight:
        if "joint" not in stage.folders:
            raise InvalidInputError("`loss.feature_weight` is of a touch encoder's features; only touch_vae takes it.")
        stem = stage.joint_space("touch").touch_model.stem.requires_grad_(False)
        layers = [*stem.children()] or [stem]
    splits = stage.splits(modality)
    seconds = [split.second for split in splits if modality == "touch" and split.second is not None]
    dataset = ArrayDataset(pixels=[*(getattr(split, modality) for split in splits), *seconds])
    stage.fit(AutoencoderObjective(vae, recipe.loss, crop, layers), dataset)
    vae.register_to_config(scaling_factor=latent_scale(vae, dataset))
    with stage.saving() as folder:
        vae.save_pretrained(folder)
        if isinstance(vae, AutoencoderTiny):  # which writes a setting that diffusers warns of when it reads it
            settings = json.loads((folder / "config.json").read_text())
            del settings["block_out_channels"]
            (folder / "config.json").write_text(json.dumps(settings, indent=2) + "\n")
