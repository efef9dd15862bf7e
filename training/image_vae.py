"""The autoencoder of pictures (stage `image_vae`) and of touches (stage `touch_vae`).

Recipes take two classes. `AutoencoderTiny` (after TAESD, Boer Bohan, 2023) fits diffusers' own unCLIP pipelines in the
place of an `AutoencoderKL`, at a fraction of its time. `VQModel` (Esser et al., 2021) is the paper's.
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
from unitouch_gen.models.autoencoders import (
    Autoencoder,
    autoencoder_class,
    encode,
    encode_raw,
    read_autoencoder,
    scale_factor,
)
from unitouch_gen.models.features import in_batches
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.models.vit import Residual
from unitouch_gen.training.batches import ArrayDataset, Batch
from unitouch_gen.training.data import Contacts
from unitouch_gen.training.recipe import Arguments, Settings, build
from unitouch_gen.training.stages import Recipe, Stage


class AutoencoderLoss(Settings):
    """Losses that are added to the L1 error of the pixels."""

    gradient_weight: NonNegativeFloat  # of the L1 error of differences between neighbouring pixels, for crisp edges
    # Deviation of noise on the latents, relative to theirs. The decoder learns to ignore a generator's last errors.
    latent_noise: NonNegativeFloat
    latent_weight: NonNegativeFloat  # of the latents' mean square, which keeps them bounded
    feature_weight: NonNegativeFloat = 0.0  # of `feature_error`, by the touch encoder of the joint space


class AutoencoderAugmentation(Settings):
    # Side of the square crops that are trained on; null for whole images. A quarter of the pixels take a quarter of the
    # time, and twice as many crops teach more than whole images.
    crop: PositiveInt | None = None


class AutoencoderRecipe(Recipe):
    model: Arguments  # `class`, and the arguments of that class
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
        if self.crop is not None:
            pixels = random_crop(pixels, self.crop)
        latents = encode_raw(self.trained, pixels).float()
        latent_size = latents.square().mean()
        noise = self.weights.latent_noise * latents.detach().std() * torch.randn_like(latents)
        decoded = self.trained.decode(latents + noise)
        restored = decoded.sample.float()
        edges = sum(F.l1_loss(restored.diff(dim=dim), pixels.diff(dim=dim)) for dim in (2, 3))
        loss = F.l1_loss(restored, pixels)
        loss = loss + self.weights.gradient_weight * edges
        loss = loss + self.weights.latent_weight * latent_size
        if isinstance(self.trained, VQModel):
            loss = loss + decoded.commit_loss.mean()
        if self.layers:
            loss = loss + self.weights.feature_weight * feature_error(self.layers, restored, pixels)
        psnr = -10.0 * torch.log10(F.mse_loss(restored.detach(), pixels) / 4.0)  # of pixels in [0, 1]
        return {"loss": loss, "psnr": psnr, "latent": latent_size.detach()}


def random_crop(pixels: Tensor, side: int) -> Tensor:
    """A square of each image (B, 3, H, W), at the same random place, no larger than the images."""
    height, width = pixels.shape[-2:]
    top = int(torch.randint(max(height - side, 0) + 1, ()))
    left = int(torch.randint(max(width - side, 0) + 1, ()))
    return pixels[..., top : top + side, left : left + side]


def feature_error(layers: Sequence[nn.Module], images: Tensor, targets: Tensor) -> Tensor:
    """L1 error of a stem's features of images in [-1, 1], relative to their deviation (after Johnson et al., 2016)."""
    features = normalise_pixels(images / 2 + 0.5)
    target_features = normalise_pixels(targets / 2 + 0.5)
    errors = list[Tensor]()
    for layer in layers:
        features = layer.to(features.device)(features)
        target_features = layer(target_features)
        if isinstance(layer, Residual) or layer is layers[-1]:
            error = (features - target_features).abs().mean((0, 2, 3))
            deviation = target_features.std((0, 2, 3)).clamp_min(1e-3)
            errors.append((error / deviation).mean())
    return torch.stack(errors).mean()


def to_signed(pixels: Tensor) -> Tensor:
    """uint8 pixels -> [-1, 1]."""
    return pixels.float() / 127.5 - 1.0


@torch.no_grad()
def latent_scale(vae: Autoencoder, dataset: ArrayDataset) -> float:
    """1 / standard deviation of the latents of 2,048 images (Rombach et al., 2022, appendix G)."""
    order = torch.randperm(len(dataset), generator=torch.Generator().manual_seed(0))[:2048].tolist()
    latents = list[Tensor]()
    for start in range(0, len(order), 128):
        pixels = dataset[order[start : start + 128]]["pixels"]
        latents.append(encode_raw(vae, to_signed(pixels).to(vae.device)))
    return 1.0 / torch.cat(latents).std().item()


@torch.no_grad()
def cached_latents(
    stage: Stage, vae: Autoencoder, name: str, splits: list[Contacts], images: Iterable[np.ndarray]
) -> Tensor:
    """Scaled latents of `images`, columns of the splits, by the autoencoder of option `--vae`."""

    def encode_column(pixels: Any) -> Tensor:
        def encode_rows(rows: Any) -> Tensor:
            return encode(vae, to_signed(torch.from_numpy(np.array(pixels[rows]))))

        return in_batches(len(pixels), encode_rows)

    def encode_all() -> Tensor:
        return torch.cat([encode_column(pixels) for pixels in images])

    return stage.computed_once(f"{name}-latents-scale{vae.config.scaling_factor:.6g}", "vae", splits, encode_all)


def main(stage: Stage, recipe: AutoencoderRecipe) -> None:
    modality = "touch" if stage.name == "touch_vae" else "image"
    init = stage.folders.get("init")
    crop = recipe.augment.crop
    arguments = {**recipe.model}
    vae_class = autoencoder_class("model.class", arguments.pop("class", None))
    vae: Any = read_autoencoder(init).requires_grad_(True) if init else build("model", vae_class, arguments)
    if crop is not None and crop % scale_factor(vae):
        raise InvalidInputError(f"`augment.crop` is {crop}; take a multiple of {scale_factor(vae)}, a latent's side.")
    layers: list[nn.Module] = []
    if recipe.loss.feature_weight:
        if "joint" not in stage.folders:
            raise InvalidInputError("`loss.feature_weight` is of a touch encoder's features; only touch_vae takes it.")
        stem = stage.joint_space("touch").touch_model.stem.requires_grad_(False)
        layers = [*stem.children()] or [stem]
    splits = stage.splits(modality)
    images = [getattr(split, modality) for split in splits]
    if modality == "touch":
        images += [split.second for split in splits if split.second is not None]
    dataset = ArrayDataset(pixels=images)
    stage.fit(AutoencoderObjective(vae, recipe.loss, crop, layers), dataset)
    vae.register_to_config(scaling_factor=latent_scale(vae, dataset))
    with stage.saving() as folder:
        vae.save_pretrained(folder)
        if isinstance(vae, AutoencoderTiny):  # diffusers writes a setting here that it warns of when reading
            settings = json.loads((folder / "config.json").read_text())
            del settings["block_out_channels"]
            (folder / "config.json").write_text(json.dumps(settings, indent=2) + "\n")
