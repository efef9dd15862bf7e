"""Networks fitted to pairs of touches and pictures: what Table 5 of the paper holds generators to that saw no pair.

`pix2pix` is a U-Net against a discriminator of patches (Isola et al., 2017), and `visgel` an encoder and a decoder of
residual blocks against one by least squares (Li et al., 2019), without the reference pictures of theirs, as a contact
here has none. Both are small and see small images, as they are trained anew for a table.
"""

import hashlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from diffusers import UNet2DModel
from diffusers.models.autoencoders.vae import Decoder, Encoder
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torch.func import functional_call

from unitouch_gen.errors import INTERRUPTED
from unitouch_gen.files import replacing
from unitouch_gen.training.batches import ArrayDataset, Batch, ShuffledSampler
from unitouch_gen.training.trainer import Trainer, TrainerConfig, checkpoints_in

SIDE = 64
"""Pixels that the networks see and make, which a picture is scaled to and from."""

BATCH_SIZE = 16

WEIGHTS = "paired.safetensors"


class PairObjective(nn.Module):
    """L1 to the true picture, and a discriminator that is shown the touch beside it, both trained in one step.

    Batches hold "touch" and "image", uint8 (B, 3, S, S).

    Args:
        generator: (B, 3, s, s) in [-1, 1] to the same, s being `SIDE`.
        criterion: A function of what the discriminator says of patches, and what it should.
        weight: Of the L1.
    """

    def __init__(self, generator: nn.Module, criterion: Any, weight: float):
        super().__init__()
        self.generator, self.criterion, self.weight = generator, criterion, weight
        self.discriminator = nn.Sequential(
            nn.Conv2d(6, 32, 4, 2, 1), nn.LeakyReLU(0.2),
            nn.Conv2d(32, 64, 4, 2, 1), nn.InstanceNorm2d(64), nn.LeakyReLU(0.2),
            nn.Conv2d(64, 1, 4, 1, 1),
        )  # fmt: skip

    @property
    def trained(self) -> nn.Module:
        return self

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        touch, image = (small(batch[name].float() / 255) for name in ("touch", "image"))
        made = self.generator(touch)
        # In one step: what fools the discriminator does not train it, and what it learns does not reach the generator.
        fixed = {name: value.detach() for name, value in self.discriminator.named_parameters()}
        fooled = functional_call(self.discriminator, fixed, torch.cat([touch, made], dim=1)).float()
        true, false = (self.discriminator(torch.cat([touch, shown], dim=1)).float() for shown in (image, made.detach()))
        told = self.criterion(true, torch.ones_like(true)) + self.criterion(false, torch.zeros_like(false))
        distance = F.l1_loss(made.float(), image)
        loss = self.criterion(fooled, torch.ones_like(fooled)) + self.weight * distance + 0.5 * told
        return {"loss": loss, "distance": distance.detach(), "told": told.detach()}

    @torch.no_grad()
    def draw(self, touch: Tensor) -> Tensor:
        """Pictures (N, 3, S, S) of touches, both in [0, 1]."""
        made = torch.cat([self.generator(small(part)).float() for part in touch.split(64)])
        return F.interpolate(0.5 * (made + 1), touch.shape[2:], mode="bilinear", antialias=True).clamp(0, 1)


def small(pixels: Tensor) -> Tensor:
    """(B, 3, S, S) in [0, 1] as networks take them, (B, 3, s, s) in [-1, 1]."""
    return 2 * F.interpolate(pixels, (SIDE, SIDE), mode="area") - 1


class Pix2Pix(nn.Module):
    """A U-Net of diffusers without its time."""

    def __init__(self) -> None:
        super().__init__()
        widths = (16, 32, 64, 96)
        self.unet = UNet2DModel(
            sample_size=SIDE, block_out_channels=widths, layers_per_block=1, norm_num_groups=8, add_attention=False,
            down_block_types=("DownBlock2D",) * len(widths), up_block_types=("UpBlock2D",) * len(widths),
        )  # fmt: skip

    def forward(self, touch: Tensor) -> Tensor:
        return self.unet(touch, 0, return_dict=False)[0].tanh()


class VisGel(nn.Module):
    """Residual blocks down to an eighth of the size and up again, as in diffusers' autoencoders."""

    def __init__(self) -> None:
        super().__init__()
        sizes: dict[str, Any] = {
            "block_out_channels": (16, 32, 64, 64), "layers_per_block": 1, "norm_num_groups": 8,
            "mid_block_add_attention": False,
        }  # fmt: skip
        self.down = Encoder(3, 64, ("DownEncoderBlock2D",) * 4, double_z=False, **sizes)
        self.up = Decoder(64, 3, ("UpDecoderBlock2D",) * 4, **sizes)

    def forward(self, touch: Tensor) -> Tensor:
        return self.up(self.down(touch)).tanh()


METHODS: dict[str, Callable[[], PairObjective]] = {
    "pix2pix": lambda: PairObjective(Pix2Pix(), F.binary_cross_entropy_with_logits, 100.0),
    "visgel": lambda: PairObjective(VisGel(), F.mse_loss, 100.0),
}
"""Both with the weight of the L1 that Isola et al. give it: a smaller one leaves `visgel` to its discriminator."""


def fitted(
    method: str, touches: Sequence[np.ndarray], images: Sequence[np.ndarray], steps: int, cache: Path, told: str,
    seed: int = 0,
) -> PairObjective:  # fmt: skip
    """A network of `METHODS`, trained on pairs or found in the cache; a training that was stopped goes on.

    Args:
        method: Of `METHODS`.
        touches, images: uint8 (N, 3, S, S) each, of one or several data sets.
        steps: Of the optimiser.
        cache: Folder of runs.
        told: What changes with the pairs.
        seed: Of weights and batches.

    Raises:
        SystemExit: If the training is stopped, with 130 by an interrupt; what is saved goes on in the next call.
    """
    torch.manual_seed(seed)
    network = METHODS[method]()
    config = TrainerConfig(
        steps=steps, batch_size=BATCH_SIZE, learning_rate=1e-3, warmup=20, weight_decay=0.0, mixed_precision="bf16",
        watch_every=0, save_every=100, trackers=[], seed=seed,
    )  # fmt: skip
    state = [told, repr(network), network.criterion.__name__, network.weight, SIDE, config.model_dump()]
    output = cache / f"{method}-{hashlib.sha256(json.dumps(state).encode()).hexdigest()[:16]}"
    if not (output / WEIGHTS).is_file():
        dataset = ArrayDataset(touch=touches, image=images)
        trainer = Trainer(network, dataset, ShuffledSampler(len(dataset), config.batch_size, seed), config, output)
        if checkpoints_in(output):
            trainer.resume()
        if not trainer.fit():
            raise SystemExit(INTERRUPTED if trainer.interrupted else 0)
        with replacing("output", output / WEIGHTS) as partial:
            save_file(network.state_dict(), partial)
    network.load_state_dict(load_file(output / WEIGHTS))
    return network.cpu().eval()
