"""The autoencoder of pictures (stage `image_vae`) and of touches (stage `touch_vae`).

The recipe's `model.class` is one of two. `AutoencoderTiny` (after TAESD, Boer Bohan, 2023) fits diffusers' own unCLIP
pipelines in the place of an `AutoencoderKL`, at a fraction of its time. `VQModel` (Esser et al., 2021) is the paper's.
"""

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
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
from unitouch_gen.models.texture import TextureTrunk
from unitouch_gen.models.vit import Residual
from unitouch_gen.training.batches import ArrayDataset, Batch
from unitouch_gen.training.data import Contacts
from unitouch_gen.training.recipe import Arguments, Settings, build
from unitouch_gen.training.stages import Recipe, Stage
from unitouch_gen.training.texture import read_trunk
from unitouch_gen.weights import JOINT

TRUNK_BLOCKS = (0, 2, 4)
"""Blocks of the texture trunk that pictures are compared by: strides of 2, 4 and 8 pixels."""


class AutoencoderLoss(Settings):
    """Losses that are added to the L1 error of the pixels."""

    gradient_weight: NonNegativeFloat  # of the L1 error of differences between neighbouring pixels, for crisp edges
    # Deviation of noise on the latents, relative to theirs. The decoder learns to ignore a generator's last errors.
    latent_noise: NonNegativeFloat
    latent_weight: NonNegativeFloat  # of the latents' mean square, which keeps them bounded
    # Weight of `feature_error`. The features of touches are of the stem of the joint space's touch encoder, those of
    # pictures of its texture trunk.
    feature_weight: NonNegativeFloat = 0.0
    # Weight of `contrast_error`, by the same features. Latents cannot hold fine grain. The error of pixels is least for
    # a picture with the grain averaged away, this one for a picture with as much grain as the original.
    contrast_weight: NonNegativeFloat = 0.0
    trunk: str | None = None  # folder of a joint space to take the texture trunk from; the built-in one if left out

    @property
    def takes_features(self) -> bool:
        return bool(self.feature_weight or self.contrast_weight)


class AutoencoderAugmentation(Settings):
    # Side of the square crops that are trained on; null for whole images. A quarter of the pixels take a quarter of the
    # time, and twice as many crops teach more than whole images.
    crop: PositiveInt | None = None


class AutoencoderRecipe(Recipe):
    model: Arguments  # `class`, and the arguments of that class
    loss: AutoencoderLoss
    augment: AutoencoderAugmentation = AutoencoderAugmentation()


class StemFeatures(nn.Module):
    """Features of a touch encoder's stem: images in [0, 1] -> outputs of its residual layers and of its last one."""

    def __init__(self, layers: Sequence[nn.Module]):
        super().__init__()
        self.layers = nn.ModuleList(layers).requires_grad_(False)

    def forward(self, images: Tensor) -> list[Tensor]:
        x = normalise_pixels(images)
        outputs = list[Tensor]()
        for layer in self.layers:
            x = layer(x)
            if isinstance(layer, Residual) or layer is self.layers[-1]:
                outputs.append(x)
        return outputs


class TrunkFeatures(nn.Module):
    """Features of the texture trunk: images in [0, 1] -> outputs of the blocks `TRUNK_BLOCKS`."""

    def __init__(self, trunk: TextureTrunk):
        super().__init__()
        self.trunk = trunk

    def forward(self, images: Tensor) -> list[Tensor]:
        return self.trunk.layers(images, TRUNK_BLOCKS)


class AutoencoderObjective(nn.Module):
    """Reconstruction of pixels from noisy latents, and a VQ model's commitment (van den Oord et al., 2017, Eq. 3).

    `features` maps images in [0, 1] to a list of features (B, C, h, w), which the losses of features need.
    """

    def __init__(
        self,
        vae: Autoencoder,
        weights: AutoencoderLoss,
        crop: int | None = None,
        features: nn.Module | None = None,
    ):
        super().__init__()
        self.trained = vae
        self.weights = weights
        self.crop = crop
        self.features = features

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        pixels = to_signed(batch["pixels"])
        if self.crop is not None:
            pixels = random_crop(pixels, self.crop)
        if pixels.device.type == "cpu":
            pixels = pixels.to(memory_format=torch.channels_last)  # takes three quarters of the time
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
        parts = self.feature_losses(restored, pixels) if self.features is not None else {}
        for name, part in parts.items():
            loss = loss + getattr(self.weights, f"{name}_weight") * part
        psnr = -10.0 * torch.log10(F.mse_loss(restored.detach(), pixels) / 4.0)  # of pixels in [0, 1]
        logged = {name: part.detach() for name, part in parts.items()}
        return {"loss": loss, "psnr": psnr, "latent": latent_size.detach(), **logged}

    def feature_losses(self, restored: Tensor, pixels: Tensor) -> dict[str, Tensor]:
        """The losses of features of images in [-1, 1], by the names of their weights."""
        features: Any = self.features
        made = features(restored / 2 + 0.5)
        with torch.no_grad():
            real = features(pixels / 2 + 0.5)
        losses = dict[str, Tensor]()
        if self.weights.feature_weight:
            losses["feature"] = feature_error(made, real)
        if self.weights.contrast_weight:
            losses["contrast"] = contrast_error(made, real)
        return losses


def random_crop(pixels: Tensor, side: int) -> Tensor:
    """A square of each image (B, 3, H, W), at the same random place, no larger than the images."""
    height, width = pixels.shape[-2:]
    top = int(torch.randint(max(height - side, 0) + 1, ()))
    left = int(torch.randint(max(width - side, 0) + 1, ()))
    return pixels[..., top : top + side, left : left + side]


def feature_error(made: Sequence[Tensor], real: Sequence[Tensor]) -> Tensor:
    """L1 error of features (B, C, h, w), relative to their deviation by channel (after Johnson et al., 2016)."""
    errors = list[Tensor]()
    for one, other in zip(made, real, strict=True):
        error = (one - other).abs().mean((0, 2, 3))
        errors.append((error / deviations(other)).mean())
    return torch.stack(errors).mean()


def contrast_error(made: Sequence[Tensor], real: Sequence[Tensor], cells: int = 2) -> Tensor:
    """L1 error of the deviation of features (B, C, h, w) within `cells` x `cells` parts of an image, relative as above.

    It does not see where in a part a texture lies (as Gatys et al., 2015, who take all covariances).
    """
    errors = list[Tensor]()
    for one, other in zip(made, real, strict=True):
        error = (local_deviation(one, cells) - local_deviation(other, cells)).abs().mean((0, 2, 3))
        errors.append((error / deviations(other)).mean())
    return torch.stack(errors).mean()


def local_deviation(features: Tensor, cells: int) -> Tensor:
    """Standard deviation of features (B, C, h, w) within each of `cells` x `cells` parts, (B, C, cells, cells)."""
    mean = F.adaptive_avg_pool2d(features, cells)
    square = F.adaptive_avg_pool2d(features.square(), cells)
    return (square - mean.square()).clamp_min(1e-4).sqrt()


def deviations(features: Tensor) -> Tensor:
    """Standard deviation of each channel of features (B, C, h, w)."""
    return features.std((0, 2, 3)).clamp_min(1e-3)


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


def features_of(stage: Stage, loss: AutoencoderLoss) -> nn.Module:
    """The frozen network that images are compared by: the stem of `--joint`'s touch encoder, or the texture trunk."""
    if stage.name == "touch_vae":
        stem = stage.joint_space("touch").touch_model.stem
        return StemFeatures([*stem.children()] or [stem])
    folder = JOINT if loss.trunk is None else Path(loss.trunk)
    trunk = read_trunk(folder)
    if trunk is None:
        raise InvalidInputError(f"`loss.trunk` is {str(folder)!r}, which holds no trunk of texture.")
    return TrunkFeatures(trunk)


def main(stage: Stage, recipe: AutoencoderRecipe) -> None:
    modality = "touch" if stage.name == "touch_vae" else "image"
    init = stage.folders.get("init")
    crop = recipe.augment.crop
    arguments = {**recipe.model}
    vae_class = autoencoder_class("model.class", arguments.pop("class", None))
    vae: Any = read_autoencoder(init).requires_grad_(True) if init else build("model", vae_class, arguments)
    if crop is not None and crop % scale_factor(vae):
        raise InvalidInputError(f"`augment.crop` is {crop}; take a multiple of {scale_factor(vae)}, a latent's side.")
    features = features_of(stage, recipe.loss) if recipe.loss.takes_features else None
    splits = stage.splits(modality)
    images = [getattr(split, modality) for split in splits]
    if modality == "touch":
        images += [split.second for split in splits if split.second is not None]
    dataset = ArrayDataset(pixels=images)
    stage.fit(AutoencoderObjective(vae, recipe.loss, crop, features), dataset)
    vae.register_to_config(scaling_factor=latent_scale(vae, dataset))
    with stage.saving() as folder:
        vae.save_pretrained(folder)
        if isinstance(vae, AutoencoderTiny):  # diffusers writes a setting here that it warns of when reading
            settings = json.loads((folder / "config.json").read_text())
            del settings["block_out_channels"]
            (folder / "config.json").write_text(json.dumps(settings, indent=2) + "\n")
