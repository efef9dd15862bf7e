"""Stage 4, the autoencoder of pictures: diffusers' `AutoencoderDC` (Chen et al., 2025), which works below full
resolution from its first layer on, with an L1 + gradient loss.

    python -m unitouch_gen.training.image_vae --output runs/image_vae
"""

import torch
import torch.nn.functional as F
from diffusers import AutoencoderDC
from torch import Tensor, nn

from unitouch_gen.encoders import UniTouchProcessor
from unitouch_gen.training.core import Batch
from unitouch_gen.training.data import ArrayDataset
from unitouch_gen.training.sampler import ShuffledSampler
from unitouch_gen.training.stages import parse, train, training_splits, write_folder, write_record


class AutoencoderObjective(nn.Module):
    """Reconstruction of pictures from noisy latents.

    Args:
        vae: What is trained.
        gradient_weight: Of the L1 error of the picture's differences, for crisp edges.
        latent_noise: Standard deviation of noise on the latents, relative to theirs, so that the decoder forgives a
            generator its last errors.
        latent_weight: Of the latents' mean square, which keeps them bounded.
    """

    def __init__(self, vae: AutoencoderDC, gradient_weight: float, latent_noise: float, latent_weight: float):
        super().__init__()
        self.trained = vae
        self.gradient_weight, self.latent_noise, self.latent_weight = gradient_weight, latent_noise, latent_weight

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        pixels = to_signed(batch["image"])
        latents = self.trained.encode(pixels).latent.float()
        noise = self.latent_noise * latents.detach().std() * torch.randn_like(latents)
        restored = self.trained.decode(latents + noise).sample.float()
        error = F.l1_loss(restored, pixels)
        edges = sum(F.l1_loss(restored.diff(dim=dim), pixels.diff(dim=dim)) for dim in (2, 3))
        size = latents.square().mean()
        loss = error + self.gradient_weight * edges + self.latent_weight * size
        psnr = -10.0 * torch.log10(F.mse_loss(restored.detach(), pixels) / 4.0)  # on [0, 1]
        return {"loss": loss, "psnr": psnr, "latent": size.detach()}


def to_signed(pixels: Tensor) -> Tensor:
    """uint8 pixels -> [-1, 1]."""
    return pixels.float() / 127.5 - 1.0


@torch.no_grad()
def latent_scale(vae: AutoencoderDC, dataset: ArrayDataset, count: int = 2048) -> float:
    """1 / standard deviation of the latents (Rombach et al., 2022, appendix G)."""
    order = torch.randperm(len(dataset), generator=torch.Generator().manual_seed(0))[:count].tolist()
    latents = [
        vae.encode(to_signed(dataset.__getitems__(order[i : i + 128])["image"]).to(vae.device)).latent
        for i in range(0, len(order), 128)
    ]
    return 1.0 / torch.cat(latents).std().item()


def main() -> None:
    stage = parse("image_vae")
    torch.manual_seed(stage.trainer.seed)
    processor = UniTouchProcessor(image_size=stage.recipe["data"]["image_size"], audio=stage.recipe["data"]["audio"])
    dataset = ArrayDataset(image=[split.image for split in training_splits(stage, processor)])
    vae = AutoencoderDC(**stage.recipe["model"])
    sampler = ShuffledSampler(len(dataset), stage.trainer.batch_size, stage.trainer.seed)
    trainer = train(stage, AutoencoderObjective(vae, **stage.recipe["loss"]), dataset, sampler)
    vae.register_to_config(scaling_factor=latent_scale(vae, dataset))
    write_folder(stage.output / "model", lambda folder: vae.save_pretrained(folder))
    write_record(stage, trainer.seconds)


if __name__ == "__main__":
    main()
