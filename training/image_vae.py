"""Stage 4, the autoencoder of pictures, and the objective that stage 7, of touches, shares.

    python -m unitouch_gen.training.image_vae --output runs/image_vae

Any of diffusers' autoencoders will do: `AutoencoderKL` (Rombach et al., 2022), which diffusers' own unCLIP pipelines
take; `AutoencoderTiny` (after TAESD, Boer Bohan, 2023), which they take as well, at a fraction of its time;
`AutoencoderDC` (Chen et al., 2025), which works below full resolution from its first layer on; or `VQModel` (Esser et
al., 2021), the paper's.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from diffusers import AutoencoderKL, AutoencoderTiny, VQModel
from diffusers.models.autoencoders.vae import AutoencoderTinyBlock
from diffusers.models.resnet import ResnetBlock2D
from PIL import Image
from pydantic import NonNegativeFloat, PositiveInt
from torch import Tensor, nn

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.files import drop_setting, read_json
from unitouch_gen.models.autoencoders import (
    Autoencoder,
    autoencoder_class,
    encode,
    encode_raw,
    scale_factor,
)
from unitouch_gen.training.batches import ArrayDataset, Batch
from unitouch_gen.training.data import Rendered, computed_once, weights_hash
from unitouch_gen.training.data.cache import Computed
from unitouch_gen.training.recipe import Settings, read_section, section_of
from unitouch_gen.training.stages import Stage, run
from unitouch_gen.training.watching import GRID_ROWS, Watch, grid, on_device_of, pixels_of

FIRST_LOG_VARIANCE = -6.0
"""Of the latents of a KL model that nothing has been learnt by."""


class AutoencoderLoss(Settings):
    """What is added to the L1 error of the pixels.

    Attributes:
        gradient_weight: Weight of the L1 error of the differences between neighbouring pixels, for crisp edges.
        latent_noise: Standard deviation of noise on the latents, relative to theirs, so that the decoder forgives a
            generator its last errors.
        latent_weight: Weight of what keeps the latents bounded: their mean square, or of a KL model their divergence
            from unit normal ones (Kingma & Welling, 2014, appendix B), for each number of a latent.
    """

    gradient_weight: NonNegativeFloat
    latent_noise: NonNegativeFloat
    latent_weight: NonNegativeFloat


class AutoencoderAugmentation(Settings):
    """What a network of convolutions needs to see.

    Attributes:
        crop: Side of the squares, at random places, that it learns from; null for whole images. A quarter of the pixels
            cost a quarter of the time, and twice as many images are worth more than whole ones.
    """

    crop: PositiveInt | None = None


class AutoencoderObjective(nn.Module):
    """Reconstruction of pixels from noisy latents.

    Args:
        vae: What is trained. A KL model's latents are sampled; a VQ model's commitment loss (van den Oord et al., 2017,
            Eq. 3) is added.
        weights: The parts of its loss.
        crop: Side of the squares that it learns from, a multiple of what one latent stands for; whole images if `None`.
    """

    def __init__(self, vae: Autoencoder, weights: AutoencoderLoss, crop: int | None = None):
        super().__init__()
        self.trained, self.weights, self.crop = vae, weights, crop

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        pixels = to_signed(batch["pixels"] if self.crop is None else random_square(batch["pixels"], self.crop))
        if isinstance(self.trained, AutoencoderKL):
            distribution = self.trained.encode(pixels).latent_dist
            latents = distribution.sample().float()
            size = distribution.kl().mean() / latents[0].numel()
        else:
            latents = encode_raw(self.trained, pixels).float()
            size = latents.square().mean()
        noise = self.weights.latent_noise * latents.detach().std() * torch.randn_like(latents)
        decoded = self.trained.decode(latents + noise)
        restored = decoded.sample.float()
        error = F.l1_loss(restored, pixels)
        edges = sum(F.l1_loss(restored.diff(dim=dim), pixels.diff(dim=dim)) for dim in (2, 3))
        loss = error + self.weights.gradient_weight * edges + self.weights.latent_weight * size
        if isinstance(self.trained, VQModel):
            loss = loss + decoded.commit_loss.mean()
        psnr = -10.0 * torch.log10(F.mse_loss(restored.detach(), pixels) / 4.0)  # on [0, 1]
        return {"loss": loss, "psnr": psnr, "latent": size.detach()}


def random_square(images: Tensor, side: int) -> Tensor:
    """A square of images (B, C, H, W), at one random place for all, (B, C, side, side); no larger than they are."""
    top, left = (int(torch.randint(max(size - side, 0) + 1, ())) for size in images.shape[-2:])
    return images[..., top : top + side, left : left + side]


def to_signed(pixels: Tensor) -> Tensor:
    """uint8 pixels -> [-1, 1]."""
    return pixels.float() / 127.5 - 1.0


@torch.no_grad()
def latent_scale(vae: Autoencoder, dataset: ArrayDataset) -> float:
    """1 / standard deviation of the latents (Rombach et al., 2022, appendix G)."""
    order = torch.randperm(len(dataset), generator=torch.Generator().manual_seed(0))[:SCALED_BY].tolist()
    batches = (dataset[order[start : start + 128]]["pixels"] for start in range(0, len(order), 128))
    return 1.0 / torch.cat([encode_raw(vae, to_signed(pixels).to(vae.device)) for pixels in batches]).std().item()


@torch.no_grad()
def cached_latents(
    vae: Autoencoder, images: Sequence[np.ndarray | Computed], key: str, cache: Path, batch_size: int = 128
) -> Tensor:
    """Scaled latents (N, C, h, w) of uint8 pixels (n, 3, H, W), computed once for each state of the autoencoder.

    The file in `cache` is named by `key`, for the pixels, and by the autoencoder's weights and scale.
    """
    file = Path(cache) / f"{key}-scale{vae.config.scaling_factor:.6g}-{weights_hash(vae)}.safetensors"
    return computed_once(file, lambda pixels: encode(vae, to_signed(pixels)).cpu(), images, batch_size)


def make_autoencoder(section: dict[str, Any]) -> Autoencoder:
    """The autoencoder a recipe's `model` section describes: its `class`, and that one's configuration.

    Raises:
        InvalidInputError: If it is none of the classes, or its configuration is none; see `read_section`.
    """
    kind = autoencoder_class("model.class", section.get("class"))
    model = {key: value for key, value in section.items() if key != "class"}
    vae = read_section({"model": model}, "model", kind)
    if isinstance(vae, AutoencoderKL):
        _initialise(vae)
    if isinstance(vae, AutoencoderTiny):
        _begin_as_thumbnail(vae)
    return vae


@torch.no_grad()
def _initialise(vae: AutoencoderKL) -> None:
    """Convolutions that keep the size of what passes (He et al., 2015), and residual branches that begin at zero.

    As torch and diffusers begin, biases drown pictures within ten layers. Latents begin with little noise, or it would
    drown them.
    """
    for module in vae.modules():
        if isinstance(module, nn.Conv2d):
            nn.init.kaiming_normal_(module.weight, nonlinearity="linear")
            if module.bias is not None:
                nn.init.zeros_(module.bias)
    for module in vae.modules():
        if isinstance(module, ResnetBlock2D):
            nn.init.zeros_(module.conv2.weight)
    if vae.quant_conv is not None:
        count = vae.config.latent_channels
        vae.quant_conv.weight[count:] *= 0.1
        vae.quant_conv.bias[count:] = FIRST_LOG_VARIANCE


SCALED_BY = 2048
"""Images by whose latents the scale is taken."""

LATENT_CONTRAST = 4.0
"""Of a thumbnail's values as latents: near the unit deviation that an `AutoencoderTiny` is made for."""


@torch.no_grad()
def _begin_as_thumbnail(vae: AutoencoderTiny) -> None:
    """Has the first three channels carry a picture's colours, blurred and halved level by level, and back.

    From random weights colours take thousands of steps, as most of what there is to learn is in the lightness.
    """
    for block in (block for block in vae.modules() if isinstance(block, AutoencoderTinyBlock)):
        nn.init.zeros_(block.conv[-1].weight)
        nn.init.zeros_(block.conv[-1].bias)
    binomial = torch.tensor([1.0, 2.0, 1.0])
    blur, same = binomial[:, None] * binomial / 16.0, torch.tensor([[0.0, 0, 0], [0, 1, 0], [0, 0, 0]])
    for layers, gain, offset in ((vae.encoder.layers, LATENT_CONTRAST, -0.5), (vae.decoder.layers, 1.0, 0.0)):
        first, *between, last = (layer for layer in layers if isinstance(layer, nn.Conv2d))
        _carry(first, same, *((1.0, 0.0) if layers is vae.encoder.layers else (1.0 / LATENT_CONTRAST, 0.5)))
        for convolution in between:
            _carry(convolution, blur, 1.0, 0.0)
        _carry(last, same, gain, gain * offset)


def _carry(convolution: nn.Conv2d, kernel: Tensor, gain: float, offset: float) -> None:
    """Has the first three channels out be those that come in, under a kernel (3, 3)."""
    convolution.weight[:3] = 0.0
    for channel in range(3):
        convolution.weight[channel, channel] = gain * kernel
    if convolution.bias is not None:
        convolution.bias[:3] = offset


def save_autoencoder(vae: Autoencoder, folder: Path) -> None:
    """Writes an autoencoder as diffusers does, without what it warns of when it reads it."""
    vae.save_pretrained(folder)
    if isinstance(vae, AutoencoderTiny):
        drop_setting(folder / "config.json", "block_out_channels")


def read_autoencoder(folder: Path) -> Autoencoder:
    """The autoencoder that a stage left in a folder.

    Raises:
        InvalidInputError: If the folder holds none.
    """
    file = folder / "config.json"
    if not file.is_file():
        raise InvalidInputError(f"`vae` is {str(folder)!r}, which holds no config.json; pass an autoencoder's folder.")
    kind = autoencoder_class("vae", read_json("vae", file).get("_class_name"))
    return kind.from_pretrained(folder, use_safetensors=True)


def watch_reconstructions(vae: Autoencoder, modality: str, held: list[Rendered]) -> Watch:
    """A grid of images, as they are and as they come out."""
    pixels = to_signed(pixels_of(held, modality, GRID_ROWS))

    def watch() -> dict[str, Image.Image]:
        (given,) = on_device_of(vae, pixels)
        return {
            "reconstructions": grid(
                *((each + 1.0) / 2.0 for each in (given, vae.decode(encode_raw(vae, given)).sample))
            )
        }

    return watch


def main(stage: Stage, modality: str = "image") -> None:
    vae = make_autoencoder(section_of(stage.recipe, "model"))
    crop = stage.settings("augment", AutoencoderAugmentation).crop
    if crop is not None and crop % scale_factor(vae):
        raise InvalidInputError(
            f"`augment.crop` is {crop}; it has to be a multiple of {scale_factor(vae)}, a latent's side."
        )
    objective = AutoencoderObjective(vae, stage.section("loss", AutoencoderLoss), crop)
    processor = stage.processor()
    splits = stage.splits(processor, modality)
    seconds = [split.second for split in splits if modality == "touch" and split.second is not None]
    dataset = ArrayDataset(pixels=[*(getattr(split, modality) for split in splits), *seconds])
    watch = stage.watching(partial(watch_reconstructions, vae, modality), processor, modality)
    stage.fit(objective, dataset, watch=watch)
    vae.register_to_config(scaling_factor=latent_scale(vae, dataset))
    with stage.saving() as folder:
        save_autoencoder(vae, folder)


if __name__ == "__main__":
    run("image_vae", main)
